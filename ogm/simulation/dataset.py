"""Datasets of simulated samples: lidar points and the true states of the cells around it, on drives through towns.

`make_sample` is a pure function of a plan, the name of a split and an index. Its result is the same on every machine
with the same library versions, in any order and with any number of workers.

>>> from ogm.simulation.dataset import make_sample, simulate
>>> from ogm.simulation.plan import DatasetPlan
>>> plan = DatasetPlan(samples=1, validation=0, test=0, town_size=240)
>>> store = simulate("data", plan, workers=1)                               # doctest: +SKIP
>>> points = make_sample(plan, "training", 0).points                        # doctest: +SKIP
"""

import logging
from collections.abc import Callable
from contextlib import closing
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np

from ogm.extras import install_line
from ogm.pose import inverse, pose
from ogm.scan import Boxes
from ogm.simulation.conditions import draw_weather
from ogm.simulation.mesh import Array, Ints
from ogm.simulation.plan import DatasetPlan, moment, sample_rng
from ogm.simulation.robot_sensors import sensor_spec
from ogm.simulation.sample import LABELS, OBJECT_DTYPE, RANGE_STEP, Beams, SimulatedSample
from ogm.simulation.sensors import beams_of, hd_directions
from ogm.simulation.store import Store
from ogm.simulation.workers import Estimate, Made, begin, check_workers, make_shards, swept, workers_that_fit
from ogm.state import Truth
from ogm.storage.files import FilePath, errors_with_path
from ogm.storage.locks import locked
from ogm.truth import HEIGHT_LIMITS, TRUTH_SPEC, cells_in_boxes
from ogm.truth.boxes import boxes_seen_from

try:
    from ogm.simulation.cells import measure_ground
    from ogm.simulation.kernels import View, make_view
    from ogm.simulation.lidar import air_optics, scan
    from ogm.simulation.moments import SceneSetup, World, sample_sweeps, set_up, the_ego_body
    from ogm.simulation.survey import Known, Limits, aimed_truth, hd_truth
except ImportError as error:
    raise ImportError(
        f"the simulator lacks a package ({error}): {install_line('sim')}; existing datasets can be read without it"
    ) from error

__all__ = ["SceneSetup", "World", "beams_of", "lidars", "make_sample", "set_up", "simulate", "versions"]

_log = logging.getLogger(__name__)

LISTED = 85.0  # [m] from the sensor within which objects are listed, just beyond the corners of the truth grid


def simulate(
    folder: FilePath,
    plan: DatasetPlan,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Callable[[Estimate | Made], object] = lambda event: None,
) -> Store:
    """Make a dataset, or resume an incomplete one.

    Parameters
    ----------
    folder : path
        A new or empty folder, or with `resume` the folder of a dataset.
    plan : DatasetPlan
        With `resume`, the plan of the dataset, or one that differs only in larger numbers of samples.
    workers : int, optional
        Number of processes on this machine; by default as many as cores and memory allow.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``.
    resume : bool
        Whether to continue the dataset in the folder.
    progress : callable
        Function called with an `Estimate` of time and space, then with a `Made` for each finished shard.

    Returns
    -------
    Store

    Raises
    ------
    ValueError
        If the folder holds anything else, the dataset has another plan, or a lidar is unknown.
    OSError
        If the disk is or would become full, workers died, or another process writes the dataset. Finished shards are
        kept; continue with `resume`.
    """
    folder, beams = Path(folder), lidars(plan)
    count = workers_that_fit() if workers is None else workers
    check_workers(count)
    if folder.is_file():
        raise ValueError(f"{folder} is a file; give a new or empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder), errors_with_path(folder), swept(folder, alone=scheduler is None):
        if not resume and Store.exists(folder):
            raise ValueError(f"{folder} already holds a dataset; continue it with resume, or give a new folder")
        store = begin(folder, plan, beams, versions())
        if store.versions != versions():
            _log.warning("the dataset was begun with other library versions; new samples may differ in detail")
        plan = DatasetPlan.from_dict(store.plan)
        with closing(make_shards(store, plan, make_sample, workers=count, scheduler=scheduler)) as events:
            for event in events:
                progress(event)
        return store


def make_sample(plan: DatasetPlan, split: str, index: int, threads: int = 0) -> SimulatedSample:
    """Make one sample of a split.

    Parameters
    ----------
    plan : DatasetPlan
    split : {"training", "validation", "test", "sequences"}
    index : int
        Index in the split, 0 or more; it may exceed the count in the plan.
    threads : int
        Number of processor cores, 0 for all. The sample does not depend on it.
    """
    at, here = moment(plan, split, index), set_up(plan, split, index, threads)
    rng = sample_rng(plan, split, index, 1)
    chosen = here.conditions
    weather = draw_weather(plan.bad_weather, rng) if chosen is None else chosen.weather
    speed, turn = here.state.ego_velocity, here.state.ego_yaw_rate
    if not (rng.random() < plan.in_motion if chosen is None else chosen.in_motion):
        speed, turn = np.zeros(3), 0.0
    paints = [(at.traffic << 20) + thing.track for thing in here.objects]
    place = (here.world.scene, here.spec, here.T_world_sensor)
    gaps: Any = {} if chosen is None else {"active": chosen.active, "dust": chosen.dust}
    image = scan(*place, rng, velocity=speed, yaw_rate=turn, weather=weather, paints=paints, **gaps)
    returns = np.bincount(image.object[(image.object >= 0) & (image.range > 0)], minlength=len(here.objects))
    steps = np.round(image.range / np.float32(RANGE_STEP)).astype(np.uint16)
    intensities = np.round(image.intensity * 255).astype(np.uint8)
    if chosen is not None and not chosen.intensity:
        intensities[:] = 0
    truth = truth_of(plan, here, returns, salt=int(rng.integers(2**31)))
    arrays: Any = (steps, intensities, truth, _listed(here, returns), here.T_world_sensor, here.T_vehicle_sensor)
    motion: Any = (np.asarray(here.state.ego_velocity, np.float64), float(here.state.ego_yaw_rate))
    facts: Any = {"stamp": at.time, "split": split, "index": index, "scenario": at.scenario, "weather": weather}
    facts["measured"] = chosen and chosen.measured
    facts["sweeps"] = sample_sweeps(plan, split, index, here.world)
    return SimulatedSample(beams_of(here.spec), *arrays, *motion, **facts)


def truth_of(plan: DatasetPlan, here: SceneSetup, returns: Ints, *, salt: int = 0) -> Truth:
    """Return the observed truth around the sensor; all cells are unknown for plans with ``truth="none"``.

    Parameters
    ----------
    plan : DatasetPlan
    here : SceneSetup
    returns : (K,) int
        Points of the scan on each object.
    salt : int
        Seed that selects the rays that pass through glass.
    """
    if plan.truth == "none":
        return Truth(TRUTH_SPEC, np.zeros(TRUTH_SPEC.shape, np.uint8))
    low, high = (bound(the_ego_body().mesh.vertices, axis=0) for bound in (np.min, np.max))
    middle = here.state.ego @ pose((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    ego = cells_in_boxes(boxes_seen_from(inverse(here.T_world_sensor), [middle], [high - low]), TRUTH_SPEC)
    scene, below = here.world.scene, measure_ground(here.world.ground, here.T_world_sensor)
    known, limits = (
        Known(_boxes(here), returns, ego),
        Limits(_view(here), here.steepest, HEIGHT_LIMITS._replace(plant=here.plant)),
    )
    if plan.truth == "hd":
        return hd_truth(scene, below, hd_directions(here.spec, plan.hd_layers), known, salt=salt, limits=limits)
    ends = (-np.pi / 2, np.pi / 2) if here.spec.kind else (here.spec.elevations[0], here.spec.elevations[-1])
    return aimed_truth(scene, below, ends, known, salt=salt, limits=limits)


def _view(here: SceneSetup) -> View | None:
    """Return the limits of a scan's visibility, for recipes and robot sensors; None for full visibility.

    The truth of a planar laser covers all heights in its sector, because its plane does not measure the ground.
    """
    spec, chosen = here.spec, here.conditions
    reach = (spec.range_min, spec.range_max, spec.reach)
    if spec.kind:
        ways = spec.directions()
        if spec.kind == "planar":
            ways = np.concatenate([ways * [1, 1, 0] + [0, 0, up] for up in (-1, 1)]).astype(np.float32)
        return make_view(ways, np.ones(ways.shape[:2], np.bool_), reach, 0.0, np.zeros((0, 5)))
    if chosen is None:
        return None
    return make_view(spec.directions(), chosen.active, reach, air_optics(chosen.weather).extinction, chosen.dust)


def _boxes(here: SceneSetup) -> Boxes:
    """Return the boxes of the objects in the sensor's frame."""
    poses, sizes = [thing.pose for thing in here.objects], [thing.size for thing in here.objects]
    return boxes_seen_from(inverse(here.T_world_sensor), poses, sizes)


def _listed(here: SceneSetup, returns: Ints) -> Array:
    """Return rows of `OBJECT_DTYPE` for the objects within `LISTED`, nearest first."""
    rows = np.zeros(len(here.objects), OBJECT_DTYPE)
    T, boxes = inverse(here.T_world_sensor), _boxes(here)
    rows["x"], rows["y"], rows["z"] = boxes.center.T
    rows["length"], rows["width"], rows["yaw"] = boxes.size[:, 0], boxes.size[:, 1], boxes.yaw
    for row, thing in zip(rows, here.objects, strict=True):
        velocity = T[:3, :3] @ np.asarray(thing.velocity)
        row["label"] = LABELS.index(thing.label)
        row["height"], row["vx"], row["vy"], row["track"] = thing.size[2], *velocity[:2], thing.track
    rows["returns"] = returns
    distance = np.hypot(rows["x"], rows["y"])
    order = np.argsort(distance, kind="stable")
    return np.asarray(rows[order[distance[order] < LISTED]])


def lidars(plan: DatasetPlan) -> tuple[Beams, ...]:
    """Return the distinct lidars of a plan, in order of first use.

    Raises
    ------
    ValueError
        If a lidar is unknown, or a planar laser or depth camera is combined with "hd" truth.
    """
    specs = [sensor_spec(name) for name in dict.fromkeys(mount.lidar for mount in plan.mounts)]
    if plan.truth == "hd" and (flat := [spec.name for spec in specs if spec.kind]):
        raise ValueError(
            f'truth "hd" needs a lidar, got {flat[0]}, a planar laser or depth camera; use "aimed" or "none"'
        )
    return tuple(map(beams_of, specs))


def versions() -> dict[str, str]:
    """Return the versions of the libraries that affect a sample's bytes."""
    found = {
        name: [*distributions(name=name)] for name in ("ogm-toolkit", "numpy", "numba", "open3d", "shapely", "zarr")
    }
    return {name: installed[0].version if installed else "unknown" for name, installed in found.items()}
