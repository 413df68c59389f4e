"""Motion at constant speed and turn rate on the plane, and the noise of white accelerations."""

import math

import numpy as np
from numpy.typing import NDArray


def arc(turn_rate: float, dt: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what takes a velocity to the shift within `dt` [s] at constant turn rate [rad/s], and to its end; (2, 2).

    The chord of an arc of length l and turn a is ``l sin(a / 2) / (a / 2)``, in the direction half-way.
    """
    half = 0.5 * turn_rate * dt
    chord = math.sin(half) / half if half else 1.0  # numpy's sinc takes ten times as long for one number
    return dt * chord * _rotation(half), _rotation(2 * half)


def _rotation(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def integrated_noise(dt: float) -> NDArray[np.float64]:
    """Return the covariance, (2, 2), of a white noise integrated twice and once (Bar-Shalom et al. 2001, 6.2.2-12)."""
    return np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
