"""Beam patterns of lidars: plain numbers, from which `ogm.simulation.sensors` makes `LidarSpec`."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np


def _evenly(low: float, high: float, layers: int) -> list[float]:
    steps: list[float] = np.linspace(low, high, layers).tolist()
    return steps


def _zigzag(layers: int, near: float, far: float) -> list[float]:
    """Return azimuth offsets [deg] of layers that four columns of lasers fire in turn."""
    return ([near, far, -near, -far] * layers)[:layers]


# Velodyne VLP-32C user manual: closer layers around the horizon, four columns of lasers.
_VLP_32C = (
    *(-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333, -3.0, -2.667),
    *(-2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0, 1.333, 1.667, 2.333),
    *(3.333, 4.667, 7.0, 10.333, 15.0),
)
_VLP_32C_OFFSETS = (
    *(-1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, -1.4, 1.4, 4.2, -4.2, -1.4, 1.4, 4.2, -4.2, -1.4),
    *(1.4, 4.2, -4.2, -1.4, 1.4, 4.2, -4.2, -1.4, 1.4, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4),
)
# A second one 0.119 m below the first and upside down, as on the cars of Argoverse 2: its elevations and
# offsets change their signs. In order of elevation, the upper sensor first where both have the same.
_UPPER = [(e, 0, a) for e, a in zip(_VLP_32C, _VLP_32C_OFFSETS, strict=True)]
_PAIR = sorted(_UPPER + [(-e, 1, -a) for e, _, a in _UPPER])
# Velodyne VLS-128 (Alpha Prime): 0.11 degrees apart between -6.5 and +4.83.
_VLS_128 = (
    *(-25.0, -19.582, -16.042, -13.565, -11.742, -10.346, -9.244, -8.352, -7.65, -7.15, -6.85, -6.65, -6.5),
    *(round(-6.39 + 0.11 * k, 2) for k in range(103)),
    *(4.98, 5.18, 5.43, 5.73, 6.08, 6.48, 6.98, 7.58, 8.43, 9.7, 11.75, 15.0),
)

# Hesai Pandar40P and Pandar64, user manuals (rounded): close layers from -6 to +2 degrees. Offsets are approximate.
_PANDAR_40P = (-25.0, -19.0, *range(-14, -6), *_evenly(-6, 2, 25), 3.0, 5.0, 8.0, 11.0, 15.0)
_PANDAR_64 = (-25.0, -19.0, *range(-14, -6), *_evenly(-6, 2, 49), 3.0, 5.0, 8.0, 11.0, 15.0)
# Hesai OT128 and QT128 as a real unit of each has them where it returned points, and evenly elsewhere.
_OT_128 = (
    *(-24.7, -23.0, -21.6, -20.3, -19.67, -19.0, -18.33, -17.64),
    *(*_evenly(-17.29, -6.29, 31), *_evenly(-5.91, 1.97, 64), *_evenly(2.4, 15.1, 25)),
)
_QT_128 = (
    *(*_evenly(-52.6, -5.1, 50), *_evenly(-4.25, 18.76, 29)),
    *(*_evenly(19.19, 36.08, 36), *_evenly(37.14, 52.63, 13)),
)

# Elevations and azimuth offsets [deg], the step between columns [rad], and what differs from the defaults.
PATTERNS: dict[str, tuple[Sequence[float], Sequence[float], float, dict[str, Any]]] = {
    "vlp-32c": (_VLP_32C, _VLP_32C_OFFSETS, math.radians(0.2), {}),
    "dual-vlp-32c": ([e for e, _, _ in _PAIR], [a for _, _, a in _PAIR], math.radians(0.2),
        {"origins": tuple((0.0, 0.0, -0.119 * lower) for _, lower, _ in _PAIR), "height": 2.0}),
    "hdl-32e": (_evenly(-30.67, 10.67, 32), [0.0] * 32, 2 * math.pi / 1085,
        {"rate": 20.0, "range_max": 100.0, "reach": 165.0, "range_noise": 0.004, "range_step": 0.002}),
    "hdl-64e": ([*_evenly(-24.33, -8.83, 32), *_evenly(-8.33, 2.0, 32)], [-3.5, 3.5] * 32, 2 * math.pi / 2083,
        {"range_min": 0.9, "range_max": 120.0, "reach": 180.0, "range_noise": 0.008, "range_step": 0.002,
         "divergence": 0.002, "height": 1.73}),
    "vls-128": (_VLS_128, [0.0] * 128, math.radians(0.2), {"range_max": 245.0, "reach": 305.0, "range_noise": 0.008}),
    "os1-64": (_evenly(-22.5, 22.5, 64), [3.16, 1.05, -1.05, -3.16] * 16, 2 * math.pi / 1024,
        {"range_max": 120.0, "reach": 165.0, "range_noise": 0.012, "range_step": 0.003, "divergence": 0.0023}),
    # Velodyne VLP-16: evenly, 2 degrees apart.
    "vlp-16": (_evenly(-15, 15, 16), [0.0] * 16, math.radians(0.2), {"range_max": 100.0, "reach": 150.0}),
    # Hesai PandarXT-32: 1 degree apart.
    "xt32": (_evenly(-16, 15, 32), [0.0] * 32, math.radians(0.18), {"range_min": 0.3, "range_max": 120.0,
        "reach": 200.0, "range_noise": 0.006}),
    "pandar40p": (_PANDAR_40P, _zigzag(40, 1.042, 3.257), math.radians(0.2), {"range_min": 0.5, "reach": 200.0,
        "range_noise": 0.01}),
    "pandar64": (_PANDAR_64, _zigzag(64, 1.042, 3.257), math.radians(0.2), {"range_min": 0.5, "reach": 200.0,
        "range_noise": 0.01}),
    "ot128": (_OT_128, [0.0] * 128, math.radians(0.2), {"range_min": 0.5, "range_max": 230.0, "reach": 250.0,
        "range_noise": 0.01}),
    "os1-128": (_evenly(-22.5, 22.5, 128), [4.23, 1.41, -1.41, -4.23] * 32, 2 * math.pi / 1024,
        {"range_max": 120.0, "reach": 165.0, "range_noise": 0.012, "range_step": 0.003, "divergence": 0.0023}),
    # Hesai QT128: a wide field of view for the blind zone beside a vehicle; 20 m at 10 %.
    "qt128": (_QT_128, [0.0] * 128, math.radians(0.4), {"range_min": 0.1, "range_max": 60.0,
        "reach": 70.0, "range_noise": 0.015, "divergence": 0.007}),
    # Hesai AT128, as if it turned: it fires 120 degrees of it (`LidarMount.view`), 0.2 degrees from layer to layer.
    "at128": (_evenly(-12.36, 13.04, 128), [0.0] * 128, math.radians(0.1), {"range_min": 0.5, "reach": 250.0,
        "range_noise": 0.012, "divergence": 0.0017, "height": 1.7}),
}  # fmt: skip
