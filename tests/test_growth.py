"""Cost as work grows: executed lines and allocated bytes, which are the same on every machine."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

LINEAR = 1.1  # highest exponent
COUNTS = Path(__file__).parent / "operation_counts.py"


def exponent(sizes: list[int], counts: list[int]) -> float:
    """Return b of ``a + c * size**b`` at three sizes with one ratio between them; at two sizes with a = 0."""
    low, high = [b - a for a, b in zip(counts, counts[1:], strict=False)] if len(sizes) == 3 else counts
    return math.log(high / low) / math.log(sizes[-1] / sizes[-2])


def test_cost_grows_with_points_cells_and_sensors_in_proportion_and_not_with_the_scans_of_a_map() -> None:
    done = subprocess.run(
        [sys.executable, COUNTS], env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, stdout=subprocess.PIPE, check=True
    )
    lines, memory = {}, {}
    for name, rows in json.loads(done.stdout).items():
        sizes, *counts = map(list, zip(*rows, strict=True))
        if name == "scans":
            assert [len(set(column)) for column in counts] == [1, 1], counts
        else:
            lines[name], memory[name] = (exponent(sizes, column) for column in counts)
    assert max(lines.values()) <= LINEAR, lines
    assert max(memory.values()) <= LINEAR, memory
    assert min(lines[name] for name in ("points", "cells", "cells, map", "sensors")) > 0.5, lines
