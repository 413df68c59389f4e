"""Simulated samples that need neither a town nor Open3D: flat ground, and a wall across the way."""

from typing import Any

import numpy as np

from ogm.simulation.sample import OBJECT_DTYPE, RANGE_STEP, Beams, SimulatedSample
from ogm.state import Truth
from ogm.truth import TRUTH_SPEC


def spinning(layers: int, low: float, high: float, columns: int, name: str = "") -> Beams:
    """Return the beams of a lidar that turns clockwise from behind; elevations [degree]."""
    elevations, offsets = np.radians(np.linspace(low, high, layers)), ((0.0, 0.0, 0.0),) * layers
    name = name or f"test-{layers}"
    return Beams(name, tuple(elevations), (np.pi,) * layers, -2 * np.pi / columns, columns, 10.0, offsets)


BEAMS = spinning(16, -20, 3, 360)


def flat_steps(beams: Beams = BEAMS, height: float = 1.9, wall: float = np.inf, reach: float = 60.0) -> np.ndarray:
    """Return range steps of flat ground below the sensor and of a wall ahead [m]; 0 without echo."""
    x, _, z = np.moveaxis(beams.directions.astype(np.float64), -1, 0)
    with np.errstate(divide="ignore"):
        distance = np.minimum(np.where(z < 0, -height / z, np.inf), np.where(x > 0, wall / x, np.inf))
    return np.where(distance < reach, distance / RANGE_STEP, 0).astype(np.uint16)


def flat_sample(split: str, index: int, steps: np.ndarray, state: Any = 0, **facts: Any) -> SimulatedSample:
    """Return a sample with these ranges and cell states, by default without objects, at the origin and at rest."""
    states = np.ascontiguousarray(np.broadcast_to(np.asarray(state, np.uint8), TRUTH_SPEC.shape))
    facts = {
        "beams": BEAMS, "intensities": np.where(steps > 0, 30, 0).astype(np.uint8),
        "objects": np.zeros(0, OBJECT_DTYPE),
        "T_world_sensor": np.eye(4), "T_vehicle_sensor": np.eye(4), "velocity": np.zeros(3), "yaw_rate": 0.0,
        "stamp": 0.0, "scenario": 0,
    } | facts  # fmt: skip
    return SimulatedSample(steps=steps, truth=Truth(TRUTH_SPEC, states), split=split, index=index, **facts)
