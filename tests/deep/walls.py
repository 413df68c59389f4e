"""A small world to train on: flat ground, a wall across the way, and a lidar of 16 layers."""

import numpy as np

from ogm.scan import Frame, Mount, Scan
from ogm.simulation.sample import OBJECT, RANGE_STEP, Beams
from ogm.simulation.sample import SimulatedSample as Sample
from ogm.state import CellState, Truth
from ogm.truth import TRUTH_SPEC

HEIGHT, LAYERS = 1.8, 16
BEAMS = Beams(
    "test-16",
    elevation=tuple(np.radians(np.linspace(-25, 3, LAYERS))),
    azimuth=(np.pi,) * LAYERS,
    step=-2 * np.pi / 240,
    columns=240,
    rate=10.0,
    origin=((0.0, 0.0, 0.0),) * LAYERS,
)


def sample(number: int, split: str = "training") -> Sample:
    """A wall at a distance of its own; all before it is free, all behind it unknown."""
    distance = np.random.default_rng([number, len(split)]).uniform(6, 11)
    x, _, z = np.moveaxis(BEAMS.directions.astype(np.float64), -1, 0)
    with np.errstate(divide="ignore"):
        ground, wall = np.where(z < 0, -HEIGHT / z, np.inf), np.where(x > 0, distance / x, np.inf)
    r = np.minimum(ground, wall)
    steps = np.where(r < 30, r / RANGE_STEP, 0).astype(np.uint16)
    cx, _ = TRUTH_SPEC.cell_centers
    state = np.where(cx < distance + 0.32, np.uint8(CellState.OCCUPIED), np.uint8(CellState.UNKNOWN))
    state[cx < distance - 0.32] = CellState.FREE
    T = np.eye(4)
    T[2, 3] = HEIGHT
    return Sample(
        beams=BEAMS,
        steps=steps,
        intensities=np.where(steps > 0, np.where(wall < ground, 150, 25), 0).astype(np.uint8),
        truth=Truth(TRUTH_SPEC, np.ascontiguousarray(np.broadcast_to(state, TRUTH_SPEC.shape))),
        objects=np.zeros(0, OBJECT),
        T_world_sensor=np.eye(4),
        T_vehicle_sensor=T,
        velocity=np.zeros(3),
        yaw_rate=0.0,
        stamp=0.0,
        split=split,
        index=number,
        scenario=0,
    )


def frame(number: int) -> Frame:
    """The sample as a frame."""
    one = sample(number)
    scan = Scan(one.points, ring=one.ring)
    return Frame(scan, Mount(HEIGHT, one.T_vehicle_sensor), None, one.truth, name=str(number))
