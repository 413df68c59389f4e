"""Tables of docs/world.md, from the records world.json, world_build.json and world_rules.json."""

from collections.abc import Mapping
from typing import Any

from record_tables import change, table

__all__ = ["build_tables", "rule_tables", "world_tables"]


def world_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the tables of times, of bytes on disk, and of the long drive."""
    scans, disk, drive, window = (record[name] for name in ("integrate", "disk", "drive", "window"))
    titles = {
        "WorldMap, uint16": "**`WorldMap.integrate`**, uint16",
        "WorldMap, float32": "`WorldMap.integrate`, float32",
        "EvidentialMapper, 624 x 624": "`EvidentialMapper.update`, window 624 x 624, as `ogm fuse` has it",
        "EvidentialMapper, 512 x 352": "`EvidentialMapper.update`, window 512 x 352, without corners of turned scans",
    }
    times = []
    for name, title in titles.items():
        median, low, high = scans["ms"][name]
        ratio = f"x {scans['ratio'][name]:.2f}" if name in scans["ratio"] else ""
        times.append([title, f"{median:.2f} ms", f"{low:.2f}–{high:.2f}", ratio])
    median, low, high = window["ms"]
    name = "reading a window of 512 x 352 cells from a folder"
    times.append([name, f"{median:.1f} ms", f"{low:.1f}–{high:.1f}", ""])
    rates = ", ".join(f"{rule} {rate:.0f}" for rule, rate in record["merge"].items())
    sizes = [[name, f"{size:.2f}"] for name, size in disk["bytes_per_seen_cell"].items()]
    resident = drive["resident_mb"]
    built, drive_of = (
        record["build"],
        f"A drive of {drive['kilometres']:g} km, a scan per metre, {drive['scans']:,} scans",
    )
    facts = [
        f"Merging tiles in memory: {rates} million cells a second. The town: {built['drives']} drives, "
        f"{built['frames']} frames, {disk['seen_cells']:,} seen cells in {disk['tiles']} tiles.",
        f"{drive_of} into {drive['tiles']} tiles, 200 MB of them in memory: {drive['ms_mean']:.1f} ms per scan "
        f"in the mean, with reading and writing ({drive['hz_mean']:.0f} scans/s), 99 % below {drive['ms_99']:.0f} ms. "
        f"The process has {resident[0]} MB after the first kilometre, {resident[-1]} MB after the last, "
        f"{max(resident)} MB at most.",
    ]
    head = ["a scan of 512 x 352 cells", "median", "quartiles", "`WorldMap` takes"]
    return [table(head, times), table(["on disk, per seen cell", "bytes"], sizes), *facts]


def rule_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the table of the rules, on the towns that the default was not chosen on, and what was counted."""
    titles = {
        "iou_occupied": "IoU occupied",
        "iou_free": "IoU free",
        "ghosts": "ghosts",
        "false_free": "false free",
        "loss_both": "log loss",
        "left_occupied": "left: occupied",
        "left_free": "left: free",
        "next_false_free": "next drive: false free",
    }
    rows = [
        [f"**{name}**" if name == record["chosen"] else name, *(f"{one[key]:.3f}" for key in titles)]
        for name, one in record["report"]["rules"].items()
    ]
    better = record["report"]["rules"][record["chosen"]]["difference"]
    found = ", ".join(f"{title} {change(better[key])}" for key, title in titles.items())
    report, fit = record["report"], record["fit"]
    cells = report["cells"]
    return [
        table(["rule", *titles.values()], rows),
        f"{report['drives']} drives through {report['towns']} towns, {report['frames']:,} scans; "
        f"{cells['free']:,} free and {cells['occupied']:,} occupied cells, {cells['left']:,} that parked cars left. "
        f"The default was chosen on {fit['drives']} drives through another town. Its differences to `cautious`, "
        f"in pairs of {report['tiles']} tiles, 95 % intervals: {found}.",
    ]


def build_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the figures of builds by several workers, and of the large map."""
    result = []
    if "town" in record:
        town = record["town"]
        equal = "the same to the last bit" if all(town["the same"].values()) else "NOT the same"
        result.append(
            f"{town['drives']} drives, {town['frames']:,} scans, {town['seen_cells']:,} seen cells: by two workers, by "
            f"a Dask scheduler with two workers, and by those into S3 (moto on loopback): {equal} in all layers, tiles "
            f"and {town['levels']} levels."
        )
    if "workers" in record:
        one = record["workers"]
        result.append(
            f"{one['drives']} drives, {one['frames']:,} scans: {one['seconds']['1']:.0f} s by one worker, "
            f"{one['seconds']['2']:.0f} s by two, x {one['gain']:.2f} (1.7 wanted)."
        )
    big = record["cells"]
    resident = big["resident_mb"]
    result.append(
        f"{big['cells']:.3g} cells in {big['tiles']:,} tiles, synthetic (a square of the simulated town, mirrored, all "
        f"of it seen, once into each tile), 200 MB of tiles in memory: {big['seconds']:.0f} s, "
        f"and {big['overviews_seconds']:.0f} s for {big['levels'] - 1} levels of overviews; "
        f"{big['gigabytes']:.2f} GB in {big['objects']:,} files, {big['bytes_per_cell']:.2f} bytes per cell. The "
        f"process has {resident[0]} MB after a twentieth and {max(resident[:-1])} MB at most until all is in."
    )
    return result
