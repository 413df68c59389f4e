"""Which returns are ground, which are obstacles? ogm beside Patchwork++, on labelled scans.

    python benchmarks/ground.py [--repeats N] [--quick]

Needs recordings that cannot be shipped; benchmarks/README.md says which and where they go. Writes
benchmarks/results/ground.json and docs/pictures/ground.png.
"""

from _run import (
    DATA,
    OURS,
    PEER,
    PICTURES,
    RESULTS,
    TWIN,
    Contender,
    caption,
    environment,
    measure,
    silent,
    write_json,
)

# isort: split
import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec, read_points
from ogm.geometric import RayISM, flat_ground, ground_height, local_ground
from ogm.io import (
    NUSCENES_ELEVEN,
    SEMANTIC_KITTI_TRAINING,
    LabelledPoints,
    Objects,
    estimate_sensor_height,
    read_kitti_calibration,
    read_kitti_objects,
    read_kitti_tracks,
    read_mmdet3d,
    read_range_image,
)
from ogm.truth import boxes_over_points

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
COARSE = GridSpec(1.0, (82, 57), SPEC.origin)  # [m] the cells that RayISM estimates the ground on
OWN = (2.5, 1.1)  # [m] |x|, |y| of the own vehicle: returns in this box are dropped beforehand, as in RayISM
NEAREST = 2.7  # [m] Patchwork++ takes no nearer return for ground, so that none is counted for anybody
OBSTACLE_HEIGHT = RayISM.obstacle_height  # [m] the default: 0.1
KINDS = tuple(f"{kind} {what}" for kind in ("obstacle", "ground") for what in ("precision", "recall", "F1"))
THRESHOLDS = np.arange(0.05, 0.401, 0.025)  # [m]
ABOVE_BOTTOM = 0.1  # [m] what is higher above the bottom of an object's box is an obstacle
LOCAL, FLAT, PATCHWORK = "local_ground", "flat_ground", "Patchwork++"


@dataclass(frozen=True)
class Frame:
    """One scan, levelled and without the own vehicle, and what is known about its points."""

    name: str
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity [0, 1]
    ground: NDArray[np.bool_]  # (N,) labelled as ground
    obstacle: NDArray[np.bool_]  # (N,) labelled as anything else; what is neither is not counted
    sensor_height: float  # [m] estimated from the points without their labels

    @property
    def ground_point(self) -> tuple[float, float, float]:
        """The ground under the sensor."""
        return 0.0, 0.0, -self.sensor_height


def make_frame(
    name: str, points: NDArray[np.float32], ground: NDArray[np.bool_], obstacle: NDArray[np.bool_]
) -> Frame:
    """Drop the own vehicle, and do not count what is too near or outside the grid."""
    x, y = points[:, 0], points[:, 1]
    kept = (np.abs(x) > OWN[0]) | (np.abs(y) > OWN[1])
    counted = SPEC.contains(x, y) & (np.hypot(x, y) > NEAREST)
    height = estimate_sensor_height(points)
    if height is None:
        raise ValueError(f"{name} shows no ground around the sensor, so its height is not known")
    points = np.ascontiguousarray(points[kept], np.float32)
    return Frame(name, points, (ground & counted)[kept], (obstacle & counted)[kept], height)


# --- Recordings -------------------------------------------------------------------------------------


class Labels(NamedTuple):
    """How a set of labelled range images is to be read."""

    folder: str
    names: Mapping[int, str]
    axes: str
    intensity_max: float


LABELS = {
    "SemanticKITTI": Labels("semantic_kitti", SEMANTIC_KITTI_TRAINING, "kitti", 1.0),
    "nuScenes": Labels("nuscenes", NUSCENES_ELEVEN, "nuscenes", 255.0),
}
GROUND = ("road", "parking", "sidewalk", "other-ground", "terrain")
NOTHING = ("unlabeled", "none")


def range_images(labels: Labels) -> Iterator[tuple[str, LabelledPoints]]:
    """Read the labelled range images that are there, each with its name."""
    for path in sorted((DATA / "labelled_range_images" / labels.folder).glob("*.npy.xz")):
        found = read_range_image(path, labels.names, labels.axes, intensity_max=labels.intensity_max)
        yield path.name.split(".")[0], found


def labelled_frames(labels: Labels) -> list[Frame]:
    """Sort the classes of range images into ground and obstacles."""
    frames = []
    for name, image in range_images(labels):
        kind = image.named()
        ground = np.isin(kind, GROUND)
        frames.append(make_frame(name, image.points, ground, ~ground & ~np.isin(kind, NOTHING)))
    return frames


def boxed_frame(name: str, points: NDArray[np.float32], objects: Objects) -> Frame:
    """Make a frame of which only the points on objects are known: those in a box and clear of its bottom."""
    obstacle = np.zeros(len(points), bool)
    for box in objects.boxes:
        above = (points[:, 2] - box[5] > ABOVE_BOTTOM) & (points[:, 2] < box[6])
        obstacle |= boxes_over_points(points, box[None]) & above
    return make_frame(name, points, np.zeros_like(obstacle), obstacle)


def kitti_object() -> Iterator[tuple[str, NDArray[np.float32], Objects]]:
    """Read KITTI's single scans with their boxes."""
    folder = DATA / "kitti_object"
    for path in sorted(folder.glob("velodyne/*.bin")):
        calibration = read_kitti_calibration(folder / "calib" / f"{path.stem}.txt")
        labels = folder / "label_2" / f"{path.stem}.txt"
        yield path.stem, read_points(path), read_kitti_objects(labels, calibration)


def kitti_drive() -> Iterator[tuple[str, NDArray[np.float32], Objects]]:
    """Read KITTI's drive 0005 with its boxes."""
    folder = DATA / "kitti_raw_0005"
    labels = folder / "label_02_0000.txt"
    if labels.is_file():
        tracks = read_kitti_tracks(labels, read_kitti_calibration(folder / "calib_2011_09_26.txt"))
        for path in sorted(folder.glob("*.pcd.xz")):
            name = path.name.split(".")[0]
            yield name, read_points(path), tracks[int(name)]


def nuscenes_boxes() -> Iterator[tuple[str, NDArray[np.float32], Objects]]:
    """Read nuScenes' key frame with its boxes."""
    for path in sorted(DATA.glob("nuscenes_n015/*.json")):
        content = read_mmdet3d(path)
        yield "n015", read_points(content.frames[0].path, axes="nuscenes"), content.objects(0)


# --- Contenders: points in, height above ground or a verdict out ------------------------------------


def above(estimate: Callable[..., NDArray[np.float32]], frame: Frame) -> NDArray[np.float32]:
    """Return the height of a frame's points above the estimated ground [m]."""
    xyz = frame.points[:, :3]
    return xyz[:, 2] - ground_height(estimate(xyz, COARSE, frame.ground_point), COARSE, xyz)


def patchwork(height: float) -> Any:
    """Make a Patchwork++ estimator with its defaults and the sensor's height."""
    import pypatchworkpp

    parameters = pypatchworkpp.Parameters()
    parameters.verbose, parameters.sensor_height = False, height
    with silent():
        return pypatchworkpp.patchworkpp(parameters)


def patchwork_obstacles(frame: Frame) -> NDArray[np.bool_]:
    """Return what Patchwork++ does not take for ground. Each frame is its first: none depends on another."""
    estimator = patchwork(frame.sensor_height)
    estimator.estimateGround(frame.points)
    obstacle = np.ones(len(frame.points), bool)
    obstacle[np.asarray(estimator.getGroundIndices(), np.int64)] = False
    return obstacle


# --- Scores -----------------------------------------------------------------------------------------


def count(frame: Frame, said: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return how many points are: obstacle and said so, ground but said obstacle, obstacle missed, ground."""
    pairs = ((frame.obstacle, said), (frame.ground, said), (frame.obstacle, ~said), (frame.ground, ~said))
    return np.array([np.count_nonzero(label & verdict) for label, verdict in pairs])


def score(counts: NDArray[np.int64]) -> dict[str, float]:
    """Turn counts into precision and recall; where only obstacles are labelled (boxes), into their recall."""
    hit, false, missed, ground = (int(n) for n in counts)

    def share(part: int, rest: int) -> float:
        return part / (part + rest) if part + rest else 0.0

    if not false + ground:
        return {"obstacle recall": share(hit, missed), "obstacle points": hit + missed}
    return {
        "obstacle precision": share(hit, false),
        "obstacle recall": share(hit, missed),
        "obstacle F1": share(2 * hit, false + missed),
        "ground precision": share(ground, missed),
        "ground recall": share(ground, false),
        "ground F1": share(2 * ground, false + missed),
        "obstacle points": hit + missed,
        "ground points": ground + false,
    }


def run_evaluation(frames: list[Frame], with_patchwork: bool) -> dict[str, Any]:
    """Score all contenders on each frame, on all together, and over the threshold."""
    total: dict[str, NDArray] = {}
    single: dict[str, Any] = {}
    curve = np.zeros((len(THRESHOLDS), 4), np.int64)
    heights, labels = [], []
    for frame in frames:
        high = above(local_ground, frame)
        said = {LOCAL: high > OBSTACLE_HEIGHT, FLAT: above(flat_ground, frame) > OBSTACLE_HEIGHT}
        if with_patchwork:
            said[PATCHWORK] = patchwork_obstacles(frame)
        counts = {name: count(frame, verdict) for name, verdict in said.items()}
        single[frame.name] = {name: score(n) for name, n in counts.items()}
        total = {name: total.get(name, 0) + n for name, n in counts.items()}
        curve += [count(frame, high > threshold) for threshold in THRESHOLDS]
        known = frame.obstacle | frame.ground
        heights.append(high[known])
        labels.append(frame.obstacle[known])
    result = {
        "frames": [frame.name for frame in frames],
        "sensor height [m]": [round(frame.sensor_height, 3) for frame in frames],
        "together": {name: score(n) for name, n in total.items()},
        "each": single,
        f"{LOCAL} over obstacle_height": {
            f"{threshold:.3f} m": score(n) for threshold, n in zip(THRESHOLDS, curve, strict=True)
        },
    }
    if with_patchwork and "ground points" in result["together"][PATCHWORK]:
        wanted = result["together"][PATCHWORK]["obstacle recall"]
        result[f"{LOCAL} at the obstacle recall of {PATCHWORK}"] = _at_recall(
            np.concatenate(heights), np.concatenate(labels), wanted
        )
    return result


def _at_recall(high: NDArray[np.float32], obstacle: NDArray[np.bool_], recall: float) -> dict[str, float]:
    """Choose the threshold that gives a recall of obstacles, and score it."""
    threshold = float(np.quantile(high[obstacle], 1 - recall))
    said = high > threshold
    pairs = ((obstacle, said), (~obstacle, said), (obstacle, ~said), (~obstacle, ~said))
    return {
        "threshold [m]": threshold,
        **score(np.array([np.count_nonzero(label & verdict) for label, verdict in pairs])),
    }


def timing(frames: list[Frame], rounds: int, with_patchwork: bool) -> dict[str, dict[str, float]]:
    """Return the median time per frame [ms]: ground and verdict for every point."""
    runs: dict[str, Contender] = {}
    for frame in frames:
        runs[f"{LOCAL}, {frame.name}"] = Contender(
            lambda _, f=frame: above(local_ground, f) > OBSTACLE_HEIGHT
        )
        if with_patchwork:
            estimator = patchwork(frame.sensor_height)
            runs[f"{PATCHWORK}, {frame.name}"] = Contender(
                lambda _, e=estimator, f=frame: (e.estimateGround(f.points), e.getGroundIndices())
            )
    times = measure(runs, rounds)
    result: dict[str, dict[str, float]] = {}
    for name in (LOCAL, PATCHWORK):
        medians = [t.median for key, t in times.items() if key.startswith(name)]
        if medians:
            result[name] = {
                "median [ms]": float(np.median(medians)),
                "slowest frame [ms]": max(medians),
                "points": int(np.median([len(frame.points) for frame in frames])),
            }
    return result


# --- Report -----------------------------------------------------------------------------------------

SEEN, UNSEEN = "seen while choosing", "not seen while choosing"
# Frame 0 of each set, while obstacle_height and the 1 m cells were chosen; frame 4, whose mirror images showed
# that the lowest layer of returns is not always the ground.
LOOKED_AT = {"SemanticKITTI": {0, 4}, "nuScenes": {0}}
NOTE = (
    "The frames of one set are consecutive and show one street each: treat a set as one scene, not as many.\n"
    f"'{SEEN}': the frames that were looked at while obstacle_height = 0.1 m, the 1 m cells and the treatment of\n"
    "mirror images were chosen."
)


def report(record: dict[str, Any]) -> None:
    """Print the result."""
    for name, groups in record["labelled"].items():
        for group, result in groups.items():
            print(f"\n{name}, frames {group}: {len(result['frames'])}. Precision, recall, F1 [%]")
            print(f"  {'':16}{'obstacle':^24}{'ground':^24}")
            rows = dict(result["together"])
            key = f"{LOCAL} at the obstacle recall of {PATCHWORK}"
            if key in result:
                rows[f"  ... at {result[key]['threshold [m]']:.3f} m"] = result[key]
            for row, s in rows.items():
                print(f"  {row:16}" + "  ".join(f"{100 * s[kind]:6.2f}" for kind in KINDS))
    print("\nRecall of the returns on boxed objects")
    for name, result in record["boxes"].items():
        for row, s in result["together"].items():
            print(f"  {name:38} {row:14} {100 * s['obstacle recall']:6.2f} of {s['obstacle points']} points")
    print("\nTime per frame, ground and a verdict for every point")
    for name, times in record["time"].items():
        for row, t in times.items():
            print(
                f"  {name:14} {row:14} {t['median [ms]']:6.2f} ms, "
                f"slowest {t['slowest frame [ms]']:6.2f} ms, {t['points']} points"
            )
    print("\n" + NOTE)


def picture(record: dict[str, Any], path: Path) -> None:
    """Draw precision over recall of obstacles for each set, and the recall on boxed objects."""
    from matplotlib.figure import Figure

    sets = record["labelled"]
    figure = Figure(figsize=(5 * (len(sets) + 1), 5.6), layout="constrained")
    axes = figure.subplots(1, len(sets) + 1, squeeze=False)[0]
    for ax, (name, groups) in zip(axes, sets.items(), strict=False):
        for group, result in groups.items():
            _tradeoff(ax, result, group)
        frames = sum(len(result["frames"]) for result in groups.values())
        ax.set_title(f"{name}, {frames} consecutive frames", fontsize=11)
        ax.set_xlabel("recall of obstacle returns [%]")
        ax.set_ylabel("precision of obstacle returns [%]")
        ax.grid(alpha=0.3)
        flat = groups[UNSEEN]["together"][FLAT]
        shown = (
            f"{100 * flat['obstacle precision']:.0f} % at a recall of {100 * flat['obstacle recall']:.0f} %"
        )
        ax.legend(fontsize=8, loc="lower left", title=f"{FLAT}: {shown}, not shown", title_fontsize=8)
        bottom, _ = ax.get_ylim()
        ax.set_ylim(bottom - 0.4 * (100 - bottom), 100.3)
    _boxes(axes[-1], record["boxes"])
    figure.suptitle("Obstacle or ground? Every labelled return within 81.92 x 56.32 m", fontsize=13)
    figure.supxlabel(caption(record), fontsize=7.5, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _tradeoff(ax: Any, result: dict[str, Any], group: str) -> None:
    dark = group == UNSEEN
    place = lambda s: (100 * s["obstacle recall"], 100 * s["obstacle precision"])  # noqa: E731
    curve = result[f"{LOCAL} over obstacle_height"]
    style = "-" if dark else ":"
    ax.plot(
        *zip(*map(place, curve.values()), strict=True),
        style,
        color=OURS,
        label=f"{LOCAL}, {group}",
        marker=".",
        markersize=4,
    )
    if dark:
        for threshold in ("0.050 m", "0.200 m", "0.400 m"):
            ax.annotate(
                threshold.replace("0 m", " m"),
                place(curve[threshold]),
                (4, 5),
                textcoords="offset points",
                fontsize=8,
                color=OURS,
            )
    fill = OURS if dark else "white"
    label = f"... at {OBSTACLE_HEIGHT:g} m, RayISM's default"
    ax.plot(*place(result["together"][LOCAL]), "o", color=OURS, mfc=fill, markersize=9, label=label)
    if PATCHWORK in result["together"]:
        fill = PEER if dark else "white"
        ax.plot(
            *place(result["together"][PATCHWORK]),
            "s",
            color=PEER,
            mfc=fill,
            markersize=9,
            label=f"{PATCHWORK}, {group}",
        )


def _boxes(ax: Any, boxes: dict[str, Any]) -> None:
    colours = {LOCAL: OURS, PATCHWORK: PEER, FLAT: TWIN}
    names = list(boxes)
    for n, (who, colour) in enumerate(colours.items()):
        recalls = [100 * boxes[name]["together"].get(who, {}).get("obstacle recall", 0) for name in names]
        places = np.arange(len(names)) + (n - 1) * 0.27
        ax.bar(places, recalls, 0.25, color=colour, label=who)
        for x, recall in zip(places, recalls, strict=True):
            ax.text(x, recall + 1, f"{recall:.1f}", ha="center", fontsize=8)
    ax.set_ylim(0, 118)
    ax.set_yticks(range(0, 101, 20))
    ax.set_xticks(
        range(len(names)),
        [name.replace(", ", "\n").replace("24 consecutive", "24 consecutive\n") for name in names],
        fontsize=8,
    )
    ax.set_ylabel("recall of obstacle returns [%]")
    ax.set_title("Returns on boxed objects (> 0.1 m up)", fontsize=11)
    ax.legend(fontsize=8, loc="upper right", ncols=3)


# --- Command ----------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=5, help="rounds of the timing (default 5)")
    parser.add_argument("--quick", action="store_true", help="one round, and 2 of the boxed frames of a set")
    parser.add_argument("--out", type=Path, default=RESULTS / "ground.json", help="where the figures go")
    parser.add_argument(
        "--picture", type=Path, default=PICTURES / "ground.png", help="where the picture goes"
    )
    options = parser.parse_args()
    rounds = 1 if options.quick else options.repeats
    if rounds < 1:
        parser.error("--repeats must be at least 1")

    record = environment()
    try:
        import pypatchworkpp  # noqa: F401

        with_patchwork = True
    except ImportError as error:
        with_patchwork = False
        print(f"left out: {PATCHWORK}: {error}")
    record["obstacle_height [m]"] = OBSTACLE_HEIGHT
    record["labelled"], record["boxes"], record["time"] = {}, {}, {}
    for name, labels in LABELS.items():
        frames = labelled_frames(labels)
        if not frames:
            print(f"left out: {name}: no labelled_range_images/{labels.folder}/*.npy.xz under {DATA}")
            continue
        seen = [k in LOOKED_AT[name] for k in range(len(frames))]
        record["labelled"][name] = {
            group: run_evaluation(
                [frame for frame, s in zip(frames, seen, strict=True) if s is wanted], with_patchwork
            )
            for group, wanted in ((UNSEEN, False), (SEEN, True))
        }
        record["time"][name] = timing(frames, rounds, with_patchwork)
    for name, read in {
        "KITTI object, 3 scans": kitti_object,
        "KITTI drive, 24 consecutive scans": kitti_drive,
        "nuScenes, 1 scan": nuscenes_boxes,
    }.items():
        frames = [boxed_frame(*one) for one in read()]
        if not frames:
            print(f"left out: boxes of {name}: no such recording under {DATA}")
            continue
        record["boxes"][name] = run_evaluation(frames[:2] if options.quick else frames, with_patchwork)
    if not record["labelled"]:
        print("nothing to measure on: benchmarks/README.md says which recordings are needed, and where")
        return
    record["note"] = NOTE
    report(record)
    write_json(options.out, record)
    picture(record, options.picture)
    print(f"\nwrote {options.out} and {options.picture}")


if __name__ == "__main__":
    main()
