"""Truth of a scan from neighbouring scans of the same drive."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.geometric import ground_height, local_ground
from ogm.grid import GridSpec
from ogm.datasets.layout import EGO
from ogm.state import CellState, Truth
from ogm.truth import MARGIN, TRUTH_SPEC, cells_in_boxes, contradicted, move_boxes, truth_from_scans, widen_boxes

__all__ = ["choose_neighbours", "ego_path_cells", "truth_from_neighbours"]

REACH = 50.0  # [m] scans that were taken further away hardly see the same cells
SPAN = 30.0  # [s] before and after: later, parked cars have left and poses have drifted
MOST = 40  # scans that are looked at, spread evenly over those
RASTER = 1.0  # [m] side of the cells that the ground is estimated on
THINNED = (
    65_000  # points that it is estimated from: of more, `local_ground` would take every second, in order
)


def choose_neighbours(
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


def ego_path_cells(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the cells of `TRUTH_SPEC` on which the own vehicle stood in any of some scans.

    Parameters
    ----------
    poses : (K, 4, 4) float
        Of its sensor in those scans, as seen from the one that is judged.
    """
    car = np.array([[0.0, 0.0, 0.0, EGO[1] - EGO[0], EGO[3] - EGO[2], -1.0, 0.0]])
    near = poses[np.linalg.norm(poses[:, :3, 3], axis=1) <= TRUTH_SPEC.length]
    return cells_in_boxes(np.concatenate([move_boxes(car, T) for T in near]), TRUTH_SPEC)


def truth_from_neighbours(
    clouds: Sequence[NDArray[np.float32]],
    height: float,
    spec: GridSpec,
    moving: NDArray[np.float64],
    *,
    min_scans: int = 2,
    own: NDArray[np.float32] | None = None,
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
    moving : (B, 7) float
        Boxes of moving objects in the judged scan: the cells under them and `MARGIN` around are ignored.
    min_scans : int
        As in `truth_from_scans`.
    own : (N, 4) float32, optional
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
    now = cells_in_boxes(widen_boxes(moving, MARGIN), spec)
    truth = truth_from_scans(near, above, spec, min_scans=min_scans, moving=now)
    if own is None:
        return truth
    state = truth.state.copy()
    state[contradicted(truth, own, own[:, 2] - ground_height(ground, raster, own))] = CellState.IGNORE
    return Truth(spec, state)
