"""`DynamicGrid`: belief in free, static and dynamic for every cell, and the velocity of dynamic cells.

>>> import numpy as np
>>> from ogm import GridSpec
>>> from ogm.dynamic_grid import DynamicGrid
>>> spec, nan = GridSpec(0.2, (4, 3), (0.0, 0.0)), np.float32(np.nan)
>>> mass = np.full((4, 3, 3), (0.1, 0.6, 0.0), np.float32)                  # free, static, dynamic
>>> grid = DynamicGrid(spec, mass, np.full((4, 3, 2), nan), np.full((4, 3, 2, 2), nan))
>>> round(float(grid.occupied[0, 0]), 3), round(float(grid.unknown[0, 0]), 3)
(0.6, 0.3)
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import check_mass
from ogm.evidence.arrays import refuse_masked
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid, SavedGrid, spec_of_arrays

__all__ = ["DynamicGrid"]

_COVARIANCE = {"velocity_covariance_xx": (0, 0), "velocity_covariance_xy": (0, 1), "velocity_covariance_yy": (1, 1)}


@dataclass(frozen=True, eq=False)
class DynamicGrid(SavedGrid):
    """Belief masses of free, static and dynamic, and the velocity of dynamic cells.

    Parameters
    ----------
    spec : GridSpec
    mass : (nx, ny, 3) float array
        Masses of free, static and dynamic, in [0, 1]. Their sum is at most 1; unknown is 1 minus the sum. Kept as
        float32.
    velocity : (nx, ny, 2) float array
        Mean velocity over ground of the dynamic mass, along the grid's x and y [m/s]; NaN where dynamic is 0.
    covariance : (nx, ny, 2, 2) float array
        Covariance of the velocity [m²/s²]; NaN where dynamic is 0.

    Raises
    ------
    TypeError
        If an array is not of floats, or masked.
    ValueError
        If a shape does not fit `spec`, a mass is NaN or negative, or a sum of masses exceeds 1 by more than 1e-6.
    """

    FORMAT: ClassVar[str] = "ogm.DynamicGrid/1"
    spec: GridSpec
    mass: NDArray[np.float32]
    velocity: NDArray[np.float32]
    covariance: NDArray[np.float32]

    def __post_init__(self) -> None:
        for name, last in (("mass", (3,)), ("velocity", (2,)), ("covariance", (2, 2))):
            refuse_masked(getattr(self, name), name)
            array = np.asarray(getattr(self, name))
            if array.dtype.kind != "f":
                raise TypeError(f"{name} must be a float array, got dtype {array.dtype}")
            wanted = (*self.spec.shape, *last)
            if array.shape != wanted:
                raise ValueError(f"{name} must have shape {wanted} for this spec, got {array.shape}")
            object.__setattr__(self, name, array.astype(np.float32, copy=False))
        check_mass(self.mass[..., :2])
        check_mass(np.stack([self.free, self.occupied], axis=-1))
        check_mass(np.stack([self.dynamic, self.static], axis=-1))

    @classmethod
    def trusted(
        cls, spec: GridSpec, mass: NDArray[np.float32], velocity: NDArray[np.float32], covariance: NDArray[np.float32]
    ) -> "DynamicGrid":
        """Make a grid without checks, for results of kernels that are masses by construction.

        Parameters as in the constructor; arrays must be float32 of the right shapes and are not copied.
        """
        grid = object.__new__(cls)
        grid.__dict__.update(spec=spec, mass=mass, velocity=velocity, covariance=covariance)
        return grid

    def check(self) -> None:
        """Check the arrays as the constructor does: for grids of `trusted` or with changed arrays, before writing."""
        type(self)(self.spec, self.mass, self.velocity, self.covariance)

    @property
    def free(self) -> NDArray[np.float32]:
        """Mass of free, (nx, ny) in [0, 1]."""
        return self.mass[..., 0]

    @property
    def static(self) -> NDArray[np.float32]:
        """Mass of occupied by a static object, (nx, ny) in [0, 1]."""
        return self.mass[..., 1]

    @property
    def dynamic(self) -> NDArray[np.float32]:
        """Mass of occupied by a dynamic object, (nx, ny) in [0, 1]."""
        return self.mass[..., 2]

    @property
    def occupied(self) -> NDArray[np.float32]:
        """Mass of occupied, (nx, ny) in [0, 1]: static + dynamic."""
        return self.static + self.dynamic

    @property
    def unknown(self) -> NDArray[np.float32]:
        """Mass of unknown, (nx, ny) in [0, 1]: 1 - free - occupied, at least 0."""
        unknown: NDArray[np.float32] = np.maximum(1 - self.free - self.occupied, 0)
        return unknown

    @property
    def speed(self) -> NDArray[np.float32]:
        """Length of `velocity`, (nx, ny) [m/s]."""
        return np.hypot(self.velocity[..., 0], self.velocity[..., 1])

    @property
    def heading(self) -> NDArray[np.float32]:
        """Direction of `velocity`, (nx, ny), counter-clockwise from the grid's x axis [rad], in (-π, π]."""
        return np.arctan2(self.velocity[..., 1], self.velocity[..., 0])

    def to_evidential(self) -> EvidentialGrid:
        """Return the masses of free and occupied, static and dynamic added."""
        return EvidentialGrid(self.spec, np.stack([self.free, self.occupied], axis=-1))

    def to_layers(self) -> LayeredGrid:
        """Return masses and velocities as named layers, for viewers and files of layers."""
        layers = {"free": self.free, "static": self.static, "dynamic": self.dynamic, "unknown": self.unknown}
        layers |= {"velocity_x": self.velocity[..., 0], "velocity_y": self.velocity[..., 1]}
        layers |= {name: self.covariance[..., i, j] for name, (i, j) in _COVARIANCE.items()}
        return LayeredGrid(self.spec, layers)

    @classmethod
    def from_layers(cls, layers: LayeredGrid) -> Self:
        """Return the grid of the layers of `to_layers`; unknown and further layers are not needed.

        Raises
        ------
        KeyError
            If a layer is missing.
        ValueError
            See the constructor.
        """
        mass = np.stack([layers[name] for name in ("free", "static", "dynamic")], axis=-1)
        velocity = np.stack([layers[name] for name in ("velocity_x", "velocity_y")], axis=-1)
        covariance = np.empty((*layers.spec.shape, 2, 2), np.float32)
        for name, (i, j) in _COVARIANCE.items():
            covariance[..., i, j] = covariance[..., j, i] = layers[name]
        return cls(layers.spec, mass, velocity, covariance)

    def __repr__(self) -> str:
        shares = (f"{name} {getattr(self, name).mean():.1%}" for name in ("free", "static", "dynamic", "unknown"))
        return f"DynamicGrid({self.spec}: {', '.join(shares)})"

    def __eq__(self, other: object) -> bool:
        """Return whether cells, masses, velocities and covariances are equal; NaN equals NaN."""
        if not isinstance(other, DynamicGrid):
            return NotImplemented
        return self.spec == other.spec and all(
            np.array_equal(getattr(self, name), getattr(other, name), equal_nan=True)
            for name in ("mass", "velocity", "covariance")
        )

    __hash__: ClassVar[None] = None  # type: ignore[assignment]

    def arrays(self) -> dict[str, ArrayLike]:
        """Return the arrays of the file: see `EvidentialGrid.arrays`; with ``velocity`` and ``covariance``."""
        self.check()
        axes = "[ix (x forward), iy (y left), state, or x and y]; origin is the corner of cell (0, 0)"
        cells = {name: getattr(self, name) for name in ("mass", "velocity", "covariance")}
        return {"states": ["free", "static", "dynamic"], "axes": axes, **self._place(), **cells}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """See `SavedGrid.of_arrays`."""
        spec = spec_of_arrays(arrays, arrays["mass"].shape)
        return cls(spec, arrays["mass"], arrays["velocity"], arrays["covariance"])
