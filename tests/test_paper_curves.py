"""Reading the paper's own figures: what is read is what was put in."""

import json
import subprocess
import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest

from ogm import GridSpec

ROOT = Path(__file__).parents[1]
SPEC = spec_from_file_location("paper_facts", ROOT / "benchmarks/_paper_facts.py")
facts = module_from_spec(SPEC)
SPEC.loader.exec_module(facts)
RECORD = ROOT / "benchmarks/results/paper_curves.json"


def figures(belief: float = 0.85, averaged: bool = True, noise: float = 0.0, frames: int = 100) -> facts.Curves:
    """Make figures as the released code would of models that are known: evidence 1 per observed cell."""
    rng = np.random.default_rng(3)
    seen = rng.uniform(0.2, 0.3, frames)  # by the geometric model
    missed = rng.uniform(0.01, 0.15, frames)
    lost = rng.uniform(0.0, 0.5, frames) * missed  # by the deep model
    known = belief * (seen + missed - lost)
    known += noise * rng.normal(size=frames)
    kl, own = facts.MISSED * lost, facts.MISSED * missed
    return facts.Curves(
        *(1 - known, 1 - seen / 3, 0.9 * known, 0.97 * seen / 3, 0.1 * known, 0.03 * seen / 3),
        *(kl, 0.5 * (kl + own) if averaged else own),
    )


def write(path: Path, curves: facts.Curves) -> Path:
    rows = np.stack([np.arange(len(curves.kl)), *curves], axis=-1)
    np.savetxt(path, rows, delimiter=",", header=",".join(facts.COLUMNS), comments="", fmt="%.17g")
    return path


def test_the_scale_of_made_up_figures_is_found() -> None:
    found = facts.scale_as_released(figures(belief=0.85), np.random.default_rng(0))
    assert found["E"]["value"] == pytest.approx(1, rel=1e-6)
    assert found["belief c"]["value"] == pytest.approx(0.85, rel=1e-6)
    assert found["R2"] == pytest.approx(1, abs=1e-9)
    assert found["one parameter: c"] == pytest.approx(0.85, rel=0.25)  # what the deep model lost is not in it


def test_the_interval_of_the_scale_holds_it_where_figures_are_noisy() -> None:
    found = facts.scale_as_released(figures(noise=0.003), np.random.default_rng(0))
    assert found["E"]["low"] < 1 < found["E"]["high"]
    assert found["belief c"]["low"] < 0.85 < found["belief c"]["high"]
    assert 0.9 < found["R2"] < 1


def test_without_the_averaging_half_the_belief_would_be_found() -> None:
    curves = figures(belief=0.85, averaged=False)
    found = facts.scale_as_released(curves, np.random.default_rng(0))
    assert found["belief c"]["value"] == pytest.approx(0.85 / 2, rel=1e-6)
    assert found["belief c without the averaging"] == pytest.approx(0.85, rel=1e-6)


def test_demixing_undoes_the_mean_of_both() -> None:
    np.testing.assert_allclose(facts.demixed(figures()), figures(averaged=False).kl_geo, rtol=1e-12)


def test_demixing_turns_no_win_into_a_loss_and_doubles_the_difference() -> None:
    curves = figures()
    plotted, own = facts.versus(curves.kl, curves.kl_geo), facts.versus(curves.kl, facts.demixed(curves))
    assert (plotted["wins"], plotted["losses"]) == (own["wins"], own["losses"])
    assert own["difference"]["value"] == pytest.approx(2 * plotted["difference"]["value"])


def test_lost_frames_are_those_in_which_the_second_is_lower() -> None:
    first, second = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 1.5, 4.0, 3.0])
    found = facts.versus(first, second)
    assert found["frames in which the second is lower"] == [1, 3]
    assert found["margin in these"] == {"mean": 0.75, "most": 1.0}
    assert (found["wins"], found["losses"]) == (2, 2)


def test_a_figure_of_a_dirichlet_divergence_gives_its_scale() -> None:
    curves = figures()
    missing = curves.unknown_geo - curves.unknown
    kl_geo = missing * (4 + 2) / 4 * (4 - np.log(5))
    assert facts.scale_as_named(curves._replace(kl_geo=kl_geo)) == pytest.approx({"E": 4, "R2": 1}, rel=1e-6)


def test_no_cell_of_evidence_up_to_one_has_a_divergence_above_one() -> None:
    assert facts.bound(21) == pytest.approx(1, abs=1e-12)


def test_a_drive_in_order_differs_from_a_shuffled_one() -> None:
    smooth = np.sin(np.linspace(0, 9, 100))
    shuffled = np.random.default_rng(1).permutation(smooth)
    curves = figures()._replace(kl=smooth, kl_geo=shuffled)
    found = facts.order(curves, np.random.default_rng(0))
    assert found["kl"]["lag-1 correlation"] > 0.9
    assert found["kl"]["p"] < 0.001
    assert found["kl_geo"]["p"] > 0.05


def test_masses_of_a_third_are_counted_as_cells() -> None:
    curves = figures()
    found = facts.observed(curves)
    assert found["cells observed"] == pytest.approx(found["cells free"] + found["cells occupied"])
    assert found["mean unknown if it had mass 1"] == pytest.approx(1 - found["cells observed"])
    masses = facts.shares(curves)
    assert masses["occupied of what is known, deep"] == pytest.approx(0.1)
    assert masses["occupied of what is known, geometric"] == pytest.approx(0.03)


def test_what_turning_leaves_without_a_label_is_what_lies_outside() -> None:
    square = GridSpec.centered(length=8, width=8, resolution=0.5)
    assert facts.turned(square, 3.0)["share of cells at 90 degrees"] == 0
    assert facts.turned(square, 3.0)["share of angles, 3 m straight ahead"] == 0
    wide = GridSpec.centered(length=8, width=4, resolution=0.5)
    found = facts.turned(wide, 3.0, steps=720)
    assert found["share of cells at 90 degrees"] == pytest.approx(0.5)
    assert found["share of angles, 3 m straight ahead"] == pytest.approx(1 - 2 * np.arcsin(2 / 3) / np.pi, abs=0.01)
    assert 0.1 < found["mean share of cells"] < 0.5


def test_values_are_read_as_written_and_others_refused(tmp_path: Path) -> None:
    curves = figures()
    path = write(tmp_path / "curves.csv", curves)
    np.testing.assert_array_equal(np.array(facts.read_curves(path)), np.array(curves))
    with pytest.raises(ValueError, match="must sum to one"):
        facts.read_curves(write(tmp_path / "off.csv", curves._replace(free=curves.free + 0.01)))
    with pytest.raises(ValueError, match="must sum to one"):
        facts.read_curves(write(tmp_path / "gap.csv", curves._replace(free=np.full(100, np.nan))))
    other = tmp_path / "other.csv"
    other.write_text(path.read_text().replace("kld_geo", "kl"))
    with pytest.raises(ValueError, match="must have the columns t, m_unknown_deep"):
        facts.read_curves(other)


def test_the_command_writes_record_and_picture_or_asks_for_the_values(tmp_path: Path) -> None:
    def run(*options: str) -> str:
        command = [sys.executable, str(ROOT / "benchmarks/paper_curves.py"), *options]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert "give the values behind the paper's figures with --curves" in run("--curves", str(tmp_path / "no.csv"))
    path = write(tmp_path / "curves.csv", figures())
    out, picture = tmp_path / "new/found.json", tmp_path / "found.png"
    run("--curves", str(path), "--out", str(out), "--picture", str(picture))
    record = json.loads(out.read_text())
    assert (
        record["command"]
        == "python benchmarks/paper_curves.py --curves curves.csv --out found.json --picture found.png"
    )
    assert record["frames"] == 100
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_record_is_that_of_the_papers_values(real: Callable[[str], Path]) -> None:
    path = real("kitti_object").parents[1] / "paper_fig_curves.csv"
    if not path.is_file():
        pytest.skip(f"no {path}: the values behind the paper's figures are not ours to pass on")
    curves, record = facts.read_curves(path), json.loads(RECORD.read_text())
    for name, one in facts.described(curves).items():
        assert record["curves"][name]["mean"] == pytest.approx(one["mean"], rel=1e-12), name
    scale = facts.scale_as_released(curves, np.random.default_rng(0))
    read = record["evidence of a label if it is what the released code computes"]
    assert read["E"]["value"] == pytest.approx(scale["E"]["value"], rel=1e-9)
    assert record["geometric de-mixed"]["mean"] == pytest.approx(facts.demixed(curves).mean(), rel=1e-12)


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
