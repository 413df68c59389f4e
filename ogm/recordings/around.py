"""Truth of a scan from other scans of the same drive."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.geometric import ground_height, local_ground
from ogm.grid import GridSpec
from ogm.recordings.layout import CAR
from ogm.scan import Boxes
from ogm.state import Truth
from ogm.truth import MARGIN, TRUTH_SPEC, cells_in_boxes, contradicted, ignore_cells, truth_from_scans

__all__ = ["choose_others", "stood_here", "truth_from_others"]

REACH = 50.0  # [m] scans that were taken further away hardly see the same cells
SPAN = 30.0  # [s] before and after: later, parked cars have left and poses have drifted
MOST = 40  # scans that are looked at, spread evenly over those
RASTER = 1.0  # [m] side of the cells that the ground is estimated on
THINNED = (
    65_000  # points that it is estimated from: of more, `local_ground` would take every second, in order
)


def choose_others(
    n: int,
    stamps: NDArray[np.float64],
    places: NDArray[np.float64],
    *,
    later: bool,
) -> list[int]:
    """Choose the scans that say what is around scan n: those near it in space and time, never itself.

    Parameters
    ----------
    n : int
    stamps : (K,) float
        Times of the drive's scans [s].
    places : (K, 3) float
        Where its sensor was [m].
    later : bool
        Only those after scan n.
    """
    near = np.linalg.norm(places - places[n], axis=1) <= REACH
    near &= np.abs(stamps - stamps[n]) <= SPAN
    near[n] = False
    if later:
        near[: n + 1] = False
    found = np.flatnonzero(near)
    if len(found) > MOST:
        found = found[np.round(np.linspace(0, len(found) - 1, MOST)).astype(int)]
    return [int(one) for one in found]


def stood_here(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the cells of `TRUTH_SPEC` on which the own vehicle stood in any of some scans.

    Parameters
    ----------
    poses : (K, 4, 4) float
        Of its sensor in those scans, as seen from the one that is judged.
    """
    car = Boxes(np.array([0, 0, -0.5]), np.array([2 * CAR[0], 2 * CAR[1], 1.0]), np.zeros(1))
    near = poses[np.linalg.norm(poses[:, :3, 3], axis=1) <= TRUTH_SPEC.length]
    result = np.zeros(TRUTH_SPEC.shape, bool)
    for T in near:
        result |= cells_in_boxes(car.moved(T), TRUTH_SPEC)
    return result


def truth_from_others(
    clouds: Sequence[NDArray[np.float32]],
    height: float,
    spec: GridSpec,
    moving: Boxes,
    *,
    min_scans: int = 2,
    judged: NDArray[np.float32] | None = None,
) -> Truth:
    """Make a truth grid of several scans, brought to the frame of the sensor that is judged.

    Heights are above the ground that `local_ground` finds in all of them together.

    Parameters
    ----------
    clouds : sequence of (N, 4) float32
        Points of each [m], without what moves.
    height : float
        Of the sensor above ground [m].
    spec : GridSpec
    moving : Boxes
        Boxes of moving objects in the judged scan: the cells under them and `MARGIN` around are ignored.
    min_scans : int
        As in `truth_from_scans`.
    judged : (N, 4) float32, optional
        Points of the judged scan itself. It says nothing about what is there, but cells in which it shows the
        opposite of the others are ignored: `contradicted`.
    """
    raster = GridSpec(
        RASTER, (math.ceil(spec.length / RASTER - 1e-9), math.ceil(spec.width / RASTER - 1e-9)), spec.origin
    )
    near = [cloud[raster.contains(cloud[:, 0], cloud[:, 1])] for cloud in clouds]
    every = np.concatenate(near)
    chosen = np.random.default_rng(0).choice(len(every), min(len(every), THINNED), replace=False)
    ground = local_ground(np.ascontiguousarray(every[chosen, :3]), raster, (0.0, 0.0, -height))
    above = [cloud[:, 2] - ground_height(ground, raster, cloud) for cloud in near]
    now = cells_in_boxes(moving.widened(MARGIN), spec)
    truth = truth_from_scans(near, above, spec, min_scans=min_scans, moving=now)
    if judged is not None:
        high = judged[:, 2] - ground_height(ground, raster, judged)
        truth = ignore_cells(truth, contradicted(truth, judged, high))
    return truth
