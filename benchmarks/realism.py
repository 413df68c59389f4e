"""Simulated scans beside real ones: the same statistics of both, and truth beside a published label.

    python benchmarks/realism.py [--towns N] [--quick]

Needs recordings that cannot be shipped; benchmarks/README.md says which and where they go. Writes
benchmarks/results/realism.json, benchmarks/results/realism.md (the tables) and docs/pictures/realism.png. The same
picture with a real scan and a published truth grid beside the simulated ones, which may not be passed on, goes to
runs/realism/side_by_side.png.
"""

from _run import DATA, PICTURES, RESULTS, ROOT, caption, environment, write_json

# isort: split
import argparse
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec, read_scan
from ogm.geometric import ground_height, local_ground
from ogm.io import estimate_sensor_height, read_argoverse2
from ogm.pose import inverse, pose
from ogm.simulation.cells import measure_ground
from ogm.simulation.lidar import scan, to_points
from ogm.simulation.scene import EGO, Scene
from ogm.simulation.sensors import LIDARS, LidarSpec
from ogm.simulation.survey import Known, aimed_truth
from ogm.simulation.town import Town, build_town
from ogm.simulation.traffic import Traffic, TrafficState, ego_vehicle
from ogm.state import CellState
from ogm.truth import boxes_seen_from

SIDE_BY_SIDE = ROOT / "runs" / "realism" / "side_by_side.png"
SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
COARSE = GridSpec.centered(length=120.0, width=120.0, resolution=1.0)
REACH = 60.0  # [m] as far as the ground is estimated, and ground is separated from obstacles
RAISED = 0.15  # [m] what lies higher above the estimated ground counts as obstacle
BESIDE, OVERHEAD = 0.3, 2.0  # [m] obstacles that bound the free space lie between these heights
JUMP, EDGE = 0.5, 1.0  # [m] between neighbours in a ring: another surface; an edge for mixed pixels
STEP_OFF = 0.3  # [m] how far from both surfaces a mixed pixel lies
SMOOTH = 0.15  # [m] neighbours in a ring on one smooth surface
NEAR = 25.0  # [m] range noise is measured up to here
FIRING = 55.296e-6  # [s] VLP-32C: from one firing of a laser to its next
BANDS = (0, 5, 10, 20, 40, 80)  # [m] of range
HEIGHTS = (0.15, 0.5, 1.0, 2.0, 4.0, 8.0, 60.0)  # [m] above ground
ELEVATIONS = (-40, -12, -5, -1, 1, 6, 26)  # [deg]
EDGES = {
    "range [m]": np.arange(0.0, 82.5, 2.5),
    "height above ground [m]": np.arange(-1.0, 8.2, 0.2),
    "intensity, ground": np.arange(0.0, 132.0, 2.0),
    "intensity, obstacle": np.arange(0.0, 132.0, 2.0),
}
COLOURS = ("#1b7837", "#2c5f9e")  # of simulated and real sweeps


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


# --- Real sweeps ------------------------------------------------------------------------------------


def in_layers(ring: NDArray[Any], xyz: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Sort the rings into layers by their median elevation; return each point's layer, and the elevations [deg]."""
    elevation = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    rings, index = np.unique(ring, return_inverse=True)
    medians = np.array([np.median(elevation[index == k]) for k in range(len(rings))])
    rank = np.argsort(np.argsort(medians))
    return rank[index], np.sort(medians)


def argoverse2() -> Iterator[Sweep]:
    """Both VLP-32C of one sweep, each seen from where it stands; columns from the firing times."""
    folder = DATA / "argoverse2_adcf"
    log = read_argoverse2(folder) if folder.is_dir() else None
    for path in log.sweeps if log else ():
        sweep = read_scan(path)
        ground = estimate_sensor_height(sweep.points)
        for name, first in (("up_lidar", 0), ("down_lidar", 32)):
            origin = log.lidars[name].astype(np.float32)
            mine = (sweep.ring >= first) & (sweep.ring < first + 32)
            points = sweep.points[mine] * np.float32([1, 1, 1, 255])
            points[:, :3] -= origin
            layer, elevations = in_layers(sweep.ring[mine], points)
            column = np.rint((sweep.time[mine] - sweep.time.min()) / FIRING).astype(int).clip(0, 1807)
            title = f"Argoverse 2, {'upper' if first == 0 else 'lower'}"
            yield Sweep(title, points, layer, column, elevations, 1808, float(origin[2]) + ground)


def nuscenes() -> Iterator[Sweep]:
    """HDL-32E: the file holds every beam, those without a return as points at the sensor."""
    for path in sorted((DATA / "nuscenes_n015").glob("*.pcd.bin")):
        sweep = read_scan(path, axes="nuscenes")
        distance = np.linalg.norm(sweep.points[:, :3], axis=1)
        kept = distance > 2.5
        points = sweep.points[kept] * np.float32([1, 1, 1, 255])
        layer, elevations = in_layers(sweep.ring[kept], points)
        column = np.arange(len(kept)) // 32
        ego = int(((distance > 0.55) & ~kept).sum())
        height = estimate_sensor_height(points)
        yield Sweep("nuScenes", points, layer, column[kept], elevations, int(column[-1]) + 1, height, ego)


def kitti() -> Iterator[Sweep]:
    """HDL-64E: points in the order of the layers, each from azimuth 0 counter-clockwise; intensities not calibrated."""
    paths = [
        *sorted((DATA / "kitti_odometry_00").glob("000000.bin")),
        *sorted((DATA / "kitti_object").glob("velodyne/*.bin")),
        *sorted((DATA / "kitti_raw_0005").glob("*70.pcd.xz")),
    ]
    for path in paths:
        points = read_scan(path).points * np.float32([1, 1, 1, 255])
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        (turns,) = np.nonzero((np.abs(azimuth[:-1] + 45) < 45) & (np.abs(azimuth[1:] - 45) <= 45))
        turns = turns[np.diff(turns, prepend=-1) > 400] + 1
        ring = np.searchsorted(turns, np.arange(len(points)), side="right")
        layer, elevations = in_layers(ring, points)
        column = (azimuth % 360 / 0.1728).astype(int)
        height = estimate_sensor_height(points)
        yield Sweep("KITTI", points, layer, column, elevations, 2083, height, calibrated=False, timed=False)


def pandar40() -> Iterator[Sweep]:
    """Hesai with 40 layers (SUSTechPOINTS); columns from the firing times."""
    for path in sorted((DATA / "sustechpoints").glob("lidar/*.pcd.xz")):
        sweep = read_scan(path, axes=("-y", "+x", "+z"))
        points = sweep.points * np.float32([1, 1, 1, 255])
        layer, elevations = in_layers(sweep.ring, points)
        column = np.rint((sweep.time - sweep.time.min()) / 55.5e-6).astype(int).clip(0, 1799)
        height = estimate_sensor_height(points)
        yield Sweep("Pandar40 (SUSTech)", points, layer, column, elevations, 1800, height)


# --- Simulated sweeps -------------------------------------------------------------------------------


class Place(NamedTuple):
    """Where and when a simulated scan is taken."""

    seed: int
    clockwise: bool
    time: float  # [s]


def places(towns: int, each: int) -> list[Place]:
    """Spread scans over towns, both directions, and the way around."""
    return [Place(seed, bool(n % 2), 25.0 + 13.0 * n) for seed in range(1, towns + 1) for n in range(each)]


def simulated(
    sensors: Mapping[str, tuple[LidarSpec, float]], where: list[Place]
) -> Iterator[tuple[str, Sweep, NDArray[np.uint8] | None]]:
    """Scan every place with every sensor, given as its specification and its height above ground [m].

    The first sensor's scans come with the true states of the cells around them.
    """
    town: Town | None = None
    for place in where:
        if town is None or town.seed != place.seed:
            town = build_town(place.seed)
            scene, ground = Scene(town.mesh, threads=1), Scene(town.ground, threads=1)
            traffic = {way: Traffic(town, place.seed, clockwise=way) for way in (True, False)}
        state = traffic[place.clockwise].at(place.time)
        scene.place([o.mesh.moved(o.pose) for o in state.objects], ego_vehicle().moved(state.ego))
        for k, (name, (spec, height)) in enumerate(sensors.items()):
            rng = np.random.default_rng([place.seed, int(place.time), int(place.clockwise)])
            T = state.ego @ pose(0.0, 0.0, height)
            image = scan(scene, spec, T, rng)
            cells = true_states(scene, ground, T, spec, state, image.object) if k == 0 else None
            yield name, sweep_of(image, spec, height, f"town {place.seed}"), cells


def true_states(
    scene: Scene, ground: Scene, T: NDArray[np.float64], spec: LidarSpec, state: TrafficState, hit: NDArray[Any]
) -> NDArray[np.uint8]:
    """Return the true states of the cells of `SPEC` around the sensor."""
    boxes = boxes_seen_from(inverse(T), [one.pose for one in state.objects], [one.size for one in state.objects])
    returns = np.bincount(hit[hit >= 0], minlength=len(state.objects))
    span = (min(spec.elevations), max(spec.elevations))
    below = measure_ground(ground, T, SPEC)
    return aimed_truth(scene, below, span, Known(boxes, returns)).state


def sweep_of(image: Any, spec: LidarSpec, height: float, name: str) -> Sweep:
    """Turn a range image into a sweep."""
    points, layer, column = to_points(image, spec)
    other = image.object[layer, column] != EGO
    points[:, 3] = np.rint(255 * points[:, 3])
    shape, ego = image.range.shape, int(np.count_nonzero(~other))
    elevations = np.degrees(spec.elevations)
    return Sweep(name, points[other], layer[other], column[other], elevations, shape[1], height, ego)


# --- Statistics -------------------------------------------------------------------------------------


class View(NamedTuple):
    """What several statistics need of a sweep."""

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
    seen = view(sweep)
    return {
        **_returns(sweep, seen),
        **_places(sweep, seen),
        **_intensities(sweep, seen),
        **_rings(sweep, seen),
        **_surroundings(sweep, seen),
    }


def _returns(sweep: Sweep, seen: View) -> dict[str, float]:
    beams = len(sweep.elevations) * sweep.columns
    result = {
        "returns [1000]": len(sweep.points) / 1e3,
        "beams with a return [%]": 100 * len(sweep.points) / beams,
        "... from the ego vehicle [%]": 100 * sweep.ego / beams,
        "... from the ground [%]": 100 * np.count_nonzero(seen.ground) / beams,
        "... from obstacles [%]": 100 * np.count_nonzero(seen.obstacle) / beams,
        "... from beyond 60 m [%]": 100 * np.count_nonzero(np.hypot(*sweep.points[:, :2].T) >= REACH) / beams,
    }
    share = layer_shares(sweep)
    for low, high in pairwise(ELEVATIONS):
        chosen = (sweep.elevations >= low) & (sweep.elevations < high)
        if chosen.any():
            result[f"layers at {low} to {high} deg with a return [%]"] = 100 * float(share[chosen].mean())
    return result


def layer_shares(sweep: Sweep) -> NDArray[np.float64]:
    """Return the share of firings with a return, for each layer [0, 1]."""
    filled = np.zeros((len(sweep.elevations), sweep.columns), bool)
    filled[sweep.layer, np.minimum(sweep.column, sweep.columns - 1)] = True
    return filled.mean(axis=1)


def _places(sweep: Sweep, seen: View) -> dict[str, float]:
    result = {f"range p{q} [m]": np.percentile(seen.distance, q) for q in (5, 25, 50, 75, 95)}
    for name, mask in (("ground", seen.ground), ("obstacle", seen.obstacle)):
        if not mask.any():
            continue
        result |= {f"{name} range p{q} [m]": np.percentile(seen.distance[mask], q) for q in (50, 95)}
    height = seen.height[seen.obstacle]
    for low, high in pairwise(HEIGHTS):
        share = np.count_nonzero((height >= low) & (height < high)) / max(len(height), 1)
        result[f"obstacle returns {low:g} to {high:g} m up [%]"] = 100 * share
    return {name: float(value) for name, value in result.items()}


def _intensities(sweep: Sweep, seen: View) -> dict[str, float]:
    if not sweep.calibrated:
        return {}
    intensity, result = sweep.points[:, 3], {}
    for name, mask in (("ground", seen.ground), ("obstacle", seen.obstacle)):
        if not mask.any():
            continue
        for q in (5, 25, 50, 75, 95, 99):
            result[f"{name} intensity p{q} [0, 255]"] = float(np.percentile(intensity[mask], q))
        result[f"{name} intensity above 100 [%]"] = 100 * float((intensity[mask] > 100).mean())
        for low, high in pairwise(BANDS):
            inside = mask & (seen.distance >= low) & (seen.distance < high)
            if np.count_nonzero(inside) > 100:
                result[f"{name} intensity at {low} to {high} m, median [0, 255]"] = float(np.median(intensity[inside]))
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
    length = np.concatenate(runs)
    total = len(sweep.points)
    result = {
        "jumps > 0.5 m per ring": jumps / len(runs),
        "jumps > 0.5 m per 1000 returns": 1e3 * jumps / total,
        "median return lies in a run of [beams]": float(np.median(np.repeat(length, length))),
        "quarter of returns lie in runs up to [beams]": float(np.percentile(np.repeat(length, length), 25)),
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
    """How far the free space reaches, how the ground undulates, how many cells are hit."""
    x, y, z = sweep.points[:, :3].T.astype(np.float64)
    distance = np.hypot(x, y)
    wall = (seen.height > BESIDE) & (seen.height < OVERHEAD)
    nearest = np.full(360, np.inf)
    sector = np.degrees(np.arctan2(y[wall], x[wall])).astype(int) % 360
    np.minimum.at(nearest, sector, distance[wall])
    result = {
        f"nearest obstacle, sectors of 1 deg, p{q} [m]": float(np.percentile(np.minimum(nearest, 99.0), q))
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
    low, high = np.zeros(SPEC.shape, bool), np.zeros(SPEC.shape, bool)
    cell = SPEC.index(x[inside], y[inside])
    for grid, mask in ((low, seen.height < RAISED), (high, (seen.height >= RAISED) & (seen.height < OVERHEAD))):
        chosen = mask[inside]
        grid[cell[0][chosen], cell[1][chosen]] = True
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


# --- Truth ------------------------------------------------------------------------------------------

STATES = ("free", "occupied", "unknown")
PUBLISHED = {"free": (25, 36), "occupied": (0.9, 2.5), "unknown": (63, 74)}  # [%] of labels that were published
RADII = (0, 3, 6, 10, 15, 20, 30, 50)  # [m]


def published_label() -> NDArray[np.uint8] | None:
    """Return one label of the paper's own data, (nx, ny) along x forward and y left: 0 unknown, 1 free, 2 occupied."""
    path = DATA.parent / "evilog_label_256x176.npy"
    return np.load(path)[::-1, ::-1] if path.is_file() else None


def truth_shares(state: NDArray[np.uint8]) -> dict[str, float]:
    """Return the shares of states in all cells, and by distance [%]; ignored cells count as unknown."""
    length = SPEC.resolution * SPEC.shape[0] / state.shape[0]
    x, y = (length * (np.arange(n) - (n - 1) / 2) for n in state.shape)
    distance = np.hypot(x[:, None], y)
    result = {}
    for name, value in (("free", state == CellState.FREE), ("occupied", state == CellState.OCCUPIED)):
        result[name] = 100 * float(value.mean())
        for low, high in pairwise(RADII):
            ring = (distance >= low) & (distance < high)
            result[f"{name} at {low} to {high} m"] = 100 * float(value[ring].mean())
    # Along rays from the sensor: what lies behind the first occupied cell?
    along = np.arange(3.5, 50.0, length / 2)
    azimuth = np.radians(np.arange(360))[:, None]
    cell = [
        np.floor(along * d / length + n / 2)
        for d, n in zip((np.cos(azimuth), np.sin(azimuth)), state.shape, strict=True)
    ]
    inside = (cell[0] >= 0) & (cell[0] < state.shape[0]) & (cell[1] >= 0) & (cell[1] < state.shape[1])
    met = state[tuple(np.where(inside, c, 0).astype(int) for c in cell)]
    behind = inside & (np.cumsum(inside & (met == CellState.OCCUPIED), axis=1) > 0)
    result["free of what lies behind the first occupied cell"] = (
        100 * float((met[behind] == CellState.FREE).mean()) if behind.any() else 0.0
    )
    return {"unknown": 100 - result["free"] - result["occupied"], **result}


# --- Comparison -------------------------------------------------------------------------------------

# Sensor of the simulator, its height above ground [m], and the recordings to compare with
PANDAR40 = np.radians([*range(-16, -6), *np.linspace(-6, 2, 25), *range(3, 8)])
_PANDAR40 = {"elevations": tuple(PANDAR40.tolist()), "azimuth_offsets": (0.0,) * len(PANDAR40)}
GROUPS: dict[str, tuple[LidarSpec, float, Callable[[], Iterator[Sweep]]]] = {
    "VLP-32C": (LIDARS["vlp-32c"], 1.98, argoverse2),
    "HDL-32E": (LIDARS["hdl-32e"], 1.85, nuscenes),
    "HDL-64E": (LIDARS["hdl-64e"], 1.75, kitti),
    "Pandar40": (replace(LIDARS["vlp-32c"], name="pandar40", **_PANDAR40), 1.77, pandar40),
}
MARGIN = 1.25  # a simulated median this far beyond the real values is a difference
FLOOR = 0.5  # or this much, in the statistic's own unit, where that is more


def compare(real: Mapping[str, list[dict[str, float]]], fake: list[dict[str, float]]) -> dict[str, Any]:
    """Hold the statistics of simulated scans beside the medians of real sets.

    A statistic is "low" or "high" where the simulated median lies below or above all of this sensor's real
    sets by more than a quarter.
    """
    rows = {}
    names = dict.fromkeys(name for sets in real.values() for one in sets for name in one)
    for name in names:
        made = [one[name] for one in fake if name in one]
        if not made:
            continue
        sets = {
            key: float(np.median([one[name] for one in sweeps if name in one]))
            for key, sweeps in real.items()
            if any(name in one for one in sweeps)
        }
        low, median, high = (float(v) for v in np.percentile(made, (10, 50, 90)))
        least, most = min(sets.values()), max(sets.values())
        verdict = ""
        if median < min(least / MARGIN, least - FLOOR):
            verdict = "low"
        if median > max(most * MARGIN, most + FLOOR):
            verdict = "high"
        rows[name] = {"real": sets, "simulated": {"median": median, "p10": low, "p90": high}, "verdict": verdict}
    return rows


def digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 9.95 else f"{value:.2g}"


def tables(record: Mapping[str, Any]) -> str:
    """Return the comparisons as tables in Markdown."""
    lines = []
    for sensor, group in record["sensors"].items():
        sets = list(group["scans"])
        lines += [f"### {sensor}", "", f"| | {' | '.join(sets)} | simulated, median (10 % to 90 %) | |"]
        lines += ["|---" * (len(sets) + 3) + "|"]
        counts = [f"{n}" for n in group["scans"].values()]
        lines += [f"| scans | {' | '.join(counts)} | {group['simulated scans']} | |"]
        for name, row in group["statistics"].items():
            real = [digits(row["real"][key]) if key in row["real"] else "" for key in sets]
            made = row["simulated"]
            made = f"{digits(made['median'])} ({digits(made['p10'])} to {digits(made['p90'])})"
            lines += [f"| {name} | {' | '.join(real)} | {made} | {row['verdict']} |"]
        lines += [""]
    lines += ["### Truth", "", "| cells [%] | published labels | one published label | aimed, median (10 % to 90 %) |"]
    lines += ["|---" * 4 + "|"]
    for name, row in record["truth"].items():
        made = row["simulated"]
        made = f"{digits(made['median'])} ({digits(made['p10'])} to {digits(made['p90'])})"
        span = "{} to {}".format(*PUBLISHED[name]) if name in PUBLISHED else ""
        label = digits(row["label"]) if row["label"] is not None else ""
        lines += [f"| {name} | {span} | {label} | {made} |"]
    return "\n".join(lines) + "\n"


# --- Picture ----------------------------------------------------------------------------------------


def picture(
    record: Mapping[str, Any],
    sensor: str,
    sweeps: Mapping[str, list[Sweep]],
    shown: Mapping[str, tuple[Sweep, NDArray[np.uint8] | None]],
    path: Path,
) -> None:
    """Draw a range image and a truth grid of each name in `shown`, and histograms of all sweeps by name."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 2.6 * len(shown) + 10), layout="constrained")
    parts = figure.subfigures(len(shown) + 2, 1, height_ratios=[2.5] * len(shown) + [6.0, 3.6])
    colours = np.array([[1, 1, 1], [0.55, 0.8, 0.55], [0.8, 0.1, 0.1], [0.85, 0.85, 0.85]])
    truths = parts[-2].subplots(1, len(shown), squeeze=False)[0]
    for part, ax, (name, (sweep, state)) in zip(parts, truths, shown.items(), strict=False):
        image = part.subplots().imshow(range_picture(sweep), aspect="auto", cmap="turbo", vmin=2, vmax=60)
        part.colorbar(image, label="range [m]", pad=0.005)
        part.suptitle(f"Range image, {name} (layers from top to bottom, azimuth; white: no return)")
        if state is not None:
            ax.imshow(colours[state[::-1, ::-1]], extent=(-28.16, 28.16, -40.96, 40.96), interpolation="nearest")
            ax.set_title(f"Truth, {name} (green free, red occupied, white unknown)")
    for ax, (name, edges) in zip(parts[-1].subplots(1, len(EDGES)), EDGES.items(), strict=True):
        for colour, (group, members) in zip(COLOURS, sweeps.items(), strict=False):
            counts = [histograms(sweep) for sweep in members]
            stack = 100 * np.array([one[name] for one in counts if name in one])
            if len(stack):
                low, median, high = np.percentile(stack, (10, 50, 90), axis=0)
                middle = (edges[1:] + edges[:-1]) / 2
                ax.fill_between(middle, low, high, step="mid", color=colour, alpha=0.25)
                ax.step(middle, median, where="mid", color=colour, label=f"{group}, median; 10 % to 90 %")
        ax.set(xlabel=name, ylabel="returns [%]", yscale="log")
        ax.legend(fontsize=7)
    figure.suptitle(f"{sensor}, real and simulated", fontsize=14)
    figure.supxlabel(caption(record), fontsize=7.5, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def range_picture(sweep: Sweep, columns: int = 1800) -> NDArray[np.float32]:
    """Sort the returns into layers (lowest last) and azimuths (from behind over left); NaN without return."""
    xyz = sweep.points[:, :3]
    turn = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    image = np.full((len(sweep.elevations), columns), np.nan, np.float32)
    image[sweep.layer, np.floor((0.5 - turn) * columns + 0.25).astype(int) % columns] = np.linalg.norm(xyz, axis=1)
    return image[::-1]


# --- Command ----------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--towns", type=int, default=4, help="towns to scan in (default 4)")
    parser.add_argument("--each", type=int, default=10, help="places in each town (default 10)")
    parser.add_argument("--quick", action="store_true", help="one town, two places")
    parser.add_argument("--out", type=Path, default=RESULTS / "realism.json", help="where the figures go")
    parser.add_argument("--picture", type=Path, default=PICTURES / "realism.png", help="where the picture goes")
    options = parser.parse_args()
    if min(options.towns, options.each) < 1:
        parser.error("--towns and --each must be at least 1")
    where = places(1, 2) if options.quick else places(options.towns, options.each)

    record = environment()
    record["versions"]["open3d"] = importlib.metadata.version("open3d")
    record["places"] = [list(place) for place in where]
    real: dict[str, list[Sweep]] = {}
    for sensor, (_, _, reader) in GROUPS.items():
        real[sensor] = list(reader())
        if not real[sensor]:
            print(f"left out: {sensor}: no recording of it under {DATA}")
    sensors = {s: (spec, height) for s, (spec, height, _) in GROUPS.items() if real[s]}
    if not sensors:
        print("nothing to compare with: benchmarks/README.md says which recordings are needed, and where")
        return
    fake: dict[str, list[Sweep]] = {sensor: [] for sensor in sensors}
    truths = []
    for sensor, sweep, state in simulated(sensors, where):
        fake[sensor].append(sweep)
        if state is not None:
            truths.append(state)

    record["sensors"] = {}
    for sensor in sensors:
        sets: dict[str, list[dict[str, float]]] = {}
        for sweep in real[sensor]:
            sets.setdefault(sweep.name, []).append(statistics(sweep))
        made = [statistics(sweep) for sweep in fake[sensor]]
        record["sensors"][sensor] = {
            "scans": {name: len(sweeps) for name, sweeps in sets.items()},
            "simulated scans": len(made),
            "statistics": compare(sets, made),
        }
    label = published_label()
    shares = [truth_shares(state) for state in truths]
    known = truth_shares(label) if label is not None else {}
    record["truth"] = {}
    for name in shares[0]:
        low, median, high = np.percentile([one[name] for one in shares], (10, 50, 90)).tolist()
        record["truth"][name] = {"label": known.get(name), "simulated": {"median": median, "p10": low, "p90": high}}
    text = tables(record)
    print(text)
    write_json(options.out, record)
    options.out.with_suffix(".md").write_text(text)
    first = next(iter(sensors))
    # The scan in the picture is a typical one: its distance to obstacles is the median of all.
    reach = [statistics(sweep)["nearest obstacle, sectors of 1 deg, p50 [m]"] for sweep in fake[first]]
    chosen = int(np.argsort(reach)[len(reach) // 2])
    shown = {"simulated": (fake[first][chosen], truths[chosen])}
    sweeps = {"simulated": fake[first], "real": real[first]}
    picture(record, first, sweeps, shown, options.picture)
    picture(record, first, sweeps, shown | {"real": (real[first][0], label)}, SIDE_BY_SIDE)
    print(f"\nwrote {options.out}, {options.picture}, and, not to be passed on, {SIDE_BY_SIDE}")


if __name__ == "__main__":
    main()
