"""Evaluation of maps without truth, by predicting the beams of held-out planar scans."""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.evaluation.statistics import Interval, ratio_interval
from ogm.evaluation.text import write_record
from ogm.evidence.map_rules import DYNAMIC, NUSS, SMOOTH
from ogm.fusion import BinaryBayesMapper, echo_window, make_mapper, map_scans
from ogm.fusion.pipeline import OnError, grid_pose, log_error
from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics.beams import BeamNoise, BeamScores, PlanarBeams, score_beams
from ogm.models.named import load_model, short_names
from ogm.pose import inverse, tilt_of
from ogm.scan import Frame, SensorModels

_SUMMED = ("log_likelihood", "ends_at", "passes_through", "ends_in_free", "no_echo_blocked")

MapMaker = Callable[[Sequence[Frame]], EvidentialGrid]

BINS = 10  # of the predicted probability, for the calibration
MAX_TILT = math.radians(5)  # tilt of the plane of the beams
BEAM_METRICS = {  # name: title, which is better, description
    "log_likelihood": ("log likelihood", "higher", "Log of the density of the range of an echo [nats, of 1/m]."),
    "ends_at": ("ends at occupied", "higher", "Share of echoes within 2 cells of the first occupied cell of the beam."),
    "passes_through": (
        "passes occupied", "lower", "Share of echoes more than 2 cells behind the first occupied cell of the beam.",
    ),
    "ends_in_free": ("ends in free", "lower", "Share of echoes in a cell that is free in the map."),
    "ece": (
        "ece of hits", "lower", "Mean distance, in 10 bins, between predicted and observed share of echoes within 2 "
        "cells of the likeliest end.",
    ),
    "no_echo_blocked": ("no echo, occupied", "lower", "Share of beams without echo that cross an occupied cell."),
}  # fmt: skip


@dataclass(frozen=True)
class FusedMap:
    """Maker of a map: fuses the scans of a drive by a sensor model and a rule, without forgetting.

    Maps of the Bayes filter have their probabilities as masses; only cells that were never observed are unknown.

    Parameters
    ----------
    ism : callable with `spec`, or mapping of str to these
        The sensor model.
    rule : str
        A rule for static maps, a name in `ogm.evidence.map_rules.MAP_RULES`.
    on_error : function
        Called with each skipped frame and its error; by default the error is logged.
    """

    ism: Any
    rule: str
    on_error: OnError = log_error

    def __post_init__(self) -> None:
        if self.rule in (DYNAMIC, NUSS):
            raise ValueError(f"rule must be of a static map, to predict beams, got {self.rule!r}")

    def __call__(self, frames: Sequence[Frame]) -> EvidentialGrid:
        """Return the map of frames with poses, covering all their grids."""
        ism: SensorModels = self.ism
        spec = next(iter(ism.values())).spec if isinstance(ism, Mapping) else ism.spec
        mapper = make_mapper(self.rule, echo_window(frames, spec), math.inf, "fixed")
        for frame, grid in map_scans(frames, ism, on_error=self.on_error):
            mapper.update(grid, grid_pose(frame))  # without stamps: no forgetting, no jumps of the pose
        if not isinstance(mapper, BinaryBayesMapper):
            return mapper.grid
        p = mapper.probability
        mass = np.where((p == 0.5)[..., None], np.float32(0), np.stack([1 - p, p], axis=-1))
        return EvidentialGrid.trusted(mapper.spec, mass)


@dataclass(frozen=True, eq=False)
class BeamEvaluation:
    """Evaluation of maps by the beams of held-out scans.

    Attributes
    ----------
    methods : tuple of str
    frames : tuple of str
        Names of the scans with predicted beams.
    drives : tuple of str
        Drive of each frame.
    echoes, no_echoes : (frames,) int64
        Numbers of beams with and without echo.
    sums : dict of str to dict of str to (frames,) float64
        Sums over the beams of each frame, by method and metric.
    bins : dict of str to (10, 3) float64
        For each bin of the predicted probability of a hit, by method: beams, sum of the probabilities, hits.
    split : str
        Description of the split.
    """

    methods: tuple[str, ...]
    frames: tuple[str, ...]
    drives: tuple[str, ...]
    echoes: NDArray[np.int64]
    no_echoes: NDArray[np.int64]
    sums: Mapping[str, Mapping[str, NDArray[np.float64]]]
    bins: Mapping[str, NDArray[np.float64]]
    split: str

    def interval(self, method: str, metric: str) -> Interval:
        """Return the mean over beams with its 95 % interval over drives or parts of a drive, see `ratio_interval`.

        Parameters
        ----------
        method : str
        metric : str
            A name in `BEAM_METRICS`; ``"ece"`` has no interval.
        """
        if metric == "ece":
            count, predicted, hits = self.bins[method].T
            return Interval(float(np.abs(predicted - hits).sum() / max(count.sum(), 1)), math.nan, math.nan)
        beams = self.no_echoes if metric == "no_echo_blocked" else self.echoes
        return ratio_interval(self.sums[method][metric], beams.astype(np.float64), self.drives)

    def record(self) -> dict[str, Any]:
        """Return all results as a dict, for `ogm.evaluation.text.as_json`."""
        return {
            "split": self.split,
            "scans": len(self.frames),
            "beams with echo": int(self.echoes.sum()),
            "beams without echo": int(self.no_echoes.sum()),
            "metrics": {
                name: {"title": title, "better": better, "text": text}
                for name, (title, better, text) in BEAM_METRICS.items()
            },
            "methods": {
                name: {
                    **{metric: self.interval(name, metric) for metric in BEAM_METRICS},
                    "bins (beams, predicted, hits)": self.bins[name],
                }
                for name in self.methods
            },
        }


def named_maps(models: Sequence[str], rules: Sequence[str], spec: GridSpec) -> dict[str, MapMaker]:
    """Return map makers for all pairs of models and rules, by name.

    Parameters
    ----------
    models : sequence of str
        See `ogm.models.load_model`; by default ``"planar"``.
    rules : sequence of str
        See `FusedMap`; by default ``"smooth"``.
    spec : GridSpec
        Cells of a measurement grid.
    """
    loaded = {short: load_model(name, spec) for short, name in short_names(models or ["planar"]).items()}
    return {f"{name}, {rule}": FusedMap(ism, rule) for name, ism in loaded.items() for rule in rules or [SMOOTH]}


def write_beam_report(folder: Path, result: BeamEvaluation, *, command: str = "") -> Path:
    """Write ``beams.json`` into a folder, which is created, and return its path.

    Parameters
    ----------
    folder : Path
    result : BeamEvaluation
    command : str
        Command of the evaluation, for the record.
    """
    return write_record(folder / "beams.json", result.record(), command)


def evaluate_beams(
    frames: Iterable[Frame],
    methods: Mapping[str, MapMaker],
    *,
    every: int = 5,
    range_noise: float = 0.03,
    p_random: float = 0.05,
    on_error: OnError = log_error,
    progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> BeamEvaluation:
    """Evaluate maps by predicting the beams of planar scans that are not in the maps.

    Cross-validation with `every` splits: split k holds out the scans k, k + `every`, k + 2 `every`, ... of a drive,
    makes the maps of the others, and predicts the beams of the held-out scans.

    The probability of occupied is ``occupied + base_rate * unknown``. The base rate describes a medium in which beams
    end as often as in the scans of the map: 1 - exp(-resolution * echoes / sum of their ranges), the maximum likelihood
    of one decay rate (Schaefer, Luft and Burgard, ICRA 2017).

    Parameters
    ----------
    frames : iterable of Frame
        Planar scans with poses; frames without pose are left out. Frames of one `Frame.sequence` are a drive, with
        its own maps.
    methods : dict of str to function
        Map makers by name, ``maker(frames) -> EvidentialGrid``, such as `FusedMap`.
    every : int
        Number of splits, 2 or more.
    range_noise, p_random : float
        See `ogm.metrics.beams.BeamNoise`.
    on_error : function
        Called with each unreadable frame, which is left out, and its error; by default the error is logged.
    progress : function
        Iterates over the numbers of the splits, and may draw a progress bar.

    Raises
    ------
    ValueError
        If a number is out of range, a scan is not planar or is tilted, or a drive has too few scans with poses.
    """
    if every < 2:
        raise ValueError(f"every must be 2 or more, as a map needs scans that are not held out, got {every}")
    if not (0 < range_noise < math.inf and 0 < p_random < 1):
        raise ValueError(f"range_noise must be above 0 m and p_random in (0, 1), got {range_noise} and {p_random}")
    drives: dict[str, list[Frame]] = {}
    for frame in frames:
        if frame.T_map_sensor is None:
            continue
        try:
            frame.scan  # noqa: B018  read here
        except (ValueError, TypeError, OSError) as error:
            on_error(frame, error)
            continue
        drives.setdefault(frame.sequence, []).append(frame)
    if not drives:
        raise ValueError("no scan has a pose, so that maps cannot be made: give a log with poses")
    for name, drive in drives.items():
        if len(drive) < every:
            raise ValueError(f"drive {name!r} needs {every} scans with poses or more, got {len(drive)}: leave it out")
    ordered = [frame for drive in drives.values() for frame in drive]
    beams = [planar_beams(frame) for frame in ordered]
    max_range = max(float(scan.distance.max(initial=0.0)) for scan in beams)
    if not max_range > 0:
        raise ValueError("the scans have no echoes to predict: give scans with points")
    noise = BeamNoise(max_range, range_noise, p_random)
    starts = np.cumsum([0, *map(len, drives.values())])
    sums = {name: {metric: np.zeros(len(ordered)) for metric in _SUMMED} for name in methods}
    bins = {name: np.zeros((BINS, 3)) for name in methods}
    for k in progress(range(every)):
        for first, last in itertools.pairwise(starts.tolist()):
            left_out = range(first + k, last, every)
            mapped = [n for n in range(first, last) if n not in left_out]
            decay = _decay_rate([beams[n] for n in mapped])
            owner = np.repeat(left_out, [len(beams[n].echo) for n in left_out])
            for name, make_map in methods.items():
                grid = make_map([ordered[n] for n in mapped])
                base_rate = -math.expm1(-decay * grid.spec.resolution)
                together = PlanarBeams(*map(np.concatenate, zip(*(beams[n] for n in left_out), strict=True)))
                scores = score_beams(grid, together, noise, base_rate)
                _add(scores, together.echo, owner, sums[name], bins[name])
    echoes = np.array([np.count_nonzero(scan.echo) for scan in beams])
    return BeamEvaluation(
        tuple(methods),
        tuple(frame.name for frame in ordered),
        tuple(frame.sequence for frame in ordered),
        echoes,
        np.array([len(scan.echo) for scan in beams]) - echoes,
        sums,
        bins,
        f"{every} splits: every {every}th scan of a drive held out, the map made of the others",
    )


def planar_beams(frame: Frame) -> PlanarBeams:
    """Return the beams of a planar scan in the plane of the map.

    Each point is the echo of a separate beam. Beams without echo are used if `Scan.max_range` is known.

    Raises
    ------
    ValueError
        If the scan is not of a planar laser, or its plane is tilted by more than 5 degrees.
    """
    scan, T = frame.scan, frame.T_map_sensor
    assert T is not None
    if scan.kind != "planar":
        kind = repr(scan.kind) if scan.kind else "a lidar or radar"
        raise ValueError(f"{frame.name} must be a scan of a planar laser, got {kind}: select the laser's `topic`")
    if tilt_of(T) > MAX_TILT:
        raise ValueError(
            f"the laser of {frame.name} must be tilted by 5 degrees at most, got {math.degrees(tilt_of(T)):.0f} degrees"
        )
    origin = T[:2, 3].astype(np.float64)
    if frame.mount.points_in == "vehicle":
        T = T @ inverse(frame.mount.T_vehicle_sensor)
    known = np.isfinite(scan.points[:, :3]).all(axis=1)
    ends = (scan.points[known, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3])[:, :2] - origin
    distance, echo = np.hypot(*ends.T), np.ones(len(ends), bool)
    if scan.no_returns is not None and scan.max_range is not None:
        silent = (scan.no_returns.astype(np.float64) @ T[:3, :3].T)[:, :2]
        silent = silent[np.isfinite(silent).all(axis=1)]
        ends = np.concatenate([ends, silent * scan.max_range])
        distance = np.concatenate([distance, np.full(len(silent), scan.max_range)])
        echo = np.concatenate([echo, np.zeros(len(silent), bool)])
    used = distance > 0
    ends, distance, echo = ends[used], distance[used], echo[used]
    direction = ends / np.hypot(*ends.T)[:, None]
    return PlanarBeams(np.tile(origin, (len(ends), 1)), direction, distance, echo)


def _decay_rate(beams: Sequence[PlanarBeams]) -> float:
    """Return the maximum likelihood rate at which beams end in a homogeneous medium [1/m]."""
    ranges = np.concatenate([scan.distance[scan.echo] for scan in beams])
    return len(ranges) / float(ranges.sum()) if len(ranges) else 1e-3


def _add(
    scores: BeamScores,
    echo: NDArray[np.bool_],
    owner: NDArray[np.int64],
    sums: Mapping[str, NDArray[np.float64]],
    bins: NDArray[np.float64],
) -> None:
    """Add the scores of beams to the sums of a method, in the column of each beam's frame `owner`."""
    columns = {
        "log_likelihood": np.where(echo, scores.log_likelihood, 0.0),
        "ends_at": scores.ends_at,
        "passes_through": scores.passes_through & echo,
        "ends_in_free": scores.ends_in_free,
        "no_echo_blocked": scores.passes_through & ~echo,
    }
    for name, column in columns.items():
        sums[name][:] += np.bincount(owner, column, len(sums[name]))
    at = np.minimum((scores.expected[echo] * BINS).astype(int), BINS - 1)
    for row, weight in zip(bins.T, (None, scores.expected[echo], scores.hit[echo]), strict=True):
        row += np.bincount(at, weight, BINS)
