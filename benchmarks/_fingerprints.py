"""Fingerprints of sensor models and maps by name: a few numbers that change when their results do.

Records hold them (`_run.environment`), and docs/build.py compares them with those of the shipped models. A fingerprint
is of the masses of a fixed scan, or of maps of fixed grids, so that settings, weights and code count as far as they
change a mass. The scan is irregular: no point is at the edge of a cell, where machines round differently. With numba's
kernels compiled without AVX and FMA all fingerprints are the same to 1e-5, except those of maps of particles (5e-4).
"""

from collections.abc import Sequence
from functools import cache
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.evidence.map_rules import DYNAMIC, MAP_RULES, NUSS
from ogm.fusion import DynamicMapper, make_mapper
from ogm.models import MODELS, load_model
from ogm.models.radar import RADAR
from ogm.pose import pose

SPEC = GridSpec.centered(length=40.96, width=30.72, resolution=0.16)
SHIPPED = (*MODELS, *MAP_RULES)
NUMBERS = 8  # of a fingerprint
TOLERANCE, OF_PARTICLES = 2e-4, 2e-3  # root mean squares by which fingerprints of one model, or map, may differ
BOXES = np.array(  # lower and upper corner, from the sensor [m]
    [
        [[-99.0, -13.7, -2.7], [99.0, 10.2, -1.9]],  # road, with nothing to the right of it
        [[-70.3, 6.17, -1.9], [70.1, 9.63, -1.77]],  # pavement
        [[-70.3, 9.63, -1.9], [70.1, 9.97, 3.3]],  # wall
        [[4.31, -11.9, -1.9], [17.3, -8.45, -1.49]],  # platform
        [[7.93, 1.37, -1.72], [12.41, 3.17, -0.41]],  # car
        [[-9.67, -4.2, -0.9], [-8.83, 2.9, -0.3]],  # bar
        [[-7.13, -5.29, -1.9], [-6.97, -5.11, 1.1]],  # pole
        [[13.1, -7.3, 0.4], [13.6, 5.9, 1.2]],  # sign
    ]
)
MAPPED = 8  # scans of a map


@cache
def fingerprint(name: str) -> tuple[float, ...]:
    """Return the fingerprint of a sensor model or of a map.

    Parameters
    ----------
    name : str
        A name or path as in `ogm.models.load_model`, or a rule as in `ogm.fusion.make_mapper`.

    Returns
    -------
    tuple of float
        Sums of all masses, each with a fixed random sign, over the root of their number. The root mean square
        difference of two fingerprints is about that of the masses.
    """
    return summed(map_masses(name) if name in MAP_RULES else model_masses(name))


def same(name: str, recorded: Sequence[float]) -> bool:
    """Return whether a recorded fingerprint is that of the model or map of a name."""
    difference = np.subtract(recorded, fingerprint(name))
    return bool(np.sqrt(np.mean(difference**2)) <= (OF_PARTICLES if name in (DYNAMIC, NUSS) else TOLERANCE))


def summed(mass: NDArray[np.float32]) -> tuple[float, ...]:
    """Return the sums of masses, in an array of N numbers, with fixed random signs, over the root of N."""
    mass = mass.astype(np.float64).ravel()
    bits = np.random.PCG64(0).random_raw(NUMBERS * len(mass)) >> np.uint64(63)  # the same bits by every numpy
    signs = 2.0 * bits.reshape(NUMBERS, -1) - 1.0
    return tuple((signs @ mass / np.sqrt(len(mass))).round(5).tolist())


def model_masses(name: str) -> NDArray[np.float32]:
    """Return the masses of a sensor model for the scan of a street, or for detections of a radar."""
    scan, mount = (radar_detections(), Mount(0.6)) if name == RADAR else (street(), Mount(1.9))
    with patch("ogm.deep.engines.prefers_openvino", lambda: False):  # in 8-bit integers, as on most machines
        return load_model(name, SPEC, mount)(scan).mass


def street() -> Scan:
    """Return a scan of boxes from 1.9 m above a street; beams that meet none within 90 m are without echo."""
    azimuth, elevation = np.meshgrid(
        (np.arange(700) + 0.3719) * 2 * np.pi / 700, np.radians(np.linspace(-24.7, 3.1, 26))
    )
    flat = np.cos(elevation)
    beams = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 1, 3)
    crossings = np.stack([BOXES[:, 0] / beams, BOXES[:, 1] / beams])  # (2, beams, boxes, 3): of the sides' planes
    near, far = crossings.min(axis=0).max(axis=-1), crossings.max(axis=0).min(axis=-1)
    distance = np.where((near < far) & (near > 0), near, np.inf)
    box, distance = distance.argmin(axis=1), distance.min(axis=1)
    met = distance < 90.0
    distance += 0.02 * np.sin(np.arange(len(distance)) * 12.9898)
    points = np.column_stack([(beams[:, 0] * distance[:, None])[met], 0.1 + 0.07 * box[met]])
    return Scan(points.astype(np.float32), no_returns=beams[~met, 0].astype(np.float32))


def radar_detections() -> Scan:
    """Return a fan of detections of a radar, of which every fourth moves."""
    k = np.arange(60)
    azimuth, distance = np.radians(k % 20 * 5.0 - 47.0), 6.0 + k * 0.37
    points = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), 0.01 * k, 0.0 * k], axis=-1)
    doppler = np.where(k % 4, 0.0, -5.0)
    rcs = 10.0 - k % 13
    return Scan(points.astype(np.float32), doppler=doppler, rcs=rcs, sensor="ars548")


def map_masses(rule: str) -> NDArray[np.float32]:
    """Return the masses of a map by a rule after each grid of a drive past walls and one moving vehicle."""
    mapper, found = make_mapper(rule, SPEC), []
    x, y = SPEC.cell_centers
    for k in range(MAPPED):
        mass = np.zeros((*SPEC.shape, 2), np.float32)
        mass[..., 0] = 0.7 * (abs(y) < 9.8) * (np.hypot(x, y) > 3.1)
        along = x + 1.0 * k
        wall, vehicle = (abs(abs(y) - 9.9) < 0.3) & (along % 17 < 15), (abs(x - k + 4.0) < 2.2) & (abs(y - 3.0) < 0.9)
        mass[wall] = 0.1, 0.6
        mass[vehicle] = 0.0, 0.8
        mapper.update(EvidentialGrid(SPEC, mass), pose(1.0 * k, yaw=0.002 * k), stamp=0.1 * k)
        found.append(mapper.dynamic_grid.mass if isinstance(mapper, DynamicMapper) else mapper.grid.mass)
    return np.stack(found)
