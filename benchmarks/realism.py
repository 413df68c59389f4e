"""How much do simulated scans look like real ones? The same statistics of both, and truth beside a published label.

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
import struct
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
from ogm.simulation.lidar import LIDARS, LidarSpec, scan
from ogm.simulation.scene import Scene
from ogm.simulation.survey import aimed_truth, look_down
from ogm.simulation.town import Town, build_town
from ogm.simulation.traffic import Frame, Traffic, own_vehicle
from ogm.truth import FREE, OCCUPIED, boxes_seen_from

SIDE_BY_SIDE = ROOT / "runs" / "realism" / "side_by_side.png"
SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
COARSE = GridSpec.centered(length=120.0, width=120.0, resolution=1.0)
REACH = 60.0  # [m] as far as the ground is estimated, and returns are told ground from obstacle
RAISED = 0.15  # [m] what lies higher above the estimated ground counts as obstacle
BESIDE, OVERHEAD = 0.3, 2.0  # [m] obstacles that bound the free space lie between these heights
JUMP, EDGE = (
    0.5,
    1.0,
)  # [m] between neighbours in a ring: another surface; a wide enough edge for mixed pixels
STEP_OFF = 0.3  # [m] how far from both surfaces a mixed pixel lies
SMOOTH = 0.15  # [m] neighbours in a ring on one smooth surface
NEAR = 25.0  # [m] range noise is told from returns up to here
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
REAL_COLOUR, SIMULATED_COLOUR = ("#2c5f9e", "#7fa8d6", "#9c6bb3"), "#1b7837"


class Sweep(NamedTuple):
    """One turn of one lidar, real or simulated, without returns from the own vehicle."""

    name: str
    points: NDArray[np.float32]  # (N, 4) x, y, z in the sensor's frame [m], intensity [0, 255]
    layer: NDArray[np.int64]  # (N,) 0 is the lowest
    column: NDArray[np.int64]  # (N,) number of the firing within the turn
    elevations: NDArray[np.float64]  # (layers,) [deg] ascending
    columns: int  # firings in a turn
    height: float  # [m] of the sensor above ground
    own: int = 0  # returns from the own vehicle that were taken out
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


def columns_by_turn(
    xyz: NDArray[np.float32], layer: NDArray[np.int64], step: float, columns: int
) -> NDArray[np.int64]:
    """Tell the firings of each layer by how far the sensor turned since the first; `step` is in degrees."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    column = np.zeros(len(xyz), np.int64)
    for k in range(layer.max() + 1):
        (members,) = np.nonzero(layer == k)
        turned = np.degrees(np.unwrap(azimuth[members]))
        turned -= turned[0]
        sense = np.sign(np.median(np.diff(turned))) if len(turned) > 1 else 1.0
        column[members] = np.clip(np.rint(sense * turned / step), 0, columns - 1)
    return column


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


def argoverse1() -> Iterator[Sweep]:
    """Read the upper VLP-32C of one sweep: the file holds its points first, then those of the lower one."""
    table = np.degrees(LIDARS["vlp-32c"].elevations)
    for path in sorted((DATA / "argoverse1").glob("*.ply")):
        sweep = read_scan(path)
        x, y, z = sweep.points[:, 0] - 1.35, sweep.points[:, 1], sweep.points[:, 2]

        def on_table(height: float, sign: int, x: Any = x, y: Any = y, z: Any = z) -> NDArray[np.bool_]:
            elevation = np.degrees(np.arctan2(z - height, np.hypot(x, y)))
            return np.abs(sign * elevation[:, None] - table).min(axis=1) < 0.1

        ours = np.cumsum(on_table(1.6, 1).astype(int) - on_table(1.5, -1))
        end = int(np.argmax(ours)) + 1
        points = sweep.points[:end] * np.float32([1, 1, 1, 255])
        points[:, :3] -= np.float32([1.35, 0.0, 1.6])
        layer, elevations = in_layers(sweep.ring[:end], points)
        column = columns_by_turn(points, layer, 0.199, 1808)
        other = np.hypot(points[:, 0], points[:, 1]) > 3.2
        yield Sweep(
            "Argoverse 1, upper",
            points[other],
            layer[other],
            column[other],
            elevations,
            1808,
            1.6 + estimate_sensor_height(sweep.points),
            int((~other).sum()),
            timed=False,
        )


def nuscenes() -> Iterator[Sweep]:
    """HDL-32E: the file holds every beam, those without a return as points at the sensor."""
    for path in sorted((DATA / "nuscenes_n015").glob("*.pcd.bin")):
        sweep = read_scan(path, axes="nuscenes")
        distance = np.linalg.norm(sweep.points[:, :3], axis=1)
        kept = distance > 2.5
        points = sweep.points[kept] * np.float32([1, 1, 1, 255])
        layer, elevations = in_layers(sweep.ring[kept], points)
        column = np.arange(len(kept)) // 32
        own = int(((distance > 0.55) & ~kept).sum())
        height = estimate_sensor_height(points)
        yield Sweep("nuScenes", points, layer, column[kept], elevations, int(column[-1]) + 1, height, own)


def packets() -> Iterator[Sweep]:
    """HDL-32E packets: 12 blocks of a mark, an azimuth and 32 pairs of distance and intensity."""
    path = DATA / "velodyne_pcap" / "sample_velodyne_hdl32.pcap"
    if not path.is_file():
        return
    data, at = path.read_bytes(), 24
    azimuths, distances, intensities = [], [], []
    pair = np.dtype([("distance", "<u2"), ("intensity", "u1")])
    while at < len(data):
        size = struct.unpack_from("<IIII", data, at)[2]
        for block in range(12):
            start = at + 16 + 42 + 100 * block
            azimuths.append(struct.unpack_from("<H", data, start + 2)[0] / 100)
            pairs = np.frombuffer(data, pair, 32, start + 4)
            distances.append(pairs["distance"] * 0.002)
            intensities.append(pairs["intensity"])
        at += 16 + size
    begin, end = np.nonzero(np.diff(azimuths) < -180)[0][:2] + 1
    # Lasers in the order of firing: every other one from the lowest, the rest from the middle.
    elevation = np.empty(32)
    elevation[0::2], elevation[1::2] = -92 / 3 + np.arange(16) * 4 / 3, -28 / 3 + np.arange(16) * 4 / 3
    azimuth, elevation = -np.radians(azimuths[begin:end])[:, None], np.radians(elevation)[None]
    distance = np.array(distances[begin:end])
    xyz = np.stack(
        [
            distance * np.cos(elevation) * np.cos(azimuth),
            distance * np.cos(elevation) * np.sin(azimuth),
            distance * np.sin(elevation),
        ],
        -1,
    )
    kept = distance > 2.5
    points = np.column_stack([xyz[kept], np.array(intensities[begin:end])[kept]]).astype(np.float32)
    ring = np.broadcast_to(np.arange(32), kept.shape)[kept]
    column = np.broadcast_to(np.arange(len(kept))[:, None], kept.shape)[kept]
    own = int(((distance > 0.5) & ~kept).sum())
    height = estimate_sensor_height(points)
    layer, elevations = in_layers(ring, points)  # one laser of this sensor is dead
    yield Sweep(
        "HDL-32E packets", points, layer, column, elevations, len(kept), height, own, calibrated=False
    )


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


def vls128() -> Iterator[Sweep]:
    """VLS-128: layers told from the exact elevations; no intensities."""
    for path in sorted((DATA / "nebula_apache2" / "vls128").glob("*.pcd")):
        points = read_scan(path).points
        elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
        levels, counts = np.unique(np.round(elevation, 2), return_counts=True)
        levels = levels[counts > 300]
        levels = levels[np.diff(levels, prepend=-90) > 0.015]
        layer = np.abs(elevation[:, None] - levels).argmin(axis=1)
        column = columns_by_turn(points, layer, 0.2, 1800)
        other = np.hypot(points[:, 0], points[:, 1]) > 4.0
        yield Sweep(
            "VLS-128 (nebula)",
            points[other],
            layer[other],
            column[other],
            levels,
            1800,
            estimate_sensor_height(points),
            int((~other).sum()),
            calibrated=False,
            timed=False,
        )


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
        frame = traffic[place.clockwise].at(place.time)
        scene.place([o.mesh.moved(o.pose) for o in frame.objects], own_vehicle().moved(frame.ego))
        for k, (name, (spec, height)) in enumerate(sensors.items()):
            rng = np.random.default_rng([place.seed, int(place.time), int(place.clockwise)])
            T = frame.ego @ pose(0.0, 0.0, height)
            image = scan(scene, spec, T, rng)
            state = true_states(scene, ground, T, spec, frame, image.object) if k == 0 else None
            yield name, sweep_of(image, spec, height, f"town {place.seed}"), state


def true_states(
    scene: Scene, ground: Scene, T: NDArray[np.float64], spec: LidarSpec, frame: Frame, hit: NDArray[Any]
) -> NDArray[np.uint8]:
    """Return the true states of the cells of `SPEC` around the sensor."""
    returns = np.bincount(hit[hit >= 0], minlength=len(frame.objects))
    boxes = None
    if frame.objects:
        poses, sizes = (np.stack([np.asarray(o[k]) for o in frame.objects]) for k in (1, 2))
        boxes = boxes_seen_from(inverse(T), poses, sizes)
    below = look_down(ground, T, SPEC)
    span = (min(spec.elevations), max(spec.elevations))
    truth = aimed_truth(
        scene, below, T, span, SPEC, boxes=boxes, returns=returns if boxes is not None else None
    )
    return truth.state


def sweep_of(image: Any, spec: LidarSpec, height: float, name: str) -> Sweep:
    """Turn a range image into a sweep."""
    hit = (image.range > 0) & (image.object != -2)
    layer, column = np.nonzero(hit)
    points = np.empty((len(layer), 4), np.float32)
    points[:, :3] = spec.directions()[hit] * image.range[hit][:, None]
    points[:, 3] = np.rint(255 * image.intensity[hit])
    own = int(((image.range > 0) & (image.object == -2)).sum())
    elevations = np.degrees(spec.elevations)
    return Sweep(name, points, layer, column, elevations, hit.shape[1], height, own)


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
    return View(
        distance, height, near & (height < RAISED) & (height > -REACH / 100), near & (height >= RAISED)
    )


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
        "... from the own vehicle [%]": 100 * sweep.own / beams,
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
                result[f"{name} intensity at {low} to {high} m, median [0, 255]"] = float(
                    np.median(intensity[inside])
                )
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
    for grid, mask in (
        (low, seen.height < RAISED),
        (high, (seen.height >= RAISED) & (seen.height < OVERHEAD)),
    ):
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
PUBLISHED = {
    "free": (25, 36),
    "occupied": (0.9, 2.5),
    "unknown": (63, 74),
}  # [%] of labels that were published
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
    for name, value in (("free", state == FREE), ("occupied", state == OCCUPIED)):
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
    behind = inside & (np.cumsum(inside & (met == OCCUPIED), axis=1) > 0)
    result["free of what lies behind the first occupied cell"] = (
        100 * float((met[behind] == FREE).mean()) if behind.any() else 0.0
    )
    return {"unknown": 100 - result["free"] - result["occupied"], **result}


# --- Comparison -------------------------------------------------------------------------------------

# Sensor of the simulator, its height above ground [m], and the real sets to hold beside it
PANDAR40 = np.radians([*range(-16, -6), *np.linspace(-6, 2, 25), *range(3, 8)])
GROUPS: dict[str, tuple[LidarSpec, float, tuple[Callable[[], Iterator[Sweep]], ...]]] = {
    "VLP-32C": (LIDARS["vlp-32c"], 1.98, (argoverse2, argoverse1)),
    "HDL-32E": (LIDARS["hdl-32e"], 1.85, (nuscenes, packets)),
    "HDL-64E": (LIDARS["hdl-64e"], 1.75, (kitti,)),
    "VLS-128": (LIDARS["vls-128"], 1.99, (vls128,)),
    "Pandar40": (
        replace(
            LIDARS["vlp-32c"],
            name="pandar40",
            elevations=tuple(PANDAR40.tolist()),
            azimuth_offsets=(0.0,) * len(PANDAR40),
        ),
        1.77,
        (pandar40,),
    ),
}
MARGIN = 1.25  # a simulated median this far beyond the real values is called a difference
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
        rows[name] = {
            "real": sets,
            "simulated": {"median": median, "p10": low, "p90": high},
            "verdict": verdict,
        }
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
    lines += [
        "### Truth",
        "",
        "| cells [%] | published labels | one published label | aimed, median (10 % to 90 %) |",
    ]
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
    real: list[Sweep],
    fake: list[Sweep],
    scans: Mapping[str, Sweep],
    truths: Mapping[str, NDArray[np.uint8]],
    path: Path,
) -> None:
    """Draw some scans and truth grids by their names, and histograms of all scans, real and simulated."""
    from matplotlib.figure import Figure

    rows = (*[2.5] * len(scans), 7.0, 3.6)
    figure = Figure(figsize=(16, 1.05 * sum(rows)), layout="constrained")
    parts = figure.subfigures(len(rows), 1, height_ratios=rows)
    for part, (what, sweep) in zip(parts, scans.items(), strict=False):
        ax = part.subplots()
        shown = ax.imshow(
            range_picture(sweep), aspect="auto", interpolation="nearest", cmap="turbo", vmin=2, vmax=60
        )
        ax.set_title(
            f"Range image, {what}: {sweep.name} (layers from top to bottom, azimuth; white: no return)"
        )
        ax.set_xticks([0, 450, 900, 1350, 1799], ["180° (back)", "90° left", "0° ahead", "90° right", "180°"])
        ax.set_yticks([])
        part.colorbar(shown, ax=ax, label="range [m]", pad=0.005)
    axes = parts[-2].subplots(1, len(scans) + len(truths), sharex=True, sharey=True)
    for ax, (what, sweep) in zip(axes, scans.items(), strict=False):
        seen = view(sweep)
        x, y = sweep.points[:, :2].T
        colour = np.clip(seen.height, -0.2, 4.0)
        ax.scatter(-y, x, c=colour, s=0.6, cmap="turbo", vmin=-0.2, vmax=4.0, linewidths=0)
        ax.set_title(f"From above, {what}\n(colour: height above ground, -0.2 to 4 m)")
    colours = np.array([[1, 1, 1], [0.55, 0.8, 0.55], [0.8, 0.1, 0.1], [0.85, 0.85, 0.85]])
    for ax, (what, state) in zip(axes[len(scans) :], truths.items(), strict=True):
        ax.set_title(f"Truth, {what}\n(green free, red occupied, white unknown)")
        ax.imshow(colours[state[::-1, ::-1]], extent=(-28.16, 28.16, -40.96, 40.96), interpolation="nearest")
    for ax in axes:
        ax.set_xlim(-28.16, 28.16)
        ax.set_ylim(-40.96, 40.96)
        ax.set_aspect("equal")
        ax.set_xlabel("right [m]")
    axes = parts[-1].subplots(1, 5)
    made = [histograms(sweep) for sweep in fake]
    for ax, (name, edges) in zip(axes, EDGES.items(), strict=False):
        middle = (edges[1:] + edges[:-1]) / 2
        stack = 100 * np.array([one[name] for one in made])
        low, median, high = np.percentile(stack, (10, 50, 90), axis=0)
        ax.fill_between(middle, low, high, step="mid", color=SIMULATED_COLOUR, alpha=0.25)
        ax.step(middle, median, where="mid", color=SIMULATED_COLOUR, label="simulated, median; 10 % to 90 %")
        for sweep, colour in zip(real, REAL_COLOUR, strict=False):
            ax.step(middle, 100 * histograms(sweep)[name], where="mid", color=colour, lw=1, label=sweep.name)
        ax.set_xlabel(name)
        ax.set_ylabel("returns [%]")
        ax.set_yscale("log")
        ax.set_ylim(bottom=0.01)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    ax = axes[4]
    shares = 100 * np.array([layer_shares(sweep) for sweep in fake])
    low, median, high = np.percentile(shares, (10, 50, 90), axis=0)
    ax.fill_between(fake[0].elevations, low, high, color=SIMULATED_COLOUR, alpha=0.25)
    ax.plot(fake[0].elevations, median, ".-", color=SIMULATED_COLOUR)
    for sweep, colour in zip(real, REAL_COLOUR, strict=False):
        ax.plot(sweep.elevations, 100 * layer_shares(sweep), ".-", color=colour, lw=1)
    ax.set_xlabel("elevation of the layer [deg]")
    ax.set_ylabel("beams with a return [%]")
    ax.set_ylim(0, 101)
    ax.grid(alpha=0.3)
    figure.suptitle(
        f"{sensor}, real and simulated: {len(real)} real scans, {len(fake)} simulated ones", fontsize=14
    )
    figure.supxlabel(caption(record), fontsize=7.5, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def range_picture(sweep: Sweep, columns: int = 1800) -> NDArray[np.float32]:
    """Sort the returns into layers (lowest last) and azimuths (from behind over left); NaN without return."""
    xyz = sweep.points[:, :3]
    turn = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    image = np.full((len(sweep.elevations), columns), np.nan, np.float32)
    image[sweep.layer, np.floor((0.5 - turn) * columns + 0.25).astype(int) % columns] = np.linalg.norm(
        xyz, axis=1
    )
    return image[::-1]


# --- Command ----------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--towns", type=int, default=4, help="towns to scan in (default 4)")
    parser.add_argument("--each", type=int, default=10, help="places in each town (default 10)")
    parser.add_argument("--quick", action="store_true", help="one town, two places")
    parser.add_argument("--out", type=Path, default=RESULTS / "realism.json", help="where the figures go")
    parser.add_argument(
        "--picture", type=Path, default=PICTURES / "realism.png", help="where the picture goes"
    )
    options = parser.parse_args()
    if min(options.towns, options.each) < 1:
        parser.error("--towns and --each must be at least 1")
    where = places(1, 2) if options.quick else places(options.towns, options.each)

    record = environment()
    record["versions"]["open3d"] = importlib.metadata.version("open3d")
    record["places"] = [list(place) for place in where]
    real: dict[str, list[Sweep]] = {}
    for sensor, (_, _, readers) in GROUPS.items():
        real[sensor] = [sweep for reader in readers for sweep in reader()]
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
        record["truth"][name] = {
            "label": known.get(name),
            "simulated": {"median": median, "p10": low, "p90": high},
        }
    text = tables(record)
    print(text)
    write_json(options.out, record)
    options.out.with_suffix(".md").write_text(text)
    first = next(iter(sensors))
    # The scan in the picture is a typical one: its distance to obstacles is the median of all.
    reach = [statistics(sweep)["nearest obstacle, sectors of 1 deg, p50 [m]"] for sweep in fake[first]]
    chosen = int(np.argsort(reach)[len(reach) // 2])
    scans, grids = {"simulated": fake[first][chosen]}, {"simulated": truths[chosen]}
    picture(record, first, real[first], fake[first], scans, grids, options.picture)
    scans = {"real": real[first][0]} | scans
    grids = grids if label is None else {"published": label} | grids
    picture(record, first, real[first], fake[first], scans, grids, SIDE_BY_SIDE)
    print(f"\nwrote {options.out}, {options.picture}, and, not to be passed on, {SIDE_BY_SIDE}")


if __name__ == "__main__":
    main()
