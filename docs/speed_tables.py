"""Tables of docs/speed.md: time of a scan next to peers, steps of `RayISM`, and how cost grows."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from record_tables import record, table, with_command

GROWTH = "pictures/growth.png"  # beside the page


def speed(comparisons: Iterable[Mapping[str, Any]]) -> str:
    """Return the time per scan of ogm's models, of peers and of a copy, on the scan that ships with the package."""
    times = {one["size"]: one["times"] for one in comparisons if one["scan"].startswith("VLS-128")}
    last = {name: one["median [ms]"] for name, one in times["120k"].items()}
    octomap = min((name for name in last if name.startswith("OctoMap")), key=last.__getitem__, default="")
    names = {
        "copy of the bytes it must read and write": "copy of the bytes",
        "HeightBandISM": "**`HeightBandISM`**",
        "RayISM": "**`RayISM`**, with ground",
        "local_ground": "`local_ground` alone",
        "Patchwork++": "Patchwork++ (ground alone)",
        "KISS-SLAM mapper": "KISS-SLAM's native mapper (3D)",
        octomap: f"{octomap}, the fastest of five ways (3D)",
    }
    copy = last["copy of the bytes it must read and write"]
    rows = [
        [title, *(f"{times[size][name]['median [ms]']:.3g} ms" for size in times), f"{last[name] / copy:.3g}"]
        for name, title in names.items()
        if name in last
    ]
    return table(["shipped scan, VLS-128", "57,600 points", "120,000 points", "x copy"], rows)


def steps() -> str:
    """Return the time of each step of `RayISM`, and the gain of two threads."""
    found = record("speed")
    timed, threads = found["steps of RayISM"], found["two threads"]
    rows = [[name, f"{one['median [ms]']:.2g} ms"] for name, one in timed["times"].items()]
    gain = f"Two threads map {threads['ratio']:.2f} times as many scans per second as one, with the same result."
    return with_command("speed", table([f"step, {timed['scan']}, 120,000 points", "time"], rows), gain)


def growth() -> str:
    """Return the exponents of time and memory, and their picture once it is drawn."""
    rows = []
    for part in record("growth")["parts"].values():
        sizes, times, peaks = part["size"], part["time [ms]"], part["peak memory [MB]"]
        rows.append([
            part["title"], f"{sizes[0]:,} to {sizes[-1]:,} {part['unit']}", f"{times[0]:.3g} to {times[-1]:.3g} ms",
            f"{part['exponents']['time [ms]']:.2f}", f"{peaks[-1]:,.0f} MB",
            f"{part['exponents']['peak memory [MB]']:.2f}",
        ])  # fmt: skip
    heads = ["one core", "from, to", "time", "exponent", "peak memory at the end", "exponent"]
    drawn = (Path(__file__).parent / GROWTH).is_file()
    pictures = [f"![Time and memory over points, cells, scans and lidars, on logarithmic axes]({GROWTH})"]
    return with_command("growth", table(heads, rows, left=2), *(pictures if drawn else []))
