"""Kernels of `PlanarISM`: cells cleared by fans and marked by the ends of beams."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells
from ogm.jit import kernel

__all__ = ["clear_fans", "mark_ends", "write_masses"]

ROUNDING = 1e-6  # [m] rounding error of an edge
TAIL = 4.0  # standard deviations of a range, beyond which its likelihood counts as 0


@kernel
def clear_fans(fans: NDArray[np.float64], cells: Cells, noise: float, free: Any) -> None:
    """Raise the mass of free in the cells of fans along the first axis.

    Parameters
    ----------
    fans : (K, 7) float64
        Cosine and sine of the middle, with the cosine at least as large as the sine in size; tangent of half the
        width; range [m] and mass of the near part; range and mass of the far part. The far part is at least as long
        and has at most the same mass.
    cells : Cells
        Corner of the array, from the sensor.
    noise : float
        Standard deviation of a range [m], above 0.
    free : (nx, ny) float32
    """
    side, (nx, ny) = cells.resolution, free.shape
    narrow, inverse = side / 2 + ROUNDING, 1 / (2 * noise * noise)
    for k in range(len(fans)):
        c, s, t, near, near_mass, far, far_mass = fans[k]
        sign, c = (1.0, c) if c >= 0 else (-1.0, -c)
        own = side / 2 * (c + abs(s))  # half the extent of a cell along the fan
        sure = max(near - own - TAIL * noise, 0.0) ** 2
        side_reach = max(far * t, narrow) * abs(s)
        if sign > 0:
            low, high = -side_reach, far * c + side_reach
        else:
            low, high = -far * c - side_reach, side_reach
        first, last = max(int((low - cells.x0) / side), 0), min(int((high - cells.x0) / side) + 1, nx)
        for i in range(first, last):
            u = sign * (cells.x0 + (i + 0.5) * side)
            bottom, top = (s * u - narrow) / c, (s * u + narrow) / c
            if u > 0:
                bottom = min(bottom, u * (s - t * c) / (c + t * s))
                top = max(top, u * (s + t * c) / (c - t * s))
            j0 = max(int(math.ceil((bottom - cells.y0) / side - 0.5)), 0)
            j1 = min(int(math.floor((top - cells.y0) / side - 0.5)) + 1, ny)
            for j in range(j0, j1):
                v = cells.y0 + (j + 0.5) * side
                if c * u + s * v <= 0:
                    continue
                square = u * u + v * v
                if square < sure:
                    free[i, j] = max(free[i, j], np.float32(near_mass))
                    continue
                left, mass = near - own - math.sqrt(square), 0.0
                if left > 0:
                    mass = near_mass * (1 - math.exp(-left * left * inverse))
                left += far - near
                if left > 0:
                    mass = max(mass, far_mass * (1 - math.exp(-left * left * inverse)))
                free[i, j] = max(free[i, j], np.float32(mass))


@kernel
def mark_ends(ends: NDArray[np.float64], cells: Cells, noise: float, occupied: Any) -> None:
    """Raise the mass of occupied in the cells around the ends of beams.

    Parameters
    ----------
    ends : (K, 5) float64
        Cosine and sine of the beam, range of its end [m], tangent of half its width, mass.
    cells : Cells
        Corner of the array, from the sensor.
    noise : float
        Standard deviation of a range [m], above 0.
    occupied : (nx, ny) float32
    """
    side, (nx, ny) = cells.resolution, occupied.shape
    half, reach = side / 2, TAIL * noise
    for k in range(len(ends)):
        c, s, distance, t, mass = ends[k]
        x, y = c * distance, s * distance
        arc = 2 * distance * t
        wide = arc > side
        pad = reach + (arc / 2 if wide else 0.0) + ROUNDING
        i0, i1 = max(int((x - pad - cells.x0) / side - 0.5), 0), min(int((x + pad - cells.x0) / side + 1.5), nx)
        j0, j1 = max(int((y - pad - cells.y0) / side - 0.5), 0), min(int((y + pad - cells.y0) / side + 1.5), ny)
        share = mass * side / arc if wide else mass
        for i in range(i0, i1):
            u = cells.x0 + (i + 0.5) * side
            for j in range(j0, j1):
                v = cells.y0 + (j + 0.5) * side
                if wide:
                    if abs(c * v - s * u) > t * (c * u + s * v):
                        continue
                    off = max(abs(math.hypot(u, v) - distance) - half - ROUNDING, 0.0)
                else:
                    # Part of the axis within the cell, counted from the end
                    a, b = _crossing(u - x, c, half + ROUNDING)
                    start, stop = _crossing(v - y, s, half + ROUNDING)
                    start, stop = max(start, a), min(stop, b)
                    if start > stop:
                        continue
                    off = max(start, -stop, 0.0)
                if off <= reach:
                    beyond = 1.0 if off == 0 else 0.5 * math.erfc(off / (noise * math.sqrt(2.0)))
                    occupied[i, j] = max(occupied[i, j], np.float32(share * beyond))


@kernel
def _crossing(middle: float, slope: float, half: float) -> tuple[float, float]:
    """Return the interval of the parameter of a line inside a strip; infinite or empty for a line along the strip."""
    if abs(slope) > 1e-9:
        a, b = (middle - half) / slope, (middle + half) / slope
        return min(a, b), max(a, b)
    return (-math.inf, math.inf) if abs(middle) <= half else (math.inf, -math.inf)


@kernel
def write_masses(
    free: NDArray[np.float32], occupied: NDArray[np.float32], false_alarm: float, mass: NDArray[np.float32]
) -> None:
    """Write masses; cells with more occupied mass than `false_alarm` lose the free mass of other beams.

    Parameters
    ----------
    free, occupied : (nx, ny) float32
    false_alarm : float
        Chance that an echo comes from a free cell.
    mass : (nx, ny, 2) float32
    """
    for i in range(free.shape[0]):
        for j in range(free.shape[1]):
            rest = np.float32(0) if occupied[i, j] > false_alarm else np.float32(1) - occupied[i, j]
            mass[i, j, 0] = min(free[i, j], rest)
            mass[i, j, 1] = occupied[i, j]
