"""Make the tables of the documentation from the records of the benchmarks.

    python docs/build.py            # fills the marked tables of the pages
    python docs/build.py --check    # writes nothing; exit code 1 if a page differs from its record

Both list the records that are outdated, with the commands that measure them again (`record_tables.outdated`).

A marked table stands between ``<!-- name -->`` and ``<!-- /name -->``. Every number comes from
``benchmarks/results/*.json``, which the command named beside the table writes.
"""

import argparse
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import deep_tables as deep
import geometric_tables as geometric
import map_tables as maps
import speed_tables as speed
from data_store_tables import data_store_tables
from dynamic_tables import dynamic_tables
from evidence_tables import evidence_tables
from quality_tables import quality_tables
from radar_tables import far_tables, fusion_tables, radar_tables
from record_tables import RESULTS, link, marked, outdated, record, table, verdicts, with_command
from reliability_tables import reliability_tables
from reproduction_sentences import sentences
from world_tables import build_tables, rule_tables, world_tables

ROOT = Path(__file__).resolve().parents[1]


# --- One table each -------------------------------------------------------------------------------------


def truth_modes() -> str:
    """Return the shares of cells that both truth modes of the simulator find."""
    modes = record("truth_modes")["against the reference"]
    rows = [[what.replace("called", "as"), *(f"{100 * modes[mode][what]:.1f} %" for mode in ("hd", "aimed"))]
            for what in modes["hd"] if not what.startswith("cells")]  # fmt: skip
    return table(["against 12,000 layers every 0.02 degrees", "`hd`", "`aimed`"], rows)


def simulation() -> str:
    """Return the cost of simulated samples."""
    cost = record("simulation")
    seconds, two, reading = cost["one sample"]["seconds, median"], cost["two workers"], cost["reading"]
    rates = [two[f"samples per second by {by}"] for by in ("one worker on one core", "two workers on two")]
    rows = [
        ["Open3D alone, the rays of a sample", f"{seconds['rays alone']:.2f} s"],
        ["a whole sample, `--truth hd`, written to disk", f"{seconds['hd']:.2f} s"],
        ["a whole sample, `--truth aimed`", f"{seconds['aimed']:.2f} s"],
        ["samples per second: one worker, two", "{:.2f}, {:.2f}".format(*rates)],
        ["bytes per sample", f"{two['bytes per sample']:,}"],
        [
            "read per second: one process, two",
            f"{reading['samples per second, 1 process']:.0f}, {reading['samples per second, 2 processes']:.0f}",
        ],
    ]
    return table(["", "measured"], rows)


def pythons() -> str:
    """Return the table of extras with wheels by version of Python."""
    found = record("pythons")
    names = list(found["without a wheel"])
    versions = list(found["without a wheel"][names[0]])
    rows = []
    for name in names:
        cells = []
        for version in versions:
            lacking = found["without a wheel"][name][version]
            texts = dict.fromkeys(", ".join(one) for one in lacking.values())
            by_system = [f"{', '.join(one)} ({system})" for system, one in lacking.items() if one]
            cells.append("yes" if not any(texts) else f"no: {next(iter(texts)) if len(texts) == 1 else by_system[0]}")
        rows.append([f"`{name}`" if name != "base" else "the base", *cells])
    note = f"*`{found['command']}`, {found['date'].split()[0]}, uv {found['uv']}; {link('pythons')}.*"
    return table(["", *versions], rows, left=1 + len(versions)) + "\n\n" + note


def coverage() -> str:
    """Return the least and greatest share of intervals that hold the truth, over shapes and likeness of frames."""
    cases = record("interval_coverage")["cases"]
    kinds = {  # of several drives, of one drive in parts, of frames
        "several": [one[kind] for one in cases for kind in ("mean", "ratio") if one["drives"] > 1],
        "parts": [one[kind] for one in cases for kind in ("mean", "ratio") if one["drives"] == 1],
        "frames": [one["mean, frames as independent"] for one in cases],
    }
    shares = {name: f"{100 * min(found):.0f} to {100 * max(found):.0f} %" for name, found in kinds.items()}
    drives = sorted({one["drives"] for one in cases} - {1})
    text = (
        f"95 % intervals over {drives[0]} to {drives[-1]} drives hold the truth of simulated metrics in "
        f"{shares['several']} of the cases, of one drive in {shares['parts']}; with frames counted as independent, in "
        f"{shares['frames']}."
    )
    return marked("interval_coverage", text)


def guarantee() -> str:
    """Return the coverage and the price of the bound of false free, by model and bound."""
    shift = "every fourth layer"
    rows = []
    for model, bounds in record("guarantee")["models"].items():
        for bound, found in bounds.items():
            shares = [found["within"], found["found free"], found["found free without"]]
            elsewhere = found["false free elsewhere"][shift]
            rows.append([
                f"`{model}`, {float(bound):.0%}", *(f"{100 * share:.0f} %" for share in shares),
                f"{100 * sum(elsewhere) / len(elsewhere):.1f} %",
                f"{sum(value <= float(bound) for value in elsewhere)} of {len(elsewhere)}",
            ])  # fmt: skip
    head = ["model, bound", "drives within", "free found", "without the bound", f"{shift}: false free", "within"]
    return table(head, rows)


def results() -> dict[str, str]:
    """Return the tables of the page of results."""
    scores = f"{deep.extent()}; {record('deep_quality')['intervals']}.", deep.deep_quality(), deep.deep_occupied()
    made = {
        "models": with_command("deep_quality", *scores),
        "objects": with_command("objects", deep.objects()),
        "maps": with_command("fusion_quality", maps.fusion()),
        "ground": with_command("ground", geometric.ground()),
        "logs": with_command("logs", maps.logs()),
        "live": with_command("live", verdicts("live", "`ogm serve`, a viewer receives all")),
        "truth": with_command("truth_modes", truth_modes()),
        "samples": with_command("simulation", simulation()),
    }
    return made | quality_tables(record("quality")) | reliability_tables()


def fill(page: str, made: Mapping[str, str]) -> str:
    """Put tables between their markers, indented as these.

    Raises
    ------
    ValueError
        If the page has no place for one of them.
    """
    for name, text in made.items():
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        place = re.compile(rf"^([ \t]*){re.escape(begin)}\n.*?^[ \t]*{re.escape(end)}", re.DOTALL | re.MULTILINE)
        found = place.search(page)
        if found is None:
            raise ValueError(f"the page has no place for {name}: {begin} and {end}, each on a line of its own")
        lines = "\n".join(found[1] + line for line in (begin, *text.splitlines(), end))
        page = page[: found.start()] + lines + page[found.end() :]
    return page


PAGES: dict[str, Callable[[], Mapping[str, str]]] = {
    "README.md": lambda: {"results": deep.headline()},
    "docs/lite.md": lambda: {"results": deep.headline()},
    "docs/deep.md": lambda: {
        "generations": deep.generations(),
        "levers": deep.levers(),
        "training": deep.deep_training(),
        "combined": deep.combined(),
    },
    "docs/dynamic.md": lambda: {"dynamic": with_command("dynamic", *dynamic_tables(record("dynamic")))},
    "docs/evidence.md": lambda: evidence_tables(record("evidence")),
    "docs/fusion.md": lambda: {"planar_odometry": with_command("planar_odometry", maps.planar_odometry())},
    "docs/geometric.md": lambda: {
        "calibration": geometric.calibration(),
        "silence": geometric.silence(),
        "steps": marked("scenes", geometric.steps()),
    },
    "docs/planners.md": lambda: {
        "heights": with_command("heights", maps.heights()),
        "planning": with_command("planning", maps.planning()),
    },
    "docs/project.md": lambda: {"pythons": pythons()},
    "docs/radar.md": lambda: {
        "radar": with_command("radar", *radar_tables(record("radar"))),
        "radar-far": with_command("radar_far", *far_tables(record("radar_far"))),
        "radar-fusion": with_command("radar_fusion", *fusion_tables(record("radar_fusion"))),
    },
    "docs/reproduction.md": lambda: (
        sentences(*map(record, ("quality", "deep_quality", "fusion_quality", "deep_speed", "objects")))
        | {"divergence": deep.divergences()}
    ),
    "docs/results.md": results,
    "docs/simulation.md": lambda: {"data_store": with_command("data_store", *data_store_tables(record("data_store")))},
    "docs/speed.md": lambda: {
        "scan": with_command("speed", speed.speed(record("speed")["comparisons"])),
        "update": with_command("fusion_speed", maps.fusion_speed_sentences(), maps.fusion_speed()),
        "network": with_command("deep_speed", deep.deep_speed()),
        "dynamic": with_command("dynamic_speed", verdicts("dynamic_speed", "one core, 512 x 352 cells")),
        "peers": with_command("peers", maps.peers()),
        "steps": speed.steps(),
        "growth": speed.growth(),
    },
    "docs/world.md": lambda: {
        "world": with_command("world", *world_tables(record("world"))),
        "rules": with_command("world_rules", *rule_tables(record("world_rules"))),
        "build": with_command("world_build", *build_tables(record("world_build"))),
    },
    "docs/evaluation.md": lambda: {
        "coverage": coverage(),
        "beams": with_command("beams", maps.beams()),
        "guarantee": with_command("guarantee", guarantee()),
    },
}


def main() -> int:
    """Write the pages, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    check = parser.parse_args().check
    made = {name: fill((ROOT / name).read_text(encoding="utf-8"), parts()) for name, parts in PAGES.items()}
    differing = []
    for name, text in made.items():
        path = ROOT / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            differing.append(name)
            if not check:
                path.write_text(text, encoding="utf-8")
    for place in sorted(RESULTS.glob("*.json")):
        if why := outdated(place.stem):
            found = record(place.stem)
            print(f"outdated: {place.stem}: {why} `{found.get('environment', found)['command']}`")
    print(f"{'differing' if check else 'written'}: {', '.join(differing) or 'none'}")
    return int(check and bool(differing))


if __name__ == "__main__":
    sys.exit(main())
