"""Tables of docs/results.md on reliability, from the records fuzz.json, faults.json and soak.json.

    python docs/reliability_tables.py    # prints them; exit code 1 if a number that must be 0 is not

A record that is not there gives "not run".
"""

import sys
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from record_tables import find_record, link, mark, table

__all__ = ["reliability_tables"]

MISSING = "not run"
FAILURES = ("crashes", "hangs", "over limit", "undocumented")  # of inputs; each must be 0
SHOWN = 5  # readers with the largest peaks, which have a row of their own
BUSY = 0.5  # load beyond which other programs disturb the figures
LONG = {
    "ray": "`RayISM`",
    "evidential": "`RayISM`, `EvidentialMapper`",
    "dynamic": "`RayISM`, `DynamicMapper`, matching, objects",
    "network": "`DeepISM` lite",
    "serve": "`ogm serve`, a viewer that comes and goes",
}


def reliability_tables() -> dict[str, str]:
    """Return the tables of inputs, of faults and of long runs."""
    return {"inputs": _of("fuzz", _inputs), "faults": _of("faults", _faults), "soak": _of("soak", _soak)}


def failed() -> list[str]:
    """Return the counts that must be 0 and are not, and the missed limits."""
    wrong: list[str] = []
    if fuzz := find_record("fuzz"):
        wrong += [f"{name}: {fuzz[name]}" for name in FAILURES if fuzz[name]]
    if faults := find_record("faults"):
        lost = faults["injected"] - faults["survived"]
        wrong += [f"{name}: {n}" for name, n in (("not survived", lost), ("lost", faults["lost"])) if n]
        wrong += [f"left behind: {faults['left behind']}"] if faults["left behind"] else []
        wrong += [f"full disk: {one}" for one in faults["full disk"].get("failures", ())]
    for part in (find_record("soak") or {"parts": {}})["parts"].values():
        wrong += [f"{row['what']}: {row['got']:.4g} {row['unit']}" for row in part["verdicts"] if not row["met"]]
    return wrong


def _of(name: str, parts: Any) -> str:
    record = find_record(name)
    if record is None:
        return MISSING
    return "\n\n".join([*parts(record), _source(record, name)])


def _source(record: Mapping[str, Any], name: str) -> str:
    """Return command, date and machine, as far as the record has them."""
    found = record.get("environment", record)
    cores = f"{found['cores']} cores" if "cores" in found else None
    words = [found.get("date", "").split(" ")[0], found.get("cpu"), cores]
    words = [f"`{found['command']}`" if "command" in found else None, *words]
    return f"*{', '.join(filter(None, words))}; {link(name)}.*{mark(name)}"


def _inputs(record: Mapping[str, Any]) -> list[str]:
    targets = sorted(record["targets"], key=lambda one: -one["peak [MB]"])
    rest = targets[SHOWN:]
    sums = {name: sum(one[name] for one in rest) for name in ("inputs", *FAILURES)}
    peak = max((one["peak [MB]"] for one in rest), default=0)
    rows = [(f"`{one['target']}`", one) for one in targets[:SHOWN]]
    rows += [(f"{len(rest)} other readers", sums | {"peak [MB]": peak})] if rest else []
    rows += [(f"**all {len(targets)} readers**", record)]
    cells = [
        [name, f"{one['inputs']:,}", *(one[key] for key in FAILURES), f"{one['peak [MB]']:.0f}"] for name, one in rows
    ]
    head = ["", "inputs", "crashes", "hangs", "over a limit", "undocumented errors", "peak [MB]"]
    return [table(head, cells)]


def _faults(record: Mapping[str, Any]) -> list[str]:
    signals = ("SIGINT", "SIGTERM", "SIGKILL")
    keys = (*signals, "survived", "lost", "left behind", "slowest exit [s]")
    rows = [[f"`{one['command']}`", *(one[key] for key in keys)] for one in record["commands"]]
    sums = [sum(one[key] for one in record["commands"]) for key in signals]
    rows += [["**all**", *sums, *(record[key] for key in keys[3:])]]
    parts = [table(["ended by", *keys[:3], "survived", "finished work lost", "files left behind", keys[-1]], rows)]
    disk = record["full disk"]
    if disk:
        facts = [f"{value} {name}" for name, value in disk.items() if isinstance(value, int)]
        parts.append(f"Full disk: {', '.join([*facts, str(len(disk.get('failures', ()))) + ' failures'])}.")
    return parts


def _soak(record: Mapping[str, Any]) -> list[str]:
    found = record["parts"]
    rows = []
    for name, title in LONG.items():
        if name not in found:
            rows.append([title, MISSING, "", "", "", "", ""])
            continue
        one = found[name]
        if name == "serve":
            memory = [held for _, held in one["memory [s, MB]"]]
            mapped, dropped = (f"{one['result'][key]:,.0f} {key}" for key in ("mapped", "dropped"))
            length = f"{one['minutes']:g} minutes, {mapped}, {dropped}"
            ratio = one["processor time, last tenth / first"]
        else:
            memory = one["memory [MB]"]
            length, ratio = f"{one['scans']:,} scans", one["processor time"]["last / first"]
        cells = [f"{one['memory grown [%]']:.1f} %", f"{_second_half(memory):.1f} %", f"{ratio:.2f}"]
        rows.append([title, length, *cells, one["files left"], one["threads left"]])
    head = ["", "length", "memory grown", "in the second half", "time, last / first", "files left", "threads left"]
    parts = [table(head, rows)]
    if "points" in found:
        one = found["points"]
        models = [f"`{name}` {model['refused'] or _huge(model)}" for name, model in one["models"].items()]
        parts.append(
            f"One scan of {one['points']:,} points ({one['bytes of the scan [MB]']:.0f} MB): {'; '.join(models)}."
        )
    if "streams" in found:
        ratios = [one["two threads / one"] for one in found["streams"]["chains"].values()]
        parts.append(
            f"Two threads with a stream each map {min(ratios):.2f} to {max(ratios):.2f} times the scans of one."
        )
    loads = [one["load at start"][0] for one in found.values() if one.get("load at start")]
    if max(loads, default=0) > BUSY:
        parts.append(f"The machine was busy: load at the start {min(loads):.1f} to {max(loads):.1f}.")
    missed = [row for one in found.values() for row in one["verdicts"] if not row["met"]]
    if missed:
        texts = [
            f"{row['what']}: {row['got']:.3g} {row['unit']}".strip() + f" (wanted {row['wanted']:g})" for row in missed
        ]
        parts.append(f"**Missed**: {'; '.join(texts)}.")
    return parts


def _second_half(memory: Sequence[float]) -> float:
    """Return by how much memory grew from the tenth of the run after its middle to its last [%]."""
    tenth = max(len(memory) // 10, 1)
    middle, last = memory[len(memory) // 2 :][:tenth], memory[-tenth:]
    return 100 * (median(last) / median(middle) - 1)


def _huge(model: Mapping[str, Any]) -> str:
    seconds, peak = model["processor time [s]"], model["peak above that [MB]"]
    return f"{seconds:.1f} s of processor time, {peak:.0f} MB more"


if __name__ == "__main__":
    for title, text in reliability_tables().items():
        print(f"{title}\n\n{text}\n")
    wrong = failed()
    print("\n".join(f"MISSED {one}" for one in wrong) or "nothing missed")
    sys.exit(bool(wrong))
