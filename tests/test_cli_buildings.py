"""``ogm fuse`` and ``ogm evaluate --beams`` on the log of a planar laser."""

import json
from pathlib import Path

import numpy as np
import pytest
from cases import each
from commands import completed, refused_command
from hall import WALLS, drive, noisy, write_log

from ogm.io.grids.files import read_grid


def test_the_map_of_a_building_covers_it_in_fine_cells_and_forgets_nothing(tmp_path: Path) -> None:
    poses = noisy(drive(24), np.random.default_rng(0))
    log = write_log(tmp_path / "hall.log", poses)
    result = completed("fuse", log, "--match", "--out", tmp_path / "hall.yaml")
    assert "24 of 24 scans, 23 refined by scan matching" in result.output
    assert "24 mapped, 0 skipped" in result.output
    grid = read_grid(tmp_path / "hall.yaml")
    assert grid.spec.resolution == pytest.approx(0.05)
    x, y, (x0, x1, y0, y1) = *WALLS.reshape(-1, 2).T, grid.spec.extent
    assert (abs(x0 - x.min()) < 1.5) & (abs(x1 - x.max()) < 1.5) & (abs(y0 - y.min()) < 1.5) & (abs(y1 - y.max()) < 1.5)


def test_maps_are_evaluated_by_beams_that_were_left_out(tmp_path: Path) -> None:
    log = write_log(tmp_path / "hall.log", drive(20))
    result = completed("evaluate", log, "--beams", "--fused", "revise,bayes", "--out", tmp_path / "report")
    record = json.loads((tmp_path / "report" / "beams.json").read_text())
    assert (record["scans"], record["beams with echo"]) == (20, 20 * 181)
    revise = record["methods"]["planar, revise"]
    assert revise["ends_at"]["value"] > 0.9
    assert revise["log_likelihood"]["value"] > record["methods"]["planar, bayes"]["log_likelihood"]["value"]
    assert "planar, bayes" in result.output
    assert "20 scans" in result.output


@each(
    "words, message",
    [
        (("evaluate", "{log}", "--beams", "--grids", "{log}"), "--beams needs no truth and evaluates maps of models"),
        (("evaluate", "{log}", "--beams", "--fused", "dynamic"), "must be of a static map"),
        (("evaluate", "{log}", "--resolution", "0.1"), "--resolution needs --beams"),
        (("fuse", "{log}", "--match", "--odometry", "kiss-icp"), "--match and --odometry exclude each other"),
    ],
)
def test_options_that_exclude_each_other_are_refused(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    log = write_log(tmp_path / "hall.log", drive(6))
    refused_command(message, *(word.format(log=log) for word in words))
