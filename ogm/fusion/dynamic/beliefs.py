"""Masses, mean velocity and covariance of the cells of a dynamic map, in the map's axes or the vehicle's."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.resampling import Moments
from ogm.fusion.dynamic.velocity_evidence import GroupVelocities
from ogm.fusion.resample import view_layers
from ogm.grid import GridSpec
from ogm.jit import kernel


class Beliefs(NamedTuple):
    """Beliefs in the cells of a map.

    Attributes
    ----------
    mass : (nx, ny, 3) float32
        Masses of free, static and dynamic.
    velocity, covariance : (nx, ny, 2), (nx, ny, 2, 2) float32
        Mean and covariance of the velocity of dynamic mass [m/s], [m²/s²].
    """

    mass: NDArray[np.float32]
    velocity: NDArray[np.float32]
    covariance: NDArray[np.float32]


def empty_beliefs(shape: tuple[int, int]) -> Beliefs:
    """Return uninitialised beliefs.

    They share one array, for which numpy requests huge pages: page faults would take longer than the computation.
    """
    cells = math.prod(shape)
    parts = np.split(np.empty(9 * cells, np.float32), [3 * cells, 5 * cells])
    return Beliefs(*(part.reshape(*shape, *last) for part, last in zip(parts, ((3,), (2,), (2, 2)), strict=True)))


def masses(cells: DynamicCells) -> NDArray[np.float32]:
    """Return the masses of free, static and dynamic, (nx, ny, 3)."""
    mass = np.empty((*cells.free.shape, 3), np.float32)
    mass[..., 0], mass[..., 1] = cells.free, cells.static
    np.add(cells.surviving, cells.born, out=mass[..., 2])
    return mass


def beliefs(cells: DynamicCells, moments: Moments, groups: GroupVelocities, still: float = np.nan) -> Beliefs:
    """Return the beliefs of all cells; velocities are of the mixture of surviving particles and births.

    In cells without dynamic mass, velocities and covariances are `still`.
    """
    mean, (xx, yx, yy) = groups.rows[:, 5:7], groups.rows[:, 7:10].T
    births = np.column_stack([mean, xx * xx, xx * yx, yx * yx + yy * yy])
    out = empty_beliefs(groups.label.shape)
    _mix(cells, moments, groups.label, births, np.float32(still), out)
    return out


@kernel
def _mix(cells: Any, moments: Any, label: Any, births: Any, still: Any, out: Any) -> None:
    """Fill beliefs; a row of `births` is the mean and covariance (xx, xy, yy) of the velocity of births in a group."""
    nx, ny = label.shape
    zero, one, least = np.float32(0), np.float32(1), np.float32(1e-30)
    for i in range(nx):
        for j in range(ny):
            born = cells.born[i, j]
            dynamic = cells.surviving[i, j] + born
            out.mass[i, j, 0], out.mass[i, j, 1], out.mass[i, j, 2] = cells.free[i, j], cells.static[i, j], dynamic
            v, cov = out.velocity[i, j], out.covariance[i, j]
            if dynamic <= zero:
                v[:] = still
                cov[:] = still
                continue
            x = y = xx = xy = yy = zero  # moments of the particles, if any
            if cells.surviving[i, j] > zero:
                x, y = moments.mean[i, j, 0], moments.mean[i, j, 1]
                c = moments.covariance[i, j]
                xx, xy, yy = c[0], c[1], c[2]
            b = births[label[i, j]]
            share = born / max(dynamic, least)
            both, dx, dy = share * (one - share), b[0] - x, b[1] - y
            v[0], v[1] = x + share * dx, y + share * dy
            cov[0, 0] = xx + share * (b[2] - xx) + both * dx * dx
            cov[0, 1] = cov[1, 0] = xy + share * (b[3] - xy) + both * dx * dy
            cov[1, 1] = yy + share * (b[4] - yy) + both * dy * dy


def seen_from(belief: Beliefs, source: GridSpec, spec: GridSpec, T_map_vehicle: ArrayLike) -> DynamicGrid:
    """Return the beliefs of a map in the vehicle's axes, by nearest cells; see `view_layers`.

    Velocities and covariances must be 0 in cells without dynamic mass.
    """
    pairs = belief.mass[..., :2], belief.mass[..., 1:], belief.velocity, *np.moveaxis(belief.covariance, 2, 0)
    known, occupied, v, along, across = (view_layers(pair, source, spec, T_map_vehicle) for pair in pairs)
    forward = np.asarray(T_map_vehicle, np.float64)[:2, 0]
    cosine, sine = (forward / np.hypot(*forward)).astype(np.float32)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    velocity, covariance = v @ turn.T, turn @ np.stack([along, across], axis=2) @ turn.T
    still = occupied[..., 1] <= 0
    velocity[still] = np.nan
    covariance[still] = np.nan
    return DynamicGrid.trusted(spec, np.concatenate([known, occupied[..., 1:]], axis=-1), velocity, covariance)
