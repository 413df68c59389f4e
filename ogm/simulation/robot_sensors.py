"""Robot sensors for the simulator: planar lasers and depth cameras.

>>> from ogm.simulation.robot_sensors import ROBOT_SENSORS, depth_camera, planar_laser
>>> ROBOT_SENSORS["utm-30lx"].shape, ROBOT_SENSORS["d435"].shape
((1, 1081), (240, 320))
>>> mine = planar_laser("mine", view=180, step=0.5, range_max=20.0, height=0.2)
>>> ROBOT_SENSORS[mine.name] = mine                                           # register it for `LidarMount`
>>> del ROBOT_SENSORS[mine.name]
"""

import math
from typing import Any

from ogm.simulation.sensors import LIDARS, LidarSpec

__all__ = ["ROBOT_SENSORS", "depth_camera", "planar_laser", "sensor_spec"]

BUMPER = 2.5  # [m] position ahead of the middle of the ego vehicle, which is 4.8 m long


def planar_laser(name: str, view: float, step: float, **numbers: Any) -> LidarSpec:
    """Return the specification of a planar laser.

    Parameters
    ----------
    name : str
    view : float
        Angle from the first to the last beam [degree]; 360 for a whole turn.
    step : float
        Angle between beams [degree].
    **numbers
        Further parameters of `LidarSpec`. By default it is mounted 0.3 m above the ground at the front bumper.
    """
    columns = 0 if view == 360 else round(view / step) + 1
    usual = {"height": 0.3, "forward": BUMPER, "gain_spread": 0.0, "range_bias": 0.0, "divergence": math.radians(step)}
    return LidarSpec(name, (0.0,), (0.0,), math.radians(step), kind="planar", columns=columns, **(usual | numbers))


def depth_camera(name: str, width: int, height: int, focal_length: float, **numbers: Any) -> LidarSpec:
    """Return the specification of a forward-facing depth camera.

    It matches images or patterns, so its depths hardly depend on reflectivity. Pixels between two surfaces have a
    mixture of both depths.

    Parameters
    ----------
    name : str
    width, height : int
        Size of the images [pixel].
    focal_length : float
        Focal length [pixel].
    **numbers
        Further parameters of `LidarSpec`, such as `noise_growth`. By default it is mounted 0.8 m above the ground at
        the front bumper, with depths from 0.3 to 8 m.
    """
    rows = tuple(math.atan((k - (height - 1) / 2) / focal_length) for k in range(height))
    step = 1 / focal_length
    usual = {"rate": 30.0, "range_min": 0.3, "range_max": 8.0, "reach": 5000.0, "range_noise": 0.001, "height": 0.8}
    usual |= {"gain_spread": 0.0, "range_bias": 0.0, "range_step": 0.001, "divergence": step, "forward": BUMPER}
    return LidarSpec(name, rows, (0.0,) * height, step, kind="depth", columns=width, **(usual | numbers))


# Rounded values of data sheets: views, steps, rates, ranges and standard deviations. Estimates of `reach`, by the range
# at which targets with a tenth of white's reflectivity, or white targets, are still detected. Cameras have images of
# 640 x 480 pixels, of which every second row and column is simulated, and focal lengths of common units. Their noise:
# 0.08 pixel of disparity at a baseline of 50 mm and 640 pixels (D435); Khoshelham and Elberink 2012 (PrimeSense: Kinect
# 1, Xtion).
ROBOT_SENSORS = {
    spec.name: spec
    for spec in (
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
    """Return the specification of a lidar, planar laser or depth camera by its name.

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    if (spec := LIDARS.get(name) or ROBOT_SENSORS.get(name)) is None:
        planar, depth = (
            ", ".join(sensor for sensor, spec in ROBOT_SENSORS.items() if spec.kind == kind)
            for kind in ("planar", "depth")
        )
        raise ValueError(
            f"unknown lidar {name!r}; lidars: {', '.join(LIDARS)}; planar lasers: {planar}; depth cameras: {depth}"
        )
    return spec
