"""Sensors of robots for the simulator: lasers in one plane and depth cameras.

>>> from ogm.simulation.robot_sensors import ROBOT_SENSORS, depth_camera, planar_laser
>>> ROBOT_SENSORS["utm-30lx"].shape, ROBOT_SENSORS["d435"].shape
((1, 1081), (240, 320))
>>> mine = planar_laser("mine", view=180, step=0.5, range_max=20.0, height=0.2)
>>> ROBOT_SENSORS[mine.name] = mine                                           # now a name for `LidarMount`
>>> del ROBOT_SENSORS[mine.name]
"""

import math
from typing import Any

from ogm.simulation.sensors import LIDARS, LidarSpec

__all__ = ["ROBOT_SENSORS", "depth_camera", "planar_laser", "sensor_spec"]

BUMPER = 2.5  # [m] ahead of the middle of the ego vehicle, which is 4.8 m long


def planar_laser(name: str, view: float, step: float, **numbers: Any) -> LidarSpec:
    """Return a laser in one plane.

    Parameters
    ----------
    name : str
    view : float
        Angle from the first beam to the last one [degree]; 360 for a whole turn.
    step : float
        From beam to beam [degree].
    **numbers
        Others of `LidarSpec`. By default it is mounted 0.3 m above the ground, at the front bumper.
    """
    columns = 0 if view == 360 else round(view / step) + 1
    usual = {"height": 0.3, "forward": BUMPER, "gain_spread": 0.0, "range_bias": 0.0, "divergence": math.radians(step)}
    return LidarSpec(name, (0.0,), (0.0,), math.radians(step), kind="planar", columns=columns, **(usual | numbers))


def depth_camera(name: str, width: int, height: int, focal_length: float, **numbers: Any) -> LidarSpec:
    """Return a depth camera that looks ahead.

    It matches images or patterns, so that depths hardly depend on reflectivity. Between two surfaces there
    are pixels with a mixture of both depths.

    Parameters
    ----------
    name : str
    width, height : int
        Size of its images [pixel].
    focal_length : float
        [pixel]
    **numbers
        Others of `LidarSpec`, as `noise_growth`. By default it is mounted 0.8 m above the ground, at the front bumper,
        and depths are from 0.3 to 8 m.
    """
    rows = tuple(math.atan((k - (height - 1) / 2) / focal_length) for k in range(height))
    usual = {
        "rate": 30.0,
        "range_min": 0.3,
        "range_max": 8.0,
        "reach": 5000.0,
        "range_noise": 0.001,
        "gain_spread": 0.0,
    }
    usual |= {"range_bias": 0.0, "range_step": 0.001, "divergence": 1 / focal_length, "height": 0.8, "forward": BUMPER}
    step, rest = 1 / focal_length, usual | numbers
    return LidarSpec(name, rows, (0.0,) * height, step, kind="depth", columns=width, **rest)


# By data sheets, rounded: views, steps, rates, ranges and standard deviations. `reach` is ours, by the range at which
# a tenth of white, or white, is still detected. Cameras have images of 640 x 480 pixels, of which every second row and
# column is simulated, focal lengths of usual units, and noise by 0.08 pixel of disparity at a baseline of 50 mm and
# 640 pixels (D435), and by Khoshelham and Elberink 2012 (PrimeSense: Kinect 1, Xtion).
ROBOT_SENSORS = {
    one.name: one
    for one in (
        planar_laser("lds-01", 360, 1.0, rate=5.0, range_min=0.12, range_max=3.5, reach=8.0, range_noise=0.01,
            height=0.2),
        planar_laser("rplidar-a2", 360, 0.45, rate=10.0, range_min=0.2, range_max=12.0, reach=15.0, range_noise=0.01),
        planar_laser("ust-10lx", 270, 0.25, rate=40.0, range_min=0.06, range_max=10.0, reach=15.0, range_noise=0.01,
            range_bias=0.01),
        planar_laser("utm-30lx", 270, 0.25, rate=40.0, range_min=0.1, range_max=30.0, reach=60.0, range_noise=0.01,
            range_bias=0.01),
        planar_laser("tim571", 270, 1 / 3, rate=15.0, range_min=0.05, range_max=25.0, reach=25.0, range_noise=0.02,
            range_bias=0.02),
        planar_laser("lms-291", 180, 0.5, rate=37.5, range_min=0.1, range_max=80.0, reach=95.0, range_noise=0.01,
            range_bias=0.01, range_step=0.01),
        depth_camera("d435", 320, 240, 192.5, noise_growth=0.0025),
        depth_camera("xtion", 320, 240, 262.5, noise_growth=0.0014, range_min=0.5, range_max=5.0),
    )
}  # fmt: skip


def sensor_spec(name: str) -> LidarSpec:
    """Return a lidar, a planar laser or a depth camera by its name.

    Raises
    ------
    ValueError
        If there is none of that name.
    """
    if (spec := LIDARS.get(name) or ROBOT_SENSORS.get(name)) is None:
        kinds = (
            ", ".join(one.name for one in ROBOT_SENSORS.values() if one.kind == kind) for kind in ("planar", "depth")
        )
        others = "; planar lasers {}; depth cameras {}".format(*kinds)
        raise ValueError(f"there is no lidar {name!r}; there are {', '.join(LIDARS)}{others}")
    return spec
