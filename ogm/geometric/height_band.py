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

    Cells with returns between `z_min` and `z_max` above ground are occupied, cells between them and the sensor are
    free, and the rest is unknown (van Kempen et al. 2021, Sec. VI-A). Ground returns and returns above the band are
    ignored, as in the paper, so a ray without an obstacle clears nothing. `RayISM` uses them.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill, in the vehicle frame; must hold the sensor.
    mount : Mount, optional
        Mount of the sensor; by default the mount of each scan, `Scan.mount`.
    z_min, z_max : float
        Ends of the band above ground [m]; 0.5 and 2.0 in the paper.
    evidence : float
        Dirichlet evidence e of an observed cell, greater than 0; its mass is e / (e + 2), by default 0.83. The paper
        gives no number. Its released code has e = 1, a mass of 1/3: see `as_released`.
    min_range : float
        Returns at a smaller distance (in 3D) are ignored [m].
    drop_ego_returns : bool
        Whether to ignore returns from the ego footprint of the mount; the paper does not.
    supersampling : int
        Number of smaller cells per cell and axis on which states are drawn; their evidence is averaged.

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
        """Return the model of the paper's released code, for a sensor-centred grid of its *output* cells.

        Settings of ``naive_geometric_ISM`` in EviLOG: a mount 1.61 m above flat ground, so the band is -1.11 to 0.39 m
        in the sensor frame; returns nearer than 3 m ignored; evidence 1, so no mass exceeds 1/3; states drawn on cells
        of half the size and averaged, so masses have quarter steps. The paper's grid is
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
            Vacuous if no return is in the band.
        """
        log_compilation(height_band_states)
        scan, fine = as_scan(scan), self.spec.refined(self.supersampling)
        mount = mount_in_grid(scan, self.spec, self.mount)
        x, y, ground = mount.ground_point

        # Points in the vehicle frame
        footprint = mount.ego_footprint if self.drop_ego_returns else NO_FOOTPRINT
        points = Points(*to_vehicle_frame(scan.points, mount, footprint).T)

        # Returns in the band mark their cells; lines from the sensor clear the cells before
        i, j = fine.index(x, y, unbounded=True)
        start = min(int(i), fine.shape[0] - 1), min(int(j), fine.shape[1] - 1)
        cells = Cells(*fine.origin, fine.resolution)
        band = HeightBand(ground + self.z_min, ground + self.z_max, float(self.min_range))
        state = height_band_states(points, mount.origin.astype(np.float32), start, cells, fine.shape, band)

        # States to masses
        mass = state_mass(state, float(self.evidence), int(self.supersampling))
        return EvidentialGrid.trusted(self.spec, mass)
