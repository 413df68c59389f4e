"""The paper's baseline: a height band on flat ground."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.inputs import check_sensor_in_grid, check_within, mount_in_grid, to_vehicle_frame
from ogm.geometric.kernels.arguments import Cells, HeightBand, Points
from ogm.geometric.kernels.lines import height_band_states, state_mass
from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import log_compilation
from ogm.scan import Mount, Scan, as_scan

NO_FOOTPRINT = (0.0, 0.0, 0.0, 0.0)


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
    mount : Mount, optional
        Where the sensor is mounted; by default each scan's own, `Scan.mount`.
    z_min, z_max : float
        The band [m above ground], 0.5 and 2.0 in the paper.
    evidence : float
        Dirichlet evidence e of an observed cell; its mass is e / (e + 2). The paper gives no number; 10 gives
        0.83. Its code has 1, which gives 1/3: see `as_released`.
    min_range : float
        Returns nearer than this are ignored [m, 3D].
    drop_ego_returns : bool
        Ignore returns from the mount's ego footprint; the paper does not.
    supersampling : int
        The state is drawn on cells this many times smaller, and their evidence averaged.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sensor lies outside the grid.
    """

    spec: GridSpec
    mount: Mount | None = None
    z_min: float = 0.5
    z_max: float = 2.0
    evidence: float = 10.0
    min_range: float = 0.0
    drop_ego_returns: bool = False
    supersampling: int = 1

    def __post_init__(self) -> None:
        check_sensor_in_grid(self.spec, self.mount)
        if not self.z_min < self.z_max:
            raise ValueError(f"z_min must lie below z_max, got {self.z_min} and {self.z_max}")
        check_within("evidence", self.evidence, 0, math.inf)
        check_within("min_range", self.min_range, -1e-9, math.inf)
        self.spec.refined(self.supersampling)

    @classmethod
    def as_released(cls, spec: GridSpec) -> Self:
        """Reproduce what the paper's released code does, for a sensor-centred grid of its *output* cells.

        That is (EviLOG, ``naive_geometric_ISM``): a mount 1.61 m above flat ground, so that the band is -1.11
        to 0.39 m in the sensor's frame; returns nearer than 3 m ignored; evidence 1, hence no mass above
        1/3; drawn on cells of half the size and resized, hence quarter steps. For the paper's set-up give
        ``GridSpec.centered(81.92, 56.32, 0.32)``.
        """
        return cls(spec, Mount(sensor_height=1.61), evidence=1.0, min_range=3.0, supersampling=2)

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Map one scan.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Uses x, y, z. NaN and inf rows are dropped and counted in the log.

        Returns
        -------
        EvidentialGrid
            Vacuous if no point is in the band.
        """
        log_compilation(height_band_states)
        scan, fine = as_scan(scan), self.spec.refined(self.supersampling)
        mount = mount_in_grid(scan, self.spec, self.mount)
        x, y, ground = mount.ground_point

        # Points in the vehicle frame
        footprint = mount.ego_footprint if self.drop_ego_returns else NO_FOOTPRINT
        points = Points(*to_vehicle_frame(scan.points, mount, footprint).T)

        # Returns in the band mark their cells, lines from the sensor clear those before
        i, j = fine.index(x, y, unbounded=True)
        start = min(int(i), fine.shape[0] - 1), min(int(j), fine.shape[1] - 1)
        cells = Cells(*fine.origin, fine.resolution)
        band = HeightBand(ground + self.z_min, ground + self.z_max, float(self.min_range))
        state = height_band_states(points, mount.origin.astype(np.float32), start, cells, fine.shape, band)

        # States to masses
        mass = state_mass(state, float(self.evidence), int(self.supersampling))
        return EvidentialGrid.trusted(self.spec, mass)
