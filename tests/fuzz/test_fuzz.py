"""Fuzzing of every reader, in small: `run.py` has the long runs."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
PACKAGES = ("laspy", "lazrs", "lzf", "pyarrow", "rosbags", "mcap", "foxglove", "rasterio", "netCDF4", "xarray", "zarr",
            "torch", "h5py", "onnxruntime", "velodyne_decoder")  # fmt: skip


def run(folder: Path, *options: str) -> tuple[int, str, dict[str, Any]]:
    """Run the command; return its exit code, what it printed, and the rows of its record by target."""
    for package in PACKAGES:
        pytest.importorskip(package)
    command = [sys.executable, str(HERE / "run.py"), "--keep", str(folder / "kept"), "--json", str(folder / "a.json")]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
    assert (folder / "a.json").exists(), done.stderr
    record = json.loads((folder / "a.json").read_text())
    return done.returncode, done.stdout, {row["target"]: row for row in record["targets"]} | {"all": record}


@pytest.mark.slow
def test_a_small_run_finds_nothing(tmp_path: Path) -> None:
    code, text, rows = run(tmp_path, "--inputs", "12")
    assert code == 0, text
    assert all(row["inputs"] == 12 for name, row in rows.items() if name != "all")
    assert rows["all"]["accepted"] + rows["all"]["refused"] == rows["all"]["inputs"] == 12 * (len(rows) - 1)


@pytest.mark.slow
def test_what_was_found_once_is_refused_or_read(tmp_path: Path) -> None:
    code, text, rows = run(tmp_path, "--again", str(HERE / "found"))
    assert code == 0, text
    assert rows["all"]["inputs"] == sum(1 for _ in (HERE / "found").iterdir())


@pytest.mark.slow
def test_the_run_notices_every_kind_of_failure_and_goes_on(tmp_path: Path) -> None:
    code, text, rows = run(tmp_path, "--targets-of", "bad_targets", "--inputs", "12")
    assert code == 1
    kinds = {"crash": "crashes", "leaves": "crashes", "hang": "hangs", "memory": "over limit", "huge": "over limit",
             "undocumented": "undocumented"}  # fmt: skip
    for name, kind in kinds.items():
        row = rows[name]
        assert row[kind] >= 1, text
        assert row["accepted"] >= 1, text
        assert row["refused"] >= 1, text
        assert row["accepted"] + row["refused"] + row[kind] == row["inputs"] == 12, text
        (failure,) = row["failures"].values()
        assert (tmp_path / "kept" / f"{name}.0.{failure['first']}" / "a").is_file()
    assert rows["memory"]["peak [MB]"] >= 256
    assert rows["good"]["accepted"] + rows["good"]["refused"] == 12
    assert "undocumented: KeyError in bad_targets.py" in text


@pytest.mark.slow
def test_an_input_is_made_again_by_its_name(tmp_path: Path) -> None:
    _, _, rows = run(tmp_path, "--targets-of", "bad_targets", "--inputs", "12", "--target", "undocumented")
    (failure,) = rows["undocumented"]["failures"].values()
    name = f"undocumented.0.{failure['first']}"
    for one in (name, str(tmp_path / "kept" / name)):
        command = [sys.executable, str(HERE / "run.py"), "--targets-of", "bad_targets", "--one", one]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "KeyError: 'undocumented'" in done.stderr
