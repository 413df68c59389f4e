"""The tutorials of the site are run, page by page, Python and commands in order, and so are their examples."""

import importlib.util
import lzma
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ogm import GridSpec
from ogm.geometric import RayISM

ROOT = Path(__file__).parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"
PAGES = [*sorted(set(TUTORIALS.glob("*.md")) - {TUTORIALS / "index.md"}), ROOT / "README.md"]
EVERY_RUN = {"README", "bag-to-nav2", "map-a-scan"}  # the others take minutes together
BLOCK = re.compile(r"^```(python|console)\n(.*?)^```", re.DOTALL | re.MULTILINE)
PRELUDE = """
def command(*words):
    import runpy, sys
    from ogm.cli import app
    if words[0] == "ogm":
        assert not app(list(words[1:]), standalone_mode=False), words
    else:
        sys.argv = list(words[1:])
        runpy.run_path(words[1], run_name="__main__")
"""


def program(text: str) -> str:
    """Return the blocks of a page as one program: Python as it is, commands of ogm and python as calls."""
    parts = [PRELUDE]
    for kind, block in BLOCK.findall(text):
        if kind == "python":
            parts.append(block)
            continue
        for line in re.findall(r"^\$ (.+)$", block.replace("\\\n", " "), re.MULTILINE):
            words = shlex.split(line, comments=True)
            if words[0] in ("ogm", "python") and words[1] != "serve":  # serve waits for viewers
                parts.append(f"command(*{words!r})\n")
    return "".join(parts)


@pytest.mark.parametrize(
    "page", [pytest.param(one, marks=[] if one.stem in EVERY_RUN else [pytest.mark.slow], id=one.stem) for one in PAGES]
)
def test_a_tutorial_runs(page: Path, tmp_path: Path) -> None:
    for example in (ROOT / "examples").glob("*.py"):
        shutil.copy(example, tmp_path)
    shutil.copy(ROOT / "ogm" / "data" / "vls128_road.pcd.xz", tmp_path / "scan.pcd.xz")
    code = program(page.read_text())
    if page.name == "README.md":  # its reader has a scan, a folder of scans with poses, and a log
        with lzma.open(tmp_path / "scan.pcd.xz") as packed:
            (tmp_path / "scan.pcd").write_bytes(packed.read())
        (tmp_path / "drive").mkdir()
        shutil.copy(tmp_path / "scan.pcd.xz", tmp_path / "drive")
        (tmp_path / "drive" / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
        code = BLOCK.findall((TUTORIALS / "bag-to-nav2.md").read_text())[1][1] + code
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    RESULTS.get(page.stem, lambda folder: None)(tmp_path)


def map_for_nav2(folder: Path) -> None:
    """By the rules of nav2's loader, in code that shares nothing with ogm."""
    file = importlib.util.spec_from_file_location("nav2_loader", ROOT / "tests" / "io" / "grids" / "nav2_loader.py")
    assert file is not None
    assert file.loader is not None
    loader = importlib.util.module_from_spec(file)
    file.loader.exec_module(loader)
    found = loader.load_map(folder / "map.yaml")
    assert [found.at(5.0, 4.0), found.at(-8.0, -8.0)] == [0, 0]
    assert found.at(-18.0, 0.0) == -1
    wall = [max(found.at(r * np.cos(a), r * np.sin(a)) for r in (14.9, 15.05, 15.2)) for a in np.linspace(0, 6, 50)]
    assert np.mean(np.array(wall) == 100) > 0.9


def world_map(folder: Path) -> None:
    """The GeoTIFF, read by rasterio: the wall stands once, 15 m around the origin."""
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(folder / "part.tif") as file:
        occupied = file.read(2)
        row, column = np.mgrid[: file.height, : file.width] + 0.5
    to_map = file.transform
    x, y = to_map.c + to_map.a * column, to_map.f + to_map.e * row
    distance = np.hypot(x, y)
    assert np.mean(np.abs(distance[occupied > 0.5] - 15) < 0.5) > 0.9
    assert (folder / "loop.png").stat().st_size > 10_000


def trained_network(folder: Path) -> None:
    """The exported network predicts something else than unknown, and the report compares it."""
    report = (folder / "report" / "report.html").read_text()
    assert "ray" in report
    assert "mine.onnx" in report
    rows = (folder / "runs" / "mine" / "log.csv").read_text().splitlines()
    loss = [float(row.split(",")[rows[0].split(",").index("loss")]) for row in rows[1:]]
    assert loss[-1] < loss[0]


RESULTS: dict[str, Callable[[Path], None]] = {
    "bag-to-nav2": map_for_nav2,
    "world-map": world_map,
    "train-on-own-sensor": trained_network,
}


def test_the_own_sensor_model_of_the_tutorial_marks_the_wall_of_the_yard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    from own_sensor_model import CountISM
    from yard import YARD, frames

    spec, scan = GridSpec.centered(length=40.0, width=40.0, resolution=0.5), next(frames(1)).scan
    own, ray = (model(scan) for model in (CountISM(spec), RayISM(spec)))
    x, y = spec.cell_centers
    distance = np.hypot(x, y)
    wall = np.abs(distance - YARD) < 0.2
    assert own.occupied[wall].mean() > 0.8
    assert own.mass[distance > YARD + 1].max() == 0
    inside = (distance > 3) & (distance < YARD - 1)
    assert own.free[inside].mean() < ray.free[inside].mean()  # nothing between its returns, as the page states
