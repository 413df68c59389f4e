"""Types that many functions of the simulator share."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Mask = NDArray[np.bool_]
HeightAt = Callable[[Floats, Floats], NDArray[Any]]  # height of the ground [m] at x, y [m]
