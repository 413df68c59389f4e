"""A small world to train on: flat ground, a wall across the way, and a lidar of 16 layers."""

import numpy as np
from samples import flat_sample, flat_steps, spinning

from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan
from ogm.simulation.sample import RANGE_STEP
from ogm.simulation.sample import SimulatedSample as Sample
from ogm.state import CellState
from ogm.truth import TRUTH_SPEC

HEIGHT, LAYERS = 1.8, 16
BEAMS = spinning(LAYERS, -25, 3, 240)


def sample(number: int, split: str = "training") -> Sample:
    """A wall at a distance of its own; all before it is free, all behind it unknown."""
    distance = np.random.default_rng([number, len(split)]).uniform(6, 11)
    steps = flat_steps(BEAMS, HEIGHT, distance, reach=30)
    at_wall = np.isclose(steps * RANGE_STEP * BEAMS.directions[..., 0], distance, atol=0.02)
    cx, _ = TRUTH_SPEC.cell_centers
    state = np.where(cx < distance + 0.32, np.uint8(CellState.OCCUPIED), np.uint8(CellState.UNKNOWN))
    state[cx < distance - 0.32] = CellState.FREE
    intensities = np.where(steps > 0, np.where(at_wall, 150, 25), 0).astype(np.uint8)
    return flat_sample(
        split, number, steps, state, beams=BEAMS, intensities=intensities, T_vehicle_sensor=pose(z=HEIGHT)
    )


def frame(number: int) -> Frame:
    """The sample as a frame."""
    one = sample(number)
    scan = Scan(one.points, ring=one.ring)
    return Frame(scan, Mount(HEIGHT, one.T_vehicle_sensor), None, one.truth, name=str(number))
