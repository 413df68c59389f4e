"""Reading the paper's own figures: what the command reads is what was put in."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks/results/paper_curves.json"
MISSED = -np.log(1e-7)  # of the released code, for a labelled cell without evidence
PLOTTED, DEMIXED = (f"KL, deep against geometric {kind}" for kind in ("as plotted", "de-mixed (2 g - d)"))
LABEL = "evidence of a label if it is "
TURNED = "turning a label of 512 x 352 cells leaves without a label"


class Curves(NamedTuple):
    """The plotted values in the order of the columns, (frames,) each; `*_geo` is the geometric model."""

    unknown: np.ndarray
    unknown_geo: np.ndarray
    free: np.ndarray
    free_geo: np.ndarray
    occupied: np.ndarray
    occupied_geo: np.ndarray
    kl: np.ndarray
    kl_geo: np.ndarray


COLUMNS = "t,m_unknown_deep,m_unknown_geo,m_free_deep,m_free_geo,m_occ_deep,m_occ_geo,kld_deep,kld_geo"


def figures(belief: float = 0.85, averaged: bool = True, noise: float = 0.0, frames: int = 100) -> Curves:
    """Make figures as the released code would of models that are known: evidence 1 per observed cell."""
    rng = np.random.default_rng(3)
    seen = rng.uniform(0.2, 0.3, frames)  # by the geometric model
    missed = rng.uniform(0.01, 0.15, frames)
    lost = rng.uniform(0.0, 0.5, frames) * missed  # by the deep model
    known = belief * (seen + missed - lost)
    known += noise * rng.normal(size=frames)
    kl, own = MISSED * lost, MISSED * missed
    return Curves(
        *(1 - known, 1 - seen / 3, 0.9 * known, 0.97 * seen / 3, 0.1 * known, 0.03 * seen / 3),
        *(kl, 0.5 * (kl + own) if averaged else own),
    )


def other_figures() -> Curves:
    """Make a smooth curve of the deep model, and one of the geometric model that is a Dirichlet divergence, E = 4."""
    curves = figures()
    missing = curves.unknown_geo - curves.unknown
    smooth = 0.6 + 0.2 * np.sin(np.linspace(0, 9, 100))
    return curves._replace(kl=smooth, kl_geo=missing * (4 + 2) / 4 * (4 - np.log(5)))


def write(path: Path, curves: Curves, header: str = COLUMNS) -> Path:
    rows = np.stack([np.arange(len(curves.kl)), *curves], axis=-1)
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.17g")
    return path


def run(*options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "benchmarks/paper_curves.py"), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def record_of(folder: Path, curves: Path) -> dict[str, Any]:
    """Return the record that the command writes."""
    out = folder / "new/found.json"
    done = run("--curves", curves, "--out", out, "--picture", folder / "found.png")
    assert done.returncode == 0, done.stderr
    return json.loads(out.read_text())


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("curves")
    record = record_of(folder, write(folder / "curves.csv", figures()))
    assert (folder / "found.png").read_bytes().startswith(b"\x89PNG")
    return record


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("curves")
    return record_of(folder, write(folder / "curves.csv", other_figures()))


@pytest.mark.slow
def test_the_record_names_command_commit_and_values(found: dict[str, Any]) -> None:
    words = "--curves curves.csv --out found.json --picture found.png"
    assert found["command"] == f"python benchmarks/paper_curves.py {words}"
    assert found["frames"] == 100
    assert "commit" in found
    for name, values in figures()._asdict().items():
        assert found["curves"][name]["mean"] == pytest.approx(values.mean(), rel=1e-12), name
        assert found["curves"][name]["frame of the most"] == values.argmax(), name


@pytest.mark.slow
def test_the_scale_of_made_up_figures_is_found(found: dict[str, Any]) -> None:
    scale = found[f"{LABEL}what the released code computes"]
    assert scale["E"]["value"] == pytest.approx(1, rel=1e-6)
    assert scale["belief c"]["value"] == pytest.approx(0.85, rel=1e-6)
    assert scale["R2"] == pytest.approx(1, abs=1e-9)
    assert scale["one parameter: c"] == pytest.approx(0.85, rel=0.25)  # what the deep model lost is not in it


@pytest.mark.slow
def test_the_interval_of_the_scale_holds_it_where_figures_are_noisy(tmp_path: Path) -> None:
    noisy = record_of(tmp_path, write(tmp_path / "curves.csv", figures(noise=0.003)))
    scale = noisy[f"{LABEL}what the released code computes"]
    assert scale["E"]["low"] < 1 < scale["E"]["high"]
    assert scale["belief c"]["low"] < 0.85 < scale["belief c"]["high"]
    assert 0.9 < scale["R2"] < 1


@pytest.mark.slow
def test_demixing_undoes_the_mean_of_both(found: dict[str, Any]) -> None:
    own = figures(averaged=False).kl_geo
    assert found["geometric de-mixed"] == pytest.approx({"mean": own.mean(), "least": own.min(), "most": own.max()})


@pytest.mark.slow
def test_lost_frames_are_those_in_which_the_second_is_lower(other: dict[str, Any]) -> None:
    curves, pair = other_figures(), other[PLOTTED]
    margins = (curves.kl - curves.kl_geo)[lost := np.flatnonzero(curves.kl_geo < curves.kl)]
    assert 0 < len(lost) < 100
    assert pair["frames in which the second is lower"] == lost.tolist()
    assert pair["margin in these"] == pytest.approx({"mean": margins.mean(), "most": margins.max()})
    assert (pair["wins"], pair["losses"]) == (100 - len(lost), len(lost))


@pytest.mark.slow
def test_a_figure_of_a_dirichlet_divergence_gives_its_scale(other: dict[str, Any]) -> None:
    assert other[f"{LABEL}a Dirichlet KL"] == pytest.approx({"E": 4, "R2": 1}, rel=1e-6)


@pytest.mark.slow
def test_what_turning_leaves_without_a_label_is_what_lies_outside(found: dict[str, Any]) -> None:
    turned = found[TURNED]
    assert turned["share of cells at 90 degrees"] == pytest.approx(1 - 56.32 / 81.92)
    ahead = 1 - 2 * np.arcsin(28.16 / 40) / np.pi
    assert turned["share of angles, 40 m straight ahead"] == pytest.approx(ahead, abs=0.01)
    assert 0.1 < turned["mean share of cells"] < 0.5


@pytest.mark.slow
def test_values_that_are_no_masses_or_have_other_names_are_refused(tmp_path: Path) -> None:
    curves, path = figures(), tmp_path / "curves.csv"
    for wrong in (curves.free + 0.01, np.full(100, np.nan)):
        assert "must sum to one" in run("--curves", write(path, curves._replace(free=wrong))).stderr
    named = run("--curves", write(path, curves, COLUMNS.replace("kld_geo", "kl")))
    assert "must have the columns t, m_unknown_deep" in named.stderr
    asked = run("--curves", tmp_path / "no.csv")
    assert "give the values behind the paper's figures with --curves" in asked.stdout


@pytest.mark.slow
def test_the_record_is_that_of_the_papers_values(real: Callable[[str], Path], tmp_path: Path) -> None:
    path = real("kitti_object").parents[1] / "paper_fig_curves.csv"
    if not path.is_file():
        pytest.skip(f"no {path}: the values behind the paper's figures are not ours to pass on")
    record, read = json.loads(RECORD.read_text()), record_of(tmp_path, path)
    for name, curve in read["curves"].items():
        assert record["curves"][name]["mean"] == pytest.approx(curve["mean"], rel=1e-12), name
    scales = [one[f"{LABEL}what the released code computes"]["E"]["value"] for one in (record, read)]
    assert scales[0] == pytest.approx(scales[1], rel=1e-9)
    for key in ("geometric de-mixed", "sha256 of the values"):
        assert record[key] == read[key] or record[key] == pytest.approx(read[key], rel=1e-12)


def test_the_record_holds_no_curve() -> None:
    """Facts may be passed on, the paper's values may not: nothing but the lost frames is as long as ten numbers."""

    def lists(value: object) -> list[list]:
        found = [value] if isinstance(value, list) else []
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        return found + [one for part in inner for one in lists(part)]

    longest = sorted(lists(json.loads(RECORD.read_text())), key=len)[-3:]
    lost = [0, 14, 26, 44, 48, 54, 61, 69, 75, 87, 91]
    assert longest[1:] == [lost, lost]
    assert len(longest[0]) < 11
