"""Truth of a simulated drive for maps: static cells, and cells that moving participants cover or have left.

All of it lies on one lattice per drive, in map coordinates: the world, shifted so that the sensor of the first frame is
at x = y = 0. A map of the same resolution that starts there has its cells on the same lattice, so that maps are
evaluated cell by cell and nothing is resampled. Poses are taken as planar: a tilt of one or two degrees shifts the
ground by a few centimetres.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ogm import Boxes, CellState, Frame, GridSpec
from ogm.pose import pose
from ogm.truth import TRUTH_SPEC, cells_in_boxes
from ogm.truth.boxes import count_returns

PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
WINDOW = GridSpec.centered(length=102.4, width=102.4, resolution=0.16)  # holds PAPER at any heading
EGO = (-2.5, 2.5, -1.1, 1.1)  # [m] footprint of the ego vehicle around the sensor
MOVING, STILL = 1.0, 0.3  # [m/s] above which a participant moves, below which it is static
SEEN = 10  # points in its box from which on a participant counts as seen
MARGIN = 0.16  # [m] around boxes, within which cells are not evaluated
MEMORY = 50  # frames for which a cell that was left is followed: 5 s
VOTES = 3  # frames whose truth must know a static cell
NEVER = 255


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive, and what all of its frames know of the world.

    Parameters
    ----------
    frames : list of Frame
    poses : (K, 4, 4) float64
        Of the levelled sensor, in which grids lie; the first is at x = y = 0.
    spec : GridSpec
        The lattice.
    static : (NX, NY) uint8
        States of the world without what ever moves; `CellState.IGNORE` where frames disagree.
    labels : (K, 624, 624) uint8
        Static state of the cells around each frame's sensor, 0 where it is not evaluated: out of view, unseen so far,
        or somebody moved there within 5 s.
    corners : (K, 2) int
        Where these cells begin on the lattice.
    moving, covered : list of (C,) int64
        Cells under moving participants that were seen, and under all with a margin.
    objects : int
        Frames times moving, seen participants in the view.
    """

    frames: list[Frame]
    poses: NDArray[np.float64]
    spec: GridSpec
    static: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    corners: NDArray[np.int64]
    moving: list[NDArray[np.int64]]
    covered: list[NDArray[np.int64]]
    objects: int

    def in_view(self, k: int, cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the cells of the paper's grid, around frame `k`, that hold some cells' centres; which are inside."""
        ix, iy = np.divmod(cells, self.spec.shape[1])
        x, y = self.spec.cell_centers
        u, v = planar(self.poses[k], x[ix, 0], y[0, iy])
        inside = PAPER.contains(u, v)
        i, j = PAPER.index(np.where(inside, u, 0), np.where(inside, v, 0))
        return i * PAPER.shape[1] + j, inside


class Trail(NamedTuple):
    """Cells of one frame, flat numbers on the lattice, that moving participants left or cover.

    Attributes
    ----------
    left, age, touched : (L,) arrays
        Static free cells in view that a moving, seen participant covered within 5 s and nothing covers now; frames
        since then; whether a scan was occupied (> 0.5) there while they were covered.
    covered, since : (C,) arrays
        Cells that one covers, from the first scan on that is occupied there; frames since that scan.
    """

    left: NDArray[np.int64]
    age: NDArray[np.int64]
    touched: NDArray[np.bool_]
    covered: NDArray[np.int64]
    since: NDArray[np.int64]


def planar(
    T: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return map coordinates in the axes of a vehicle, taken as planar."""
    yaw = np.arctan2(T[1, 0], T[0, 0])
    c, s, dx, dy = np.cos(yaw), np.sin(yaw), x - T[0, 3], y - T[1, 3]
    return c * dx + s * dy, c * dy - s * dx


def read_drive(frames: Sequence[Frame]) -> Drive:
    """Read the frames of a drive, and evaluate the world's static truth and labels of all of them."""
    frames = list(frames)
    poses = np.array([frame.T_map_sensor @ frame.mount.T_sensor_level for frame in frames])
    poses[:, :2, 3] -= poses[0, :2, 3].copy()
    r, n = TRUTH_SPEC.resolution, TRUTH_SPEC.shape[0]
    middles = np.rint(poses[:, :2, 3] / r).astype(np.int64)
    low, high = middles.min(axis=0) - n // 2, middles.max(axis=0) + n // 2
    spec = GridSpec(r, tuple((high - low).tolist()), tuple((low * r).tolist()))
    corners = middles - n // 2 - low

    speeds = [np.hypot(*frame.boxes.velocity.T) for frame in frames]
    dynamic = {
        track
        for f, v in zip(frames, speeds, strict=True)
        for track, s in zip(f.boxes.track, v, strict=True)
        if s > STILL
    }
    votes, first = np.zeros((2, *spec.shape), np.uint8), np.full(spec.shape, NEVER, np.uint8)
    moving, covered, unseen, objects = [], [], [], 0
    for k, (frame, speed) in enumerate(zip(frames, speeds, strict=True)):
        at, corner = window(corners[k], n), np.array(spec.origin) + corners[k] * r
        yaw, (x, y) = np.arctan2(poses[k, 1, 0], poses[k, 0, 0]), poses[k, :2, 3]
        state = frame.truth.crop(GridSpec(r, (n, n), tuple(corner)), yaw, x, y).state
        seen = count_returns(frame.scan.points, frame.boxes) >= SEEN
        moves = seen & (speed > MOVING)
        here = frame.boxes.moved(pose(x, y, yaw=yaw))
        moving.append(cells_under(here.select(moves), spec))
        covered.append(cells_under(here, spec, MARGIN))
        unseen.append(cells_under(here.select((speed > STILL) & ~moves), spec, MARGIN))
        objects += int(np.count_nonzero(PAPER.contains(*frame.boxes.center[moves, :2].T)))
        known = (state == CellState.FREE) | (state == CellState.OCCUPIED)
        first[at] = np.minimum(first[at], np.where(known, k, NEVER).astype(np.uint8))
        hide = np.zeros(spec.shape, bool)  # where somebody who ever moves is now
        tracks = np.array([track in dynamic for track in here.track], bool)
        hide.ravel()[cells_under(here.select(tracks), spec, 2 * MARGIN)] = True
        votes[0][at] += (state == CellState.FREE) & ~hide[at]
        votes[1][at] += (state == CellState.OCCUPIED) & ~hide[at]
    share = votes[1] / np.maximum(votes.sum(axis=0), 1)
    static = np.full(spec.shape, CellState.IGNORE, np.uint8)
    static[share >= 0.5], static[share <= 0.1] = CellState.OCCUPIED, CellState.FREE
    static[votes.sum(axis=0) < VOTES] = CellState.UNKNOWN

    labels, lately = np.zeros((len(frames), n, n), np.uint8), np.full(spec.shape, -NEVER, np.int32)
    for k in range(len(frames)):
        at, moved = window(corners[k], n), np.zeros(spec.shape, bool)
        moved.ravel()[moving[k]] = True
        moved = binary_dilation(moved, np.ones((3, 3)))
        moved.ravel()[unseen[k]] = True
        lately[moved] = k
        x, y = (c.ravel()[s] for c, s in zip(spec.cell_centers, at, strict=True))
        u, v = planar(poses[k], x[:, None], y[None, :])
        ego = (u > EGO[0]) & (u < EGO[1]) & (v > EGO[2]) & (v < EGO[3])
        kept = PAPER.contains(u, v) & ~ego & (k - lately[at] > MEMORY) & (first[at] <= k)
        labels[k] = np.where(kept & (static[at] <= CellState.OCCUPIED), static[at], 0)
    return Drive(frames, poses, spec, static, labels, corners, moving, covered, objects)


def trails(drive: Drive, grids: Sequence[NDArray[np.float32]]) -> Iterator[Trail]:
    """Yield what moving participants left and cover, for every frame, given its measurement masses on `PAPER`."""
    free = drive.static == CellState.FREE
    contested = (drive.static == CellState.OCCUPIED) | (drive.static == CellState.IGNORE)
    free = (free & ~binary_dilation(contested, np.ones((3, 3)))).ravel()  # with all eight neighbours
    last = np.full(free.shape, -NEVER, np.int64)
    entered, touched, busy = last.copy(), np.zeros(free.shape, bool), np.zeros(free.shape, bool)
    for k, cells in enumerate(drive.moving):
        view, inside = drive.in_view(k, cells)
        hit = inside & (grids[k][..., 1].ravel()[view] > 0.5)
        new = cells[last[cells] < k - 1]
        touched[new], entered[new] = False, -1
        entered[cells[hit & (entered[cells] < 0)]] = k
        touched[cells[hit]], last[cells] = True, k
        busy[:] = False
        busy[drive.covered[k]] = True
        left = np.flatnonzero((last >= k - MEMORY) & (last < k) & ~busy & free)
        view, inside = drive.in_view(k, left)
        state = drive.frames[k].truth.crop(PAPER).state.ravel()[view]
        left = left[inside & (state <= CellState.FREE)]
        on = cells[(entered[cells] >= 0) & free[cells]]
        on = on[drive.in_view(k, on)[1]]
        yield Trail(left, k - last[left], touched[left], on, k - entered[on])


def window(corner: NDArray[np.int64], n: int) -> tuple[slice, slice]:
    """Return the part of the lattice around a frame."""
    return slice(corner[0], corner[0] + n), slice(corner[1], corner[1] + n)


def cells_under(boxes: Boxes, spec: GridSpec, margin: float = 0.0) -> NDArray[np.int64]:
    """Return the flat numbers of the cells under any of the boxes, with a margin [m]."""
    return np.flatnonzero(cells_in_boxes(boxes.widened(margin), spec))
