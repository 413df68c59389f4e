"""Simulated drives with everything that a map can be judged by: the world's static truth, and who moved where.

All of it lies on one lattice per drive, in map coordinates: the world, shifted so that the sensor of the first
frame stands at x = y = 0. A mapper of the same resolution that starts there has its cells on the same lattice, so
that maps are judged cell by cell and nothing is resampled.

Poses are taken as planar (x, y, yaw), as the grids are: the truth of a frame, its boxes and its measurement grid lie
in the x and y of a sensor that tilts by one or two degrees, which shifts the ground below it by a few centimetres.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ogm import GridSpec
from ogm.simulation.store import Split
from ogm.truth import TRUTH_SPEC, FREE, IGNORE, OCCUPIED, UNKNOWN, cells_in_box

__all__ = ["Drive", "Label", "Motion", "Trail", "drives", "grown", "planar", "read_drive", "trails"]

PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
EGO_FOOTPRINT = (-2.5, 2.5, -1.1, 1.1)  # [m] of the own vehicle, around the sensor
FRAMES = 100  # of a drive
MOVING = 1.0  # [m/s] beyond which a participant moves
STILL = 0.3  # [m/s] below which it stands; between the two, its cells are not judged as moving or standing
SEEN = 10  # returns from which on a participant counts as seen in a frame
MARGIN = 0.16  # [m] around boxes, within which cells are not judged
MEMORY = 50  # frames for which a cell that was left is followed: 5 s
RECENT = 5  # frames, 0.5 s: how long a cell counts as just entered or just left
RING = 4.0  # [m] the lowest beam, 25 degrees down at 1.9 m, meets flat ground at 4.07 m
VOTES = 3  # frames whose truth must know a cell of the world
NEVER = 255


class Label:
    """What is static in a cell, relative to a frame: rows of the counts in `_trails`."""

    NONE = 0  # outside the view, unknown, contested, own vehicle, or somebody moved there lately
    FREE, OCCUPIED = 1, 2  # and some frame up to this one could see it
    LATER_FREE, LATER_OCCUPIED = 3, 4  # only later frames can see it
    RING_FREE, RING_OCCUPIED = 5, 6  # seen, and nearer to the sensor than its lowest beam meets the ground
    COUNT = 7


class Motion:
    """Who moves in a cell, relative to a frame."""

    NOBODY = 0
    FRONT = 1  # covered now by a moving participant that was seen, and not yet 0.5 s ago
    BODY = 2  # covered now, and 0.5 s ago as well
    BACK = 3  # not covered any more, but within the last 0.5 s
    NOT_JUDGED = 4  # outside the view, within the margin, or moved without being seen
    COUNT = 5


class Trail(NamedTuple):
    """Cells of one frame that moving participants cover or have left, as flat numbers on the drive's lattice.

    Attributes
    ----------
    left : (L,) int64
        Cells that a moving, seen participant covered within the last 5 s, that nobody covers now, that are free
        in the world with all their neighbours, and that lie in the view.
    age : (L,) int64
        Frames since the last that covered it, 1 to 50.
    where : (L,) uint8
        0: hidden from this frame; 1: visible, but this scan says nothing about it (unknown > 0.5); 2: measured.
    touched : (L,) bool
        A scan said occupied (> 0.5) while the cell was covered.
    visit : (L,) int64
        The frame of that last cover: tells the visits of a cell apart.
    covered : (C,) int64
        Cells of the static free world that a moving, seen participant covers, from the scan on that first says
        occupied there.
    since : (C,) int64
        Frames since that scan; 0: this one.
    """

    left: NDArray[np.int64]
    age: NDArray[np.int64]
    where: NDArray[np.uint8]
    touched: NDArray[np.bool_]
    visit: NDArray[np.int64]
    covered: NDArray[np.int64]
    since: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive of 10 s, its truth, and what the world's truth makes of it.

    Parameters
    ----------
    number : int
    stamps : (K,) float64
        [s]
    poses : (K, 4, 4) float64
        ``T_map_sensor``.
    height : float
        Of the sensor above ground [m].
    points : list of (N, 4) float32
    truth : (K, 512, 352) uint8
        States as seen from each frame, on the paper's grid.
    spec : GridSpec
        The lattice.
    static : (NX, NY) uint8
        The world without those who move: `UNKNOWN`, `FREE`, `OCCUPIED`; `IGNORE` where frames disagree.
    first : (NX, NY) uint8
        First frame whose truth knows the cell; 255 for none.
    windows : (K, 2) int64
        Cell of the lattice at which the 624 x 624 cells around each frame's sensor begin.
    labels, motion : (K, 624, 624) uint8
        `Label` and `Motion` of these cells.
    moving, anybody : list of (C,) int64
        Cells, flat, covered by moving and seen participants, and by all with a margin.
    roomy : (NX, NY) bool
        Static free with all eight neighbours.
    objects : int
        Frames times moving, seen participants in the view.
    boxes : list of (B, 5) float64
        x, y, yaw, length, width of the moving and seen, in map coordinates.
    standing : list of (B, 5) float64
        Likewise of those that are seen and never move in the drive.
    """

    number: int
    stamps: NDArray[np.float64]
    poses: NDArray[np.float64]
    height: float
    points: list[NDArray[np.float32]]
    truth: NDArray[np.uint8]
    spec: GridSpec
    static: NDArray[np.uint8]
    first: NDArray[np.uint8]
    windows: NDArray[np.int64]
    labels: NDArray[np.uint8]
    motion: NDArray[np.uint8]
    moving: list[NDArray[np.int64]]
    anybody: list[NDArray[np.int64]]
    roomy: NDArray[np.bool_]
    objects: int
    boxes: list[NDArray[np.float64]]
    standing: list[NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.stamps)

    def centers(self, cells: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y of the middles of cells given by their flat numbers [m]."""
        ix, iy = np.divmod(cells, self.spec.shape[1])
        x0, y0 = self.spec.origin
        return x0 + (ix + 0.5) * self.spec.resolution, y0 + (iy + 0.5) * self.spec.resolution

    def in_view(self, frame: int, cells: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the flat numbers of the paper's cells that hold given cells' middles, and which lie inside."""
        x, y, yaw = planar(self.poses[frame])
        cx, cy = self.centers(cells)
        c, s = np.cos(yaw), np.sin(yaw)
        u, v = c * (cx - x) + s * (cy - y), c * (cy - y) - s * (cx - x)
        inside = PAPER.contains(u, v)
        ix, iy = PAPER.index(np.where(inside, u, 0), np.where(inside, v, 0))
        return ix * PAPER.shape[1] + iy, inside


def planar(T: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return x, y [m] and yaw [rad] of a pose."""
    return float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0], T[0, 0]))


def drives(part: Split, most: int | None = None) -> list[int]:
    """Return the numbers of the drives of which every frame can be read."""
    counts = np.bincount(part.finished // FRAMES, minlength=1)
    return np.flatnonzero(counts == FRAMES).tolist()[:most]


def read_drive(part: Split, number: int) -> Drive:
    """Read a drive and work out the world's static truth, labels and motion of all its frames."""
    samples = [part[number * FRAMES + k] for k in range(FRAMES)]
    start = samples[0].T_world_sensor[:2, 3].copy()
    poses = np.array([one.T_world_sensor for one in samples])
    poses[:, :2, 3] -= start

    # The lattice: all windows of 624 x 624 cells around the sensor fit
    r, n = TRUTH_SPEC.resolution, TRUTH_SPEC.shape[0]
    middles = np.rint(poses[:, :2, 3] / r).astype(np.int64)
    low, high = middles.min(axis=0) - n // 2, middles.max(axis=0) + n // 2
    spec = GridSpec(r, tuple((high - low).tolist()), tuple((low * r).tolist()))
    windows = middles - n // 2 - low

    own_moves = _movers(samples)
    votes = np.zeros((2, *spec.shape), np.uint8)
    first = np.full(spec.shape, NEVER, np.uint8)
    moving, anybody, unseen, boxes, standing, objects = [], [], [], [], [], 0
    for k, sample in enumerate(samples):
        x, y, yaw = planar(poses[k])
        part_of = _slices(windows[k], n)
        corner = (spec.origin[0] + windows[k, 0] * r, spec.origin[1] + windows[k, 1] * r)
        state = sample.truth.crop(GridSpec(r, (n, n), corner), yaw, x, y).state
        rows = _boxes(sample, x, y, yaw)
        speed = np.hypot(sample.objects["vx"], sample.objects["vy"])
        seen = sample.objects["returns"] >= SEEN
        moves = speed > MOVING
        track_moves = np.isin(sample.objects["track"], own_moves)
        moving.append(_covered(rows[moves & seen], spec))
        unseen.append(_covered(grown(rows[(speed > STILL) & ~(moves & seen)]), spec))
        anybody.append(_covered(grown(rows), spec))
        boxes.append(rows[moves & seen])
        standing.append(rows[~track_moves & seen])
        objects += _inside(sample.objects[moves & seen])
        known = (state == FREE) | (state == OCCUPIED)
        first[part_of] = np.minimum(first[part_of], np.where(known, k, NEVER).astype(np.uint8))
        hide = np.zeros(spec.shape, bool)  # where somebody who ever moves stands now
        hide.ravel()[_covered(grown(rows[track_moves], 2 * MARGIN), spec)] = True
        state[hide[part_of]] = UNKNOWN
        votes[0][part_of] += state == FREE
        votes[1][part_of] += state == OCCUPIED
    static = _settle(votes)
    roomy = static == FREE
    roomy &= ~binary_dilation((static == OCCUPIED) | (static == IGNORE), np.ones((3, 3)))

    drive = Drive(
        number=number,
        stamps=np.array([one.stamp for one in samples]),
        poses=poses,
        height=float(samples[0].T_vehicle_sensor[2, 3]),
        points=[one.points for one in samples],
        truth=np.stack([one.truth.crop(PAPER).state for one in samples]),
        spec=spec,
        static=static,
        first=first,
        windows=windows,
        labels=np.zeros((FRAMES, n, n), np.uint8),
        motion=np.zeros((FRAMES, n, n), np.uint8),
        moving=moving,
        anybody=anybody,
        roomy=roomy,
        objects=objects,
        boxes=boxes,
        standing=standing,
    )
    _label(drive, unseen)
    return drive


def trails(drive: Drive, scans: Sequence[NDArray[np.float32]]) -> Iterator[Trail]:
    """Yield what moving participants cover and have left, for every frame.

    Parameters
    ----------
    drive : Drive
    scans : sequence of (512, 352, 2) float32
        Measurement grids, which tell in which cells the participants were seen at all.
    """
    last = np.full(drive.spec.shape, -NEVER, np.int64).ravel()
    entered = last.copy()  # frame of the first scan of this visit that says occupied; -1 for none yet
    touched = np.zeros(last.shape, bool)
    busy = np.zeros(last.shape, bool)
    for k, cells in enumerate(drive.moving):
        view, inside = drive.in_view(k, cells)
        hit = inside & (scans[k][..., 1].ravel()[view] > 0.5)
        new = cells[last[cells] < k - 1]
        touched[new], entered[new] = False, -1
        entered[cells[hit & (entered[cells] < 0)]] = k
        touched[cells[hit]] = True
        last[cells] = k

        busy[:] = False
        busy[drive.anybody[k]] = True
        left = np.flatnonzero((last >= k - MEMORY) & (last < k))
        left = left[~busy[left] & drive.roomy.ravel()[left]]
        view, inside = drive.in_view(k, left)
        state = drive.truth[k].ravel()[view]
        inside &= (state == FREE) | (state == UNKNOWN)
        left, view, state = left[inside], view[inside], state[inside]
        measured = scans[k].reshape(-1, 2)[view].sum(axis=1) > 0.5
        where = np.where(state == FREE, 1 + measured, 0).astype(np.uint8)
        on = cells[(entered[cells] >= 0) & drive.roomy.ravel()[cells]]
        on = on[drive.in_view(k, on)[1]]
        yield Trail(left, k - last[left], where, touched[left], last[left], on, k - entered[on])


def _movers(samples: Sequence[Any]) -> NDArray[np.int32]:
    """Return the tracks that move at any time of the drive."""
    rows = np.concatenate([one.objects for one in samples])
    return np.unique(rows["track"][np.hypot(rows["vx"], rows["vy"]) > STILL])


def _boxes(sample: Any, x: float, y: float, yaw: float) -> NDArray[np.float64]:
    """Return the participants' boxes in map coordinates, (B, 5)."""
    one = sample.objects
    c, s = np.cos(yaw), np.sin(yaw)
    px, py = one["x"].astype(np.float64), one["y"].astype(np.float64)
    return np.column_stack(
        [x + c * px - s * py, y + s * px + c * py, one["yaw"] + yaw, one["length"], one["width"]]
    )


def grown(boxes: NDArray[np.float64], margin: float = MARGIN) -> NDArray[np.float64]:
    """Return boxes (B, 5), wider and longer by a margin on every side [m]."""
    return boxes + np.array([0, 0, 0, 2 * margin, 2 * margin])


def _covered(boxes: NDArray[np.float64], spec: GridSpec) -> NDArray[np.int64]:
    """Return the flat numbers of the cells that any of the boxes covers, ascending."""
    cells = [np.ravel_multi_index(cells_in_box(box, spec), spec.shape) for box in boxes]
    return np.unique(np.concatenate(cells)) if cells else np.empty(0, np.int64)


def _inside(objects: NDArray[Any]) -> int:
    return int(np.count_nonzero(PAPER.contains(objects["x"], objects["y"])))


def _slices(corner: NDArray[np.int64], n: int) -> tuple[slice, slice]:
    return slice(corner[0], corner[0] + n), slice(corner[1], corner[1] + n)


def _settle(votes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the static states: occupied by half of the votes and more, free by nine tenths, else contested."""
    free, occupied = votes.astype(np.float32)
    total = free + occupied
    share = occupied / np.maximum(total, 1)
    state = np.full(free.shape, IGNORE, np.uint8)
    state[share >= 0.5] = OCCUPIED
    state[share <= 0.1] = FREE
    state[total < VOTES] = UNKNOWN
    return state


def _label(drive: Drive, unseen: Sequence[NDArray[np.int64]]) -> None:
    """Fill in the labels and the motion of every frame."""
    spec, n = drive.spec, drive.labels.shape[1]
    r = spec.resolution
    last = np.full(spec.shape, -NEVER, np.int32)  # last cover by the moving and seen, by frame
    lately = np.full(spec.shape, -NEVER, np.int32)  # last cover by anybody who moves, with a margin
    history: list[NDArray[np.bool_]] = []
    for k in range(len(drive)):
        at = _slices(drive.windows[k], n)
        now = np.zeros(spec.shape, bool)
        now.ravel()[drive.moving[k]] = True
        before = history[k - RECENT] if k >= RECENT else np.zeros_like(now)
        history.append(now)
        last.ravel()[drive.moving[k]] = k
        hidden = np.zeros(spec.shape, bool)
        hidden.ravel()[unseen[k]] = True
        x, y, yaw = planar(drive.poses[k])
        px = spec.origin[0] + (drive.windows[k, 0] + np.arange(n)[:, None] + 0.5) * r - x
        py = spec.origin[1] + (drive.windows[k, 1] + np.arange(n)[None, :] + 0.5) * r - y
        c, s = np.cos(yaw), np.sin(yaw)
        u, v = c * px + s * py, c * py - s * px
        x0, x1, y0, y1 = EGO_FOOTPRINT
        own = (u > x0) & (u < x1) & (v > y0) & (v < y1)
        view = PAPER.contains(u, v) & ~own

        recent = k - last[at]
        motion = np.full((n, n), Motion.NOBODY, np.uint8)
        motion[recent <= RECENT] = Motion.BACK
        motion[now[at]] = np.where(before[at], Motion.BODY, Motion.FRONT)[now[at]]
        near = binary_dilation(motion != Motion.NOBODY, np.ones((3, 3))) & (motion == Motion.NOBODY)
        motion[near | (hidden[at] & (motion == Motion.NOBODY)) | ~view] = Motion.NOT_JUDGED
        drive.motion[k] = motion

        moved = binary_dilation(now[at], np.ones((3, 3))) | hidden[at]
        lately[at] = np.where(moved, k, lately[at])
        judged = view & (k - lately[at] > MEMORY)
        static, seen = drive.static[at], drive.first[at] <= k
        ring = np.hypot(u, v) < RING
        label = np.zeros((n, n), np.uint8)
        for state, on, later, near_by in (
            (FREE, Label.FREE, Label.LATER_FREE, Label.RING_FREE),
            (OCCUPIED, Label.OCCUPIED, Label.LATER_OCCUPIED, Label.RING_OCCUPIED),
        ):
            here = judged & (static == state)
            label[here & seen] = on
            label[here & ~seen] = later
            label[here & seen & ring] = near_by
        drive.labels[k] = label
