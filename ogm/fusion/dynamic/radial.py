"""Radial velocities by Doppler as measurements of one velocity component of groups of cells.

`TURN_RATE` is needed since one sensor cannot distinguish rotation of a body from motion across the beam: Kellner et
al., "Instantaneous ego-motion estimation using multiple Doppler radars" (2014).
"""

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.groups import find_groups
from ogm.fusion.dynamic.measured_velocities import MeasuredVelocities
from ogm.fusion.dynamic.radial_kernels import ellipses, mark_within, nearest_labels, sum_evidence
from ogm.geometric.doppler import RadialVelocities
from ogm.grid import GridSpec

MIN_DEVIATION = 0.3  # [m/s] of a radial velocity: parts of an object differ, such as wheels and limbs
TURN_RATE = 0.5  # [rad/s] standard deviation of the turn rate of objects
SCATTER = 1.0  # [m/s] plus 3 standard deviations: greatest difference of a detection from the median of its group
LINK = 1  # [cells] between cells of a group
MAX_DEVIATION = 20.0  # [m/s] of a measured component; less certain ones are lost in float32


def with_radial_velocities(
    matched: MeasuredVelocities,
    radial: RadialVelocities,
    measured: NDArray[np.float32],
    cells: DynamicCells,
    spec: GridSpec,
) -> MeasuredVelocities:
    """Return matched velocities with the radial velocities added.

    Groups are connected cells within two standard deviations of a detection. Their cells are more occupied than free
    in the scan, or hold more dynamic than static or free mass. A matched group with such a cell receives the
    information of the detections; otherwise the cells form a new group.

    Parameters
    ----------
    matched : MeasuredVelocities
        Matched velocities of the same scan; may be empty.
    radial : RadialVelocities
        Radial velocities in map coordinates, at least one.
    measured : (nx, 2 ny) float32
        Masses of the scan in the cells of the window.
    cells : DynamicCells
        Cells after the update by the scan.
    spec : GridSpec
        The window in map coordinates.
    """
    rows = ellipses((radial.xy - spec.origin) / spec.resolution, radial.direction, radial.extent / spec.resolution)
    inside = np.zeros(spec.shape, np.uint8)
    mark_within(rows, measured, cells, inside)
    groups = find_groups(inside, inside, LINK, 1)
    group = np.empty(len(rows), np.int32)
    nearest_labels(rows, groups.label, group)
    information, weighted = radial_evidence(radial, group, len(groups.start) - 1)

    count = len(matched.velocity)
    label, target = groups.label, np.full(len(information), -1)  # index of the matched group of each group
    if count:
        label, of_cell = matched.label.copy(), matched.label[groups.x, groups.y]
        holds = np.concatenate([[False], matched.information.any(axis=(1, 2))])
        size = np.diff(groups.start)
        np.maximum.at(target, np.repeat(np.arange(len(size)), size), np.where(holds[of_cell], of_cell, 0) - 1)
    alone = target < 0
    target[alone] = count + np.arange(alone.sum())
    if count:
        label[groups.x, groups.y] = np.repeat(target + 1, size)

    total = np.zeros((count + int(alone.sum()), 2, 2))
    total[:count] = matched.information
    vector = np.zeros((len(total), 2))
    vector[:count] = np.einsum("gij,gj->gi", matched.information, matched.velocity)
    np.add.at(total, target, information)
    np.add.at(vector, target, weighted)
    velocity = np.zeros((len(total), 2))
    velocity[:count] = matched.velocity
    velocity[target], total[target] = _solved(total[target], vector[target])
    resting = np.concatenate([matched.resting, np.zeros(len(total) - count, bool)])
    resting[target] = False
    return MeasuredVelocities(label, velocity, total, resting)


def radial_evidence(
    radial: RadialVelocities, group: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return information I (G, 2, 2) [s²/m²] and I v (G, 2) for the velocity v at the middle of each group.

    Parameters
    ----------
    radial : RadialVelocities
    group : (N,) int32
        Group of each detection, from 1 to `count`; 0 for none.
    count : int

    Notes
    -----
    A detection at p in the direction u measures u . v + w q, with the turn rate w of the body, q = u x (m - p), and the
    middle m of the group's detections: one sensor cannot distinguish rotation from motion across the beam. With
    w ~ N(0, `TURN_RATE`²) integrated out, I is the sum of u u' / s² minus g g' / (1 / `TURN_RATE`² + h), with the sums
    g of q u / s² and h of q² / s² (Woodbury). For a single detection it has rank one. Detections that differ from the
    median of their group by more than 3 s + `SCATTER` have no weight.
    """
    s = np.maximum(radial.deviation, MIN_DEVIATION)
    agree = np.abs(radial.speed - _medians(radial.speed, group, count)[group]) <= 3 * s + SCATTER
    rows = np.column_stack([radial.xy, radial.direction, radial.speed, agree / s**2])
    information, weighted = np.zeros((count, 2, 2)), np.zeros((count, 2))
    sum_evidence(rows, group, TURN_RATE, information, weighted)
    return information, weighted


def _solved(
    information: NDArray[np.float64], weighted: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return velocities v (G, 2) and I, from I and I v; rank one, with v along it, if I measures one component.

    Eigenvalues p >= q of I satisfy p + q = trace, p q = det. Without its part along q, I is (I - q) p / (p - q).
    """
    a, b, d = information[:, 0, 0], information[:, 0, 1], information[:, 1, 1]
    (x, y), det = weighted.T, a * d - b * b
    p = (a + d) / 2 + np.hypot((a - d) / 2, b)
    q = det / np.maximum(p, 1e-300)
    full = q > MAX_DEVIATION**-2
    by_cofactors = np.stack([d * x - b * y, a * y - b * x], axis=-1) / np.where(full, det, 1)[:, None]
    scale = p / np.where(full | (p <= q), 1, p - q)
    rank_one = (information - q[:, None, None] * np.eye(2)) * scale[:, None, None]
    along = np.einsum("gij,gj->gi", rank_one, weighted) / np.maximum(p**2, 1e-300)[:, None]
    v = np.where(full[:, None], by_cofactors, along)
    return v, np.where(full[:, None, None], information, rank_one)


def _medians(values: NDArray[np.float64], group: NDArray[np.int32], count: int) -> NDArray[np.float64]:
    """Return the median of each group's values, (count + 1,)."""
    in_order = values[np.lexsort((values, group))]
    size = np.bincount(group, minlength=count + 1)
    last = np.cumsum(size) - 1
    low, high = (np.clip(last - half, 0, len(values) - 1) for half in (size // 2, (size - 1) // 2))
    medians: NDArray[np.float64] = (in_order[low] + in_order[high]) / 2
    return medians
