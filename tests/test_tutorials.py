"""The tutorials of the site are run, page by page, and so are their examples."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ogm import GridSpec
from ogm.geometric import RayISM

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_tutorial_runs(page: Path, tmp_path: Path) -> None:
    code = "\n".join(re.findall(r"```python\n(.*?)```", page.read_text(), re.S))
    shutil.copy(ROOT / "examples" / "yard.py", tmp_path)
    shutil.copy(ROOT / "ogm" / "data" / "vls128_road.pcd.xz", tmp_path / "scan.pcd.xz")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_own_sensor_model_of_the_tutorial_marks_the_wall_of_the_yard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    from own_sensor_model import CountISM
    from yard import MOUNT, YARD, frames

    spec, scan = GridSpec.centered(length=40.0, width=40.0, resolution=0.5), next(frames(1)).scan
    own, ray = (model(scan) for model in (CountISM(spec, MOUNT), RayISM(spec, MOUNT)))
    x, y = spec.cell_centers
    distance = np.hypot(x, y)
    wall = np.abs(distance - YARD) < 0.2
    assert own.occupied[wall].mean() > 0.8
    assert own.mass[distance > YARD + 1].max() == 0
    inside = (distance > 3) & (distance < YARD - 1)
    assert own.free[inside].mean() < ray.free[inside].mean()  # nothing between its returns, as the page states
