"""What a map of belief masses says beyond a probability: conflict, unknown; and where the two kinds are the same."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from _fusion_methods import MATCHED, MIN_UNKNOWN
from _sequences import MEMORY, PAPER, Drive, Motion, grown
from _trails import LEVELS, WINDOW, average_precision
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from ogm import EvidentialGrid, GridSpec
from ogm.evidence import dempster, plausibility_transform
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, warp
from ogm.metrics import auroc, score, accumulate
from ogm.truth import IGNORE, OCCUPIED, Truth, cells_in_box

__all__ = [
    "conflict_kinds",
    "conflict_report",
    "lost_by_cells",
    "same_filter",
    "unknown_report",
    "what_half_means",
]

INF = float("inf")
KINDS = ("K of the last scan", "K, fading", "normalised", "normalised, fading", "K, fading, opened 2 x 2")
THRESHOLDS = (0.1, 0.2, 0.3, 0.5, 0.7)
EVERY = 2  # frames between two that are judged for conflict
BLOB = 3  # cells of a participant that must show conflict for it to be found
STEP = 10  # frames between two looks at what P = 1/2 means
SURE = 0.5


def conflict_kinds(
    drive: Drive, scans: Sequence[NDArray[np.float32]], half_life: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure how well five kinds of conflict find those who move.

    K is the mass that Dempster's rule would put on the empty set, free -> occupied plus occupied -> free;
    normalised, it is divided by what map and scan know, (1 - u_map) (1 - u_scan). Opened: the least of 2 x 2
    cells, so that single cells and lines of them vanish.

    Returns
    -------
    (kinds, motion, LEVELS) float64
        Histograms.
    (thresholds, 6) float64
        For K, fading and opened, at each of `THRESHOLDS`: participants in the view that move and those of them found,
        by `BLOB` cells and more within their boxes and one cell around; the same of those that never move, which
        are found falsely; false cells, and those of them within two cells of something static.
    """
    mapper = EvidentialMapper(WINDOW, dempster, half_life, moving_half_life=INF, conflict_half_life=0.5)
    histograms = np.zeros((len(KINDS), Motion.COUNT, LEVELS))
    found = np.zeros((len(THRESHOLDS), 6))
    n, r = drive.labels.shape[1], drive.spec.resolution
    fading = np.zeros((n, n), np.float32)
    normal = np.zeros((*drive.spec.shape,), np.float32)
    before: EvidentialGrid | None = None
    edges = binary_dilation(drive.static == OCCUPIED, np.ones((5, 5)))
    for k in range(len(drive)):
        stamp = float(drive.stamps[k])
        scan = EvidentialGrid.trusted(PAPER, scans[k])
        mapper.update(scan, drive.poses[k], stamp=stamp)
        x, y = drive.spec.origin
        i, j = drive.windows[k]
        at = slice(i, i + n), slice(j, j + n)
        spec = GridSpec(r, (n, n), (x + i * r, y + j * r))
        said = warp(scan, spec, drive.poses[k], "nearest").mass
        if before is None:
            now = normalised = np.zeros((n, n), np.float32)
        else:
            step = stamp - float(drive.stamps[k - 1])
            map_ = warp(before, spec, np.eye(4), "nearest").mass * np.float32(0.5 ** (step / half_life))
            now = (map_ * said[..., ::-1]).sum(axis=-1)
            known = map_.sum(axis=-1) * said.sum(axis=-1)
            normalised = np.where(known > 1e-3, now / np.maximum(known, 1e-3), 0)
            normal *= np.float32(0.5 ** (step / mapper.conflict_half_life))
        before = mapper.grid
        offset = np.rint((np.array(mapper.spec.origin) - drive.spec.origin) / r).astype(int)
        di, dj = drive.windows[k] - offset
        fading = mapper.conflict[di : di + n, dj : dj + n].sum(axis=-1)
        normal[at] = np.maximum(normal[at], normalised)
        if k % EVERY:
            continue
        kinds = (now, fading, normalised, normal[at], opened(fading))
        motion = drive.motion[k]
        for row, values in enumerate(kinds):
            level = np.minimum((values * (LEVELS - 1) + 0.5).astype(np.int64), LEVELS - 1)
            flat = np.bincount(
                (motion.astype(np.int64) * LEVELS + level).ravel(), minlength=Motion.COUNT * LEVELS
            )
            histograms[row] += flat.reshape(Motion.COUNT, LEVELS)
        unobserved, near = motion == Motion.NOBODY, edges[at]
        for row, threshold in enumerate(THRESHOLDS):
            there = kinds[-1] > threshold
            found[row, :2] += _found(drive.boxes[k], motion, spec, there)
            found[row, 2:4] += _found(drive.standing[k], motion, spec, there)
            found[row, 4] += np.count_nonzero(there & unobserved)
            found[row, 5] += np.count_nonzero(there & unobserved & near)
    return histograms, found


def opened(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the grey opening by 2 x 2 cells: what is left of a score that single cells and lines cannot have."""
    low = np.zeros_like(values)
    pairs = np.minimum(values[:-1], values[1:])
    low[:-1, :-1] = np.minimum(pairs[:, :-1], pairs[:, 1:])
    high = low.copy()
    high[1:] = np.maximum(high[1:], low[:-1])
    result = high.copy()
    result[:, 1:] = np.maximum(result[:, 1:], high[:, :-1])
    return result


def _found(
    boxes: NDArray[np.float64], motion: NDArray[np.uint8], spec: GridSpec, there: NDArray[np.bool_]
) -> tuple[int, int]:
    """Count the participants that lie in the view, and those in whose boxes there is conflict."""
    inside = found = 0
    for box in grown(boxes):
        cells = cells_in_box(box, spec)
        if np.mean(motion[cells] != Motion.NOT_JUDGED) < 0.5:
            continue
        inside += 1
        found += np.count_nonzero(there[cells]) >= BLOB
    return inside, found


def lost_by_cells(drive: Drive) -> list[dict[str, float]]:
    """Score the frames' own truths after a way through the map's cells: what turning cells twice costs a map.

    Returns
    -------
    list of dict
        IoU of free and occupied, of every tenth frame.
    """
    result = []
    for k in range(STEP - 1, len(drive), STEP):
        mapper = EvidentialMapper(WINDOW, dempster, INF, moving_half_life=INF, min_unknown=0.0)
        truth = Truth(PAPER, drive.truth[k])
        mapper.update(truth.grid, drive.poses[k], stamp=float(drive.stamps[k]))
        state = np.where(truth.known, truth.state, IGNORE).astype(np.uint8)
        scores = score(accumulate(mapper.view(PAPER).mass, state))
        result.append({name: scores[name] for name in ("iou_free_known", "iou_occupied_known")})
    return result


def conflict_report(
    histograms: NDArray[np.float64], found: NDArray[np.float64], frames: int
) -> dict[str, Any]:
    """Tabulate what `conflict_kinds` counted, summed over drives."""
    kinds = {}
    for name, one in zip(KINDS, histograms, strict=True):
        positive = one[Motion.FRONT] + one[Motion.BACK]
        kinds[name] = average_precision(positive, one[Motion.NOBODY])
    area = PAPER.resolution**2
    levels = {
        f"{threshold:g}": {
            "moving participants found": row[1] / max(row[0], 1),
            "standing participants found falsely": row[3] / max(row[2], 1),
            "false cells [m2 a frame]": row[4] * area * EVERY / frames,
            "of them within two cells of something static": row[5] / max(row[4], 1),
        }
        for threshold, row in zip(THRESHOLDS, found, strict=True)
    }
    return {"kinds": kinds, "K, fading, opened 2 x 2, by threshold": levels}


def same_filter(drive: Drive, scans: Sequence[NDArray[np.float32]]) -> dict[str, float]:
    """Compare Dempster's rule with the Bayes filter of plausibilities: one filter but for forgetting and limits.

    Nothing is forgotten. Without limits, after 3 scans: later, beliefs run out of float32's digits (unknown becomes
    0, and Dempster's map cannot change its mind any more). With limits that allow the same plausibilities, after
    10 and 100 scans: Dempster's map scales both beliefs down, Bayes cuts the log-odds off.

    Returns
    -------
    dict
        Over the cells that were measured: the greatest difference of the two probabilities, the difference that
        99.9 % of the cells stay below, the mean one, and the share of the cells that only one calls occupied.
    """
    result = {}
    for name, frames, least, limits in (
        ("no limits, 3 scans", 3, 0.0, (1e-6, 1 - 1e-6)),
        ("limits, 10 scans", 10, MIN_UNKNOWN, MATCHED),
        ("limits, 100 scans", 100, MIN_UNKNOWN, MATCHED),
    ):
        ours = EvidentialMapper(WINDOW, dempster, INF, moving_half_life=INF, min_unknown=least)
        theirs = BinaryBayesMapper(WINDOW, INF, match="plausibility", limits=limits)
        for k in range(frames):
            grid = EvidentialGrid.trusted(PAPER, scans[k])
            for mapper in (ours, theirs):
                mapper.update(grid, drive.poses[k], stamp=float(drive.stamps[k]))
        mass = ours.grid.mass
        known = mass.sum(axis=-1) > 0
        p, q = plausibility_transform(mass)[known], theirs.probability[known]
        apart = np.abs(p - q)
        result[f"{name}: greatest difference"] = float(apart.max())
        result[f"{name}: 99.9 % of cells differ by less than"] = float(np.quantile(apart, 0.999))
        result[f"{name}: mean difference"] = float(apart.mean())
        result[f"{name}: called otherwise"] = float(((p > 0.5) != (q > 0.5)).mean())
    return result


def what_half_means(
    drive: Drive, scans: Sequence[NDArray[np.float32]], half_life: float
) -> dict[str, NDArray[np.float32]]:
    """Look at the cells that a Bayes filter calls neither free nor occupied, 0.4 < P < 0.6.

    Bayes forgets as fast as Dempster does. Every second, over the cells in view.

    Returns
    -------
    dict of (cells,) arrays
        ``unmeasured``: no scan ever gave the cell a belief above 1/2; ``contradicted``: within the last 5 s, scans
        said both free and occupied (above 1/2 each); ``hidden``: no frame's truth so far knows it; ``probability`` of
        Bayes; ``unknown`` and ``dissonance``, 2 min(F, O), of Dempster; ``conflict``.
    """
    ours = EvidentialMapper(WINDOW, dempster, half_life, moving_half_life=INF)
    theirs = BinaryBayesMapper(WINDOW, half_life)
    description = np.full((2, *drive.spec.shape), -1000, np.int32)  # last frame whose scan said free, occupied
    n, r = drive.labels.shape[1], drive.spec.resolution
    rows: list[NDArray] = []
    for k in range(len(drive)):
        grid = EvidentialGrid.trusted(PAPER, scans[k])
        for mapper in (ours, theirs):
            mapper.update(grid, drive.poses[k], stamp=float(drive.stamps[k]))
        i, j = drive.windows[k]
        at = slice(i, i + n), slice(j, j + n)
        spec = GridSpec(r, (n, n), (drive.spec.origin[0] + i * r, drive.spec.origin[1] + j * r))
        said = warp(grid, spec, drive.poses[k], "nearest").mass
        for state in range(2):
            description[state][at][said[..., state] > SURE] = k
        if k % STEP != STEP - 1:
            continue
        offset = np.rint((np.array(ours.spec.origin) - drive.spec.origin) / r).astype(int)
        di, dj = drive.windows[k] - offset
        here = slice(di, di + n), slice(dj, dj + n)
        p, mass = theirs.probability[here], ours.grid.mass[here]
        look = (np.abs(p - 0.5) < 0.1) & (drive.motion[k] != Motion.NOT_JUDGED)
        free, occupied = description[0][at], description[1][at]
        rows.append(
            np.stack(
                [
                    (free < 0) & (occupied < 0),
                    (k - free <= MEMORY) & (k - occupied <= MEMORY),
                    drive.first[at] > k,
                    p,
                    1 - mass.sum(axis=-1),
                    2 * mass.min(axis=-1),
                    ours.conflict[here].sum(axis=-1),
                ],
                axis=-1,
            )[look].astype(np.float32)
        )
    names = ("unmeasured", "contradicted", "hidden", "probability", "unknown", "dissonance", "conflict")
    return dict(zip(names, np.concatenate(rows).T, strict=True))


def unknown_report(cells: dict[str, NDArray[np.float32]]) -> dict[str, float]:
    """Tabulate what `what_half_means` found, drives together."""
    never, against = cells["unmeasured"] > 0, cells["contradicted"] > 0
    both = never | against
    hidden = cells["hidden"] > 0
    doubt = -np.abs(cells["probability"] - 0.5)
    result = {
        "cells": float(len(never)),
        "share never measured": float(never.mean()),
        "share contradicted": float(against.mean()),
        "share measured weakly or long ago": float(1 - both.mean()),
        "AUROC for never measured against contradicted, unknown mass": auroc(
            cells["unknown"][both], never[both]
        ),
        "AUROC for never measured against contradicted, |P - 1/2| of Bayes": auroc(doubt[both], never[both]),
        "AUROC for hidden so far, unknown mass": auroc(cells["unknown"], hidden),
        "AUROC for hidden so far, |P - 1/2| of Bayes": auroc(doubt, hidden),
    }
    for name, mask in (("never measured", never), ("contradicted", against)):
        for what in ("unknown", "dissonance", "conflict"):
            result[f"mean {what} where {name}"] = float(cells[what][mask].mean())
    return result
