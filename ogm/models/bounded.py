"""A sensor model with less belief in free, so that a guarantee of false free holds.

>>> from ogm import GridSpec, Mount, load_model
>>> from ogm.models.bounded import BoundedISM
>>> from ogm.models.fitted import Guarantee
>>> ray = load_model("ray", GridSpec.centered(), Mount(1.9))
>>> BoundedISM(ray, Guarantee(0.01, 0.9, 0.6, drives=12), "ray").spec == ray.spec
True
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ogm.grid import Combine, CombinedGrid, EvidentialGrid, GridSpec, PartialGrid
from ogm.models.fitted import Guarantee
from ogm.scan import InverseSensorModel, Scan, as_scan


@dataclass(frozen=True)
class DiscountedFree:
    """Function that combines the masses of several models, and multiplies the mass of free by a factor.

    Attributes
    ----------
    combine : function
        See `ogm.CombinedGrid`.
    factor : float
        In [0, 1]; the removed mass becomes unknown (Shafer's discounting, of one state).
    """

    combine: Combine
    factor: float

    def __call__(self, masses: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the combined masses, (..., 2), with discounted free."""
        return discounted_free(self.combine(masses), self.factor)


def discounted_free(mass: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """Return masses of free and occupied, (..., 2), with the mass of free multiplied by a factor in [0, 1]."""
    return mass * np.array([factor, 1.0], np.float32)


@dataclass(frozen=True, eq=False)
class BoundedISM:
    """A sensor model whose mass of free is multiplied by the factor of a guarantee.

    Maps combine the models of `ogm.models.CombinedISM` first, and discount the result when they are read.

    Parameters
    ----------
    model : InverseSensorModel
    guarantee : Guarantee
    name : str
        Name of the model, for `EvidentialGrid.meta`.
    """

    model: InverseSensorModel
    guarantee: Guarantee
    name: str

    @property
    def spec(self) -> GridSpec:
        """Cells of the model's grids."""
        return self.model.spec

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Return the grid of a scan; its ``meta["guarantee"]`` states the bound."""
        return self.bounded(self.model(as_scan(scan)))

    def bounded(self, grid: EvidentialGrid) -> EvidentialGrid:
        """Return a grid of the model with discounted free."""
        factor, meta = self.guarantee.factor, grid.meta | {"guarantee": f"{self.name}: {self.guarantee}"}
        if isinstance(grid, CombinedGrid):
            combined = CombinedGrid.of_parts(grid.spec, grid.parts, DiscountedFree(grid.combine, factor))
            return combined.with_meta(meta)
        corner, mass = grid.known
        return PartialGrid.of(grid.spec, corner, discounted_free(mass, factor), in_plane=grid.in_plane).with_meta(meta)
