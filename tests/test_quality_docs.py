"""The whole comparison: what is kept of it, how its tables come into the pages, and that the pages hold its record."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ogm import GridSpec
from ogm.cli.report import plain  # noqa: E402
from ogm.cli.source import Frame, Item, Source
from ogm.metrics import Evaluation, distances, tally
from ogm.truth import Truth

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
import _quality_sources as sources  # noqa: E402
from _quality_methods import alone, fused_over_time, made_of  # noqa: E402
from _quality_pictures import by_distance, chosen, maps, papers_figures, recordings  # noqa: E402
from _quality_record import KEPT, PAIRED, brief, of_evaluation, published, write  # noqa: E402
from _quality_tables import TITLES, TOWN, fill, sentences, tables  # noqa: E402

sys.path.pop(0)
RECORD = ROOT / "benchmarks/results/quality.json"
SPEC = GridSpec.centered(length=8, width=4, resolution=0.5)
NAMES = ("height-band", "height-band-released", "ray", "lite", "ray + bayes")


def evaluation(
    names: tuple[str, ...] = NAMES, frames: int = 6, states: tuple[int, ...] = (0, 1, 2)
) -> Evaluation:
    """Judge made-up grids: the later the method, the nearer to the truth."""
    rng, far = np.random.default_rng(5), distances(SPEC)
    judged = []
    for _ in range(frames):
        state = rng.choice(np.array(states, np.uint8), SPEC.shape)
        right = np.stack([state == 1, state == 2], axis=-1) * np.float32(0.8)
        noise = rng.dirichlet([1, 1, 1], SPEC.shape)[..., :2].astype(np.float32)
        row = []
        for k in range(len(names)):
            share = np.float32(k / len(names))
            row.append(tally(share * right + (1 - share) * noise, state, far))
        judged.append((row, np.bincount(state.ravel(), minlength=4) / state.size))
    return Evaluation.from_counts(names, SPEC, judged)


def part(result: Evaluation, drives: int = 1) -> dict:
    facts = {name: {"description": f"what {name} is", "weights": None} for name in result.models}
    sequences = [f"drive {k % drives}" for k in range(result.frames)]
    return plain(of_evaluation(result, np.random.default_rng(0), sequences, facts))


def record() -> dict:
    town = evaluation(NAMES[:4])
    return {
        "town": part(town) | {"as the released code would report": plain(published(town, "lite", NAMES[1]))},
        "drives": part(evaluation(), drives=6),
        "real": {
            "a street": {"alone": part(evaluation(NAMES[:4], 1, (2, 3))), "fused": brief(part(evaluation()))},
            "another": {"left out": "there is no such folder"},
        },
    }


def test_means_are_those_of_the_evaluation() -> None:
    result = evaluation()
    found = part(result)
    for name in NAMES:
        assert set(found["models"][name]["mean"]) == set(KEPT)
        for metric, (value, low, high) in found["models"][name]["mean"].items():
            wanted = result.macro(name)[metric]
            assert value == pytest.approx(wanted, rel=1e-4), metric
            assert low <= value * (1 + 1e-4) + 1e-9
            assert value <= high * (1 + 1e-4) + 1e-9
        assert found["models"][name]["pooled"]["brier"] == pytest.approx(
            result.micro(name)["brier"], rel=1e-4
        )
    assert found["intervals"].endswith("over frames")
    assert part(result, drives=6)["intervals"].endswith("over drives")


def test_every_method_is_compared_with_both_geometric_ones_and_a_map_with_its_scans() -> None:
    pairs = part(evaluation())["paired"]
    assert "lite against ray" in pairs
    assert "lite against height-band" in pairs
    assert "ray + bayes against ray" in pairs
    assert not [name for name in pairs if len(set(name.split(" against "))) < 2]
    won, tied, lost = pairs["lite against height-band"]["brier"]["wins, ties, losses"]
    assert (won, tied, lost) == (6, 0, 0)
    assert set(pairs["lite against ray"]) == set(PAIRED)


def test_states_that_the_truth_lacks_have_no_score() -> None:
    found = part(evaluation(states=(2, 3)))
    for one in found["models"].values():
        assert one["mean"]["iou_free"] == [None, None, None]
        assert one["pooled"]["iou_free"] is None
        assert set(one["by range"]["iou_free"]) == {None}
        assert one["mean"]["iou_occupied"][0] is not None
        assert one["mean"]["auroc_unknown"][0] is None
        assert "unknown" in one["missing"]["auroc_unknown"]
    assert "iou_free" not in found["paired"]["lite against ray"]


def test_what_the_released_code_would_report_is_the_mean_of_both() -> None:
    result = evaluation()
    said = published(result, "lite", "ray")
    own = result.of("lite", "legacy_kl").mean(), result.of("ray", "legacy_kl").mean()
    assert said["KL, deep"] == pytest.approx(own[0])
    assert said["KL, geometric itself"] == pytest.approx(own[1])
    assert said["KL, geometric, mean of both"] == pytest.approx(sum(own) / 2)


def test_a_record_is_written_as_json_and_read_again(tmp_path: Path) -> None:
    wanted = record()
    write(tmp_path / "new/quality.json", wanted)
    assert json.loads((tmp_path / "new/quality.json").read_text()) == wanted
    assert plain({"a": float("nan"), "b": (np.float64(0.12345671), float("inf"))}) == {
        "a": None,
        "b": [0.1234567, None],
    }


def test_every_metric_of_a_table_is_kept_and_named() -> None:
    assert set(TITLES) == set(KEPT)
    page = "\n".join(tables(record()).values())
    for name in NAMES:
        assert f"`{name}`" in page
    assert "| a street, 1 frame; 0.0 % free," in page
    for row in page.splitlines():
        assert row[0] == row[-1] == "|"


def test_tables_come_between_their_markers_and_stay_if_made_again() -> None:
    page = "before\n<!-- town -->\nold\n<!-- /town -->\nbetween\n  <!-- b -->\n  <!-- /b -->\nafter\n"
    once = fill(page, {"town": "| new |\n| row |", "b": "one\ntwo"})
    assert once == (
        "before\n<!-- town -->\n| new |\n| row |\n<!-- /town -->\nbetween\n  <!-- b -->\n  one\n  two\n  <!-- /b -->\n"
        "after\n"
    )
    assert fill(once, {"town": "| new |\n| row |", "b": "one\ntwo"}) == once
    with pytest.raises(ValueError, match="no place for gone: <!-- gone -->"):
        fill(page, {"gone": "x"})


def test_the_pages_have_a_place_for_everything() -> None:
    made = record()
    fill((ROOT / "docs/quality.md").read_text(), tables(made))
    fill((ROOT / "docs/reproduction.md").read_text(), sentences(made))


@pytest.mark.skipif(not RECORD.exists(), reason="benchmarks/quality.py has not been run to its end")
def test_the_pages_hold_what_was_measured() -> None:
    found = json.loads(RECORD.read_text())
    for name, make in (("quality", tables), ("reproduction", sentences)):
        page = (ROOT / f"docs/{name}.md").read_text()
        assert fill(page, make(found)) == page, f"docs/{name}.md is not what benchmarks/quality.py wrote"
    assert found["split"] == "test"
    for name in found["town"]["models"]:
        assert f"`{name}`" in (ROOT / "docs/quality.md").read_text() or name == "paper"


@pytest.mark.skipif(not RECORD.exists(), reason="benchmarks/quality.py has not been run to its end")
def test_the_pictures_and_pages_that_the_page_names_are_there() -> None:
    page = ROOT / "docs/quality.md"
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE) if anchor else []
        slugs = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]
        assert not anchor or anchor in slugs, link


def test_pictures_are_drawn(tmp_path: Path) -> None:
    result, made = evaluation(), record()
    papers_figures(tmp_path / "a.png", result, "lite", "note")
    by_distance(tmp_path / "b.png", made["town"], "note")
    maps(tmp_path / "c.png", made["drives"], "note")
    recordings(tmp_path / "d.png", made["real"], "note")
    for name in "abcd":
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    words = [word for word, _ in chosen(result, "lite", "kl_e10")]
    frames = [k for _, k in chosen(result, "lite", "kl_e10")]
    values = result.of("lite", "kl_e10")
    assert words[0].startswith("best")
    assert values[frames[0]] == values.min()
    assert values[frames[-1]] == values.max()


def test_all_rules_are_compared_and_every_map_is_made_of_a_model() -> None:
    spec = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
    models = alone(spec)
    assert list(models) == ["height-band", "height-band-released", "ray", "lite"]
    methods = fused_over_time(models, spec)
    rules = {name.partition(" + ")[2] for name in methods if made_of(name) == "lite"}
    assert rules == {
        *("", "cautious", "dempster", "yager", "cumulative", "pcr6", "averaging", "weighted", "bayes"),
        "dempster-plain",
    }
    assert {made_of(name) for name in methods} == set(models)
    quick = fused_over_time(models, spec, quick=True)
    assert set(quick) < set(methods)


def line(names: list[str]) -> Source:
    """Make a source of frames in sequences, with a truth that knows free, occupied and not all."""
    state = np.zeros(SPEC.shape, np.uint8)
    state[3:6], state[6:9], state[9:12] = 1, 2, 3
    frames = tuple(Frame(f"{name} {k}", name, float(k)) for k, name in enumerate(names))
    return Source("simulated store", "line", "Made up.", {}, frames, lambda k: Item(Truth(SPEC, state)))


def test_of_each_drive_every_fifth_frame_is_judged() -> None:
    source = line(["a"] * 12 + ["b"] * 7)
    assert sources.every(source, 5) == [4, 9, 16]
    assert sources.every(source, 1) == list(range(19))
    assert sources.first_drives(source, [4, 9, 16], 1) == [4, 9]


def test_recordings_that_are_not_there_or_not_labelled_are_left_out_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in ("kitti_object", "kitti_raw_0005"):
        (tmp_path / place).mkdir()

    def opened(path: Path, *_: object, **options: str) -> Source:
        if path.name == "kitti_object":
            raise ValueError(f"{path} has no labels")
        source = line(["a"] * 4)
        pose = np.eye(4)
        return replace(
            source,
            name=options.get("judged", "scans"),
            read=lambda k: replace(source.read(k), T_map_sensor=pose),
        )

    monkeypatch.setattr(sources, "source_of", opened)
    found = {one.name: one for one in sources.real(tmp_path, SPEC)}
    assert set(found) == set(sources.REAL)
    assert found["nuScenes"].description == "there is no nuscenes_n015"
    assert found["KITTI, single scans"].description == "OGM_DATA/kitti_object has no labels"
    drive = found["KITTI, drive 0005"]
    assert drive.alone is not None
    assert drive.fused is not None
    assert (drive.alone.name, drive.fused.name) == ("scans", "maps")


@pytest.mark.skipif(not RECORD.exists(), reason="benchmarks/quality.py has not been run to its end")
def test_the_four_answers_are_those_of_the_record() -> None:
    found = json.loads(RECORD.read_text())
    page = (ROOT / "docs/quality.md").read_text()
    answers = " ".join(page[page.index("## The four answers") : page.index("## Single frames")].split())
    town, drives = (
        {n: one["mean"] for n, one in found[part]["models"].items()} for part in ("town", "drives")
    )
    real = {
        n: {m: one["mean"] for m, one in part["alone"]["models"].items()} for n, part in found["real"].items()
    }

    def iou(place: str, digits: int, *models: str) -> list[str]:
        return [f"{real[place][model]['iou_occupied'][0]:.{digits}f}" for model in models]

    def memory(name: str, metric: str) -> float:
        return found["drives"]["paired"][f"{name} against {name.partition(' + ')[0]}"][metric]["ratio"][0]

    ahead = [
        metric
        for metric in town["lite"]
        if (better := found["metrics"][metric]["better"])
        and any(
            one[metric][0] < town["lite"][metric][0]
            if better == "lower"
            else one[metric][0] > town["lite"][metric][0]
            for one in town.values()
        )
    ]
    assert {TITLES[metric] for metric in ahead if metric in TOWN} == {
        *("false free", "false occupied", "outside [Bel, Pl]", "KL, E = 1"),
    }
    bins = {name: one["by range"] for name, one in found["town"]["models"].items()}
    far = [100 * value for value in bins["lite"]["false_free"][3:]]
    for said in (
        "{} against {} on Argoverse 2".format(*iou("Argoverse 2", 2, "lite", "ray")),
        "{} against {} on nuScenes".format(*iou("nuScenes", 2, "lite", "ray")),
        "{} against {} on SemanticKITTI".format(*iou("SemanticKITTI, labelled scans", 2, "ray", "lite")),
        f"{100 * (memory('ray + cautious', 'iou_occupied') - 1):.0f} % more IoU of occupied",
        f"{100 * (memory('ray + cautious', 'iou_free') - 1):.0f} % more of free",
        f"a Brier score of {memory('ray + cautious', 'brier'):.2f} times",
        f"{100 * (memory('ray + cautious', 'false_free') - 1):.0f} % more occupied cells called free",
        f"{memory('ray + bayes', 'false_free'):.1f} to {memory('ray + dempster', 'false_free'):.1f} times",
        f"IoU {drives['lite + cautious']['iou_occupied'][0]:.3f} instead of {drives['lite']['iou_occupied'][0]:.3f}",
        f"{100 * drives['lite + cautious']['free_recall_1'][0]:.0f} % of the free space at 1 % false free",
        f"instead of {100 * drives['lite']['free_recall_1'][0]:.0f} %",
        f"`lite` calls {far[0]:.0f} to {far[1]:.0f} % of the occupied cells free",
        f"space left to drive on ({100 * town['lite']['free_recall_1'][0]:.0f} %",
        f"at 0.1 %, {100 * town['lite']['free_recall_01'][0]:.0f} %",
    ):
        assert said in answers, said
