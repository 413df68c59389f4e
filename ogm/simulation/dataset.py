"""Data sets of simulated samples: the lidar's points and the truth around it on drives through towns.

`make_sample` is a pure function of a plan, the name of a split and a number: the same on any machine with the
same versions of the libraries, whatever else is made at the same time.

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
from ogm.simulation.sample import LABELS, OBJECT, RANGE_STEP, Beams, SimulatedSample
from ogm.simulation.sensors import beams_of, hd_directions
from ogm.simulation.store import Store
from ogm.simulation.workers import Estimate, Made, begin, check_workers, make_shards, swept, workers_that_fit
from ogm.state import Truth
from ogm.storage.files import FilePath, naming
from ogm.storage.locks import locked
from ogm.truth import TRUTH_SPEC, cells_in_boxes
from ogm.truth.boxes import boxes_seen_from

try:
    from ogm.simulation.cells import measure_ground
    from ogm.simulation.kernels import View, make_view
    from ogm.simulation.lidar import air_of, scan
    from ogm.simulation.moments import SceneSetup, World, sample_sweeps, set_up, the_ego_body
    from ogm.simulation.survey import Known, Limits, aimed_truth, hd_truth
except ImportError as error:
    raise ImportError(
        f"the simulator lacks a package ({error}): {install_line('sim')}; existing data sets can be read without"
    ) from error

__all__ = ["SceneSetup", "World", "beams_of", "lidars", "make_sample", "set_up", "simulate", "versions"]

_log = logging.getLogger(__name__)

LISTED = 85.0  # [m] around the sensor, within which objects are listed: a little more than the truth's corners


def simulate(
    folder: FilePath,
    plan: DatasetPlan,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Callable[[Estimate | Made], object] = lambda event: None,
) -> Store:
    """Make a data set, or go on with one.

    Parameters
    ----------
    folder : path
        New or empty; with `resume`, that of a data set.
    plan : DatasetPlan
        With `resume`, the data set's own plan or one with more samples.
    workers : int, optional
        Processes on this machine; by default as many as cores and memory allow.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``.
    resume : bool
        Whether the folder may hold a data set.
    progress : callable
        Called with an `Estimate` of the time and space needed, then with each shard that is `Made`.

    Returns
    -------
    Store

    Raises
    ------
    ValueError
        If the folder holds something else, the data set was begun by another plan, or a lidar is unknown.
    OSError
        If the disk is full or will be, or workers die. Finished shards are complete; go on with `resume`. Also if
        another process makes the data set.
    """
    folder, beams = Path(folder), lidars(plan)
    count = workers_that_fit() if workers is None else workers
    check_workers(count)
    if folder.is_file():
        raise ValueError(f"{folder} is a file; give a new or empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder), naming(folder), swept(folder, alone=scheduler is None):
        if not resume and Store.exists(folder):
            raise ValueError(f"{folder} holds a data set already; go on with it (resume), or give a new folder")
        store = begin(folder, plan, beams, versions())
        if store.versions != versions():
            _log.warning("the data set was begun with other versions of libraries; new samples may differ in detail")
        plan = DatasetPlan.from_dict(store.plan)
        with closing(make_shards(store, plan, make_sample, workers=count, scheduler=scheduler)) as events:
            for event in events:
                progress(event)
        return store


def make_sample(plan: DatasetPlan, split: str, index: int, threads: int = 0) -> SimulatedSample:
    """Make one sample.

    Parameters
    ----------
    plan : DatasetPlan
    split : {"training", "validation", "test", "sequences"}
    index : int
        Number in the split, 0 or more; not bound by the plan's counts.
    threads : int
        Processor cores to use, 0 for all. The sample does not depend on it.
    """
    at, here = moment(plan, split, index), set_up(plan, split, index, threads)
    rng = sample_rng(plan, split, index, 1)
    chosen = here.conditions
    weather = draw_weather(plan.bad_weather, rng) if chosen is None else chosen.weather
    speed, turn = here.state.ego_velocity, here.state.ego_yaw_rate
    if not (rng.random() < plan.in_motion if chosen is None else chosen.in_motion):
        speed, turn = np.zeros(3), 0.0
    coats = [(at.traffic << 20) + one.track for one in here.objects]
    place = (here.world.scene, here.spec, here.T_world_sensor)
    gaps: Any = {} if chosen is None else {"seeing": chosen.seeing, "dust": chosen.dust}
    image = scan(*place, rng, velocity=speed, yaw_rate=turn, weather=weather, coats=coats, **gaps)
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
    """Observe the truth around the sensor, in the way that the plan wants; all is unknown if it wants none.

    Parameters
    ----------
    plan : DatasetPlan
    here : SceneSetup
    returns : (K,) int
        Points that the sensor's scan has on each of the objects.
    salt : int
        Decides which rays pass through glass.
    """
    if plan.truth == "none":
        return Truth(TRUTH_SPEC, np.zeros(TRUTH_SPEC.shape, np.uint8))
    low, high = (bound(the_ego_body().mesh.vertices, axis=0) for bound in (np.min, np.max))
    middle = here.state.ego @ pose((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    ego = cells_in_boxes(boxes_seen_from(inverse(here.T_world_sensor), [middle], [high - low]), TRUTH_SPEC)
    scene, below = here.world.scene, measure_ground(here.world.ground, here.T_world_sensor)
    known, limits = Known(_boxes(here), returns, ego), Limits(_view(here), here.steepest)
    if plan.truth == "hd":
        return hd_truth(scene, below, hd_directions(here.spec, plan.hd_layers), known, salt=salt, limits=limits)
    ends = (-np.pi / 2, np.pi / 2) if here.spec.kind else (here.spec.elevations[0], here.spec.elevations[-1])
    return aimed_truth(scene, below, ends, known, salt=salt, limits=limits)


def _view(here: SceneSetup) -> View | None:
    """Return where a scan can see that was taken by a recipe, or not by a lidar; None for all round.

    The truth of a planar laser holds all heights in its sector, as its own plane tells nothing of the ground.
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
    return make_view(spec.directions(), chosen.seeing, reach, air_of(chosen.weather).extinction, chosen.dust)


def _boxes(here: SceneSetup) -> Boxes:
    """Return the boxes of the objects in the sensor's frame."""
    poses, sizes = [one.pose for one in here.objects], [one.size for one in here.objects]
    return boxes_seen_from(inverse(here.T_world_sensor), poses, sizes)


def _listed(here: SceneSetup, returns: Ints) -> Array:
    """Return the rows of the objects nearby, the nearest first."""
    rows = np.zeros(len(here.objects), OBJECT)
    T, boxes = inverse(here.T_world_sensor), _boxes(here)
    rows["x"], rows["y"], rows["z"] = boxes.center.T
    rows["length"], rows["width"], rows["yaw"] = boxes.size[:, 0], boxes.size[:, 1], boxes.yaw
    for row, one in zip(rows, here.objects, strict=True):
        velocity = T[:3, :3] @ np.asarray(one.velocity)
        row["label"] = LABELS.index(one.label)
        row["height"], row["vx"], row["vy"], row["track"] = one.size[2], *velocity[:2], one.track
    rows["returns"] = returns
    distance = np.hypot(rows["x"], rows["y"])
    order = np.argsort(distance, kind="stable")
    return np.asarray(rows[order[distance[order] < LISTED]])


def lidars(plan: DatasetPlan) -> tuple[Beams, ...]:
    """Return the plan's lidars, each once, in the order in which it names them.

    Raises
    ------
    ValueError
        If there is no lidar of such a name, or one has no truth of that kind.
    """
    specs = [sensor_spec(name) for name in dict.fromkeys(mount.lidar for mount in plan.mounts)]
    if plan.truth == "hd" and (flat := [spec.name for spec in specs if spec.kind]):
        raise ValueError(f'truth "hd" needs a lidar with more layers, got {flat[0]}; take "aimed" or "none"')
    return tuple(map(beams_of, specs))


def versions() -> dict[str, str]:
    """Return the versions of the libraries that the bytes of a sample depend on."""
    found = {
        name: [*distributions(name=name)] for name in ("ogm-toolkit", "numpy", "numba", "open3d", "shapely", "zarr")
    }
    return {name: installed[0].version if installed else "unknown" for name, installed in found.items()}
