"""Heights of the ground over time: one Kalman filter per cell, in a window that moves with the vehicle.

Source: Fankhauser, Bloesch and Hutter, "Probabilistic terrain mapping for mobile robots with uncertain localization"
(2018); the drift of heights is estimated here from the overlap of scan and map.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.fusion.lookup import ScanLookup, gather
from ogm.fusion.mapper import MapLock, locked
from ogm.fusion.update_gate import CheckedScan, UpdateGate
from ogm.fusion.window import Window, WindowMode
from ogm.geometric.heights import HEIGHT_LAYERS
from ogm.grid import GridSpec, LayeredGrid

_SLOPE_REACH = 0.5  # [m] to either side of a cell over which its slope is measured
_CONTRADICTION = 3.0  # [standard deviations] height difference that counts as a contradiction
_CORRELATED_CELLS = 50  # neighbouring cells whose heights have a common error
_MIN_SHARED_CELLS = 200  # cells that scan and map must share for an estimate of the drift
HEIGHT, PRECISION, LATEST = 0, 1, 2  # indices in a cell: [m], [1/m2], and from 2 on 1 + value of the last four layers


class ElevationMapper:
    """Map of ground heights and variances, with the newest step, roughness, obstacles and clearance.

    The height of a cell is constant up to process noise. A measured height that differs by more than three standard
    deviations first raises the variance of the cell to the square of the difference.

    Parameters
    ----------
    spec : GridSpec
        Cells and extent of the window, see `EvidentialMapper`.
    drift : float
        Drift of the poses' heights, a random walk: the standard deviation after s metres of travel is
        ``drift * sqrt(s)`` [m].
    estimate_drift : bool
        With True, the drift is estimated by the median difference between scan and map, and removed: heights keep the
        reference of the first scans. With False, the variance of all cells grows by ``drift**2`` per metre of travel.
    process_noise : float
        Growth of the variance of a cell with time [m2/s].
    independent_scans : float
        Greatest precision of a cell, in multiples of the precision of a single scan, at least 1. Scans from nearby
        poses share the errors of gaps and calibration, so they are not all independent. Infinity is the plain Kalman
        filter.
    window, max_speed, max_delay
        See `EvidentialMapper`.

    Raises
    ------
    ValueError
        If a number is out of its range.
    """

    drift: float
    estimate_drift: bool
    process_noise: float
    independent_scans: float

    def __init__(
        self,
        spec: GridSpec,
        *,
        drift: float = 0.01,
        estimate_drift: bool = True,
        process_noise: float = 1e-6,
        independent_scans: float = 4.0,
        window: WindowMode = "rolling",
        max_speed: float = 70.0,
        max_delay: float = 0.5,
    ) -> None:
        if not (0 <= drift < math.inf and 0 <= process_noise < math.inf):
            raise ValueError(f"drift and process_noise must be 0 or more and finite, got {drift} and {process_noise}")
        if not independent_scans >= 1:
            raise ValueError(f"independent_scans must be at least 1, got {independent_scans}")
        self.drift, self.estimate_drift, self.process_noise = float(drift), estimate_drift, float(process_noise)
        self.independent_scans = float(independent_scans)
        self.lock, self._window = MapLock(), Window(spec, window)
        self._gate = UpdateGate(max_speed, max_delay, needs_stamps=process_noise > 0)
        self._cells = np.zeros((*spec.shape, 6), np.float32)
        self._clear()

    def _clear(self) -> None:
        self._offset, self._offset_variance = 0.0, 0.0
        self._level: float | None = None  # height of the first pose: float32 resolves millimetres relative to it

    @property
    @locked
    def spec(self) -> GridSpec:
        """The window's cells now, in map coordinates."""
        return self._window.spec

    @property
    @locked
    def scans(self) -> int:
        """Number of scans in the map."""
        return self._gate.scans

    @property
    @locked
    def height_offset(self) -> tuple[float, float]:
        """Estimated error of the newest pose's height [m], and its variance [m2]."""
        return self._offset, self._offset_variance

    @locked
    def update(
        self,
        layers: LayeredGrid,
        T_map_vehicle: ArrayLike,  # noqa: N803
        stamp: float | None = None,
    ) -> None:
        """Move the window to the vehicle and fuse the heights of a scan.

        Parameters
        ----------
        layers : LayeredGrid
            Height layers of the scan, see `ogm.geometric.height_layers`.
        T_map_vehicle : (4, 4) array
            Pose of the vehicle in the map, heights included [m]; `layers` are in the vehicle frame. For a `Frame` it is
            ``frame.T_map_sensor @ inverse(frame.mount.T_vehicle_sensor)``.
        stamp : float
            Time of the scan [s]; optional without process noise.

        Raises
        ------
        KeyError
            If a layer is missing.
        PoseJump, StampJump, ValueError
            See `Mapper.update`.
        """
        scan = self._gate.check(self._window, layers.spec, T_map_vehicle, stamp, None)
        before, T = self._gate.T_map_vehicle, np.asarray(T_map_vehicle, np.float64)
        travelled = 0.0 if before is None else math.dist(before[:3, 3].tolist(), scan.T_map_vehicle[:3, 3].tolist())
        self._window.move_to(scan.corner, self._cells)
        if self._level is None:
            self._level = float(T[2, 3])

        # Heights of the scan in the map, at the cells of the window
        x, y = layers.spec.cell_centers
        z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * layers["ground_height"] + (T[2, 3] - self._level)
        variance = layers["ground_variance"]
        known = np.isfinite(z) & (variance > 0)
        measured = self._gathered(np.where(known, z, 0), np.where(known, variance, 0), scan)
        z, variance = measured[..., 0], measured[..., 1]
        seen = variance > 0

        # Age the map, and remove the drift
        walk = self.drift**2 * travelled
        growth = self.process_noise * abs(scan.elapsed) + (0.0 if self.estimate_drift else walk)
        height, precision = self._cells[..., HEIGHT], self._cells[..., PRECISION]
        precision /= 1 + np.float32(growth) * precision
        both = seen & (precision > 0)
        if self.estimate_drift:
            self._offset_variance += walk
            self._estimate_offset((z - height)[both])
            z, variance = z - np.float32(self._offset), variance + np.float32(self._offset_variance)

        # Kalman filter of each cell; a contradiction raises the variance
        difference = z - height
        spread = np.where(both, 1 / np.where(both, precision, 1), 0)
        far = both & (difference**2 > _CONTRADICTION**2 * (spread + variance))
        precision[far] = 1 / difference[far] ** 2
        added = np.where(seen, 1 / np.where(seen, variance, 1), 0).astype(np.float32)
        new = precision + added
        height += difference * added / np.where(seen, new, 1)
        max_precision = np.maximum(precision, np.minimum(np.float32(self.independent_scans), 1e9) * added)
        precision[:] = np.minimum(new, max_precision)

        # Other layers: the last values
        for k in (0, 2):
            first, second = (np.nan_to_num(layers[name] + 1) for name in HEIGHT_LAYERS[3 + k : 5 + k])
            latest = self._gathered(first, second, scan)
            kept = self._cells[..., LATEST + k : LATEST + k + 2]
            np.copyto(kept, latest, where=latest > 0)
        self._gate.accept(scan)

    def _gathered(
        self, first: NDArray[np.floating], second: NDArray[np.floating], scan: CheckedScan
    ) -> NDArray[np.float32]:
        """Return two layers of a scan at the cells of the buffer, (nx, ny, 2), 0 outside."""
        out, pair = np.empty((*self._cells.shape[:2], 2), np.float32), np.stack([first, second], -1).astype(np.float32)
        gather(ScanLookup(pair, scan.affine, 1), self._window.ring, out.reshape(out.shape[0], -1))
        return out

    def _estimate_offset(self, differences: NDArray[np.float32]) -> None:
        """Update the estimated height error of the pose from differences between scan and map [m]."""
        if len(differences) < _MIN_SHARED_CELLS:
            return
        middle = float(np.median(differences))
        deviation = 1.4826 * float(np.median(np.abs(differences - middle)))
        noise = (deviation**2 + 1e-6) * _CORRELATED_CELLS / len(differences)
        gain = self._offset_variance / (self._offset_variance + noise)
        self._offset += gain * (middle - self._offset)
        self._offset_variance *= 1 - gain

    @locked
    def reset(self) -> None:
        """Forget everything: the next scan begins a new map."""
        self._cells[:] = 0
        self._window.corner = (0, 0)
        self._gate.clear()
        self._clear()

    @property
    @locked
    def layers(self) -> LayeredGrid:
        """The layers of `ogm.geometric.height_layers` in map coordinates; the slope is that of the map's heights."""
        cells = self._window.unrolled(self._cells)
        known = cells[..., PRECISION] > 0
        height = np.where(known, cells[..., HEIGHT] + (self._level or 0.0), np.nan)
        variance = np.where(known, 1 / np.where(known, cells[..., PRECISION], 1), np.nan)
        latest = np.where(cells[..., LATEST:] > 0, cells[..., LATEST:] - 1, np.nan)
        found = (height, variance, _slope(height, self._window.spec0.resolution), *np.moveaxis(latest, -1, 0))
        return LayeredGrid(self.spec, dict(zip(HEIGHT_LAYERS, found, strict=True)))

    def __repr__(self) -> str:
        drift = "estimated" if self.estimate_drift else f"{self.drift:g} m after 1 m"
        return f"ElevationMapper(drift {drift}, {self.scans} scans, {self.spec})"


def _slope(height: NDArray[np.floating], resolution: float) -> NDArray[np.floating]:
    """Return the inclination [rad] from the rise over `_SLOPE_REACH` to both sides, or to the known side alone."""
    reach = max(round(_SLOPE_REACH / resolution), 1)
    squares = np.zeros(height.shape)
    for axis in (0, 1):
        padded = np.pad(height, [(reach, reach) if k == axis else (0, 0) for k in (0, 1)], constant_values=np.nan)
        sides = [np.moveaxis(padded, axis, 0)[s : s + height.shape[axis]] for s in (0, 2 * reach)]
        low, high = (np.moveaxis(side, 0, axis) for side in sides)
        count = np.isfinite(low).astype(int) + np.isfinite(high)
        rise = np.where(np.isfinite(high), high, height) - np.where(np.isfinite(low), low, height)
        squares += np.where(count > 0, rise / (np.maximum(count, 1) * reach * resolution), np.nan) ** 2
    return np.arctan(np.sqrt(squares))
