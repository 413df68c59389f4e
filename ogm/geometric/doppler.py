"""Sensor velocity, moving detections and radial velocities from the Doppler of a scan.

>>> import numpy as np
>>> from ogm import Scan
>>> from ogm.geometric.doppler import sensor_velocity
>>> azimuth = np.linspace(-1, 1, 50)
>>> directions = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
>>> scan = Scan(20 * directions.astype(np.float32), doppler=-8.0 * np.cos(azimuth))
>>> sensor_velocity(scan).round(3)     # [m/s]: forward, past static objects
array([8., 0.])
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.inputs import in_footprint
from ogm.pose import rotate
from ogm.scan import Mount, Scan

__all__ = [
    "DirectionSectors", "RadialVelocities", "direction_sectors", "moving_detections", "nearest_in_direction",
    "radial_velocities", "sensor_velocity", "unfolded",
]  # fmt: skip

PAIRS = 128  # pairs of detections that give first guesses of the velocity
MIN_DETECTIONS = 5  # for an estimate of the velocity
MAX_SPEED = 60.0  # [m/s] greatest velocity tried with folded Doppler
MAX_GUESS_DETECTIONS = 1000  # detections used for first guesses with folded Doppler
FOLDED_GUESSES = 8  # guesses refined with folded Doppler
GATE = 3  # a detection moves if its speed over ground exceeds this number of standard deviations


class RadialVelocities(NamedTuple):
    """Radial velocities of moving points, for `ogm.fusion.DynamicMapper.update`.

    Attributes
    ----------
    xy : (N, 2) float64
        Positions in the frame of the measurement grid [m].
    direction : (N, 2) float64
        Unit vectors from the sensor to the positions.
    speed : (N,) float64
        Velocity over ground along the direction, positive away from the sensor [m/s].
    deviation : (N,) float64
        Standard deviation of the speed, above 0 [m/s].
    extent : (N, 2) float64
        Standard deviations of the position along and across the direction, above 0 [m].
    dense : bool
        Whether the measurement grid shows the shapes of objects, as a lidar with Doppler does. Only groups of cells of
        dense scans are matched from scan to scan. Change it by ``_replace(dense=True)``.
    """

    xy: NDArray[np.float64]
    direction: NDArray[np.float64]
    speed: NDArray[np.float64]
    deviation: NDArray[np.float64]
    extent: NDArray[np.float64]
    dense: bool = False

    @classmethod
    def empty(cls) -> "RadialVelocities":
        """Return an instance without rows, of a sparse scan."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 2)))

    def checked(self) -> "RadialVelocities":
        """Check the columns, and return them as float64 arrays.

        Raises
        ------
        ValueError
            If a column has another shape, a number is not finite, a deviation or extent is not above 0, or a direction
            is no unit vector.
        """
        scalars = (np.size(self.speed),)
        vectors = (*scalars, 2)
        columns = []
        for name, shape in zip(self._fields, (vectors, vectors, scalars, scalars, vectors), strict=False):
            column = np.asarray(getattr(self, name), np.float64)
            if column.shape != shape:
                raise ValueError(f"{name} of radial velocities must have shape {shape}, got {column.shape}")
            if not np.isfinite(column).all():
                raise ValueError(f"{name} of radial velocities must be finite; leave out the other detections")
            if name in ("deviation", "extent") and not (column > 0).all():
                raise ValueError(f"{name} of radial velocities must be above 0, got {column.min()}")
            columns.append(column)
        xy, direction, speed, deviation, extent = columns
        if not (np.abs(np.hypot(*direction.T) - 1) < 1e-3).all():
            raise ValueError("direction of radial velocities must be unit vectors; divide by their lengths")
        return RadialVelocities(xy, direction, speed, deviation, extent, bool(self.dense))

    def moved(self, T: NDArray[np.float64]) -> "RadialVelocities":
        """Transform to another frame and project along its vertical axis; `T` (4, 4) takes this frame to the other."""
        direction = self.direction @ T[:2, :2].T
        direction /= np.hypot(*direction.T)[:, None]
        return self._replace(xy=self.xy @ T[:2, :2].T + T[:2, 3], direction=direction)


def sensor_velocity(scan: Scan, *, doppler_noise: float = 0.1) -> NDArray[np.float64] | None:
    """Estimate the velocity of a sensor from the Doppler of static objects.

    A static object in direction u has doppler = -v . u. Random pairs of detections, the same for every scan, give
    guesses of the velocity v. The guess that agrees with most detections is refined by least squares (Kellner et al.,
    "Instantaneous ego-motion estimation using Doppler radar", 2013).

    If Doppler folds (`Scan.doppler_interval`), the guesses are a grid of velocities up to 60 m/s, ranked by the sum of
    ``exp(2 pi i r / interval)`` over the residuals r, which is the same for all folds. The best are refined on folded
    residuals.

    Parameters
    ----------
    scan : Scan
        In the sensor frame, with `Scan.doppler` relative to the sensor.
    doppler_noise : float
        Standard deviation of the Doppler [m/s].

    Returns
    -------
    (2,) float64 or None
        Velocity over ground along the sensor's x and y axes [m/s]. None without Doppler, with fewer than 5 detections,
        if less than half of the detections agree, or if several velocities that differ by folds fit equally.
    """
    if scan.doppler is None:
        return None
    return _velocity(scan.points[:, :2].astype(np.float64), scan.doppler, doppler_noise, scan.doppler_interval)


def unfolded(speed: NDArray[np.float64], interval: float | None) -> NDArray[np.float64]:
    """Wrap speeds [m/s] to half of the Doppler interval on either side of 0; without an interval return them as is."""
    return speed if interval is None else (speed + interval / 2) % interval - interval / 2


def moving_detections(
    scan: Scan, doppler_noise: float = 0.1, azimuth_noise: float = 0.01, *, origin: NDArray[np.float64] | None = None
) -> NDArray[np.bool_]:
    """Return a mask of the moving detections: speed over ground above 3 standard deviations.

    Parameters
    ----------
    scan : Scan
        Without Doppler, or if `sensor_velocity` finds no velocity, no detection moves.
    doppler_noise, azimuth_noise : float
        Standard deviations [m/s, rad].
    origin : (3,) array, optional
        Position of the sensor in the frame of the points [m]; by default the origin.
    """
    if scan.doppler is None:
        return np.zeros(len(scan), np.bool_)
    xy = scan.points[:, :2].astype(np.float64) - (0.0 if origin is None else origin[:2])
    found = _over_ground(xy, scan.doppler, doppler_noise, azimuth_noise, scan.doppler_interval)
    return np.zeros(len(scan), np.bool_) if found is None else np.abs(found[0]) > GATE * found[1]


def radial_velocities(
    scan: Scan,
    mount: Mount,
    doppler_noise: float = 0.1,
    azimuth_noise: float = 0.01,
    range_noise: float = 0.2,
    *,
    beam: float = math.radians(1.8),
    margin: float = 2.5,
) -> RadialVelocities | None:
    """Return the radial velocities over ground of moving detections, in the levelled vehicle frame.

    The sensor velocity is estimated from the scan (`sensor_velocity`), so Doppler may also be compensated for it.
    Static detections and detections in the ego footprint are left out. So are detections behind another in the same
    direction, which are often ghosts by reflection. The elevation of a detection is neglected.

    Parameters
    ----------
    scan : Scan
        With `Scan.doppler` relative to the sensor or over ground. With `Scan.doppler_interval`, speeds over ground are
        below half the interval. Without it, **folded Doppler gives speeds that are wrong by the interval**: for
        example an oncoming car at 13 m/s, seen from a vehicle at 13 m/s by a radar that folds at 23 m/s.
    mount : Mount
        Mount of the sensor.
    doppler_noise, azimuth_noise, range_noise : float
        Standard deviations [m/s, rad, m].
    beam : float
        Detections within this angle have the same direction [rad].
    margin : float
        A detection is behind another if it is further by this distance plus twice `range_noise` [m].

    Returns
    -------
    RadialVelocities or None
        None for scans with neither Doppler nor `Scan.rcs`, which are not from a radar. No rows if nothing moves or no
        sensor velocity is found.
    """
    if scan.doppler is None:
        return None if scan.rcs is None else RadialVelocities.empty()
    T = mount.T_vehicle_points
    place = (rotate(T[:3, :3], scan.points[:, :3].T.astype(np.float64)) + T[:3, 3:])[:2].T
    from_sensor = place - mount.origin[:2]
    distance = np.hypot(*from_sensor.T)
    usable = np.isfinite(scan.points[:, :3]).all(axis=1) & np.isfinite(scan.doppler) & (distance > 1e-3)
    usable &= ~in_footprint(mount, *place.T)
    place, from_sensor, distance = place[usable], from_sensor[usable], distance[usable]
    found = _over_ground(from_sensor, scan.doppler[usable], doppler_noise, azimuth_noise, scan.doppler_interval)
    speed, deviation = found or (np.zeros(len(place)), np.ones(len(place)))
    sectors = direction_sectors(beam)
    bearing = np.arctan2(from_sensor[:, 1], from_sensor[:, 0])
    nearest = nearest_in_direction(bearing, distance, sectors)
    hidden = distance > nearest[sectors.of(bearing)] + margin + 2 * range_noise
    chosen = (np.abs(speed) > GATE * deviation) & ~hidden
    direction = from_sensor / distance[:, None]
    extent = np.stack([np.full(len(place), range_noise), np.maximum(distance * azimuth_noise, 1e-3)], axis=-1)
    return RadialVelocities(place[chosen], direction[chosen], speed[chosen], deviation[chosen], extent[chosen])


def _over_ground(
    xy: NDArray[np.float64],
    doppler: NDArray[np.float32],
    doppler_noise: float,
    azimuth_noise: float,
    interval: float | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return radial velocities over ground and their standard deviations, None without a sensor velocity.

    `xy` (N, 2) are positions relative to the sensor [m].
    """
    velocity = _velocity(xy, doppler, doppler_noise, interval)
    if velocity is None:
        return None
    unit = xy / np.maximum(np.hypot(*xy.T), 1e-6)[:, None]
    across = unit @ np.array([-velocity[1], velocity[0]])
    return unfolded(doppler + unit @ velocity, interval), np.hypot(doppler_noise, across * azimuth_noise)


class DirectionSectors(NamedTuple):
    """Equal sectors of the full circle, counted from the angle -pi, each about half the beam angle wide.

    Attributes
    ----------
    number : int
    width : int
        Sectors on either side that count as the same direction.
    """

    number: int
    width: int

    def of(self, bearing: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the sector of each angle [rad]."""
        return ((bearing + math.pi) / (2 * math.pi / self.number)).astype(np.int64) % self.number


def direction_sectors(beam: float) -> DirectionSectors:
    """Return the sectors for a beam of the given angle [rad]."""
    count = 4 * math.ceil(math.pi / beam)
    return DirectionSectors(count, math.ceil(beam * count / (2 * math.pi) - 1e-9))


def nearest_in_direction(
    bearing: NDArray[np.float64], distance: NDArray[np.float64], sectors: DirectionSectors
) -> NDArray[np.float64]:
    """Return the distance of the nearest detection in the direction of each sector, inf without a detection.

    Parameters
    ----------
    bearing, distance : (N,) float64
        Bearing and distance of each detection [rad, m].
    sectors : DirectionSectors
    """
    nearest, middle = np.full(sectors.number, np.inf), sectors.of(bearing)
    for shift in range(-sectors.width, sectors.width + 1):
        np.minimum.at(nearest, (middle + shift) % sectors.number, distance)
    return nearest


def _velocity(
    xy: NDArray[np.float64], doppler: NDArray[np.float32], noise: float, interval: float | None
) -> NDArray[np.float64] | None:
    usable = np.isfinite(doppler) & (np.hypot(*xy.T) > 1e-3)
    unit = xy[usable] / np.hypot(*xy[usable].T)[:, None]
    rate = doppler[usable].astype(np.float64)
    if len(rate) < MIN_DETECTIONS:
        return None
    if interval is None:
        guess = _guess_of_pairs(unit, rate, noise)
        return _refined(guess, unit, rate, (noise, noise), None)[0]
    noises = (max(interval / 16, noise), max(interval / 32, noise), noise, noise, noise)
    found = [_refined(guess, unit, rate, noises, interval) for guess in _folded_guesses(unit, rate, interval)]
    velocity, agreeing = max(found, key=lambda pair: pair[1])
    if velocity is None:
        return None
    rivals = [other for other, number in found if other is not None and number > 0.95 * agreeing]
    return velocity if all(np.hypot(*(other - velocity)) < interval / 4 for other in rivals) else None


def _guess_of_pairs(unit: NDArray[np.float64], rate: NDArray[np.float64], noise: float) -> NDArray[np.float64]:
    """Return the velocity with most agreeing detections, from random pairs of detections and zero."""
    first, second = np.random.default_rng(0).integers(len(rate), size=(2, PAIRS))
    A = np.stack([unit[first], unit[second]], axis=1)
    firm = np.abs(np.linalg.det(A)) > 0.05
    guesses = np.linalg.solve(A[firm], -np.stack([rate[first], rate[second]], axis=-1)[firm][..., None])[..., 0]
    guesses = np.vstack([guesses, np.zeros(2)])
    best: NDArray[np.float64] = guesses[(np.abs(rate + guesses @ unit.T) < 4 * noise).sum(axis=1).argmax()]
    return best


def _folded_guesses(unit: NDArray[np.float64], rate: NDArray[np.float64], interval: float) -> list[NDArray[np.float64]]:
    """Return the grid velocities with the greatest sums of ``exp(2 pi i r / interval)`` over the residuals r."""
    thinned = slice(None, None, 1 + len(rate) // MAX_GUESS_DETECTIONS)
    unit, rate = unit[thinned], rate[thinned]
    axis = np.arange(-math.ceil(4 * MAX_SPEED / interval), math.ceil(4 * MAX_SPEED / interval) + 1) * (interval / 4)
    turn = 2j * math.pi / interval
    along_x = np.exp(turn * (unit[:, :1] * axis + rate[:, None]))
    score = np.abs(along_x.T @ np.exp(turn * unit[:, 1:] * axis))
    best = np.argpartition(-score, min(FOLDED_GUESSES, score.size - 1), axis=None)[:FOLDED_GUESSES]
    x, y = np.unravel_index(best, score.shape)
    return list(np.stack([axis[x], axis[y]], axis=-1))


def _refined(
    velocity: NDArray[np.float64],
    unit: NDArray[np.float64],
    rate: NDArray[np.float64],
    noises: tuple[float, ...],
    interval: float | None,
) -> tuple[NDArray[np.float64] | None, int]:
    """Refine a velocity by least squares; also return the number of agreeing detections.

    Returns None and 0 if less than half of the detections agree within one of the standard deviations.
    """
    agreeing = 0
    for noise in noises:
        expected = -unit @ velocity
        residual = unfolded(rate - expected, interval)
        agree = np.abs(residual) < 4 * noise
        agreeing = int(agree.sum())
        if agreeing < max(MIN_DETECTIONS, len(rate) / 2):
            return None, 0
        velocity = np.asarray(np.linalg.lstsq(unit[agree], -(expected + residual)[agree], rcond=1e-3)[0], np.float64)
    return velocity, agreeing
