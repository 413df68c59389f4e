"""A moment of a drive through a town: everything in place, ready for rays."""

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from ogm.pose import inverse, pose, transform_points
from ogm.simulation.arrays import Floats
from ogm.simulation.conditions import Conditions, draw_conditions, layer_errors
from ogm.simulation.mounts import LidarMount
from ogm.simulation.plan import SEQUENCE, DatasetPlan, Moment, moment, sample_rng
from ogm.simulation.recipe import RECIPES, Country, DataRecipe
from ogm.simulation.scene import Scene
from ogm.simulation.sensors import LIDARS, LidarSpec, beams_of
from ogm.simulation.town import Town, build_town
from ogm.simulation.traffic.bodies import ego_body
from ogm.simulation.traffic.departure import Object
from ogm.simulation.traffic.motion import Traffic, TrafficState

REACH = 120.0  # [m] around the ego vehicle, within which moving things are put in place
DRIVES_KEPT = 12  # drives whose traffic is kept in memory, to go on from where they were


class World(NamedTuple):
    """A town, ready for rays."""

    town: Town
    scene: Scene
    ground: Scene


class SceneSetup(NamedTuple):
    """One moment in the world, everything in place: what a sample is made from.

    Attributes
    ----------
    world : World
        Its scene has the moving things where they are.
    state : TrafficState
    objects : tuple of Object
        Those in the scene, in the order of its object numbers.
    spec : LidarSpec
    T_vehicle_sensor, T_world_sensor : (4, 4) float64
    conditions : Conditions, optional
        What a recipe does to the scan.
    steepest : float
        As `ogm.simulation.survey.Limits.steepest`.
    """

    world: World
    state: TrafficState
    objects: tuple[Object, ...]
    spec: LidarSpec
    T_vehicle_sensor: Floats
    T_world_sensor: Floats
    conditions: Conditions | None = None
    steepest: float = np.inf


# The last towns and drives are kept: building a town takes seconds, and traffic goes on from where it was.
_town = lru_cache(maxsize=1)(build_town)
the_ego_body = lru_cache(maxsize=1)(ego_body)


@lru_cache(maxsize=1)
def _world(seed: int, size: float, country: Country | None, threads: int) -> World:
    town = _town(seed, size, country)
    return World(town, Scene(town.mesh, threads=threads), Scene(town.ground, threads=threads))


@lru_cache(maxsize=DRIVES_KEPT)
def _drive(town: int, size: float, country: Country | None, seed: int, clockwise: bool) -> Traffic:
    return Traffic(_town(town, size, country), seed, clockwise=clockwise)


def set_up(plan: DatasetPlan, split: str, index: int, threads: int = 0) -> SceneSetup:
    """Put everything where it is in a sample's moment; `threads` processor cores cast rays, 0 for all."""
    at = moment(plan, split, index)
    recipe = RECIPES.get(plan.recipe)
    world = _world(at.town, plan.town_size, recipe and recipe.country, threads)
    state = traffic_of(plan, at).at(at.time)
    near = put_in_place(world, state)
    mount, (height, forward, roll, pitch) = draw_mount(plan, split, index)
    T_vehicle_sensor = pose(forward, 0.0, height, roll=roll, pitch=pitch)
    spec = replace(LIDARS[mount.lidar], unit=at.traffic)  # another vehicle, another sensor of this kind
    here = SceneSetup(world, state, near, spec, T_vehicle_sensor, state.ego @ T_vehicle_sensor)
    return here if recipe is None else _by_recipe(here, recipe, mount.view, _sequence_rng(plan, split, index, 2))


def draw_mount(plan: DatasetPlan, split: str, index: int) -> tuple[LidarMount, tuple[float, float, float, float]]:
    """Draw the lidar of a sample and its mounting: height, forward [m], roll, pitch [rad].

    All samples of a sequence have the same.
    """
    rng = _sequence_rng(plan, split, index, 0)
    shares = np.cumsum([mount.share for mount in plan.mounts])
    choice = int(np.searchsorted(shares, rng.random() * shares[-1], side="right"))
    mount = plan.mounts[min(choice, len(plan.mounts) - 1)]
    low, high = mount.height or (LIDARS[mount.lidar].height,) * 2
    height, forward = rng.uniform(low, high), rng.uniform(*mount.forward)
    roll, pitch = rng.uniform(-mount.tilt, mount.tilt, 2)
    return mount, (height, forward, roll, pitch)


def traffic_of(plan: DatasetPlan, at: Moment) -> Traffic:
    """Return the traffic of a drive; that of the last drives is kept."""
    recipe = RECIPES.get(plan.recipe)
    return _drive(at.town, plan.town_size, recipe and recipe.country, at.traffic, at.clockwise)


def put_in_place(world: World, state: TrafficState) -> tuple[Object, ...]:
    """Put the things near the ego vehicle where they are, and return them in the order of the scene."""
    near = tuple(one for one in state.objects if np.hypot(*(one.pose - state.ego)[:2, 3]) < REACH)
    world.scene.place([one.mesh.moved(one.pose) for one in near], the_ego_body().mesh.moved(state.ego))
    return near


def _sequence_rng(plan: DatasetPlan, split: str, index: int, purpose: int) -> Generator:
    """Return the random numbers of one sample and one purpose; all samples of a sequence have the same."""
    return sample_rng(plan, split, index // SEQUENCE if split == "sequences" else index, purpose)


def _by_recipe(here: SceneSetup, recipe: DataRecipe, view: float, rng: Generator) -> SceneSetup:
    """Give the sensor the errors of its unit, and the scan its conditions."""
    spec = here.spec
    elevation, distance = layer_errors(recipe, spec.name, spec.layers, spec.unit)
    T = inverse(here.T_world_sensor)
    movers = [np.r_[transform_points(T, one.pose[None, :3, 3])[0], T[:2, :3] @ one.velocity] for one in here.objects]
    conditions = draw_conditions(recipe, beams_of(spec), view, np.array(movers).reshape(-1, 5), rng)
    return here._replace(
        spec=replace(spec, elevation_errors=elevation, range_errors=distance),
        conditions=conditions,
        steepest=recipe.steepest,
    )
