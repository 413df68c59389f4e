"""Scene of a moment of a drive, ready for ray casting, and its radar sweeps."""

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from ogm.pose import inverse, pose, transform_points
from ogm.simulation.conditions import Conditions, draw_conditions, draw_density, layer_errors
from ogm.simulation.mesh import Floats
from ogm.simulation.mounts import LidarMount
from ogm.simulation.plan import PERIOD, SEQUENCE, SPLITS, DatasetPlan, Moment, moment, sample_rng
from ogm.simulation.radar import sweep
from ogm.simulation.radars import RADARS
from ogm.simulation.recipe import RECIPES, Country, DataRecipe
from ogm.simulation.robot_sensors import sensor_spec
from ogm.simulation.sample import PlacedSweep
from ogm.simulation.scene import Scene
from ogm.simulation.sensors import LidarSpec, beams_of
from ogm.simulation.town import Town, build_town
from ogm.simulation.traffic.bodies import ego_body
from ogm.simulation.traffic.departure import USUAL, Density, Object
from ogm.simulation.traffic.motion import Traffic, TrafficState
from ogm.truth import HEIGHT_LIMITS

REACH = 120.0  # [m] radius around the ego vehicle within which moving objects are placed
CACHED_DRIVES = 12  # drives with their traffic in memory, to continue them


class World(NamedTuple):
    """A town with scenes of all its static meshes and of its ground."""

    town: Town
    scene: Scene
    ground: Scene


class SceneSetup(NamedTuple):
    """Everything a sample is made from: one moment in the world.

    Attributes
    ----------
    world : World
        Town with the moving objects placed in its scene.
    state : TrafficState
    objects : tuple of Object
        Objects in the scene, in the order of its object indices.
    spec : LidarSpec
    T_vehicle_sensor, T_world_sensor : (4, 4) float64
    conditions : Conditions, optional
        Conditions of the scan drawn from a recipe.
    steepest : float
        See `ogm.simulation.survey.Limits.steepest`.
    plant : float
        Height below which plants are drivable [m].
    """

    world: World
    state: TrafficState
    objects: tuple[Object, ...]
    spec: LidarSpec
    T_vehicle_sensor: Floats
    T_world_sensor: Floats
    conditions: Conditions | None = None
    steepest: float = np.inf
    plant: float = HEIGHT_LIMITS.plant


# Recent towns and drives are cached: building a town takes seconds, and traffic continues from its last state.
_town = lru_cache(maxsize=1)(build_town)
the_ego_body = lru_cache(maxsize=1)(ego_body)


@lru_cache(maxsize=1)
def _world(seed: int, size: float, country: Country | None, threads: int) -> World:
    town = _town(seed, size, country)
    return World(town, Scene(town.mesh, threads=threads), Scene(town.ground, threads=threads))


@lru_cache(maxsize=CACHED_DRIVES)
def _drive(town: int, size: float, country: Country | None, seed: int, clockwise: bool, density: Density) -> Traffic:
    return Traffic(_town(town, size, country), seed, clockwise=clockwise, density=density)


def set_up(plan: DatasetPlan, split: str, index: int, threads: int = 0) -> SceneSetup:
    """Return the scene of a sample's moment; `threads` processor cores cast rays, 0 for all."""
    at = moment(plan, split, index)
    recipe = RECIPES.get(plan.recipe)
    world = _world(at.town, plan.town_size, recipe and recipe.country, threads)
    state = traffic_of(plan, at).at(at.time)
    near = put_in_place(world, state)
    mount, (height, forward, roll, pitch) = draw_mount(plan, split, index)
    T_vehicle_sensor = pose(forward, 0.0, height, roll=roll, pitch=pitch)
    spec = replace(sensor_spec(mount.lidar), unit=at.traffic)  # each vehicle has its own unit of the sensor
    here = SceneSetup(world, state, near, spec, T_vehicle_sensor, state.ego @ T_vehicle_sensor)
    return here if recipe is None else _by_recipe(here, recipe, mount.view, _sequence_rng(plan, split, index, 2))


def draw_mount(plan: DatasetPlan, split: str, index: int) -> tuple[LidarMount, tuple[float, float, float, float]]:
    """Draw the lidar of a sample and its height and forward position [m], roll and pitch [rad].

    All samples of a sequence share the result.
    """
    rng = _sequence_rng(plan, split, index, 0)
    shares = np.cumsum([mount.share for mount in plan.mounts])
    choice = int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))
    mount = plan.mounts[min(choice, len(plan.mounts) - 1)]
    low, high = mount.height or (sensor_spec(mount.lidar).height,) * 2
    height, forward = rng.uniform(low, high), rng.uniform(*mount.forward)
    roll, pitch = rng.uniform(-mount.tilt, mount.tilt, 2)
    return mount, (height, forward, roll, pitch)


def traffic_of(plan: DatasetPlan, at: Moment) -> Traffic:
    """Return the traffic of a drive, cached for recent drives."""
    recipe = RECIPES.get(plan.recipe)
    density = USUAL if recipe is None else draw_density(recipe.crowds, at.traffic)
    return _drive(at.town, plan.town_size, recipe and recipe.country, at.traffic, at.clockwise, density)


def put_in_place(world: World, state: TrafficState) -> tuple[Object, ...]:
    """Place the objects near the ego vehicle in the scene, and return them in order."""
    near = tuple(thing for thing in state.objects if np.hypot(*(thing.pose - state.ego)[:2, 3]) < REACH)
    world.scene.place([thing.mesh.moved(thing.pose) for thing in near], the_ego_body().mesh.moved(state.ego))
    return near


def _sequence_rng(plan: DatasetPlan, split: str, index: int, purpose: int) -> Generator:
    """Return the random generator of a sample for a purpose; all samples of a sequence share it."""
    return sample_rng(plan, split, index // SEQUENCE if split == "sequences" else index, purpose)


def _by_recipe(here: SceneSetup, recipe: DataRecipe, view: float, rng: Generator) -> SceneSetup:
    """Apply the calibration errors of the unit to the sensor, and the conditions to the scan."""
    spec = here.spec
    elevation, distance = layer_errors(recipe, spec.name, spec.layers, spec.unit)
    T = inverse(here.T_world_sensor)
    movers = [
        np.r_[transform_points(T, thing.pose[None, :3, 3])[0], T[:2, :3] @ thing.velocity] for thing in here.objects
    ]
    conditions = draw_conditions(recipe, beams_of(spec), view, np.array(movers).reshape(-1, 5), rng)
    return here._replace(
        spec=replace(spec, elevation_errors=elevation, range_errors=distance),
        conditions=conditions,
        steepest=recipe.steepest,
        plant=recipe.plant,
    )


def sweep_times(split: str, time: float, rate: float) -> list[float]:
    """Return the times of a radar's sweeps that belong to a sample [s].

    In `sequences`, these are the multiples of the radar's period within the lidar's turn, so that every sweep of a
    drive belongs to one sample. In the other splits, it is the sample's time only.
    """
    if split != "sequences":
        return [time]
    first = math.ceil((time - PERIOD / 2) * rate - 1e-6)
    last = math.ceil((time + PERIOD / 2) * rate - 1e-6)
    return [k / rate for k in range(first, last)]


def sample_sweeps(plan: DatasetPlan, split: str, index: int, world: World) -> tuple[PlacedSweep, ...]:
    """Simulate the sweeps of all radars that belong to a sample.

    Parameters
    ----------
    plan, split, index
        See `ogm.simulation.dataset.make_sample`.
    world : World
        World of the sample. Its moving objects stay at their positions of the last sweep.

    Returns
    -------
    tuple of PlacedSweep
        Sweeps in the order of the plan's radars, each radar's in order of time.
    """
    at = moment(plan, split, index)
    taken = [
        (time, number)
        for number, mount in enumerate(plan.radars)
        for time in sweep_times(split, at.time, RADARS[mount.radar].rate)
    ]
    result: dict[tuple[float, int], PlacedSweep] = {}
    for time in dict.fromkeys(time for time, _ in sorted(taken)):
        state = traffic_of(plan, at).at(time)
        near = put_in_place(world, state)
        velocities = np.array([thing.velocity for thing in near]).reshape(-1, 3)
        tracks = np.array([*(thing.track for thing in near), -1])
        for number in (number for other, number in taken if other == time):
            mount = plan.radars[number]
            T = state.ego @ pose(mount.x, mount.y, mount.z, yaw=mount.yaw)
            arm = T[:3, 3] - state.ego[:3, 3]
            own = np.asarray(state.ego_velocity) + state.ego_yaw_rate * np.array([-arm[1], arm[0], 0.0])
            rng = np.random.default_rng([plan.seed, 6, SPLITS.index(split), index, number, round(1e6 * time)])
            spec = RADARS[mount.radar]
            found = sweep(world.scene, spec, T, rng, velocity=own, velocities=velocities)
            placed = found._replace(object=tracks[found.object].astype(np.int32))
            result[time, number] = PlacedSweep(number, time, T, own, placed)
    return tuple(result[key] for key in sorted(result, key=lambda key: key[::-1]))
