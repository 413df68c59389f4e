"""Maps in an MCAP, decoded by the JavaScript of the viewers (Foxglove, Lichtblick)."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each

from ogm import EvidentialGrid, GridSpec
from ogm.io import GridLog, PlacedGrid
from ogm.io.messages import StampedTransform
from ogm.pose import pose

MODULES = Path(os.environ.get("NODE_PATH", Path(__file__).parents[3] / ".venv" / "viewers" / "node_modules"))
SPEC = GridSpec(0.3, (7, 5), (-1.2, 0.45))
L_SHAPE = ((1, 0), (2, 0), (3, 0), (3, 1))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("node") is None or not (MODULES / "@mcap" / "core").is_dir(),
        reason=f"node or the viewers' packages in {MODULES} are missing; ./run nightly installs them",
    ),
]


def decoded(path: Path) -> list[dict[str, Any]]:
    """Return topics and messages of an MCAP."""
    words = ["node", str(Path(__file__).with_name("viewers_decoder.cjs")), str(path)]
    done = subprocess.run(words, env=os.environ | {"NODE_PATH": str(MODULES)}, check=True, capture_output=True)
    return json.loads(done.stdout)


def l_shape() -> EvidentialGrid:
    """Return a grid with an L of occupied cells, unknown cells at x of index 6, and free ones elsewhere."""
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[:6, :, 0] = 0.8
    for cell in L_SHAPE:
        mass[cell] = 0.1, 0.7
    return EvidentialGrid(SPEC, mass)


@each("message", ["occupancy-grid", "grid-map"])
def test_viewers_see_the_map_where_it_is(tmp_path: Path, message: Any) -> None:
    grid, T = l_shape(), pose(2.0, -1.0, yaw=0.5)
    with GridLog(tmp_path / "m.mcap", message) as log:
        log.write(PlacedGrid(grid, pose(z=0.25), "odom", 12.5), [StampedTransform("odom", "vehicle", 12.5, T)])
    found = {one["topic"]: one["message"] for one in decoded(tmp_path / "m.mcap")}
    placed = found["/tf"]["transforms"][0]
    assert (placed["header"]["frame_id"], placed["child_frame_id"]) == ("odom", "vehicle")
    assert placed["transform"]["translation"]["x"] == pytest.approx(2.0)
    assert placed["transform"]["rotation"]["z"] == pytest.approx(np.sin(0.25))
    seen = found["/map"]
    header = seen["header"]
    assert header["frame_id"] == "odom"
    assert header["stamp"]["sec"] == 12
    if message == "occupancy-grid":
        info = seen["info"]
        assert (info["width"], info["height"]) == SPEC.shape
        assert info["resolution"] == pytest.approx(0.3)
        corner = info["origin"]["position"]
        assert [corner["x"], corner["y"], corner["z"]] == pytest.approx([-1.2, 0.45, 0.25])
        values = np.array(seen["data"]).reshape(5, 7)  # row by row along x, from the least y
        expected = np.full((5, 7), 10)  # [%] half of the unknown 0.2
        expected[:, 6] = -1
        for ix, iy in L_SHAPE:
            expected[iy, ix] = 80  # 0.7 and half of 0.2
        assert np.array_equal(values, expected)
    else:
        assert seen["layers"][:3] == ["free", "occupied", "unknown"]
        middle = seen["info"]["pose"]["position"]
        assert [middle["x"], middle["y"]] == pytest.approx([-1.2 + 7 * 0.15, 0.45 + 5 * 0.15])
        rows = seen["data"][1]["data"]
        occupied = np.array(rows).reshape(5, 7).T[::-1, ::-1]  # column by column, from the greatest x and y
        assert np.array_equal(occupied.astype(np.float32), grid.occupied)
