"""Tables of docs/world.md, from the record world.json."""

from collections.abc import Mapping
from typing import Any

__all__ = ["world_tables"]


def world_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the tables of times, of bytes on disk, and of the long drive."""
    scans, disk, drive, window = (record[name] for name in ("integrate", "disk", "drive", "window"))
    titles = {
        "WorldMap, uint16": "**`WorldMap.integrate`**, uint16",
        "WorldMap, float32": "`WorldMap.integrate`, float32",
        "EvidentialMapper, 624 x 624": "`EvidentialMapper.update`, window 624 x 624, as `ogm fuse` has it",
        "EvidentialMapper, 512 x 352": "`EvidentialMapper.update`, window 512 x 352, without corners of turned scans",
    }
    times = [_row("a scan of 512 x 352 cells", "median", "quartiles", "`WorldMap` takes"), "|---|---:|---:|---:|"]
    for name, title in titles.items():
        median, low, high = scans["ms"][name]
        ratio = f"x {scans['ratio'][name]:.2f}" if name in scans["ratio"] else ""
        times.append(_row(title, f"{median:.2f} ms", f"{low:.2f} to {high:.2f}", ratio))
    median, low, high = window["ms"]
    times.append(
        _row("reading a window of 512 x 352 cells from a folder", f"{median:.1f} ms", f"{low:.1f} to {high:.1f}", "")
    )
    rates = ", ".join(f"{rule} {rate:.0f}" for rule, rate in record["merge"].items())
    sizes = [_row("on disk, per seen cell", "bytes"), "|---|---:|"]
    sizes += [_row(name, f"{value:.2f}") for name, value in disk["bytes_per_seen_cell"].items()]
    resident = drive["resident_mb"]
    built, drive_of = (
        record["build"],
        f"A drive of {drive['kilometres']:g} km, a scan per metre, {drive['scans']:,} scans",
    )
    facts = [
        f"Merging tiles in memory: {rates} million cells a second. The town: {built['drives']} drives, "
        f"{built['frames']} frames, {disk['seen_cells']:,} seen cells in {disk['tiles']} tiles.",
        f"{drive_of} into {drive['tiles']} tiles with 200 MB of tiles in memory: {drive['ms_mean']:.1f} ms per scan "
        f"in the mean, with reading and writing ({drive['hz_mean']:.0f} scans/s), 99 % below {drive['ms_99']:.0f} ms. "
        f"The process has {resident[0]} MB after the first kilometre and {resident[-1]} MB after the last one, "
        f"{max(resident)} MB at most in between.",
    ]
    return ["\n".join(times), "\n".join(sizes), *facts]


def _row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
