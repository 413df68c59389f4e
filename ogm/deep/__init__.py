"""Deep inverse sensor model `DeepISM`, its networks, losses and training.

The model runs exported networks without torch. The other names here need torch and are loaded on first use.

>>> import numpy as np
>>> from ogm import Mount, Scan
>>> from ogm.deep import DeepISM
>>> deep = DeepISM.load("lite", mount=Mount(sensor_height=1.9))             # weights in the package
>>> deep(Scan(np.zeros((0, 4), np.float32))).mass.shape
(512, 352, 2)
"""

import importlib
from typing import TYPE_CHECKING

from ogm.deep.ism import DeepISM
from ogm.extras import install_line

if TYPE_CHECKING:
    from ogm.deep.network import LITE, PAPER, NetworkConfig, PillarNetwork

__all__ = ["LITE", "PAPER", "DeepISM", "NetworkConfig", "PillarNetwork"]


def __getattr__(name: str) -> object:
    """Load a name of `ogm.deep.network` on first use."""
    if name not in __all__:
        raise AttributeError(f"module 'ogm.deep' has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module("ogm.deep.network"), name)
    except ImportError as error:
        raise ImportError(
            f"{name} needs a package that is missing ({error}): {install_line('train')}; on a machine without an "
            "NVIDIA GPU install PyTorch's CPU build first"
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
