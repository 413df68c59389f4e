"""Which way the axes of a file point."""

from collections.abc import Sequence

import numpy as np

AXES: dict[str, tuple[str, str, str]] = {
    "flu": ("+x", "+y", "+z"),  # forward, left, up: REP 103
    "ros": ("+x", "+y", "+z"),
    "kitti": ("+x", "+y", "+z"),  # the lidar's frame
    "argoverse": ("+x", "+y", "+z"),  # the vehicle's frame: origin behind and below the sensors
    "nuscenes": ("+y", "-x", "+z"),  # the frame of LIDAR_TOP
    "sustech": ("-y", "+x", "+z"),  # the example of SUSTechPOINTS
}
"""Names for the axes of a file that point forward, left and up."""

Axes = str | Sequence[str] | np.ndarray

_WAYS = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
_WAY_OUT = f'give {", ".join(AXES)}, or the axes that point forward, left, up, such as ("+y", "-x", "+z")'


def rotation_to_flu(axes: Axes) -> np.ndarray:
    """Matrix that takes a file's coordinates to forward, left, up.

    Parameters
    ----------
    axes : str, 3 str or (3, 3) array
        A name from `AXES`, three signed axes, or the matrix itself.

    Returns
    -------
    rotation : (3, 3) float64
        A rotation: never a reflection.
    """
    if isinstance(axes, str):
        if axes not in AXES:
            raise ValueError(f"axes {axes!r} are not known: {_WAY_OUT}")
        axes = AXES[axes]
    if not isinstance(axes, Sequence | np.ndarray):
        raise ValueError(f"axes must be a name, three signed axes or a (3, 3) matrix, got {axes!r}: {_WAY_OUT}")
    if all(isinstance(axis, str) for axis in axes):
        if not set(axes) <= _WAYS.keys():
            raise ValueError(f"axes {tuple(axes)} are not three of {', '.join(_WAYS)}: {_WAY_OUT}")
        axes = np.array([_WAYS[axis] for axis in axes])
    try:
        rotation = np.asarray(axes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"axes {axes!r} are no (3, 3) matrix of numbers: {_WAY_OUT}") from error
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        raise ValueError(f"axes must be three at right angles to each other, got {rotation.tolist()}: {_WAY_OUT}")
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"axes must be right-handed, got the reflection {rotation.tolist()}: {_WAY_OUT}")
    return rotation
