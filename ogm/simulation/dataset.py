"""Samples of a data set: what a drive through a town looks like to its lidar, and what is true.

`sample` is a pure function of a plan, the name of a split and a number: the same on any machine with the same
versions of the libraries, whoever else makes samples at the same time.
"""

from collections import OrderedDict
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ogm.pose import inverse, pose
from ogm.scan import Boxes
from ogm.simulation.plan import Plan, moment, mount_of, random
from ogm.simulation.sample import LABELS, OBJECT, RANGE_STEP, Beams, Sample
from ogm.simulation.sensors import LIDARS, LidarSpec, hd_directions
from ogm.state import Truth
from ogm.truth import TRUTH_SPEC, boxes_seen_from, cells_in_boxes

try:
    from ogm.simulation.lidar import CLEAR, Weather, scan
    from ogm.simulation.scene import Scene
    from ogm.simulation.survey import aimed_truth, hd_truth, look_down
    from ogm.simulation.town import Town, build_town
    from ogm.simulation.traffic import Frame, Object, Traffic, own_vehicle
except ImportError as error:
    raise ImportError(
        f'the simulator lacks a package ({error}): pip install "ogm-toolkit[sim]"; '
        "data sets that are there can be read without"
    ) from error

__all__ = ["Look", "World", "beams_of", "look", "sample", "threads_per_sample", "versions", "world_of"]

REACH = 120.0  # [m] around the own vehicle, within which moving things are put in place
LISTED = (
    85.0  # [m] around the sensor, within which objects are listed: a little more than the canvas's corners
)
DRIVES_KEPT = 12  # drives whose traffic is kept in memory, to go on from where they were

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class World(NamedTuple):
    """A town, ready for rays."""

    town: Town
    scene: Scene
    ground: Scene


class Look(NamedTuple):
    """One moment in the world, everything in place: what a sample is made from.

    Attributes
    ----------
    world : World
        Its scene has the moving things where they are.
    frame : Frame
    objects : tuple of Object
        Those in the scene, in the order of its object numbers.
    spec : LidarSpec
    T_vehicle_sensor, T_world_sensor : (4, 4) float64
    """

    world: World
    frame: Frame
    objects: tuple[Object, ...]
    spec: LidarSpec
    T_vehicle_sensor: NDArray[np.float64]
    T_world_sensor: NDArray[np.float64]


_threads = 0


def threads_per_sample(count: int) -> None:
    """Set how many cores this process uses for one sample; 0 for all. The samples do not depend on it."""
    global _threads
    if count != _threads:
        _threads = count
        world_of.cache_clear()


@lru_cache(maxsize=1)
def _town(seed: int, size: float) -> Town:
    return build_town(seed, size)


@lru_cache(maxsize=1)
def world_of(seed: int, size: float) -> World:
    """Build a town, or take the one that was built last."""
    town = _town(seed, size)
    return World(town, Scene(town.mesh, threads=_threads), Scene(town.ground, threads=_threads))


_drives: OrderedDict[tuple, Traffic] = OrderedDict()


def _drive(town: int, size: float, traffic: int, clockwise: bool) -> Traffic:
    key = (town, size, traffic, clockwise)
    if key not in _drives:
        _drives[key] = Traffic(world_of(town, size).town, traffic, clockwise=clockwise)
        while len(_drives) > DRIVES_KEPT:
            _drives.popitem(last=False)
    _drives.move_to_end(key)
    return _drives[key]


@lru_cache(maxsize=1)
def _own() -> Any:
    return own_vehicle()


def look(plan: Plan, split: str, index: int) -> Look:
    """Put everything where it is in a sample's moment."""
    at = moment(plan, split, index)
    world = world_of(at.town, plan.town_size)
    frame = _drive(at.town, plan.town_size, at.traffic, at.clockwise).at(at.time)
    near = tuple(one for one in frame.objects if _distance(one.pose, frame.ego) < REACH)
    own = _own().moved(frame.ego)
    world.scene.place([one.mesh.moved(one.pose) for one in near], own)
    mount, (height, forward, roll, pitch) = mount_of(plan, split, index)
    T_vehicle_sensor = pose(forward, 0.0, height, roll=roll, pitch=pitch)
    spec = replace(LIDARS[mount.lidar], unit=at.traffic)  # another vehicle, another sensor of this kind
    return Look(world, frame, near, spec, T_vehicle_sensor, frame.ego @ T_vehicle_sensor)


def sample(plan: Plan, split: str, index: int) -> Sample:
    """Make one sample.

    Parameters
    ----------
    plan : Plan
    split : {"training", "validation", "test", "sequences"}
    index : int
        Number in the split, 0 or more; not bound by the plan's counts.
    """
    at, here = moment(plan, split, index), look(plan, split, index)
    rng = random(plan, split, index, 1)
    weather = _weather(plan, rng)
    moves = rng.random() < plan.in_motion
    image = scan(
        here.world.scene,
        here.spec,
        here.T_world_sensor,
        rng,
        velocity=here.frame.ego_velocity if moves else np.zeros(3),
        yaw_rate=here.frame.ego_yaw_rate if moves else 0.0,
        weather=weather,
        coats=[(at.traffic << 20) + one.track for one in here.objects],
    )
    returns = np.bincount(image.object[(image.object >= 0) & (image.range > 0)], minlength=len(here.objects))
    return Sample(
        beams=beams_of(here.spec),
        steps=np.round(image.range / np.float32(RANGE_STEP)).astype(np.uint16),
        intensities=np.round(image.intensity * 255).astype(np.uint8),
        truth=truth_of(plan, here, returns, salt=int(rng.integers(2**31))),
        objects=_listed(here, returns),
        T_world_sensor=here.T_world_sensor,
        T_vehicle_sensor=here.T_vehicle_sensor,
        velocity=np.asarray(here.frame.ego_velocity, np.float64),
        yaw_rate=float(here.frame.ego_yaw_rate),
        stamp=at.time,
        split=split,
        index=index,
        scenario=at.scenario,
        weather=weather,
    )


def truth_of(plan: Plan, here: Look, returns: NDArray[np.int64], *, salt: int = 0) -> Truth:
    """Find out what is true around the sensor, the way that the plan wants.

    Parameters
    ----------
    plan : Plan
    here : Look
    returns : (K,) int
        Points that the sensor's scan has on each of the objects.
    salt : int
        Decides which rays pass through glass.
    """
    T = inverse(here.T_world_sensor)
    boxes = _boxes(T, [(one.pose, one.size) for one in here.objects])
    low, high = _own().vertices.min(axis=0), _own().vertices.max(axis=0)
    middle = here.frame.ego @ pose((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    ego = cells_in_boxes(_boxes(T, [(middle, high - low)]), TRUTH_SPEC)
    below = look_down(here.world.ground, here.T_world_sensor)
    known: dict[str, Any] = {"boxes": boxes, "returns": returns, "unobserved": ego, "salt": salt}
    if plan.truth == "hd":
        rays = hd_directions(here.spec, plan.hd_layers)
        return hd_truth(here.world.scene, below, here.T_world_sensor, rays, TRUTH_SPEC, **known)
    ends = (min(here.spec.elevations), max(here.spec.elevations))
    return aimed_truth(here.world.scene, below, here.T_world_sensor, ends, TRUTH_SPEC, **known)


def _boxes(T: NDArray[np.float64], things: Sequence[tuple[NDArray, NDArray]]) -> Boxes:
    poses = np.array([one for one, _ in things], np.float64).reshape(-1, 4, 4)
    sizes = np.array([one for _, one in things], np.float64).reshape(-1, 3)
    return boxes_seen_from(T, poses, sizes)


def _listed(here: Look, returns: NDArray[np.int64]) -> NDArray[Any]:
    """Return the rows of the objects nearby, the nearest first."""
    rows = np.zeros(len(here.objects), OBJECT)
    T = inverse(here.T_world_sensor)
    boxes = _boxes(T, [(one.pose, one.size) for one in here.objects])
    rows["x"], rows["y"], rows["z"] = boxes.center.T
    rows["length"], rows["width"], rows["yaw"] = boxes.size[:, 0], boxes.size[:, 1], boxes.yaw
    for row, one in zip(rows, here.objects, strict=True):
        velocity = T[:3, :3] @ np.asarray(one.velocity)
        row["label"] = LABELS.index(one.label)
        row["height"], row["vx"], row["vy"], row["track"] = one.size[2], *velocity[:2], one.track
    rows["returns"] = returns
    distance = np.hypot(rows["x"], rows["y"])
    order = np.argsort(distance, kind="stable")
    return rows[order[distance[order] < LISTED]]


def _distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.hypot(*(a[:2, 3] - b[:2, 3])))


def _weather(plan: Plan, rng: np.random.Generator) -> Weather:
    """Draw the weather: clear, or, in a share of the samples, rain, fog or a road that is still wet."""
    bad, kind, strength = rng.random(3)
    if bad >= plan.bad_weather:
        return CLEAR
    if kind < 0.4:
        return CLEAR._replace(rain=float(1 + 24 * strength), wet=1.0)
    if kind < 0.7:
        return CLEAR._replace(fog=float(40 * 10**strength))
    return CLEAR._replace(wet=float(strength))


@lru_cache(maxsize=64)
def beams_of(spec: LidarSpec) -> Beams:
    """Return what turns a lidar's range images into points, without the simulator."""
    return Beams(
        spec.name,
        spec.elevations,
        tuple(spec.first_azimuth + offset for offset in spec.azimuth_offsets),
        -spec.azimuth_step,
        spec.azimuths,
        spec.rate,
        spec.origins or ((0.0, 0.0, 0.0),) * spec.layers,
    )


def lidars(plan: Plan) -> tuple[Beams, ...]:
    """Return the plan's lidars, each once, in the order in which it names them.

    Raises
    ------
    ValueError
        If there is no lidar of such a name.
    """
    for mount in plan.mounts:
        if mount.lidar not in LIDARS:
            raise ValueError(f"there is no lidar {mount.lidar!r}; there are {', '.join(LIDARS)}")
    return tuple(beams_of(LIDARS[name]) for name in dict.fromkeys(mount.lidar for mount in plan.mounts))


def versions() -> dict[str, str]:
    """Return the versions of the libraries that the bytes of a sample depend on."""
    found = {}
    for name in ("ogm-toolkit", "numpy", "numba", "open3d", "shapely", "zarr"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
