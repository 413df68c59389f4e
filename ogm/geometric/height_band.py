"""The paper's baseline: a height band on flat ground."""

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.geometric.core.lines import height_band_states, state_mass
from ogm.geometric.mount import Frame, Mount, check_box, check_within, mount_sensor, own_points, scratch
from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["HeightBandISM"]

NO_BOX = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class HeightBandISM:
    """The paper's geometric baseline: a height band on flat ground.

    Cells with returns between `z_min` and `z_max` above ground are occupied, cells between the sensor and
    these are free, the rest is unknown (van Kempen et al. 2021, Sec. VI-A). Ground returns and returns above the
    band are ignored, so that a ray without an obstacle clears nothing: that is the paper's text, and what
    `RayISM` does better.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill, in the vehicle frame; must hold the sensor.
    sensor_height : float
        Of the sensor above ground [m].
    T_vehicle_sensor : (4, 4) array, optional
        Pose of the sensor in the frame of the grid; identity if the grid is centred on the sensor.
    points_in : {"sensor", "vehicle"}
        Frame of the points. Rays start at the sensor in either case.
    z_min, z_max : float
        The band [m above ground], 0.5 and 2.0 in the paper.
    evidence : float
        Dirichlet evidence e of an observed cell; its mass is e / (e + 2). The paper does not say; 10 gives
        0.83. Its code has 1, which gives 1/3: see `as_released`.
    min_range : float
        Returns nearer than this are ignored [m, 3D].
    own_box : (float, float, float, float)
        Returns with x_min < x < x_max, y_min < y < y_max in the vehicle frame [m] are the own vehicle's and
        ignored; none by default, as in the paper.
    supersampling : int
        The state is drawn on cells this many times smaller, and their evidence averaged.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sensor lies outside the grid.
    """

    spec: GridSpec
    sensor_height: float
    T_vehicle_sensor: ArrayLike | None = None
    points_in: Frame = "sensor"
    z_min: float = 0.5
    z_max: float = 2.0
    evidence: float = 10.0
    min_range: float = 0.0
    own_box: tuple[float, float, float, float] = NO_BOX
    supersampling: int = 1
    _mount: Mount = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "_mount", mount_sensor(self.spec, self.sensor_height, self.T_vehicle_sensor, self.points_in)
        )
        if not self.z_min < self.z_max:
            raise ValueError(f"z_min must lie below z_max, got {self.z_min} and {self.z_max}")
        check_within("evidence", self.evidence, 0, math.inf)
        check_within("min_range", self.min_range, -1e-9, math.inf)
        object.__setattr__(self, "own_box", check_box(self.own_box))
        self.spec.refined(self.supersampling)

    @classmethod
    def as_released(cls, spec: GridSpec) -> Self:
        """Reproduce what the paper's released code does, for a sensor-centred grid of its *output* cells.

        That is (EviLOG, ``naive_geometric_ISM``): a mount 1.61 m above flat ground, so that the band is -1.11
        to 0.39 m in the sensor's frame; returns nearer than 3 m ignored; evidence 1, hence no mass above
        1/3; drawn on cells of half the size and resized, hence quarter steps. For the paper's set-up give
        ``GridSpec.centered(81.92, 56.32, 0.32)``.
        """
        return cls(spec, sensor_height=1.61, evidence=1.0, min_range=3.0, supersampling=2)

    def __call__(self, points: NDArray[np.float32]) -> EvidentialGrid:
        """Map one scan.

        Parameters
        ----------
        points : (N, 4) float32
            x, y, z [m], intensity [0, 1] (not used). NaN and inf rows are dropped and counted in the log.

        Returns
        -------
        EvidentialGrid
            Vacuous if no point is in the band.
        """
        xyz = own_points(points, self._mount, self.own_box)
        fine = self.spec.refined(self.supersampling)
        state = scratch("state", fine.shape, np.uint8)
        state[:] = 0
        ground = self._mount.foot[2]
        height_band_states(
            *xyz.T,
            self._mount.origin,
            *(min(int(k), n - 1) for k, n in zip(fine.index(*self._mount.foot[:2]), fine.shape, strict=True)),
            ground + self.z_min,
            ground + self.z_max,
            self.min_range,
            *fine.origin,
            fine.resolution,
            state,
            scratch("ends", (min(len(xyz), state.size), 2), np.int32),
        )
        mass = np.empty((*self.spec.shape, 2), np.float32)
        state_mass(state, self.evidence, self.supersampling, mass)
        return EvidentialGrid.trusted(self.spec, mass)
