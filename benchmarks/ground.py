"""Which returns are ground, which are obstacles? ogm beside Patchwork++ and TRAVEL, on labelled scans.

    python benchmarks/ground.py [--repeats N] [--quick]

Needs recordings that cannot be shipped; benchmarks/README.md names them and where they go. Writes
benchmarks/results/ground.json and docs/pictures/ground.png.
"""

import _run as run  # first: it sets the number of threads
from _contenders import PATCHWORK, patchwork_estimator
from _labelled_scans import BOXED, LABELS, SPEC, LabelledScan, boxed_scans, range_images

# isort: split
import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _charts import OURS, PEER, SECOND_PEER, TWIN, caption, save_picture
from _timing import Contender, measure
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.geometric import RayISM, flat_ground, ground_height, local_ground

COARSE = GridSpec(1.0, (82, 57), SPEC.origin)  # [m] the cells that RayISM estimates the ground on
OBSTACLE_HEIGHT = RayISM.obstacle_height  # [m]
THRESHOLDS = np.arange(0.05, 0.401, 0.025)  # [m]
LOCAL, FLAT, TRAVEL = "local_ground", "flat_ground", "TRAVEL"
PEERS = {PATCHWORK: ("pypatchworkpp", "s", PEER), TRAVEL: ("travel_seg", "^", SECOND_PEER)}
Segmenter = Callable[[NDArray[np.float32]], NDArray[np.bool_]]
OVER_THRESHOLD, AT_RECALL = f"{LOCAL} over obstacle_height", f"{LOCAL} at the obstacle recall of {PATCHWORK}"

SEEN, UNSEEN = "seen while choosing", "not seen while choosing"
# Frame 0 of each set, while obstacle_height and the 1 m cells were chosen; frame 4, whose ghost returns showed
# that the lowest layer of returns is not always the ground.
CHOSEN_ON = {"SemanticKITTI": {0, 4}, "nuScenes": {0}}
NOTE = (
    "The frames of one set are consecutive and show one street each: treat a set as one scene, not as many.\n"
    f"'{SEEN}': the frames that were used while obstacle_height, the 1 m cells and the treatment of\n"
    "ghost returns were chosen."
)


def heights(estimate: Callable[..., NDArray[np.float32]], scan: LabelledScan) -> NDArray[np.float32]:
    """Return the height of a scan's points above the estimated ground [m]."""
    xyz = scan.points[:, :3]
    ground = estimate(xyz, COARSE, (0.0, 0.0, -scan.sensor_height))
    return xyz[:, 2] - ground_height(ground, COARSE, xyz)


def segmenter(peer: str, sensor_height: float) -> Segmenter:
    """Return a function of points that returns those a peer does not take for ground, with the peer's defaults."""
    if peer == PATCHWORK:
        estimator = patchwork_estimator(sensor_height)

        def obstacles(points: NDArray[np.float32]) -> NDArray[np.bool_]:
            estimator.estimateGround(points)
            obstacle = np.ones(len(points), bool)
            obstacle[np.asarray(estimator.getGroundIndices(), np.int64)] = False
            return obstacle

        return obstacles
    import travel_seg

    ground = travel_seg.TravelGroundSeg(travel_seg.GroundSegConfig())
    return lambda points: ~np.asarray(ground.estimate_ground(points)[0], bool)


def count(obstacle: NDArray[np.bool_], ground: NDArray[np.bool_], predicted: NDArray[np.bool_]) -> NDArray:
    """Count points: obstacles found, ground predicted obstacle, obstacles missed, ground predicted ground."""
    pairs = ((obstacle, predicted), (ground, predicted), (obstacle, ~predicted), (ground, ~predicted))
    return np.array([np.count_nonzero(label & prediction) for label, prediction in pairs])


def score(counts: NDArray[np.int64]) -> dict[str, float]:
    """Turn counts into precision and recall; where only obstacles are labelled (boxes), into their recall."""
    hit, false, missed, ground = map(int, counts)
    shares = {
        "obstacle precision": (hit, false),
        "obstacle recall": (hit, missed),
        "obstacle F1": (2 * hit, false + missed),
        "ground precision": (ground, missed),
        "ground recall": (ground, false),
        "ground F1": (2 * ground, false + missed),
    }
    found = {name: part / max(part + rest, 1) for name, (part, rest) in shares.items()}
    if not false + ground:
        return {"obstacle recall": found["obstacle recall"], "obstacle points": hit + missed}
    return found | {"obstacle points": hit + missed, "ground points": ground + false}


def evaluate(scans: list[LabelledScan], peers: Mapping[str, Any]) -> dict[str, Any]:
    """Score all methods on each scan, on all together, and over the threshold."""
    each: dict[str, dict[str, NDArray]] = {}
    high = [heights(local_ground, scan) for scan in scans]
    for scan, above in zip(scans, high, strict=True):
        predicted = {LOCAL: above > OBSTACLE_HEIGHT, FLAT: heights(flat_ground, scan) > OBSTACLE_HEIGHT}
        for peer in peers:  # a new one for each scan: none depends on another
            predicted[peer] = segmenter(peer, scan.sensor_height)(scan.points)
        each[scan.name] = {who: count(scan.obstacle, scan.ground, p) for who, p in predicted.items()}
    together = {who: score(sum(counts[who] for counts in each.values())) for who in predicted}
    obstacle, ground = (np.concatenate([getattr(s, kind) for s in scans]) for kind in ("obstacle", "ground"))
    above = np.concatenate(high)
    result = {
        "frames": [scan.name for scan in scans],
        "sensor height [m]": [round(scan.sensor_height, 3) for scan in scans],
        "together": together,
        "each": {name: {who: score(n) for who, n in counts.items()} for name, counts in each.items()},
        OVER_THRESHOLD: {f"{t:.3f} m": score(count(obstacle, ground, above > t)) for t in THRESHOLDS},
    }
    if "ground points" in together.get(PATCHWORK, {}):
        recall = together[PATCHWORK]["obstacle recall"]
        threshold = float(np.quantile(above[obstacle], 1 - recall))
        scores = score(count(obstacle, ground, above > threshold))
        result[AT_RECALL] = {"threshold [m]": threshold, **scores}
    return result


def timing(scans: list[LabelledScan], rounds: int, peers: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the median time per scan [ms]: ground and a prediction for every point."""
    runs: dict[str, Contender] = {}
    for scan in scans:
        runs[f"{LOCAL}, {scan.name}"] = Contender(lambda _, s=scan: heights(local_ground, s) > OBSTACLE_HEIGHT)
        for peer in peers:
            segment = segmenter(peer, scan.sensor_height)
            runs[f"{peer}, {scan.name}"] = Contender(lambda _, f=segment, s=scan: f(s.points))
    times = measure(runs, rounds)
    result: dict[str, dict[str, float]] = {}
    for who in (LOCAL, *peers):
        medians = [t.median for key, t in times.items() if key.startswith(who)]
        points = int(np.median([len(scan.points) for scan in scans]))
        result[who] = {"median [ms]": float(np.median(medians)), "slowest frame [ms]": max(medians), "points": points}
    return result


def picture(record: dict[str, Any], path: Path) -> None:
    """Draw precision over recall of obstacles for each set, and the recall on boxed objects."""
    sets = record["labelled"]
    figure = Figure(figsize=(5 * (len(sets) + 1), 5.6), layout="constrained")
    axes = figure.subplots(1, len(sets) + 1, squeeze=False)[0]
    for ax, (name, groups) in zip(axes, sets.items(), strict=False):
        for group, result in groups.items():
            _tradeoff(ax, result, group)
        frames = sum(len(result["frames"]) for result in groups.values())
        ax.set_title(f"{name}, {frames} consecutive frames", fontsize=11)
        ax.set(xlabel="recall of obstacle returns [%]", ylabel="precision of obstacle returns [%]")
        ax.grid(alpha=0.3)
        recall, precision = _place(groups[UNSEEN]["together"][FLAT])
        shown = f"{FLAT}: {precision:.0f} % at a recall of {recall:.0f} %, not shown"
        ax.legend(fontsize=8, loc="lower left", title=shown, title_fontsize=8)
        bottom, _ = ax.get_ylim()
        ax.set_ylim(bottom - 0.4 * (100 - bottom), 100.3)
    _boxes(axes[-1], record["boxes"])
    figure.suptitle("Obstacle or ground? Every labelled return within 81.92 x 56.32 m", fontsize=13)
    save_picture(figure, path, caption(record))


def _place(s: dict[str, float]) -> tuple[float, float]:
    return 100 * s["obstacle recall"], 100 * s["obstacle precision"]


def _tradeoff(ax: Axes, result: dict[str, Any], group: str) -> None:
    dark, curve = group == UNSEEN, result[OVER_THRESHOLD]
    places, style = zip(*map(_place, curve.values()), strict=True), "-" if dark else ":"
    ax.plot(*places, style, color=OURS, label=f"{LOCAL}, {group}", marker=".", markersize=4)
    for threshold in ("0.050 m", "0.200 m", "0.400 m") if dark else ():
        text, place = threshold.replace("0 m", " m"), _place(curve[threshold])
        ax.annotate(text, place, (4, 5), textcoords="offset points", fontsize=8, color=OURS)
    default = f"... at {OBSTACLE_HEIGHT:g} m, RayISM's default"
    signs = [(LOCAL, "o", OURS, default)]
    signs += [(peer, sign, colour, f"{peer}, {group}") for peer, (_, sign, colour) in PEERS.items()]
    for who, sign, colour, label in signs:
        if who in result["together"]:
            fill = colour if dark else "white"
            place = _place(result["together"][who])
            ax.plot(*place, sign, color=colour, mfc=fill, markersize=9, label=label)


def _boxes(ax: Axes, boxes: dict[str, Any]) -> None:
    colours = {LOCAL: OURS} | {peer: colour for peer, (_, _, colour) in PEERS.items()} | {FLAT: TWIN}
    for n, (who, colour) in enumerate(colours.items()):
        recalls = [100 * one["together"].get(who, {}).get("obstacle recall", 0) for one in boxes.values()]
        bars = ax.bar(np.arange(len(boxes)) + (n - 1.5) * 0.22, recalls, 0.2, color=colour, label=who)
        ax.bar_label(bars, fmt="%.1f", fontsize=8)
    names = [name.replace(", ", "\n").replace("24 consecutive", "24 consecutive\n") for name in boxes]
    ax.set_xticks(range(len(names)), names, fontsize=8)
    ax.set(ylim=(0, 118), yticks=range(0, 101, 20), ylabel="recall of obstacle returns [%]")
    ax.set_title("Returns on boxed objects (> 0.1 m up)", fontsize=11)
    ax.legend(fontsize=8, loc="upper right", ncols=3)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--repeats", type=int, default=5, help="rounds of the timing (default 5)")
    options = parser.parse_args()
    peers = {peer: package for peer, (package, *_) in PEERS.items() if importlib.util.find_spec(package)}
    for peer in PEERS.keys() - peers.keys():
        print(f"left out: {peer}: {PEERS[peer][0]} is not installed")
    record = run.environment("ray")
    record["obstacle_height [m]"] = OBSTACLE_HEIGHT
    record["labelled"], record["boxes"], record["time"] = {}, {}, {}
    for name, (folder, *_) in LABELS.items():
        scans = list(range_images(name))
        if not scans:
            print(f"left out: {name}: no labelled_range_images/{folder}/*.npy.xz under {run.DATA}")
            continue
        groups = {UNSEEN: [], SEEN: []}
        for k, scan in enumerate(scans):
            groups[SEEN if k in CHOSEN_ON[name] else UNSEEN].append(scan)
        record["labelled"][name] = {group: evaluate(some, peers) for group, some in groups.items()}
        record["time"][name] = timing(scans, 1 if options.quick else options.repeats, peers)
    for name, folder in BOXED.items():
        if scans := boxed_scans(name, 2 if options.quick else None):
            record["boxes"][name] = evaluate(scans, peers)
        else:
            print(f"left out: boxes of {name}: no {folder}/ under {run.DATA}")
    if not record["labelled"]:
        print("nothing to measure on: benchmarks/README.md names the recordings that are needed, and where")
        return
    record["note"] = NOTE
    run.write_record(options.out, record)
    picture(record, options.picture)


if __name__ == "__main__":
    main()
