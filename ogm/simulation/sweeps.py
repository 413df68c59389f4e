"""The sweeps of a vehicle's radars that belong to a sample."""

import math

import numpy as np

from ogm.pose import pose
from ogm.simulation.detections import PlacedSweep
from ogm.simulation.moments import World, put_in_place, traffic_of
from ogm.simulation.plan import PERIOD, SPLITS, DatasetPlan, moment
from ogm.simulation.radar import sweep
from ogm.simulation.radars import RADARS


def sweep_times(split: str, time: float, rate: float) -> list[float]:
    """Return when the sweeps of a radar are taken that belong to a sample [s].

    In `sequences`, whole multiples of the radar's period within the lidar's turn, so that every sweep of a drive
    belongs to one sample; in the other splits, the sample's time alone.
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
        As of `ogm.simulation.dataset.make_sample`.
    world : World
        The sample's; its moving things stay where the last sweep had them.

    Returns
    -------
    tuple of PlacedSweep
        In the order of the plan's radars, each in the order of time.
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
        velocities = np.array([one.velocity for one in near]).reshape(-1, 3)
        tracks = np.array([*(one.track for one in near), -1])
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
