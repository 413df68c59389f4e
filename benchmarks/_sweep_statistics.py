"""Statistics of one lidar sweep, real or simulated, for `realism.py`."""

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.geometric import ground_height, local_ground

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
COARSE = GridSpec.centered(length=120.0, width=120.0, resolution=1.0)
REACH = 60.0  # [m] as far as the ground is estimated, and ground is separated from obstacles
RAISED = 0.15  # [m] what lies higher above the estimated ground counts as obstacle
BESIDE, OVERHEAD = 0.3, 2.0  # [m] obstacles that bound the free space lie between these heights
JUMP, EDGE = 0.5, 1.0  # [m] between neighbours in a ring: another surface; an edge for mixed pixels
STEP_OFF = 0.3  # [m] how far from both surfaces a mixed pixel lies
SMOOTH = 0.15  # [m] neighbours in a ring on one smooth surface
NEAR = 25.0  # [m] range noise is measured up to here
BANDS = (0, 5, 10, 20, 40, 80)  # [m] of range
HEIGHTS = (0.15, 0.5, 1.0, 2.0, 4.0, 8.0, 60.0)  # [m] above ground
ELEVATIONS = (-40, -12, -5, -1, 1, 6, 26)  # [deg]
EDGES = {
    "range [m]": np.arange(0.0, 82.5, 2.5),
    "height above ground [m]": np.arange(-1.0, 8.2, 0.2),
    "intensity, ground": np.arange(0.0, 132.0, 2.0),
    "intensity, obstacle": np.arange(0.0, 132.0, 2.0),
}


class Sweep(NamedTuple):
    """One turn of one lidar, real or simulated, without returns from the ego vehicle."""

    name: str
    points: NDArray[np.float32]  # (N, 4) x, y, z in the sensor's frame [m], intensity [0, 255]
    layer: NDArray[np.int64]  # (N,) 0 is the lowest
    column: NDArray[np.int64]  # (N,) number of the firing within the turn
    elevations: NDArray[np.float64]  # (layers,) [deg] ascending
    columns: int  # firings in a turn
    height: float  # [m] of the sensor above ground
    ego: int = 0  # returns from the ego vehicle that were taken out
    calibrated: bool = True  # intensities on the maker's 0 ... 255 scale of reflectivity
    timed: bool = True  # columns from firing times; from azimuths otherwise, which makes false gaps


class View(NamedTuple):
    """Distances, heights and classes of the points of a sweep."""

    distance: NDArray[np.float32]  # (N,) from the sensor [m]
    height: NDArray[np.float32]  # (N,) above the estimated ground [m]
    ground: NDArray[np.bool_]  # (N,)
    obstacle: NDArray[np.bool_]  # (N,)


def view(sweep: Sweep) -> View:
    """Estimate the ground, the same way in real and simulated sweeps."""
    xyz = np.ascontiguousarray(sweep.points[:, :3])
    distance = np.linalg.norm(xyz, axis=1)
    surface = local_ground(xyz, COARSE, (0.0, 0.0, -sweep.height))
    height = xyz[:, 2] - ground_height(surface, COARSE, xyz)
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < REACH
    return View(distance, height, near & (height < RAISED) & (height > -REACH / 100), near & (height >= RAISED))


def statistics(sweep: Sweep) -> dict[str, float]:
    """Return everything that is compared, by name and unit."""
    seen, result = view(sweep), {}
    for part in (_returns, _places, _intensities, _rings, _surroundings):
        result |= part(sweep, seen)
    return {name: float(value) for name, value in result.items()}


def _returns(sweep: Sweep, seen: View) -> dict[str, float]:
    beams = len(sweep.elevations) * sweep.columns
    counts = {
        "beams with a return": len(sweep.points),
        "... from the ego vehicle": sweep.ego,
        "... from the ground": np.count_nonzero(seen.ground),
        "... from obstacles": np.count_nonzero(seen.obstacle),
        "... from beyond 60 m": np.count_nonzero(np.hypot(*sweep.points[:, :2].T) >= REACH),
    }
    result = {"returns [1000]": len(sweep.points) / 1e3}
    result |= {f"{name} [%]": 100 * count / beams for name, count in counts.items()}
    filled = np.zeros((len(sweep.elevations), sweep.columns), bool)
    filled[sweep.layer, np.minimum(sweep.column, sweep.columns - 1)] = True
    for low, high in pairwise(ELEVATIONS):
        chosen = (sweep.elevations >= low) & (sweep.elevations < high)
        if chosen.any():
            result[f"layers at {low} to {high} deg with a return [%]"] = 100 * float(filled.mean(axis=1)[chosen].mean())
    return result


def _places(sweep: Sweep, seen: View) -> dict[str, float]:
    result = {f"range p{q} [m]": np.percentile(seen.distance, q) for q in (5, 25, 50, 75, 95)}
    for name, mask in (("ground", seen.ground), ("obstacle", seen.obstacle)):
        if mask.any():
            result |= {f"{name} range p{q} [m]": np.percentile(seen.distance[mask], q) for q in (50, 95)}
    height = seen.height[seen.obstacle]
    for low, high in pairwise(HEIGHTS):
        share = np.count_nonzero((height >= low) & (height < high)) / max(len(height), 1)
        result[f"obstacle returns {low:g} to {high:g} m up [%]"] = 100 * share
    return result


def _intensities(sweep: Sweep, seen: View) -> dict[str, float]:
    intensity, result = sweep.points[:, 3], {}
    for name, mask in (("ground", seen.ground), ("obstacle", seen.obstacle)):
        if not (sweep.calibrated and mask.any()):
            continue
        for q in (5, 25, 50, 75, 95, 99):
            result[f"{name} intensity p{q} [0, 255]"] = np.percentile(intensity[mask], q)
        result[f"{name} intensity above 100 [%]"] = 100 * float((intensity[mask] > 100).mean())
        for low, high in pairwise(BANDS):
            inside = mask & (seen.distance >= low) & (seen.distance < high)
            if np.count_nonzero(inside) > 100:
                result[f"{name} intensity at {low} to {high} m, median [0, 255]"] = np.median(intensity[inside])
    return result


def _rings(sweep: Sweep, seen: View) -> dict[str, float]:
    """Follow the rings from beam to beam: jumps, runs between them, noise, mixed pixels, gaps."""
    jumps = edges = mixed = lone = 0
    runs: list[NDArray[Any]] = []
    noise: dict[str, list[NDArray[Any]]] = {"ground": [], "obstacles": []}
    gaps = {name: [0, 0] for name in ("ground", "obstacles")}
    for k in range(len(sweep.elevations)):
        (members,) = np.nonzero(sweep.layer == k)
        if len(members) < 100:
            continue
        column, first = np.unique(sweep.column[members], return_index=True)
        members = members[first]
        distance, ground, obstacle = (seen.distance[members], seen.ground[members], seen.obstacle[members])
        step, rise = np.diff(column), np.diff(distance)
        breaks = (np.abs(rise) > JUMP) | (step > 2)
        jumps += np.count_nonzero(breaks & (step <= 2))
        runs.append(np.diff(np.flatnonzero(np.r_[True, breaks, True])))

        # Noise: third differences cancel any smooth surface, and leave sqrt(20) of the noise of one return.
        small = (np.abs(rise) < SMOOTH) & (step == 1)
        calm = small[:-2] & small[1:-1] & small[2:] & (distance[1:-2] < NEAR)
        third = np.diff(rise, 2)
        noise["ground"].append(third[calm & ground[1:-2]])
        noise["obstacles"].append(third[calm & obstacle[1:-2]])

        # Of five neighbours, two on either side of an edge: does the middle one lie between both surfaces?
        # An edge without such a return is met twice.
        flat = (np.abs(rise) < STEP_OFF) & (step == 1)
        low, high = np.minimum(distance[1:-3], distance[3:-1]), np.maximum(distance[1:-3], distance[3:-1])
        edge = flat[:-3] & flat[3:] & (step[1:-2] == 1) & (step[2:-1] == 1) & (high - low > EDGE)
        middle = distance[2:-2]
        edges += np.count_nonzero(edge)
        mixed += np.count_nonzero(edge & (middle > low + STEP_OFF) & (middle < high - STEP_OFF))

        # Of three, is the middle one off the surface of both others?
        beside = (step[:-1] == 1) & (step[1:] == 1) & (np.abs(distance[2:] - distance[:-2]) < STEP_OFF)
        lone += np.count_nonzero(beside & (np.abs(rise[:-1]) > JUMP) & (np.abs(rise[1:]) > JUMP))

        for name, mask in (("ground", ground), ("obstacles", obstacle)):
            surface = mask[:-1] & mask[1:] & (np.abs(rise) < SMOOTH) & (step <= 6)
            gaps[name][0] += int((step[surface] - 1).sum())
            gaps[name][1] += int(step[surface].sum())
    length, total = np.concatenate(runs), len(sweep.points)
    around = np.repeat(length, length)
    result = {
        "jumps > 0.5 m per ring": jumps / len(runs),
        "jumps > 0.5 m per 1000 returns": 1e3 * jumps / total,
        "median return lies in a run of [beams]": np.median(around),
        "quarter of returns lie in runs up to [beams]": np.percentile(around, 25),
        "mixed pixels per 1000 clean edges > 1 m": 2e3 * mixed / max(edges + mixed, 1),
        "lone returns per 1000": 1e3 * lone / total,
    }
    for name, parts in noise.items():
        third = np.concatenate(parts)
        if len(third) > 100:
            result[f"range noise on {name} [mm]"] = 1e3 * 1.4826 * float(np.median(np.abs(third))) / 20**0.5
    if sweep.timed:
        for name, (missing, beams) in gaps.items():
            result[f"beams missing on smooth {name} [%]"] = 100 * missing / max(beams, 1)
    return result


def _surroundings(sweep: Sweep, seen: View) -> dict[str, float]:
    """Return the reach of the free space, the roughness of the ground, the shares of hit cells."""
    x, y, z = sweep.points[:, :3].T.astype(np.float64)
    distance = np.hypot(x, y)
    wall = (seen.height > BESIDE) & (seen.height < OVERHEAD)
    nearest = np.full(360, np.inf)
    sector = np.degrees(np.arctan2(y[wall], x[wall])).astype(int) % 360
    np.minimum.at(nearest, sector, distance[wall])
    result = {
        f"nearest obstacle, sectors of 1 deg, p{q} [m]": np.percentile(np.minimum(nearest, 99.0), q)
        for q in (5, 25, 50, 75)
    }
    result["sectors without obstacle within 40 m [%]"] = 100 * float((nearest > 40).mean())
    for reach in (20, 40):
        chosen = seen.ground & (distance < reach)
        if np.count_nonzero(chosen) > 100:
            A = np.column_stack([x[chosen], y[chosen], np.ones(np.count_nonzero(chosen))])
            plane, *_ = np.linalg.lstsq(A, z[chosen], rcond=None)
            result[f"ground within {reach} m, slope of its plane [%]"] = 100 * float(np.hypot(*plane[:2]))
            rms = float(np.std(z[chosen] - A @ plane))
            result[f"ground within {reach} m, rms off its plane [cm]"] = 100 * rms
    inside = SPEC.contains(x, y)
    low, high = np.zeros((2, *SPEC.shape), bool)
    for grid, mask in ((low, seen.height < RAISED), (high, (seen.height >= RAISED) & (seen.height < OVERHEAD))):
        grid[SPEC.index(x[inside & mask], y[inside & mask])] = True
    result["cells with an obstacle return [%]"] = 100 * float(high.mean())
    result["cells with ground returns only [%]"] = 100 * float((low & ~high).mean())
    return result


def histograms(sweep: Sweep) -> dict[str, NDArray[np.float64]]:
    """Return the shares of returns between `EDGES`."""
    seen = view(sweep)
    near = seen.ground | seen.obstacle
    values = {"range [m]": seen.distance, "height above ground [m]": seen.height[near]}
    if sweep.calibrated:
        values["intensity, ground"] = sweep.points[seen.ground, 3]
        values["intensity, obstacle"] = sweep.points[seen.obstacle, 3]
    return {name: np.histogram(value, EDGES[name])[0] / max(len(value), 1) for name, value in values.items()}
