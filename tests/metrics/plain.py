"""Every score from its definition, in plain Python and without histograms: the reference of `ogm.metrics.score`."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.evidence import dirichlet_kl
from ogm.state import CellState

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState

STEPS = 4096  # of the lattice: on it, no histogram rounds anything


def lattice_grid(
    seed: int, shape: tuple[int, int] = (7, 7), coarse: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Masses of all kinds whose unknown and P(occupied) are whole 4096ths (many ties if coarse), and states."""
    rng = np.random.default_rng(seed)
    sides = rng.dirichlet([0.4, 0.4, 0.6], shape)[..., :2]
    free, occupied = np.moveaxis((sides * STEPS / 2 / coarse).astype(int) * 2 * coarse, -1, 0)
    mass = np.stack([free, occupied], axis=-1) / STEPS
    mass[rng.random(shape) < 0.1] = 0.0
    mass[rng.random(shape) < 0.05] = [1.0, 0.0]
    mass[rng.random(shape) < 0.05] = [0.0, 1.0]
    return mass.astype(np.float32), rng.choice(4, size=shape, p=[0.4, 0.3, 0.2, 0.1]).astype(np.uint8)


def plain_scores(mass: NDArray[np.floating], state: NDArray[np.uint8]) -> dict[str, float]:
    """Return all scores but those of predicted states, which `test_metrics_counts.py` counts."""
    cells = [
        (float(f), float(o), int(s))
        for (f, o), s in zip(mass.reshape(-1, 2).astype(float), state.ravel(), strict=True)
        if s != IGNORE
    ]
    known = [(f, o, float(s == OCCUPIED)) for f, o, s in cells if s in (FREE, OCCUPIED)]
    free = [one for one in known if one[2] == 0]
    occupied = [one for one in known if one[2] == 1]
    p = [(1 + o - f) / 2 for f, o, _ in known]
    y = [one[2] for one in known]
    unknown = [1 - f - o for f, o, _ in known]
    relative = [o / (f + o) if f + o else 0.5 for f, o, _ in known]
    right = [q if t else 1 - q for q, t in zip(p, y, strict=True)]
    spread = [q * (1 - q) * u / (2 + u) for q, u in zip(p, unknown, strict=True)]
    doubts = [1 - f - o for f, o, s in cells if s == UNKNOWN]
    wrong = [0.5 if q == 0.5 else float(q < 0.5) for q in right]
    aurc = area(unknown, wrong)
    nll = mean([-math.log(max(q, 1e-5)) for q in right])
    return {
        **divergences(cells),
        "brier": mean([(q - t) ** 2 for q, t in zip(p, y, strict=True)]),
        "brier_relative": mean([(q - t) ** 2 for q, t in zip(relative, y, strict=True)]),
        "brier_expected": mean([(q - t) ** 2 + v for q, t, v in zip(p, y, spread, strict=True)]),
        "nll": nll,
        "map_score": map_score(cells) / len(known) if known else math.nan,
        "false_free": mean([f > 0.5 for f, _, _ in occupied]),
        "missed_occupied": mean([o <= 0.5 for _, o, _ in occupied]),
        "false_occupied": mean([o > 0.5 for _, o, _ in free]),
        "missed_obstacles": missed_obstacles(mass, state),
        "free_recall_1": free_recall(free, occupied, 0.01),
        "free_recall_01": free_recall(free, occupied, 0.001),
        "ap_occupied": near_precision(mass, state, 0),
        "ap_occupied_near": near_precision(mass, state, 1),
        "auroc_unknown": mean([(a > b) + 0.5 * (a == b) for a in doubts for b in unknown]),
        "aupr_unknown": ranked_precision(doubts, unknown),
        "aupr_known": ranked_precision([-u for u in unknown], [-u for u in doubts]),
        "fpr95_unknown": fpr95(doubts, unknown),
        "aurc": aurc,
        "ause": aurc - area(wrong, wrong),
        "ece": binned(p, p, y),
        "ece_relative": binned(relative, relative, y),
        "ace": equal_mass(p, y),
        "interval_violation": violation(known),
        "conflict": mean([f if t else o for f, o, t in known]),
        "conflict_free": mean([f for f, _, _ in occupied]),
        "conflict_occupied": mean([o for _, o, _ in free]),
        "entropy": mean([entropy((1 + o - f) / 2) for f, o, _ in cells]),
        "dissonance": mean([2 * min(f, o) for f, o, _ in cells]),
        "mean_free": mean([f for f, _, _ in cells]),
        "mean_occupied": mean([o for _, o, _ in cells]),
        "mean_unknown": mean([1 - f - o for f, o, _ in cells]),
    }


def map_score(cells: list[tuple[float, float, int]]) -> float:
    """Martin and Moravec's score of the grid against the truth, whose P(occupied) is 0, 1/2 or 1."""
    total = 0.0
    for f, o, s in cells:
        a, b = (1 + o - f) / 2, {UNKNOWN: 0.5, FREE: 0.0, OCCUPIED: 1.0}[s]
        total += 1 + math.log2(max(a * b + (1 - a) * (1 - b), 1e-5))
    return total


def mean(values: list) -> float:
    return sum(values) / len(values) if values else math.nan


def entropy(p: float) -> float:
    return -sum(q * math.log2(q) for q in (p, 1 - p) if q > 0)


def divergences(cells: list[tuple[float, float, int]]) -> dict[str, float]:
    """Dirichlet and released divergences, unknown being at least 2e-5."""
    if not cells:
        names = ("kl_e10", "kl_e1", "kl_e1_scaled", "kl_e10_reverse", "kl_e1_reverse", "legacy_kl")
        return dict.fromkeys(names, math.nan)
    f, o, s = np.array(cells).T
    evidence = 2 * np.stack([f, o], axis=-1) / np.maximum(1 - f - o, 2e-5)[:, None]
    truth = np.stack([s == FREE, s == OCCUPIED], axis=-1).astype(float)
    label, clipped = np.clip(truth, 1e-7, 1), np.clip(evidence, 1e-7, 1)
    return {
        "kl_e10": dirichlet_kl(1 + evidence, 1 + 10 * truth).mean(),
        "kl_e1": dirichlet_kl(1 + evidence, 1 + truth).mean(),
        "kl_e1_scaled": dirichlet_kl(1 + evidence / 10, 1 + truth).mean(),
        "kl_e10_reverse": dirichlet_kl(1 + 10 * truth, 1 + evidence).mean(),
        "kl_e1_reverse": dirichlet_kl(1 + truth, 1 + evidence).mean(),
        "legacy_kl": (label * np.log(label / clipped)).sum(axis=-1).mean(),
    }


def area(order: list[float], wrong: list[float], points: int = 200_000) -> float:
    """Mean over coverage of the share of wrong cells, cells of one order being spread evenly."""
    if not order:
        return math.nan
    ends, errors = [0.0], [0.0]
    for level in sorted(set(order)):
        group = [e for u, e in zip(order, wrong, strict=True) if u == level]
        ends.append(ends[-1] + len(group))
        errors.append(errors[-1] + sum(group))
    taken = (np.arange(points) + 0.5) / points * ends[-1]
    return float((np.interp(taken, ends, errors) / taken).mean())


def ranked_precision(positive: list[float], negative: list[float]) -> float:
    if not positive or not negative:
        return math.nan
    total, before = 0.0, 0.0
    for threshold in sorted(set(positive), reverse=True):
        found = sum(x >= threshold for x in positive)
        claimed = found + sum(x >= threshold for x in negative)
        total += (found / len(positive) - before) * found / claimed
        before = found / len(positive)
    return total


def fpr95(positive: list[float], negative: list[float]) -> float:
    if not positive or not negative:
        return math.nan
    rates = [
        (sum(x >= t for x in positive) / len(positive), sum(x >= t for x in negative) / len(negative))
        for t in set(positive)
    ]
    return min(false for found, false in rates if found >= 0.95)


def free_recall(free: list, occupied: list, bound: float) -> float:
    if not free or not occupied:
        return math.nan
    best = 0.0
    for threshold in {one[0] for one in free + occupied}:
        if mean([one[0] >= threshold for one in occupied]) <= bound:
            best = max(best, mean([one[0] >= threshold for one in free]))
    return best


def binned(values: list[float], claimed: list[float], happened: list[float]) -> float:
    """Expected calibration error in 15 even bins."""
    error = 0.0
    for k in range(15):
        inside = [i for i, v in enumerate(values) if min(int(v * 15), 14) == k]
        error += abs(sum(claimed[i] for i in inside) - sum(happened[i] for i in inside))
    return error / len(values) if values else math.nan


def equal_mass(p: list[float], y: list[float]) -> float:
    """Calibration error in 15 bins of equal weight: every cell is cut in 15, equal ones share what happened."""
    if not p:
        return math.nan
    order = sorted(range(len(p)), key=p.__getitem__)
    shared = [mean([t for q, t in zip(p, y, strict=True) if q == p[i]]) for i in order]
    gaps = np.repeat([p[i] - t for i, t in zip(order, shared, strict=True)], 15).reshape(15, len(p))
    return float(np.abs(gaps.mean(axis=1)).mean())


def violation(known: list[tuple[float, float, float]]) -> float:
    outside = 0.0
    for k in range(15):
        inside = [one for one in known if min(int(one[1] * 15), 14) == k]
        if inside:
            share = mean([t for _, _, t in inside])
            low, high = mean([o for _, o, _ in inside]), mean([1 - f for f, _, _ in inside])
            outside += len(inside) * max(low - share, share - high, 0.0)
    return outside / len(known) if known else math.nan


def around(i: int, j: int, shape: tuple[int, ...], reach: int) -> list[tuple[int, int]]:
    return [
        (a, b)
        for a in range(max(i - reach, 0), min(i + reach + 1, shape[0]))
        for b in range(max(j - reach, 0), min(j + reach + 1, shape[1]))
    ]


def near_precision(mass: NDArray, state: NDArray, reach: int) -> float:
    """Average precision of P(occupied) where right and found mean: within `reach` cells."""
    p = (1 + mass[..., 1].astype(float) - mass[..., 0].astype(float)) / 2
    there = list(np.ndindex(*state.shape))
    known = [c for c in there if state[c] in (FREE, OCCUPIED)]
    occupied = [c for c in known if state[c] == OCCUPIED]
    if not occupied or len(occupied) == len(known):
        return math.nan
    close = {c for c in known if any(state[n] == OCCUPIED for n in around(*c, state.shape, reach))}
    best = {c: max(p[n] for n in around(*c, state.shape, reach) if state[n] != IGNORE) for c in occupied}
    total, before = 0.0, 0.0
    for threshold in sorted({*p[state != IGNORE].tolist()}, reverse=True):
        claimed = [c for c in known if p[c] >= threshold]
        precision = mean([c in close for c in claimed]) if claimed else 1.0
        recall = mean([best[c] >= threshold for c in occupied])
        total += (recall - before) * precision
        before = recall
    return total


def missed_obstacles(mass: NDArray, state: NDArray) -> float:
    """Walk over every group of touching occupied cells, and look at P(occupied) within one cell of it."""
    p = (1 + mass[..., 1].astype(float) - mass[..., 0].astype(float)) / 2
    left = {c for c in np.ndindex(*state.shape) if state[c] == OCCUPIED}
    missed = []
    while left:
        group, edge = set(), {left.pop()}
        while edge:
            cell = edge.pop()
            group.add(cell)
            neighbours = {n for n in around(*cell, state.shape, 1) if n in left}
            left -= neighbours
            edge |= neighbours
        seen = {n for c in group for n in around(*c, state.shape, 1) if state[n] != IGNORE}
        missed.append(not any(p[n] > 0.5 for n in seen))
    return mean(missed)
