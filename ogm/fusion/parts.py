"""Parts of a map, one per sensor model, each fused separately: their arrays, and their bands in files."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.kernels import BLOCK, BeliefLayers
from ogm.fusion.mapper import CONFLICT_LAYERS
from ogm.grid import LayeredGrid
from ogm.io.grids.placed import MODEL_LAYER

PLAIN = 0  # key of the part of scans of one model; parts of several models have keys 1, 2, ...
PLANE = -1  # key of the part of scans that are free in a plane only
_NAMES = {PLAIN: "rest", PLANE: "plane"}  # names of parts in files; further parts are model1, model2, ...
_BANDS = ("free", "occupied"), CONFLICT_LAYERS


class PartLayers(NamedTuple):
    """Masses and conflict of a part, (nx, ny, 2), and the time to which blocks of cells have aged [s]."""

    mass: NDArray[np.float32]
    conflict: NDArray[np.float32]
    aged: NDArray[np.float64]

    @classmethod
    def empty(cls, shape: tuple[int, int], now: float) -> "PartLayers":
        """Return a part without belief."""
        mass, conflict = np.zeros((2, *shape, 2), np.float32)
        return cls(mass, conflict, np.full((shape[0], -(-shape[1] // BLOCK)), now))

    def copy(self) -> "PartLayers":
        """Return a deep copy."""
        return PartLayers(self.mass.copy(), self.conflict.copy(), self.aged.copy())

    @property
    def rows(self) -> BeliefLayers:
        """View of the arrays in the form that kernels take."""
        nx, ny = self.mass.shape[:2]
        return BeliefLayers(self.mass.reshape(nx, 2 * ny), self.conflict.reshape(nx, 2 * ny), self.aged)


def bands_of_parts(
    parts: Mapping[int, tuple[NDArray[np.float32], NDArray[np.float32]]],
) -> dict[str, NDArray[np.float32]]:
    """Return masses and conflict, (nx, ny, 2), of parts of a map as bands such as ``model1_free``."""
    return {
        f"{_NAMES.get(number, f'model{number}')}_{name}": array[..., k]
        for number, part in parts.items()
        for array, names in zip(part, _BANDS, strict=True)
        for k, name in enumerate(names)
    }


def parts_of_bands(bands: LayeredGrid, ring: tuple[int, int]) -> tuple[PartLayers, dict[int, PartLayers]]:
    """Return a whole map, and its parts if the bands contain them, at time 0.

    Parameters
    ----------
    bands : LayeredGrid
        Bands on the cells of the window. Missing bands and NaN are 0.
    ring : (int, int)
        See `ogm.fusion.window.Window.ring`.
    """

    def part_of(prefix: str) -> PartLayers:
        part = PartLayers.empty(bands.spec.shape, 0.0)
        for array, names in zip(part[:2], _BANDS, strict=True):
            for k, name in enumerate(names):
                if f"{prefix}{name}" in bands.layers:
                    array[..., k] = np.roll(np.nan_to_num(bands[f"{prefix}{name}"]), ring, axis=(0, 1))
        return part

    numbers = {name: number for number, name in _NAMES.items()}
    found = sorted({name.partition("_")[0] for name in bands.layers if MODEL_LAYER.fullmatch(name)})
    parts = {
        numbers[name] if name in numbers else int(name.removeprefix("model")): part_of(f"{name}_") for name in found
    }
    return part_of(""), parts


def continued_parts(
    whole: PartLayers, parts: dict[int, PartLayers], measured: Collection[int]
) -> dict[int, PartLayers]:
    """Return the parts of a saved map into which scans are fused.

    Parameters
    ----------
    whole : PartLayers
        The map as a whole.
    parts : dict of int to PartLayers
        Parts of the map, if the file contains them.
    measured : collection of int
        Parts to which the first scan belongs.

    Returns
    -------
    dict of int to PartLayers
        `parts` if the map and the scan have the same models. Without `parts`, `whole` is the part of a scan of one
        model. In all other cases `whole` is a separate part.
    """
    if parts and {key for key in parts if key > PLAIN} == {key for key in measured if key > PLAIN}:
        return parts
    return {next(iter(measured)) if len(measured) == 1 and not parts else PLAIN: whole}
