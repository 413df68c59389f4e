"""Colour maps for numbers: matplotlib's "inferno" and "viridis" (Smith and van der Walt), and "turbo" (Mikhailov)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# 52 evenly spaced colours each; interpolation is within 1.2 / 255 of the original.
_MAPS = {
    "inferno": bytes.fromhex(
        "00000402020c0504170a072210092d160b391e0c45260c512f0a5b380962400a67490b6a510e6c59106e61136e69166e71196e78"
        "1c6d801f6c88226a902568982766a02a63a82e5fb0315bb73557bf3952c63d4dcc4248d34743d94d3ddf5337e45a31e9612bed69"
        "25f1711ff47918f78212f98b0bfa9407fb9d07fca60cfcb014fbba1ffac42af8cd37f6d746f4e156f2ea69f2f27df5f992fcffa4"
    ),
    "viridis": bytes.fromhex(
        "44015446085c471063481769481d6f482475472a7a46307e453781433d844142873f48893d4e8a3a538b38598c355e8d33638d31"
        "688e2e6d8e2c718e2a768e297b8e27808e25848e23898e218e8d20928c1f978b1e9c891fa18821a58524aa8328ae802eb37c35b7"
        "793dbc7446c06f50c46a5ac86465cb5e70cf577cd25089d54895d840a2da37b0dd2fbddf26cae11fd8e219e5e419f1e51dfde725"
    ),
    "turbo": bytes.fromhex(
        "30123b36215f3b2f803f3e9c424bb54559cb4666dd4773eb4680f6458cfd4099ff38a5fb2fb2f427bee91fc9dd1ad4d018ddc21a"
        "e4b622ebaa2ff19b3ff68a52fa7a65fd6979fe598bff4b9cfe40a9fb39b7f735c3f134d0ea34dbe236e5d938eecf3af5c53afaba"
        "39fdae35fea130fe932afc8423f9751df46617ef5811e84b0ce14109d83706ce2d04c32503b71d02a916019b0f018b09027a0403"
    ),
}


def colour_map(name: str, values: NDArray[Any]) -> NDArray[np.float64]:
    """Return red, green, blue [0, 1] of values in [0, 1] by a colour map, (..., 3)."""
    colours = np.frombuffer(_MAPS[name], np.uint8).reshape(-1, 3) / 255
    at = np.clip(values, 0, 1) * (len(colours) - 1)
    return np.stack([np.interp(at, np.arange(len(colours)), part) for part in colours.T], axis=-1)
