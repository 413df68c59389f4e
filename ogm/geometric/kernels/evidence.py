"""Returns that show the ground: neighbouring beams meet a surface, each beam farther out than the beam below.

A wall stops all beams of a direction at a single distance. A single beam shows no surface: its returns lie on a cone
with its tip in the sensor. Returns at growing distances, on a surface that passes under the sensor, show the ground.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, Points, RayNumbers
from ogm.geometric.kernels.polar import azimuth
from ogm.jit import kernel

__all__ = ["ground_evidence", "mark_own_cells", "raise_unshown", "shown_points"]

SECTORS = 256
BINS, LOWEST_SLOPE, BIN = 512, np.float32(-1.28), np.float32(0.005)  # slopes (rise over run): number, first, width
HIGHEST_SLOPE = np.float32(1.275)
SAMPLE = 16384  # approximate number of returns for the test of a whole scan
LINKS, SECTOR_SHARE = 5, 0.25  # links in a sector that shows the ground; share of such sectors
MIN_SEPARATION = 0.003  # smallest difference of slope (rise over run) between two beams
MAX_GROUND_SLOPE, MIN_WALL_SLOPE = 0.3, 0.5  # rise over run between beams: largest on ground, smallest on a wall
MIN_DEPTH = 0.5  # smallest depth of an extended link under the sensor, as a share of the sensor's height
LEVEL = 0.1  # largest height of the begin of a chain above the plane of the mount, as a share of the sensor's height
BEND, NOISE, RATIO = 0.35, 0.05, 1.5  # last beam of a chain: rise over run, rise by sensor height, ratio of runs
REAR_SHARE = np.float32(0.8)  # share of a beam's longest run, from which its other returns are alike
CLEARANCE_MARGIN = np.float32(1e-3)  # [m] above the clearance up to which other returns mark
PLANE_MARGIN = np.float32(0.05)  # [m] above the ground from which other returns mark


@kernel
def ground_evidence(points: Points, origin: NDArray[np.float32], sensor_height: float) -> NDArray[np.uint8]:
    """Return a flag for each return that shows the ground, or no flags if the whole scan shows it.

    A *link* joins the farthest returns of two neighbouring beams of a sector, if the surface between them is no
    steeper than ground and its extension passes well under the sensor. If a quarter of the sectors have at least
    `LINKS` links, the whole scan shows the ground. Otherwise a beam shows the ground if it is no wall and is linked to
    the beams above and below. The beam below must show the ground, too, or lie on the plane of the mount.

    Parameters
    ----------
    points : Points
        N returns.
    origin : (3,) float32
        The sensor [m].
    sensor_height : float
        Height of the sensor above the ground [m].

    Returns
    -------
    (N,) uint8
        1 for a return that shows the ground, else 0; empty if the whole scan shows the ground.
    """
    count, beams = points.x.shape[0], np.empty((BINS, 3))
    farthest, runs = np.empty(BINS, np.int64), np.empty(BINS, np.float32)
    stride = (count // SAMPLE) | 1  # odd: firings have an even number of beams
    places, seen, used = _sort_returns(points, origin, stride), 0, 0
    for s in range(SECTORS):
        _find_farthest(places, s, farthest, runs)
        found, links = _find_beams(points, origin, farthest, beams), 0
        for k in range(found - 1):
            links += int(_is_link(beams[k], beams[k + 1], sensor_height))
        used += int(found > 0)
        seen += int(links >= LINKS)
        if seen > SECTOR_SHARE * SECTORS:
            break
    if count == 0 or seen > SECTOR_SHARE * used:
        return np.empty(0, np.uint8)

    if stride > 1:
        places = _sort_returns(points, origin, int(np.int64(1)))  # a constant would be compiled separately
    shown, shows, reach = np.zeros(count, np.uint8), np.empty(BINS, np.bool_), np.empty(BINS, np.float32)
    for s in range(SECTORS):
        _find_farthest(places, s, farthest, runs)
        found, k = _find_beams(points, origin, farthest, beams), -1
        _find_chain(beams[:found], sensor_height, shows)
        for b in range(BINS):  # a beam has one or two bins
            if farthest[b] >= 0:
                slope, run, _ = _ray(points, origin, farthest[b])
                while k + 1 < found and slope >= beams[k + 1, 0]:
                    k += 1
                reach[b] = REAR_SHARE * run if shows[k] else np.float32(np.inf)
            else:  # returns at the sensor itself have no run
                reach[b] = np.float32(0.0)
        for m in range(places.starts[s], places.starts[s + 1]):
            shown[places.point[m]] = places.run[m] >= reach[places.bin[m]]
    return shown


class _Places(NamedTuple):
    """Returns sorted by sector."""

    point: NDArray[np.int32]  # (K,) index of the return
    bin: NDArray[np.int32]  # (K,) bin of its slope
    run: NDArray[np.float32]  # (K,) [m]
    starts: NDArray[np.int32]  # (SECTORS + 1,) first return of each sector


@kernel
def _sort_returns(points: Points, origin: NDArray[np.float32], stride: int) -> _Places:
    """Return every `stride`-th return, sorted by sector."""
    count = (points.x.shape[0] + stride - 1) // stride
    sector, bins, runs = np.empty(count, np.int32), np.empty(count, np.int32), np.empty(count, np.float32)
    for m in range(count):
        sector[m], bins[m], runs[m] = _place(points, origin, (m * stride) & 0x7FFFFFFF)
    starts = np.zeros(SECTORS + 2, np.int32)
    for m in range(count):
        starts[(sector[m] & 0xFF) + 2] += 1
    for s in range(SECTORS):
        starts[s + 2] += starts[s + 1]
    places = _Places(np.empty(count, np.int32), np.empty(count, np.int32), np.empty(count, np.float32), starts[:-1])
    for m in range(count):
        s = (sector[m] & 0xFF) + 1
        to = starts[s] & 0x7FFFFFFF
        starts[s] += 1
        places.point[to], places.bin[to], places.run[to] = m * stride, bins[m], runs[m]
    return places


@kernel
def _ray(points: Points, origin: NDArray[np.float32], n: int) -> tuple[np.float32, np.float32, np.float32]:
    """Return slope (rise over run), run and rise [m] of a return from the sensor."""
    dx, dy, dz = points.x[n] - origin[0], points.y[n] - origin[1], points.z[n] - origin[2]
    run = np.float32(math.sqrt(dx * dx + dy * dy))
    return dz / max(run, np.float32(1e-6)), run, dz


@kernel
def _place(points: Points, origin: NDArray[np.float32], n: int) -> tuple[int, int, np.float32]:
    """Return sector and bin of slope of a return, and its run [m]."""
    slope, run, _ = _ray(points, origin, n)
    angle = azimuth(points.x[n] - origin[0], points.y[n] - origin[1])
    s = min(int(angle * np.float32(SECTORS / (2 * math.pi))), SECTORS - 1)
    return s, int((min(max(slope, LOWEST_SLOPE), HIGHEST_SLOPE) - LOWEST_SLOPE) / BIN), run


@kernel
def _find_farthest(places: _Places, s: int, farthest: NDArray[np.int64], runs: NDArray[np.float32]) -> None:
    """Fill in index and run of the farthest return of each bin of a sector; -1 and 0 for empty bins."""
    for b in range(BINS):
        farthest[b], runs[b] = -1, 0
    for m in range(places.starts[s], places.starts[s + 1]):
        b = places.bin[m] & (BINS - 1)
        if places.run[m] > runs[b]:
            runs[b], farthest[b] = places.run[m], places.point[m]


@kernel
def _find_beams(
    points: Points, origin: NDArray[np.float32], farthest: NDArray[np.int64], beams: NDArray[np.float64]
) -> int:
    """Fill in slope, run and rise of each beam's farthest return in a sector by slope; return the number of beams."""
    found = 0
    for b in range(BINS):
        if farthest[b] < 0:
            continue
        slope, run, rise = _ray(points, origin, farthest[b])
        if found == 0 or slope - beams[found - 1, 0] >= MIN_SEPARATION:
            beams[found, 0], beams[found, 1], beams[found, 2] = slope, run, rise
            found += 1
        elif run > beams[found - 1, 1]:
            beams[found - 1, 1], beams[found - 1, 2] = run, rise
    return found


@kernel
def _is_link(near: NDArray[np.float64], far: NDArray[np.float64], sensor_height: float) -> bool:
    """Return whether the surface between the farthest returns of two beams may be ground."""
    if far[1] <= near[1]:
        return False
    slope = (far[2] - near[2]) / (far[1] - near[1])
    return bool(abs(slope) <= MAX_GROUND_SLOPE and slope * near[1] - near[2] >= MIN_DEPTH * sensor_height)


@kernel
def _is_wall(beams: NDArray[np.float64], k: int) -> bool:
    """Return whether the surface between a beam and the next or previous beam is as steep as a wall."""
    for j in range(max(k, 1), min(k + 2, beams.shape[0])):
        if beams[j, 1] - beams[j - 1, 1] < (beams[j, 2] - beams[j - 1, 2]) / MIN_WALL_SLOPE:
            return True
    return False


@kernel
def _find_chain(beams: NDArray[np.float64], sensor_height: float, shows: NDArray[np.bool_]) -> None:
    """Fill in whether each beam of a sector, sorted by slope, shows the ground."""
    count, level = beams.shape[0], LEVEL * sensor_height - sensor_height
    for k in range(count):
        shows[k] = False
        if _is_wall(beams, k):
            continue
        run, rise = beams[k, 1], beams[k, 2]
        links = k + 1 < count and not _is_wall(beams, k + 1) and _is_link(beams[k], beams[k + 1], sensor_height)
        if k == 0:  # the surface of three beams must lead to the ground under the sensor
            more = count > 2 and not _is_wall(beams, k + 2) and _is_link(beams[1], beams[2], sensor_height)
            if links and more:
                slope = (beams[1, 2] - rise) / (beams[1, 1] - run)
                shows[0] = rise - slope * run <= level
        elif (shows[k - 1] or beams[k - 1, 2] <= level) and _is_link(beams[k - 1], beams[k], sensor_height):
            near, ratio = beams[k - 1, 2], run / beams[k - 1, 1]
            ends_chain = ratio < RATIO and rise - near <= sensor_height * (BEND * (ratio - 1) + NOISE)
            shows[k] = links or ends_chain


@kernel
def shown_points(points: Points, shown: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return x, y and z of the points that show the ground, (3, K)."""
    xyz, kept = np.empty((3, shown.shape[0]), np.float32), 0
    for n in range(shown.shape[0]):
        if shown[n]:
            xyz[0, kept], xyz[1, kept], xyz[2, kept] = points.x[n], points.y[n], points.z[n]
            kept += 1
    return xyz[:, :kept]


@kernel
def raise_unshown(above: np.float32, numbers: RayNumbers) -> np.float32:
    """Return the height of a return that does not show the ground, changed so that it marks [m].

    Heights above `PLANE_MARGIN` are raised to the lowest height that marks. Heights at the clearance are lowered below
    it.
    """
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    if above > PLANE_MARGIN and above <= low:
        above = np.nextafter(low, np.float32(np.inf))
    elif above >= high and above < high + CLEARANCE_MARGIN:
        above = np.nextafter(high, np.float32(0))
    return above


@kernel
def mark_own_cells(
    points: Points, above: NDArray[np.float32], cells: Cells, numbers: RayNumbers, hits: NDArray[np.int32]
) -> None:
    """Add half a hit to cells with an obstacle return but no hits: range noise moves hits to other cells."""
    low, high, inverse = numbers.obstacle_height, numbers.clearance, np.float32(1.0 / cells.resolution)
    for n in range(points.x.shape[0]):
        u, v = (points.x[n] - np.float32(cells.x0)) * inverse, (points.y[n] - np.float32(cells.y0)) * inverse
        inside = u >= 0 and u < hits.shape[1] and v >= 0 and v < hits.shape[2]
        if inside and above[n] > np.float32(low) and above[n] < np.float32(high):
            i, j, total = int(u), int(v), 0
            for k in range(hits.shape[0]):
                total += hits[k, i, j]
            hits[0, i, j] += int(total == 0)
