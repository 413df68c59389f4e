"""Tables of docs/radar.md, from the records radar.json, radar_fusion.json and radar_far.json."""

from collections.abc import Mapping, Sequence
from typing import Any

from record_tables import once, table

__all__ = ["far_tables", "fusion_tables", "radar_tables"]

METRICS = {
    "nll": "log loss", "brier": "Brier", "iou_free": "IoU free", "false_free": "false free",
    "iou_occupied": "IoU occupied", "ece": "ECE", "auroc_unknown": "AUROC unknown",
}  # fmt: skip
FUSED = {
    "motion_ap": "AP of moving cells", "motion_iou": "IoU of moving", "static_moving": "static predicted moving",
    "nll": "log loss", "iou_free": "IoU free", "iou_occupied": "IoU occupied", "false_free": "false free",
}  # fmt: skip
STATIC_FUSED = ("nll", "iou_free", "iou_occupied", "false_free")
PAIRED = ("nll", "brier", "iou_free", "false_free")
MEAN = "mean ± half a 95 % interval over drives"
ALIKE = "RadarISM, static"  # without what moves: nearly the same scores


def radar_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the tables of scores, of pairs, of detections, and of the recorded frame."""
    scores, pairs, counts = [], [], []
    for name, found in record["radars"].items():
        for model, one in found["scores"].items():
            if model != ALIKE:
                scores.append([name, model, *(f"{one[key]:.3f}" for key in METRICS)])
        compared = found["RadarISM minus another, mean over drives, 95 %"]
        pairs.append([name, *(_difference(compared[key]["rays (RayISM)"]) for key in PAIRED)])
        one = found["detections"]
        least, middle, most = one["per sweep, least, median, most"]
        low, _, high = one["compensated Doppler of static things, 5, 50, 95 %"]
        shares = (f"{100 * share:.0f} %" for share in one["share of each"].values())
        ends = f"{low:+.2f} to {high:+.2f}", f"{one['seconds per sweep']:.3f}"
        counts.append([name, f"{least}, {middle:.0f}, {most}", *shares, *ends])
    head = ["radar", "detections (least, median, most)", "objects", "ground", "ghosts", "clutter"]
    tables = [
        f"Frames: {record['frames']}, drives: {record['drives']}.\n\n"
        + table(["radar", "model", *METRICS.values()], once(scores), left=2),
        table([f"`RadarISM` minus rays, {MEAN}", *(METRICS[key] for key in PAIRED)], pairs),
        table([*head, "static Doppler, 5 to 95 % [m/s]", "time of a sweep [s]"], counts),
    ]
    if times := record.get("ms per sweep, 512 x 352 cells"):
        each = ", ".join(f"{name} {time:.1f} ms" for name, time in times.items())
        tables.append(f"Time of one sweep of 300 detections on 512 x 352 cells, median, one core: {each}.")
    if "ARS548, recorded" in record:
        for key, edges in _edges(record["ARS548, recorded"]).items():
            names = ("ARS548, recorded", "ARS548, simulated")
            tables.append(
                table([key.split()[0], *edges], [[name, *(f"{n:.0f}" for n in record[name][key])] for name in names])
            )
    return tables


def fusion_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the tables of lidar with radar against lidar alone: means over drives, and differences."""
    means = [[name, *(f"{one[key]:.3f}" for key in FUSED)] for name, one in record["mean"].items()]
    less = [[name, *(_difference(one[key]) for key in FUSED)] for name, one in record["minus lidar"].items()]
    times = []
    for name, found in record["drives"].items():
        pairs = [pair for one in found for pair in zip(one["seconds to detect"], one["approaching"], strict=True)]
        groups = [seconds for seconds, _ in pairs], [seconds for seconds, approaching in pairs if approaching]
        times.append([name, *map(_times, groups)])
    head = f"Drives: {len(record['drives']['lidar'])}, reliability of radar beside lidar: "
    return [
        f"{head}{record['reliability of radar']:g}.",
        table(["", *FUSED.values()], means),
        table([f"minus lidar alone, {MEAN}", *FUSED.values()], less),
        table(["in sight, detected, median time to detect [s]", "all that move", "approaching vehicles"], times),
    ]


def far_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the tables of maps below and beyond 60 m, in clear air and in fog, with and without radar."""
    drives, titles, rows = record["drives"], [FUSED[key] for key in STATIC_FUSED], []
    bands = list(next(iter(drives[0].values())))
    for name in drives[0]:
        scores = {band: [drive[name][band] for drive in drives] for band in bands}
        means = [
            [f"{sum(one[key] for one in scores[band]) / len(drives):.3f}" for band in bands] for key in STATIC_FUSED
        ]
        traffic = [[str(sum(one["traffic"][k] for one in scores[band])) for band in bands] for k in (0, 1)]
        rows.append([name, *map(" / ".join, means + traffic)])
    changes = record["radar minus none"].items()
    less = [[name, *(_difference(one[key]) for key in STATIC_FUSED)] for name, one in changes]
    head = f"Drives: {len(drives)}, visibility in fog: {record['visibility in fog [m]']:g} m, "
    return [
        f"{head}reliability of radar: {record['reliability of radar']:g}.",
        table([" / ".join(bands), *titles, "moving participants in sight", "shown"], rows),
        table([f"with radar minus without, {MEAN}", *titles], less),
    ]


def _times(seconds: Sequence[float | None]) -> str:
    """Return the numbers of objects and of detected ones, and the median time; None for never."""
    each = sorted(float("inf") if value is None else value for value in seconds)
    if not each:
        return "0, 0, –"
    middle = (each[(len(each) - 1) // 2] + each[len(each) // 2]) / 2
    detected = sum(value < float("inf") for value in each)
    return f"{len(each)}, {detected}, {f'{middle:.2f}' if middle < float('inf') else 'never'}"


def _edges(found: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the bins of the histograms by their keys, which list the edges: "range 0, 20, 40 m"."""
    result = {}
    for key in found:
        if key != "detections":
            *numbers, unit = key.partition(" ")[2].replace(",", "").split()
            result[key] = [f"{a} to {b} {unit}" for a, b in zip(numbers, numbers[1:], strict=False)]
    return result


def _difference(found: Sequence[float]) -> str:
    """Return a difference and half of its interval, which is symmetric."""
    mean, low, high = found
    return f"{mean:+.3f} ±\xa0{(high - low) / 2:.3f}"
