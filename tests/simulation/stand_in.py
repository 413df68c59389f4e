"""Samples that need neither a town nor Open3D."""

from functools import lru_cache

import numpy as np

from ogm.simulation.sample import OBJECT_DTYPE, Beams, SimulatedSample, Weather
from ogm.state import Truth
from ogm.truth import TRUTH_SPEC

SMALL = Beams(
    "small", (-0.3, -0.2, -0.1, 0.1), (0.0, 0.01, 0.0, 0.02), -2 * np.pi / 90, 90, 10.0, ((0.0, 0.0, 0.0),) * 4
)
TALL = Beams("tall", (-0.3, -0.2), (0.0, 0.0), 2 * np.pi / 300, 300, 20.0, ((0.0, 0.0, 0.1),) * 2)
BEAMS = (SMALL, TALL)


def stand_in(plan: object, split: str, index: int, threads: int = 1) -> SimulatedSample:
    """Make a sample out of thin air, the same for the same split and index; it is not to be changed."""
    return _sample(split, index)


@lru_cache(maxsize=200)
def _sample(split: str, index: int) -> SimulatedSample:
    rng = np.random.default_rng([index, len(split)])
    beams = (SMALL, TALL)[index % 2]
    steps = rng.integers(0, 65536, beams.shape).astype(np.uint16) * (rng.random(beams.shape) < 0.7)
    objects = np.zeros(index % 4, OBJECT_DTYPE)
    for name in OBJECT_DTYPE.names or ():
        objects[name] = rng.integers(1, 8, len(objects))
    state = np.zeros(TRUTH_SPEC.shape, np.uint8)
    state[100:200, 50:90], state[300, 300:400], state[10:20] = 1, 2, 3
    state = np.roll(state, index, axis=0)
    heights = (state == 2) * rng.integers(5, 201, state.shape).astype(np.uint8)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(2, 3))
    return SimulatedSample(
        beams=beams,
        steps=steps.astype(np.uint16),
        intensities=rng.integers(0, 256, beams.shape).astype(np.uint8) * (steps > 0),
        truth=Truth(TRUTH_SPEC, state, heights),
        objects=objects,
        T_world_sensor=poses[0],
        T_vehicle_sensor=poses[1],
        velocity=rng.normal(size=3),
        yaw_rate=float(rng.normal()),
        stamp=20.0 + index,
        split=split,
        index=index,
        scenario=index // 10,
        weather=Weather(rain=float(index)),
    )
