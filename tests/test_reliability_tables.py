"""Tables of docs/results.md on reliability: from small records, from records that are not there, and what must be 0."""

import json
import sys
from pathlib import Path

import pytest
from cases import each

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
import record_tables
import reliability_tables as tables

COUNTS = {"crashes": 0, "hangs": 0, "over limit": 0, "undocumented": 0}
FUZZ = {
    "inputs": 70,
    **COUNTS,
    "peak [MB]": 7.0,
    "targets": [{"target": f"reader {k}", "inputs": 10, **COUNTS, "peak [MB]": float(k)} for k in range(1, 8)],
}
ROW = {"SIGINT": 2, "SIGTERM": 2, "SIGKILL": 1, "survived": 5, "lost": 0, "left behind": 0, "slowest exit [s]": 0.5}
FAULTS = {
    "injected": 5,
    **{key: ROW[key] for key in ("survived", "lost", "left behind", "slowest exit [s]")},
    "commands": [{"command": "fuse", **ROW}],
    "full disk": {"places": 9, "failures": []},
    "command": "python tests/faults.py",
    "date": "2026-11-23",
}
SCANS = {
    "scans": 10_000,
    "memory grown [%]": 0.5,
    "memory [MB]": [90.0, 100.0, 101.0, 102.0],
    "processor time": {"last / first": 1.25},
    "files left": 0,
    "threads left": 0,
    "verdicts": [{"what": "RayISM: p99", "got": 1.25, "wanted": 1.2, "unit": "x", "met": False}],
}
SOAK = {
    "environment": {"command": "python benchmarks/soak.py", "date": "2026-11-23 10:00 UTC"},
    "parts": {"ray": SCANS},
}


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(record_tables, "RESULTS", tmp_path)
    return tmp_path


def test_what_was_not_run_is_stated(results: Path) -> None:
    assert tables.reliability_tables() == dict.fromkeys(("inputs", "faults", "soak"), "not run")
    assert tables.failed() == []


def test_records_become_tables_whose_last_row_is_of_all(results: Path) -> None:
    for name, record in {"fuzz": FUZZ, "faults": FAULTS, "soak": SOAK}.items():
        (results / f"{name}.json").write_text(json.dumps(record))
    made = tables.reliability_tables()
    assert "| **all 7 readers** | 70 | 0 | 0 | 0 | 0 | 7 |" in made["inputs"]
    assert "| 2 other readers | 20 | 0 | 0 | 0 | 0 | 2 |" in made["inputs"]
    assert "| **all** | 2 | 2 | 1 | 5 | 0 | 0 | 0.5 |" in made["faults"]
    assert "9 places, 0 failures" in made["faults"]
    assert "`python tests/faults.py`, 2026-11-23" in made["faults"]
    assert "| `RayISM` | 10,000 scans | 0.5 % | 1.0 % | 1.25 | 0 | 0 |" in made["soak"]
    assert "| `DeepISM` lite | not run |" in made["soak"]
    assert "**Missed**: RayISM: p99: 1.25 x (wanted 1.2)" in made["soak"]
    assert tables.failed() == ["RayISM: p99: 1.25 x"]


@each("name, change, found", [
        ("fuzz", {"crashes": 1}, "crashes: 1"),
        ("fuzz", {"undocumented": 2}, "undocumented: 2"),
        ("faults", {"survived": 3}, "not survived: 2"),
        ("faults", {"lost": 1}, "lost: 1"),
        ("faults", {"left behind": 1}, "left behind: 1"),
        ("faults", {"full disk": {"failures": ["a.npz is cut"]}}, "full disk: a.npz is cut"),
    ])  # fmt: skip
def test_what_must_be_0_and_is_not_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, change: dict, found: str
) -> None:
    monkeypatch.setattr(record_tables, "RESULTS", tmp_path)
    record = {"fuzz": FUZZ, "faults": FAULTS}[name] | change
    (tmp_path / f"{name}.json").write_text(json.dumps(record))
    assert tables.failed() == [found]
