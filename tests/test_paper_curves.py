"""Reading the paper's own figures: what is read is what was put in, and the pages say what was measured."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ogm import GridSpec

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
from _paper_facts import (  # noqa: E402
    COLUMNS,
    MISSED,
    Curves,
    bound,
    demixed,
    described,
    observed,
    order,
    read_curves,
    scale_as_named,
    scale_as_released,
    shares,
    turned,
    versus,
)

sys.path.pop(0)
RECORD = ROOT / "benchmarks/results/paper_curves.json"
PAGE = ROOT / "docs/reproduction.md"


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


def write(path: Path, curves: Curves) -> Path:
    rows = np.stack([np.arange(len(curves.kl)), *curves], axis=-1)
    np.savetxt(path, rows, delimiter=",", header=",".join(COLUMNS), comments="", fmt="%.17g")
    return path


def test_the_scale_of_made_up_figures_is_found() -> None:
    found = scale_as_released(figures(belief=0.85), np.random.default_rng(0))
    assert found["E"]["value"] == pytest.approx(1, rel=1e-6)
    assert found["belief c"]["value"] == pytest.approx(0.85, rel=1e-6)
    assert found["R2"] == pytest.approx(1, abs=1e-9)
    assert found["one parameter: c"] == pytest.approx(0.85, rel=0.25)  # what the deep model lost is not in it


def test_the_interval_of_the_scale_holds_it_where_figures_are_noisy() -> None:
    found = scale_as_released(figures(noise=0.003), np.random.default_rng(0))
    assert found["E"]["low"] < 1 < found["E"]["high"]
    assert found["belief c"]["low"] < 0.85 < found["belief c"]["high"]
    assert 0.9 < found["R2"] < 1


def test_without_the_averaging_half_the_belief_would_be_found() -> None:
    curves = figures(belief=0.85, averaged=False)
    found = scale_as_released(curves, np.random.default_rng(0))
    assert found["belief c"]["value"] == pytest.approx(0.85 / 2, rel=1e-6)
    assert found["belief c without the averaging"] == pytest.approx(0.85, rel=1e-6)


def test_demixing_undoes_the_mean_of_both() -> None:
    np.testing.assert_allclose(demixed(figures()), figures(averaged=False).kl_geo, rtol=1e-12)


def test_demixing_turns_no_win_into_a_loss_and_doubles_the_difference() -> None:
    curves, rng = figures(), np.random.default_rng(0)
    plotted, own = versus(curves.kl, curves.kl_geo, rng), versus(curves.kl, demixed(curves), rng)
    assert (plotted["wins"], plotted["losses"]) == (own["wins"], own["losses"])
    assert own["difference"]["value"] == pytest.approx(2 * plotted["difference"]["value"])


def test_lost_frames_are_those_in_which_the_second_is_lower() -> None:
    first, second = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 1.5, 4.0, 3.0])
    found = versus(first, second, np.random.default_rng(0))
    assert found["frames in which the second is lower"] == [1, 3]
    assert found["margin in these"] == {"mean": 0.75, "most": 1.0}
    assert (found["wins"], found["losses"]) == (2, 2)


def test_a_figure_of_a_dirichlet_divergence_gives_its_scale() -> None:
    curves = figures()
    missing = curves.unknown_geo - curves.unknown
    kl_geo = missing * (4 + 2) / 4 * (4 - np.log(5))
    assert scale_as_named(curves._replace(kl_geo=kl_geo)) == pytest.approx({"E": 4, "R2": 1}, rel=1e-6)


def test_no_cell_of_evidence_up_to_one_has_a_divergence_above_one() -> None:
    assert bound(21) == pytest.approx(1, abs=1e-12)


def test_a_drive_in_order_is_told_from_a_shuffled_one() -> None:
    smooth = np.sin(np.linspace(0, 9, 100))
    shuffled = np.random.default_rng(1).permutation(smooth)
    curves = figures()._replace(kl=smooth, kl_geo=shuffled)
    found = order(curves, np.random.default_rng(0))
    assert found["kl"]["lag-1 correlation"] > 0.9
    assert found["kl"]["p"] < 0.001
    assert found["kl_geo"]["p"] > 0.05


def test_masses_of_a_third_are_counted_as_cells() -> None:
    curves = figures()
    found = observed(curves)
    assert found["cells observed"] == pytest.approx(found["cells free"] + found["cells occupied"])
    assert found["mean unknown if it had mass 1"] == pytest.approx(1 - found["cells observed"])
    masses = shares(curves, np.random.default_rng(0))
    assert masses["occupied of what is known, deep"] == pytest.approx(0.1)
    assert masses["occupied of what is known, geometric"] == pytest.approx(0.03)


def test_what_turning_leaves_without_a_label_is_what_lies_outside() -> None:
    square = GridSpec.centered(length=8, width=8, resolution=0.5)
    assert turned(square, 3.0)["share of cells at 90 degrees"] == 0
    assert turned(square, 3.0)["share of angles, 3 m straight ahead"] == 0
    wide = GridSpec.centered(length=8, width=4, resolution=0.5)
    found = turned(wide, 3.0, steps=720)
    assert found["share of cells at 90 degrees"] == pytest.approx(0.5)
    assert found["share of angles, 3 m straight ahead"] == pytest.approx(
        1 - 2 * np.arcsin(2 / 3) / np.pi, abs=0.01
    )
    assert 0.1 < found["mean share of cells"] < 0.5


def test_values_are_read_as_written_and_others_refused(tmp_path: Path) -> None:
    curves = figures()
    path = write(tmp_path / "curves.csv", curves)
    np.testing.assert_array_equal(np.array(read_curves(path)), np.array(curves))
    with pytest.raises(ValueError, match="must sum to one"):
        read_curves(write(tmp_path / "off.csv", curves._replace(free=curves.free + 0.01)))
    with pytest.raises(ValueError, match="must sum to one"):
        read_curves(write(tmp_path / "gap.csv", curves._replace(free=np.full(100, np.nan))))
    other = tmp_path / "other.csv"
    other.write_text(path.read_text().replace("kld_geo", "kl"))
    with pytest.raises(ValueError, match="must have the columns t, m_unknown_deep"):
        read_curves(other)


def test_the_command_writes_record_and_picture_and_says_when_there_is_nothing(tmp_path: Path) -> None:
    def run(*options: str) -> str:
        command = [sys.executable, str(ROOT / "benchmarks/paper_curves.py"), *options]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    assert "give the values behind the paper's figures with --curves" in run(
        "--curves", str(tmp_path / "no.csv")
    )
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
    curves, record = read_curves(path), json.loads(RECORD.read_text())
    for name, one in described(curves).items():
        assert record["curves"][name]["mean"] == pytest.approx(one["mean"], rel=1e-12), name
    scale = scale_as_released(curves, np.random.default_rng(0))
    read = record["evidence of a label if it is what the released code computes"]
    assert read["E"]["value"] == pytest.approx(scale["E"]["value"], rel=1e-9)
    assert record["geometric de-mixed"]["mean"] == pytest.approx(demixed(curves).mean(), rel=1e-12)


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


def test_the_reproduction_page_holds_what_was_read() -> None:
    page, record = (
        " ".join(PAGE.read_text().split()),
        json.loads(RECORD.read_text()),
    )
    means = {name: one["mean"] for name, one in record["curves"].items()}
    plotted = record["KL, deep against geometric as plotted"]
    masses = record["the geometric model's masses, if an observed cell has 1/3"]
    scale = record["evidence of a label if it is what the released code computes"]
    named = record["evidence of a label if it is a Dirichlet KL"]
    limit = record["is it a Dirichlet KL with labels of evidence 1?"]
    turn = record["turning a label of 512 x 352 cells leaves without a label"]
    difference = {key: -value for key, value in plotted["difference"].items()}
    lags = [abs(one["lag-1 correlation"]) for one in record["is it time?"].values()]
    said = (
        f"mean unknown {means['unknown_geo']:.3f} against {means['unknown']:.3f}",
        f"is {100 * masses['cells observed']:.1f} % of the cells *observed*",
        f"would be {masses['mean unknown if such a cell had evidence 10 (mass 5/6)']:.3f}, if they were certain, "
        f"{masses['mean unknown if it had mass 1']:.3f}",
        f"{record['masses']['free, deep / geometric']['value']:.1f} times the mass of free and "
        f"{record['masses']['occupied, deep / geometric']['value']:.1f} times",
        f"means {means['kl']:.3f} and {means['kl_geo']:.3f}; the deep model is lower in {plotted['wins']} frames, the "
        f"geometric one in {plotted['losses']} "
        f"({', '.join(map(str, plotted['frames in which the second is lower']))}, by "
        f"{plotted['margin in these']['mean']:.3f} in the mean)",
        f"Difference {difference['value']:.3f} (95 %: {difference['high']:.3f} to {difference['low']:.3f})",
        f"the baseline's mean is {record['geometric de-mixed']['mean']:.3f}",
        f"but {limit['frames whose plotted mean exceeds it']} frame means do, up to "
        f"{limit['largest plotted mean']:.2f}",
        f"(E = {named['E']:.1f} fits the mean), it explains the frames badly (R² {named['R2']:.2f})",
        f"R² {scale['R2']:.2f}, evidence per observed cell {scale['E']['value']:.2f} ({scale['E']['low']:.2f} to "
        f"{scale['E']['high']:.2f})",
        f"a belief of {scale['belief c without the averaging']:.2f} into a cell",
        f"no series has a lag-1 correlation beyond {max(lags):.2f}",
        f"labels know {100 * scale['cells that the labels know']['mean']:.1f} % of the cells; at most "
        f"{100 * scale['cells that the geometric model misses, at most']['mean']:.1f} % of all cells get no evidence "
        f"from the baseline though labelled, {100 * scale['cells that the deep model misses, at most']['mean']:.1f} %",
        f"{100 * record['masses']['occupied of what is known, deep']:.1f} % of what the deep model knows is occupied",
        f"{100 * turn['mean share of cells']:.1f} % of all cells lose their label so, "
        f"{100 * turn['share of cells at 90 degrees']:.1f} % at a right angle",
    )
    assert [words for words in said if words not in page] == []
    assert min(one["p"] for one in record["is it time?"].values()) > 0.2
    assert turn["share of angles, 40 m straight ahead"] == pytest.approx(0.5, abs=0.01)


def test_the_reproduction_page_holds_what_was_measured() -> None:
    page = " ".join(PAGE.read_text().split())
    results = {
        name: json.loads((ROOT / f"benchmarks/results/{name}.json").read_text())
        for name in (
            "deep_quality",
            "deep_losses",
            "deep_real",
            "deep_speed",
            "truth_modes",
            "fusion_quality",
        )
    }
    for name, shown in (
        ("squares as printed", "as printed, α / S"),
        ("squares as released", "as released, e / S"),
        ("squares as released, occupied x 100", "as released, occupied x 100"),
        ("reverse KL", "reverse KL, our default"),
    ):
        scores = results["deep_losses"]["scores"][name]
        values = (
            f"{scores[m]['value']:.3f}"
            for m in ("kl_e10", "iou_free", "iou_occupied", "auroc_unknown", "ece")
        )
        assert f"| {shown} | {' | '.join(values)} |" in page

    quality = results["deep_quality"]
    models = ("lite", "height-band", "height-band-released")
    for metric in ("kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl"):
        ours, text, code = (f"{quality['models'][name]['macro'][metric]['value']:.3f}" for name in models)
        wins = [quality["paired"][f"lite against {name}"][metric]["wins"] for name in models[1:]]
        assert f"| {ours} | {text} | {wins[0]} | {code} | {wins[1]} |" in page, metric
    mean = {
        metric: {name: f"{one['macro'][metric]['value']:.3f}" for name, one in quality["models"].items()}
        for metric in ("iou_free", "iou_occupied", "auroc_unknown", "ece_relative", "mean_unknown", "ece")
    }
    kinds = quality["occupied cells by what stands there, pooled"]
    ours, band = (kinds[name]["participants"] for name in ("lite", "height-band"))
    truth = 100 * np.mean(quality["truth per frame"]["unknown"])
    boxes = results["deep_real"]["boxes"]["all, each place once"]["models"]
    covered, freed = (
        {
            name: 100 * boxes[name][what]["mean over objects"]
            for name in ("DeepISM", "RayISM", "HeightBandISM")
        }
        for what in ("occupied", "free")
    )
    modes = results["truth_modes"]["against the reference"]
    doubt = results["fusion_quality"]["where Bayes says 0.4 to 0.6"]
    bayes, dempster, default = (
        results["fusion_quality"]["maps"][name]["mean and 95 % interval"]["ghost_area"][0]
        for name in ("classical Bayes", "Dempster, 2 s", "cautious, what came leaves, 0.04 s")
    )
    speed = results["deep_speed"]["summary"]
    said = (
        f"IoU of free {mean['iou_free']['lite']} against {mean['iou_free']['height-band']} and of occupied "
        f"{mean['iou_occupied']['lite']} against {mean['iou_occupied']['height-band']}",
        f"an AUROC of {mean['auroc_unknown']['lite']} (`RayISM` {mean['auroc_unknown']['ray']}, baseline "
        f"{mean['auroc_unknown']['height-band']})",
        f"is calibrated to {mean['ece_relative']['lite']} ({mean['ece_relative']['ray']}, "
        f"{mean['ece_relative']['height-band']})",
        f"P(occupied) itself is off by {mean['ece']['lite']}",
        f"mean unknown is {mean['mean_unknown']['height-band-released']} as released, "
        f"{mean['mean_unknown']['height-band']} with evidence 10, {mean['mean_unknown']['lite']} with `lite`, and "
        f"{truth:.1f} % of the cells",
        f"`lite` calls {100 * ours['called occupied']:.1f} % occupied and {100 * ours['false free']:.1f} % free; the "
        f"baseline {100 * band['called occupied']:.1f} and {100 * band['false free']:.1f} %",
        f"calls {covered['DeepISM']:.1f} % occupied and {freed['DeepISM']:.1f} % free; `RayISM` "
        f"{covered['RayISM']:.1f} and {freed['RayISM']:.1f} %, the baseline {covered['HeightBandISM']:.1f} and "
        f"{freed['HeightBandISM']:.1f} %",
        f"it finds {100 * modes['hd']['free found']:.1f} % of the free and {100 * modes['hd']['occupied found']:.1f} %",
        f"find {100 * modes['aimed']['free found']:.1f} and {100 * modes['aimed']['occupied found']:.1f} %",
        f"{100 * doubt['share never measured']:.1f} % were never seen and "
        f"{100 * doubt['share contradicted']:.1f} % are",
        f"leaves {bayes:.2f} m² of ghosts behind each mover, Dempster's rule {dempster:.2f}; the rule that we take by "
        f"default {default:.2f},",
        f"`lite` {speed['lite']['scans per second']:.1f} scans per second, the network of the paper's size "
        f"{speed['paper']['scans per second']:.1f}",
    )
    assert [words for words in said if words not in page] == []
    for metric in ("iou_free", "iou_occupied"):
        assert quality["paired"]["lite against height-band"][metric]["wins"] == 100


def slug(heading: str) -> str:
    """Return the anchor that a heading gets."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_the_links_of_the_page_lead_somewhere() -> None:
    links = re.findall(r"\]\(([^)\s]+)\)", PAGE.read_text())
    assert len(links) > 20
    for link in links:
        name, _, anchor = link.partition("#")
        target = (PAGE.parent / name).resolve() if name else PAGE
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE)
            assert anchor in {slug(heading) for heading in headings}, link


def test_every_claim_of_the_table_has_its_verdict() -> None:
    text = PAGE.read_text()
    rows = re.findall(r"^\| \[.+?\]\(#([^)]+)\) \|", text, re.MULTILINE)
    sections = dict(re.findall(r"^## (.+?)\n(.+?)(?=\n## |\Z)", text, re.MULTILINE | re.DOTALL))
    assert [slug(heading) for heading in sections] == rows
    for heading, words in sections.items():
        assert "- **Text**" in words, heading
        assert "- **Verdict**" in words, heading
