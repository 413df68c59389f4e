"""Logs with random oddities: their map is that of the clean log, or they are refused or told about, never silent."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from random_logs import HARMLESS, TOLD, combination, made_scans, messages_of, odd_drive, write

from ogm.datasets import open_dataset
from ogm.fusion import EvidentialMapper, fuse
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import read_points
from ogm.pose import pose
from ogm.scan import Scan
from ogm.storage.files import OgmError

SPEC = GridSpec.centered(20, 16, 0.4)
MODEL = RayISM(SPEC)


def fused(path: Path) -> tuple[EvidentialGrid, int, list[str]]:
    """Return the map of the longest part of a log, its number of scans, and errors of scans."""
    dataset = open_dataset(path, sensor_height=1.8)
    if main := dataset.recording.main_sequence:
        dataset = dataset.select(dataset.sequences[main])
    mapper = EvidentialMapper(GridSpec(0.4, (80, 80), (-16, -16)), half_life=float("inf"), window="fixed")
    errors: list[str] = []
    for _ in fuse(dataset, MODEL, mapper, on_error=lambda frame, error: errors.append(str(error))):
        pass
    return mapper.grid, mapper.scans, errors


def check(folder: Path, scans: list, numbers: range, caplog: pytest.LogCaptureFixture) -> None:
    """Compare the maps of odd logs with that of the clean one."""
    expected, count, errors = fused(write(folder / "clean.mcap", messages_of(scans)))
    assert (count, errors) == (len(scans), [])
    assert expected.occupied.max() > 0.5
    refusals: list[str] = []
    for number in numbers:
        drive, names = odd_drive(scans, number)
        path, harmless = write(folder / "odd.mcap", drive), not set(names) & {one.__name__ for one in TOLD}
        caplog.clear()
        try:
            grid, mapped, errors = fused(path)
        except OgmError as error:
            refusals.append(f"{number}, {names}: {error}")
            assert not harmless, refusals[-1]  # noqa: PT017
            continue
        lines = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
        case = (number, names, mapped, errors, lines)
        if harmless:
            assert np.array_equal(grid.mass, expected.mass), case
            assert not errors, case
        elif not np.array_equal(grid.mass, expected.mass):
            assert errors or lines, case
        assert len(lines) <= 2 * len(names), case  # never one for each scan
    assert len(refusals) < len(numbers) / 4, refusals


def test_odd_logs_give_the_same_map_or_a_reason(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    check(tmp_path, made_scans(), range(20), caplog)


def test_every_oddity_is_tried() -> None:
    assert {one for number in range(200) for one in combination(number)} == {*HARMLESS, *TOLD}


@pytest.mark.slow
def test_odd_logs_of_real_scans(tmp_path: Path, real: Callable[[str], Path], caplog: pytest.LogCaptureFixture) -> None:
    files = sorted(real("kitti_odometry_00").rglob("*.bin*"))[:6]
    scans = []
    for k, file in enumerate(files):
        points = read_points(file)[::8]
        time = np.linspace(0, 0.1, len(points))
        scans.append((Scan(points, time=time, ring=np.arange(len(points)) % 64), pose(0.8 * k, z=1.8)))
    check(tmp_path, scans, range(200), caplog)
