"""Tables of docs/evidence.md, from the record evidence.json."""

import math
from collections.abc import Mapping
from typing import Any

from record_tables import table

__all__ = ["evidence_tables", "of_other_library", "times_per_grid"]


def evidence_tables(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the tables of times, and of times in multiples of copies, by the names of their markers."""
    times, machine = times_per_grid(record), record["environment"]
    rules = [name.removeprefix("numpy ") for name in times if name.startswith("numpy") and name.count(" ") == 1]
    rows = []
    for name in rules:
        numba = times.get(f"numba {name} with discount")
        others = [
            (ms, key.split()[0]) for key, ms in times.items() if of_other_library(key) and key.endswith(f" {name}")
        ]
        fastest = "{:,.0f} ({})".format(*min(others)) if others else ""
        rows.append([f"`{name}`", f"{times[f'numpy {name}']:.1f}", f"{numba:.2f}" if numba else "", fastest])
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    note = f"{machine['cpu']}, one core, {machine['date'].split()[0]}; {versions}; `{machine['command']}`."
    copies = [times[name] for name in ("copy", "copy of half")]
    multiples = [
        [task.replace(" with discount", ""), f"{ms:.2f}", *(f"{ms / copy:.2f}" for copy in copies)]
        for task, ms in times.items()
        if "with discount" in task
    ]
    head = ["with the discount included", "time [ms]", "x copying the bytes", "x the same traffic"]
    text = "A copy of all bytes takes {:.2f} ms, one of half of them {:.2f} ms.".format(*copies)
    libraries = ["rule", "numpy [ms]", "numba [ms]", "fastest other library [ms]"]
    return {
        "times": "\n\n".join([table(libraries, rows, left=4), note]),
        "copies": "\n\n".join([text, table(head, multiples, left=4)]),
    }


def times_per_grid(record: Mapping[str, Any]) -> dict[str, float]:
    """Return the time of each task of the benchmark on the whole grid [ms]; other libraries are extrapolated."""
    scale = math.prod(record["grid"]["shape"]) / record["grid"]["cells of other libraries"]
    return {name: ms * scale if of_other_library(name) else ms for name, ms in record["milliseconds"].items()}


def of_other_library(task: str) -> bool:
    """Return whether another library was measured."""
    return task.split()[0] not in ("copy", "numba", "numpy", "powerset")
