"""Runs a mapper over a drive and counts: static cells, ghost trails, clearing, appearing, conflict, views."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from _sequences import MEMORY, PAPER, Drive, Label, Motion, Trail
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ogm import EvidentialGrid, GridSpec
from ogm.evidence import dempster
from ogm.fusion import EvidentialMapper
from ogm.metrics import Interval, auroc_of_histograms, bootstrap_mean, score, accumulate

__all__ = ["SAID", "WINDOW", "Counts", "Mapper", "ScanAlone", "run_evaluation", "survival"]

WINDOW = GridSpec.centered(length=102.4, width=102.4, resolution=0.16)  # holds the paper's grid at any yaw
EVERY = 5  # frames: how often a view is held against the frame's own truth
LEVELS = 512  # of conflict, unknown and doubt
APPEAR = 20  # frames for which a cell that is covered is followed
SAID = ("cells", "free", "occupied", "P<1/4", "P<1/2", "P>1/2", "P>3/4", "squared", "known")
VIEW = (
    "iou_free", "iou_occupied", "iou_free_known", "iou_occupied_known", "false_free", "missed_occupied",
    "false_occupied", "brier", "ece", "ece_called", "ece_relative",
)  # fmt: skip
EVEN = 1e-4  # how near to 1/2 a probability is neither


class Mapper(Protocol):
    """What is judged: `EvidentialMapper`, `BinaryBayesMapper` and `ScanAlone`."""

    @property
    def grid(self) -> EvidentialGrid:
        """The map."""
        ...

    def update(self, grid: EvidentialGrid, T_map_sensor: ArrayLike, *, stamp: float) -> None:
        """Fuse a scan."""
        ...

    def view(self, spec: GridSpec) -> EvidentialGrid:
        """Return the map in the vehicle's axes."""
        ...


class ScanAlone:
    """No memory: the map is the last scan."""

    def __init__(self, spec: GridSpec) -> None:
        self._mapper = EvidentialMapper(spec, dempster, np.inf, moving_half_life=np.inf, min_unknown=0.0)
        self._grid: EvidentialGrid | None = None

    def update(self, grid: EvidentialGrid, T_map_sensor: ArrayLike, *, stamp: float) -> None:
        """Forget the last scan and take this one."""
        self._mapper.reset()
        self._mapper.update(grid, T_map_sensor, stamp=stamp)
        self._grid = grid

    @property
    def grid(self) -> EvidentialGrid:
        """The scan on the cells of a map."""
        return self._mapper.grid

    def view(self, spec: GridSpec) -> EvidentialGrid:
        """Return the scan, as it came."""
        assert self._grid is not None
        return self._grid


class Counts(NamedTuple):
    """What is counted of one mapper on one drive.

    Attributes
    ----------
    static : (K, labels, SAID)
        For every frame and `Label`, how many cells were said to be what.
    trail : (51, 3, 2, 4)
        For every age [frames], place (hidden, visible, measured) and whether touched: cells that were left, and
        those with occupied > 1/2, P > 1/2, free <= 1/2.
    clearing : (2, 2, 51, 2)
        For P < 1/2 and free > 1/2; for all cells and for those visible now; by age: touched cells that had not yet
        been so, and those that became so.
    appearing : (2, 21, 2)
        For P > 1/2 and occupied > 1/2, by age since the first scan that says occupied: cells that had not yet
        been so while covered, and those that became so.
    body : (2,)
        Cells that a moving participant covers from the first scan on that says occupied; those with P > 1/2.
    ghosts : float
        Sum over frames of cells left within 5 s with P > 1/2.
    objects : float
        Sum over frames of moving, seen participants.
    conflict : (3, motion, LEVELS)
        Histograms of free -> occupied, occupied -> free and their sum over [0, 1].
    views : (V, VIEW)
        Scores against the truth of every fifth frame, unknown truth left out.
    share : (V,)
        Of the cells whose truth is known, those that are called free or occupied.
    """

    static: NDArray[np.float64]
    trail: NDArray[np.float64]
    clearing: NDArray[np.float64]
    appearing: NDArray[np.float64]
    body: NDArray[np.float64]
    ghosts: float
    objects: float
    conflict: NDArray[np.float64]
    views: NDArray[np.float64]
    share: NDArray[np.float64]


def run_evaluation(
    drive: Drive, mapper: Mapper, scans: Sequence[NDArray[np.float32]], trails: Sequence[Trail]
) -> Counts:
    """Run a mapper over a drive and count."""
    frames = len(drive)
    static = np.zeros((frames, Label.COUNT, len(SAID)))
    trail = np.zeros((MEMORY + 1, 3, 2, 4))
    clearing, appearing = np.zeros((2, 2, MEMORY + 1, 2)), np.zeros((2, APPEAR + 1, 2))
    body, ghosts = np.zeros(2), 0.0
    conflict = np.zeros((3, Motion.COUNT, LEVELS))
    done = np.full((2, drive.spec.shape[0] * drive.spec.shape[1]), -1, np.int64)  # visits that were cleared
    shown = np.full((2, drive.spec.shape[0] * drive.spec.shape[1]), -1, np.int64)  # visits that appeared
    views, shares = [], []
    has_conflict = hasattr(mapper, "conflict")
    for k in range(frames):
        mapper.update(EvidentialGrid.trusted(PAPER, scans[k]), drive.poses[k], stamp=float(drive.stamps[k]))
        grid = mapper.grid
        offset = _offset(grid.spec, drive.spec)
        corner = drive.windows[k] - offset
        count_static(grid.mass, *corner, drive.labels[k], EVEN, static[k])
        if has_conflict:
            count_conflict(mapper.conflict, *corner, drive.motion[k], conflict)  # type: ignore[attr-defined]

        one = trails[k]
        free, occupied = _sampled(grid.mass, one.left, drive.spec, offset)
        p = occupied + 0.5 * (1 - free - occupied)
        description = np.stack([np.ones_like(p), occupied > 0.5, p > 0.5 + EVEN, free <= 0.5], axis=-1)
        np.add.at(trail, (one.age, one.where, one.touched.astype(int)), description)
        ghosts += np.count_nonzero(p > 0.5 + EVEN)
        for which, clear in enumerate((p < 0.5 - EVEN, free > 0.5)):
            open_ = one.touched & (done[which, one.left] != one.visit)
            done[which, one.left[open_ & clear]] = one.visit[open_ & clear]
            for row, kept in enumerate((open_, open_ & (one.where > 0))):
                clearing[which, row, :, 0] += np.bincount(one.age[kept], minlength=MEMORY + 1)
                clearing[which, row, :, 1] += np.bincount(one.age[kept & clear], minlength=MEMORY + 1)

        free, occupied = _sampled(grid.mass, one.covered, drive.spec, offset)
        p = occupied + 0.5 * (1 - free - occupied)
        body += np.array([len(p), np.count_nonzero(p > 0.5 + EVEN)])
        began = k - one.since
        for which, there in enumerate((p > 0.5 + EVEN, occupied > 0.5)):
            open_ = (shown[which, one.covered] != began) & (one.since <= APPEAR)
            shown[which, one.covered[open_ & there]] = began[open_ & there]
            appearing[which, :, 0] += np.bincount(one.since[open_], minlength=APPEAR + 1)
            appearing[which, :, 1] += np.bincount(one.since[open_ & there], minlength=APPEAR + 1)

        if k % EVERY == EVERY - 1:
            state = drive.truth[k].copy()
            state[state == 0] = 3  # what this frame cannot see is left out: a map may well know it
            counts = accumulate(mapper.view(PAPER).mass, state)
            scores = score(counts)
            views.append([scores[name] for name in VIEW])
            shares.append(counts.confusion[1:, 1:].sum() / counts.cells[1:].sum())
    return Counts(
        static, trail, clearing, appearing, body, ghosts, float(drive.objects), conflict,
        np.array(views), np.array(shares),
    )  # fmt: skip


def _offset(spec: GridSpec, lattice: GridSpec) -> NDArray[np.int64]:
    """Return the lattice cell at which a map's cells begin; a map off the lattice is not judged."""
    cells = (np.array(spec.origin) - np.array(lattice.origin)) / lattice.resolution
    whole = np.rint(cells)
    if np.abs(cells - whole).max() > 1e-3:
        raise ValueError(f"the map's cells are off the drive's lattice by {cells - whole} cells")
    return whole.astype(np.int64)


def _sampled(
    mass: NDArray[np.float32], cells: NDArray[np.int64], lattice: GridSpec, offset: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the masses of some of the lattice's cells."""
    ix, iy = np.divmod(cells, lattice.shape[1])
    said = mass[ix - offset[0], iy - offset[1]]
    return said[:, 0], said[:, 1]


@njit(cache=True, nogil=True)
def count_static(mass: Any, dx: int, dy: int, labels: Any, even: float, out: Any) -> None:
    """Add up, per label, what a map says; `labels` begin at cell (dx, dy) of the map."""
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            label = labels[i, j]
            if label == 0:
                continue
            f, o = mass[i + dx, j + dy, 0], mass[i + dx, j + dy, 1]
            u = 1 - f - o
            p = o + 0.5 * u
            row = out[label]
            row[0] += 1
            row[1] += f > 0.5
            row[2] += o > 0.5
            row[3] += p < 0.25
            row[4] += p < 0.5 - even
            row[5] += p > 0.5 + even
            row[6] += p > 0.75
            row[7] += (p - (1 - label % 2)) ** 2
            row[8] += u < 0.5


@njit(cache=True, nogil=True)
def count_conflict(conflict: Any, dx: int, dy: int, motion: Any, out: Any) -> None:
    """Add up the histograms of both directions of conflict and of their sum, per kind of motion."""
    top = out.shape[2] - 1
    for i in range(motion.shape[0]):
        for j in range(motion.shape[1]):
            kind = motion[i, j]
            if kind == 4:
                continue
            a, b = conflict[i + dx, j + dy, 0], conflict[i + dx, j + dy, 1]
            out[0, kind, min(int(a * top + 0.5), top)] += 1
            out[1, kind, min(int(b * top + 0.5), top)] += 1
            out[2, kind, min(int((a + b) * top + 0.5), top)] += 1


def survival(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the share of cells that have not yet become what is waited for, by age: Kaplan and Meier (1958).

    Cells that are covered again or leave the view are censored.

    Parameters
    ----------
    counts : (ages, 2)
        Cells that had not yet become so and were looked at; those of them that became so.
    """
    risk, event = counts.T
    return np.cumprod(1 - event / np.maximum(risk, 1))


def quantile_of(counts: NDArray[np.float64], share: float, step: float = 0.1) -> float:
    """Return the age [s] by which a share of the cells has become what is waited for; NaN beyond the last."""
    left = survival(counts)
    reached = np.flatnonzero(left <= 1 - share)
    return float(reached[0] * step) if len(reached) else float("nan")


def average_precision(positive: NDArray[np.float64], negative: NDArray[np.float64]) -> dict[str, float]:
    """Return the average precision and the best F1 of a score, from its histograms (ascending)."""
    tp, fp = positive[::-1].cumsum(), negative[::-1].cumsum()
    recall = tp / max(positive.sum(), 1)
    precision = tp / np.maximum(tp + fp, 1)
    gain = np.diff(np.concatenate([[0.0], recall]))
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
    best = int(f1.argmax())
    return {
        "ap": float((gain * precision).sum()),
        "auroc": auroc_of_histograms(positive, negative),
        "best f1": float(f1[best]),
        "precision": float(precision[best]),
        "recall": float(recall[best]),
        "threshold": float((len(positive) - 1 - best) / (len(positive) - 1)),
        "base rate": float(positive.sum() / max(positive.sum() + negative.sum(), 1)),
    }


def summary(one: Counts) -> dict[str, float]:
    """Turn the counts of a drive into its scores."""
    static = one.static.sum(axis=0)
    column = {name: n for n, name in enumerate(SAID)}
    free = static[Label.FREE] + static[Label.RING_FREE]
    occupied = static[Label.OCCUPIED] + static[Label.RING_OCCUPIED]
    hit, miss = occupied[column["P>1/2"]], free[column["P>1/2"]]
    right = free[column["P<1/2"]]
    said = {name: float(value) for name, value in zip(VIEW, np.nanmean(one.views, axis=0), strict=True)}
    left = one.trail.sum(axis=2)  # all, touched or not
    touched = one.trail[:, :, 1]
    past = slice(5, MEMORY + 1)
    result = {
        "static_iou_occupied": hit / (occupied[0] + miss),
        "static_iou_free": right / (free[0] + occupied[column["P<1/2"]]),
        "static_false_free": occupied[column["P<1/4"]] / occupied[0],
        "static_false_free_half": occupied[column["P<1/2"]] / occupied[0],
        "static_missed": 1 - hit / occupied[0],
        "static_false_occupied": miss / free[0],
        "static_brier": (free[column["squared"]] + occupied[column["squared"]]) / (free[0] + occupied[0]),
        "static_known": (free[1] + occupied[2]) / (free[0] + occupied[0]),
        "ghost_area": one.ghosts * PAPER.resolution**2 / one.objects,
        "ghost_share": touched[past, :, 2].sum() / touched[past, :, 0].sum(),
        "ghost_share_all": left[past, :, 2].sum() / left[past, :, 0].sum(),
        "ghost_1s": _share(touched[8:13, :, 2], touched[8:13, :, 0]),
        "ghost_hidden": _share(touched[past, 0, 2], touched[past, 0, 0]),
        "ghost_unmeasured": _share(touched[past, 1, 2], touched[past, 1, 0]),
        "ghost_measured": _share(touched[past, 2, 2], touched[past, 2, 0]),
        "ghost_not_free": _share(touched[past, :, 3], touched[past, :, 0]),
        "clear_median": quantile_of(one.clearing[0, 0], 0.5),
        "clear_90": quantile_of(one.clearing[0, 0], 0.9),
        "free_median": quantile_of(one.clearing[1, 0], 0.5),
        "free_90": quantile_of(one.clearing[1, 0], 0.9),
        "clear_visible_90": quantile_of(one.clearing[0, 1], 0.9),
        "appear_first": 1 - float(survival(one.appearing[0])[0]),
        "appear_90": quantile_of(one.appearing[0], 0.9),
        "body_recall": one.body[1] / one.body[0],
        "share_called": float(one.share.mean()),
        **{f"view_{name}": value for name, value in said.items()},
    }
    if one.conflict.any():
        result |= {f"conflict_{name}": value for name, value in conflict_scores(one.conflict).items()}
    return {name: float(value) for name, value in result.items()}


def conflict_scores(histograms: NDArray[np.float64]) -> dict[str, float]:
    """Return how well conflict finds moving cells: fronts, backs, and both by the sum."""
    a, b, total = histograms
    unobserved = Motion.NOBODY
    front = average_precision(a[Motion.FRONT], a[unobserved])
    back = average_precision(b[Motion.BACK], b[unobserved])
    both = average_precision(total[Motion.FRONT] + total[Motion.BACK], total[unobserved])
    every = average_precision(total[Motion.FRONT] + total[Motion.BODY] + total[Motion.BACK], total[unobserved])
    kinds = (("front", front), ("back", back), ("both", both), ("all", every))
    return {f"{kind}_{name}": value for kind, one in kinds for name, value in one.items()}


def completeness(one: Counts) -> dict[str, NDArray[np.float64]]:
    """Return, by frame, the share of static cells that the map knows rightly."""
    s = one.static
    free, occupied = SAID.index("free"), SAID.index("occupied")

    def share(*pairs: tuple[int, int]) -> NDArray[np.float64]:
        right = sum(s[:, row, free] for row, _ in pairs) + sum(s[:, row, occupied] for _, row in pairs)
        cells = sum(s[:, row, 0] + s[:, other, 0] for row, other in pairs)
        return np.where(cells > 0, right / np.maximum(cells, 1), np.nan)

    on = (Label.FREE, Label.OCCUPIED)
    ring = (Label.RING_FREE, Label.RING_OCCUPIED)
    later = (Label.LATER_FREE, Label.LATER_OCCUPIED)
    return {"seen so far": share(on, ring), "all": share(on, ring, later), "ring": share(ring)}


def interval(values: Sequence[float], rng: np.random.Generator) -> Interval:
    """Return a mean over drives with its 95 % bootstrap interval over drives."""
    return bootstrap_mean(values, rng)


def _share(some: NDArray[np.float64], whole: NDArray[np.float64]) -> float:
    return float(some.sum() / whole.sum()) if whole.sum() > 0 else float("nan")
