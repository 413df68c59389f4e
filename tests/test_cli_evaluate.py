"""``ogm evaluate``, as a person uses it."""

import csv
import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import each, fail_call
from commands import completed, ogm, refused_command
from PIL import Image
from samples import BEAMS, flat_sample, flat_steps

from ogm.deep.checkpoint import save_network
from ogm.deep.network import NetworkConfig, PillarNetwork
from ogm.evaluation import cache, report, runner, tasks
from ogm.fusion import EvidentialMapper
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics import METRICS, accumulate, score
from ogm.pose import pose
from ogm.scan import Mount, Scan
from ogm.simulation.exchange import write_label
from ogm.simulation.sample import SimulatedSample as Sample
from ogm.simulation.store import Store
from ogm.state import CellState, Truth
from ogm.storage.locks import locked
from ogm.truth import TRUTH_SPEC

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState
PAPER = GridSpec.centered()


def sample(split: str, index: int) -> Sample:
    """Flat ground before a wall that stands across the way, the farther the higher the index."""
    height, wall = 1.9 if index % 3 else 2.1, 10.0 + 3 * index
    cx, _ = TRUTH_SPEC.cell_centers
    column = np.where(cx < wall - 0.16, FREE, np.where(cx < wall + 0.16, OCCUPIED, UNKNOWN))
    steps = flat_steps(height=height, wall=wall, reach=100)
    return flat_sample(split, index, steps, column, T_vehicle_sensor=pose(0.3, 0.0, height), stamp=float(index))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four validation samples; training is planned but not made, of the test there is none."""
    folder = tmp_path_factory.mktemp("evaluate") / "data"
    counts = {"training": 10, "validation": 4, "test": 0}
    store = Store.create(folder, {"seed": 1}, counts, [BEAMS], {"ogm": "0"})
    store.write("validation", 0, [sample("validation", k) for k in range(4)])
    return folder


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained small network."""
    torch.manual_seed(0)
    scale = (15, 10, 2, 0.5, 0.2, 0.2, 0.3, 0.3, 0.3)
    config = NetworkConfig(4, ((4, 1), (4, 1), (4, 1)), join="add", bearings=False, scale=scale)
    return save_network(tmp_path_factory.mktemp("run") / "small.safetensors", PillarNetwork(config, PAPER), {})


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes longest."""
    for name in ("draw_metrics", "draw_frames"):
        monkeypatch.setattr(report.figures, name, lambda *_: None)


def record_of(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def test_models_are_evaluated_on_the_same_samples(
    data: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report, "ROWS", 2)
    folder = tmp_path / "new" / "report"
    result = completed("evaluate", data, "--ism", "height-band", "ray", weights, "--out", folder)
    for text in ("Means over data, validation, 4 frames", "IoU occupied", "small against ray", "ratio of means"):
        assert text in result.output
    record = record_of(folder)
    assert record["data"]["samples"] == [0, 1, 2, 3]
    assert [frame["name"] for frame in record["frames"]] == [f"validation {k}" for k in range(4)]
    assert list(record["methods"]) == ["height-band", "ray", "small"]
    assert record["methods"]["ray"]["weights"] is None
    assert len(record["methods"]["small"]["weights"]["sha256"]) == 64
    assert record["data"]["plan"] == {"seed": 1}
    assert record["data"]["split"] == "validation"
    for one in record["methods"].values():
        assert set(one["macro"]) == set(one["micro"]) == set(one["per frame"]) == set(METRICS)
        for metric, values in one["per frame"].items():
            assert len(values) == 4
            if None not in values:
                assert one["macro"][metric]["value"] == pytest.approx(np.mean(values), abs=1e-6)
    assert set(record["paired"]) == {"ray against height-band", "small against height-band", "small against ray"}
    for one in record["paired"]["small against ray"].values():
        assert one["wins"] + one["ties"] + one["losses"] == one["frames"]
    for name in ("metrics.png", "frames.png"):
        with Image.open(folder / name) as picture:
            assert min(picture.size) > 500
    with open(folder / "frames.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * 3
    of_ray = [float(row["iou_free"]) for row in rows if row["method"] == "ray"]
    assert of_ray == pytest.approx(record["methods"]["ray"]["per frame"]["iou_free"])
    page = (folder / "report.html").read_text()
    assert "validation 3" in page
    assert "height-band" in page


@pytest.mark.usefixtures("no_pictures")
def test_the_released_baseline_is_evaluated_on_the_fine_cells(data: Path, tmp_path: Path) -> None:
    completed("evaluate", data, "--ism", "height-band-released", "--out", tmp_path)
    record = record_of(tmp_path)
    assert record["grid"]["shape"] == [512, 352]
    assert record["methods"]["height-band-released"]["macro"]["iou_free"]["value"] == 0.0
    assert record["methods"]["height-band-released"]["macro"]["ece_called"]["value"] is None
    assert record["methods"]["height-band-released"]["missing"]["ece_called"]


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.slow
def test_samples_are_drawn_by_the_seed_and_the_report_repeats(data: Path, tmp_path: Path) -> None:
    def record(seed: int, folder: str) -> dict:
        words = ("--ism", "ray", "--samples", 2, "--seed", seed, "--out", tmp_path / folder)
        completed("evaluate", data, *words)
        return record_of(tmp_path / folder)

    one, again = record(3, "a"), record(3, "b")
    assert one["methods"] == again["methods"]
    assert one["paired"] == again["paired"]
    assert len(one["frames"]) == 2
    drawn = {tuple(frame["name"] for frame in record(seed, "c")["frames"]) for seed in range(4)}
    assert len(drawn) > 1


# --- Interrupted runs -------------------------------------------------------------------------------


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Note the number of every frame that is evaluated."""
    seen: list[int] = []
    save = cache.ResultCache.save

    def noting(self: object, frame: int, one: object) -> None:
        seen.append(frame)
        save(self, frame, one)

    monkeypatch.setattr(cache.ResultCache, "save", noting)
    return seen


@each("folder", ["a", "a/frames"])
def test_one_process_evaluates_into_a_folder_at_a_time(data: Path, tmp_path: Path, folder: str) -> None:
    (tmp_path / folder).mkdir(parents=True)
    with locked(tmp_path / folder):
        result = ogm("evaluate", data, "--ism", "height-band", "--out", tmp_path / "a")
    assert result.exit_code == 2
    assert f"{tmp_path / folder}: another process is writing to this folder" in result.output


@pytest.mark.usefixtures("no_pictures")
def test_an_interrupted_run_keeps_its_frames_and_resumes(
    data: Path, tmp_path: Path, evaluated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("evaluate", data, "--ism", "ray", "--out", tmp_path / "a")
    with monkeypatch.context() as patch:
        fail_call(patch, tasks, "accumulate", 3)
        result = ogm(*words)
    assert result.exit_code == 130
    assert "2 of 4 frames are finished and kept: repeat the command to resume" in result.output
    assert not (tmp_path / "a" / "report.json").exists()
    assert evaluated == [0, 1]
    result = completed(*words)
    assert "2 of 4 frames were finished before" in result.output
    assert evaluated == [0, 1, 2, 3]
    assert ogm("evaluate", data, "--ism", "ray", "--out", tmp_path / "b").exit_code == 0
    assert record_of(tmp_path / "a")["methods"] == record_of(tmp_path / "b")["methods"]


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.slow
def test_a_damaged_frame_is_evaluated_again(data: Path, tmp_path: Path, evaluated: list[int]) -> None:
    words = ("evaluate", data, "--ism", "ray", "--out", tmp_path)
    assert ogm(*words).exit_code == 0
    first = record_of(tmp_path)["methods"]
    path = tmp_path / "frames" / "000002.npz"
    whole = path.read_bytes()
    for damaged in (b"", whole[:1000], whole[:20000] + bytes(2000) + whole[22000:]):
        path.write_bytes(damaged)
        del evaluated[:]
        assert ogm(*words).exit_code == 0
        assert evaluated == [2]
        assert record_of(tmp_path)["methods"] == first


@pytest.mark.usefixtures("no_pictures")
def test_frames_of_other_settings_are_not_mixed(
    data: Path, tmp_path: Path, evaluated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        fail_call(patch, tasks, "accumulate", 2)
        assert ogm("evaluate", data, "--ism", "ray", "--out", tmp_path).exit_code == 130
    result = ogm("evaluate", data, "--ism", "height-band", "--out", tmp_path)
    assert result.exit_code == 2
    assert "1 frames of an unfinished run with other data" in result.output
    assert (tmp_path / "frames" / "000000.npz").exists()
    assert ogm("evaluate", data, "--ism", "ray", "--out", tmp_path).exit_code == 0
    del evaluated[:]
    assert ogm("evaluate", data, "--ism", "height-band", "--out", tmp_path).exit_code == 0  # that one was finished
    assert evaluated == [0, 1, 2, 3]


@pytest.mark.usefixtures("no_pictures")
def test_an_interrupted_run_does_not_resume_with_files_that_changed(
    folders: Path, evaluated: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("evaluate", folders / "truth", "--grids", folders / "nothing", "--out", folders / "report")
    with monkeypatch.context() as patch:
        fail_call(patch, tasks, "accumulate", 2)
        assert ogm(*words).exit_code == 130
    for changed in ("truth/2.png", "nothing/2.npz"):
        before = (folders / changed).stat()
        os.utime(folders / changed, (0, 0))
        refused_command("files that have changed", *words)
        os.utime(folders / changed, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert ogm(*words).exit_code == 0
    assert evaluated == [0, 1, 2]


@pytest.mark.usefixtures("no_pictures")
def test_grids_that_were_written_again_are_evaluated_again(folders: Path) -> None:
    words = ("evaluate", folders / "truth", "--grids", folders / "perfect", "--out", folders / "report")
    assert ogm(*words).exit_code == 0
    for k in range(3):
        (folders / "nothing" / f"{k}.npz").replace(folders / "perfect" / f"{k}.npz")
    result = ogm(*words)
    assert "are finished already" not in result.output
    assert record_of(folders / "report")["methods"]["perfect"]["macro"]["iou_free"]["value"] == 0.0


@pytest.mark.usefixtures("no_pictures")
def test_frames_by_another_ogm_are_not_mixed(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        fail_call(patch, tasks, "accumulate", 2)
        assert ogm("evaluate", data, "--ism", "ray", "--out", tmp_path).exit_code == 130
    monkeypatch.setattr(runner, "code_state", lambda: "another")
    refused_command("or version of ogm", "evaluate", data, "--ism", "ray", "--out", tmp_path)


def test_the_state_of_files_leaves_out_the_report_beside_them(tmp_path: Path) -> None:
    (tmp_path / "scans" / "a").mkdir(parents=True)
    (tmp_path / "scans" / "a" / "0.bin").write_bytes(b"x")
    paths, report = [tmp_path / "scans"], tmp_path / "scans" / "report"
    before = cache.files_state(paths, report)
    (report / "frames").mkdir(parents=True)
    (report / "frames" / "0.npz").write_bytes(b"x")
    assert cache.files_state(paths, report) == before
    (tmp_path / "scans" / "b.bin").symlink_to("nowhere")
    assert cache.files_state(paths, report) == before
    (tmp_path / "scans" / "a" / "1.bin").write_bytes(b"x")
    assert cache.files_state(paths, report) != before


@pytest.mark.usefixtures("no_pictures")
def test_only_frames_of_a_finished_run_are_removed(data: Path, tmp_path: Path) -> None:
    words = ("evaluate", data, "--samples", 1, "--out", tmp_path / "report")
    assert ogm(*words, "--ism", "ray").exit_code == 0
    mine = tmp_path / "report" / "frames" / "mine.txt"
    mine.write_text("x")
    assert ogm(*words, "--ism", "height-band").exit_code == 0
    assert mine.exists()


def test_a_folder_of_frames_that_is_not_ours_is_left_alone(data: Path, tmp_path: Path) -> None:
    note = tmp_path / "frames" / "run.json"
    note.parent.mkdir()
    for text in ('{"mine": 1}', "mine"):
        note.write_text(text)
        refused_command("is damaged or no file of `ogm evaluate`", "evaluate", data, "--ism", "ray", "--out", tmp_path)
        assert note.read_text() == text


# --- Folders of grids -------------------------------------------------------------------------------


@pytest.fixture
def folders(tmp_path: Path) -> Path:
    """Truth of three frames; the same as precomputed grids; and vacuous grids."""
    for name in ("truth", "perfect", "nothing"):
        (tmp_path / name).mkdir()
    state = np.zeros(PAPER.shape, np.uint8)
    for k in range(3):
        state[:] = UNKNOWN
        state[100:300, 50:200] = FREE
        state[300:310, 50 + 10 * k : 200] = OCCUPIED
        truth = Truth(PAPER, state)
        write_label(tmp_path / "truth" / f"{k}.png", truth)
        EvidentialGrid(PAPER, truth.grid.mass * np.float32(0.95)).save(tmp_path / "perfect" / f"{k}.npz")
        EvidentialGrid.vacuous(PAPER).save(tmp_path / "nothing" / f"{k}.npz")
    return tmp_path


@pytest.mark.usefixtures("no_pictures")
def test_folders_of_grids_are_compared_with_each_other_without_truth(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in ("scans", "ours", "theirs"):
        (tmp_path / name).mkdir()
    for k in range(3):
        rng.random((20, 4), np.float32).tofile(tmp_path / "scans" / f"{k}.bin")
        for name in ("ours", "theirs"):
            mass = rng.dirichlet([1, 1, 1], PAPER.shape)[..., :2].astype(np.float32)
            EvidentialGrid(PAPER, mass).save(tmp_path / name / f"{k}.npz")
    folders = [tmp_path / name for name in ("scans", "ours", "theirs", "report")]
    words = ("evaluate", folders[0], "--grids", folders[1], "--grids", folders[2], "--out", folders[3])
    refused_command("--agreement` compares methods with each other", *words)
    refused_command("leave out --truth", *words, "--agreement", "--truth", "boxes")
    refused_command("give one of them", *words, "--agreement", "--beams")
    result = completed(*words, "--agreement", "--every", "2")
    assert "Means over scans, 2 frames" in result.output
    assert "KL[first || second]" in result.output
    record = json.loads((folders[3] / "agreement.json").read_text())
    (pair,) = record["pairs"]
    assert (pair["first"], pair["second"], len(pair["per frame"]["kl"])) == ("ours", "theirs", 2)
    assert f"{pair['means']['kl']['value']:.3f}" in result.output


def test_folders_of_grids_pair_by_their_frames_names(folders: Path) -> None:
    grids = ("--grids", folders / "nothing", "--grids", folders / "perfect")
    completed("evaluate", folders / "truth", *grids, "--out", folders / "report")
    record = record_of(folders / "report")
    assert list(record["methods"]) == ["nothing", "perfect"]
    for metric in ("iou_free", "iou_occupied", "iou_unknown", "auroc_unknown"):
        assert record["methods"]["perfect"]["macro"][metric]["value"] == 1.0
    assert record["methods"]["nothing"]["macro"]["iou_free"]["value"] == 0.0
    assert record["paired"]["perfect against nothing"]["iou_free"]["wins"] == 3


@pytest.mark.usefixtures("no_pictures")
def test_grids_of_other_cells_are_resampled_on_request_only(folders: Path) -> None:
    other = GridSpec.centered(length=80.0, width=50.0, resolution=0.2)
    for k in range(3):
        EvidentialGrid.vacuous(other).save(folders / "nothing" / f"{k}.npz")
    words = ("evaluate", folders / "truth", "--grids", folders / "nothing", "--out", folders / "report")
    result = ogm(*words)
    assert result.exit_code == 2
    for text in ("400 x 250 cells of 0.2 m", "512 x 352 cells of 0.16 m", "--resample area"):
        assert text in result.output
    result = completed(*words, "--resample", "nearest")
    assert record_of(folders / "report")["methods"]["nothing"]["macro"]["mean_unknown"]["value"] == 1.0


def test_grids_with_nan_masses_are_refused(folders: Path) -> None:
    mass = np.full((*PAPER.shape, 2), np.nan, np.float32)
    (folders / "nothing" / "2.npz").unlink()
    np.save(folders / "nothing" / "2.npy", mass)
    result = ogm("evaluate", folders / "truth", "--grids", folders / "nothing", "--out", folders / "report")
    assert result.exit_code == 2
    assert "2.npy: mass must be" in result.output
    assert len(list((folders / "report" / "frames").glob("*.npz"))) == 2  # what was finished is kept


@pytest.mark.usefixtures("no_pictures")
def test_a_truth_of_a_part_of_the_cells_leaves_out_the_rest(folders: Path) -> None:
    (folders / "truth" / "0.png").unlink()
    EvidentialGrid.vacuous(GridSpec(0.32, (128, 176), (-40.96, -28.16))).save(folders / "truth" / "0.npz")
    completed("evaluate", folders / "truth", "--grids", folders / "nothing", "--out", folders / "report")
    assert record_of(folders / "report")["truth per frame"]["ignored"] == [0.5, 0.0, 0.0]


def test_the_report_is_not_written_into_the_evaluated_data(folders: Path) -> None:
    for out in ("truth", "nothing"):
        words = ("evaluate", folders / "truth", "--grids", folders / "nothing", "--out", folders / out)
        refused_command("contains the evaluated data", *words)
        assert len(list((folders / out).iterdir())) == 3


@pytest.mark.usefixtures("no_pictures")
def test_a_folder_that_is_given_as_a_dot_has_a_name(folders: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folders / "perfect")
    assert ogm("evaluate", "../truth", "--grids", ".", "--out", "../report").exit_code == 0
    monkeypatch.chdir(folders / "truth")
    assert ogm("evaluate", ".", "--grids", "../nothing", "--out", "../other").exit_code == 0
    assert list(record_of(folders / "report")["methods"]) == ["perfect"]
    assert record_of(folders / "other")["data"]["name"] == "truth"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Glyph")
def test_frames_may_have_any_name(folders: Path) -> None:
    given = ["a\nb", "<b>&", "=1+1", "漢", os.fsdecode(b"\xff")]
    for folder, ending in (("truth", "png"), ("nothing", "npz")):
        content = (folders / folder / f"0.{ending}").read_bytes()
        for name in given:
            try:
                (folders / folder / f"{name}.{ending}").write_bytes(content)
            except (OSError, UnicodeError):
                pytest.skip("this file system has no such names")
    words = ("evaluate", folders / "truth", "--grids", folders / "nothing", "--out", folders / "report")
    assert ogm(*words).exit_code == 0
    with open(folders / "report" / "frames.csv", newline="", encoding="utf-8") as file:
        names = {row["frame"] for row in csv.DictReader(file)}
    assert {name.encode("utf-8", "replace").decode() for name in given} < names


@pytest.mark.usefixtures("no_pictures")
def test_frames_without_a_value_are_not_the_worst(folders: Path) -> None:
    (folders / "truth" / "1.png").unlink()
    np.save(folders / "truth" / "1.npy", np.full(PAPER.shape, IGNORE, np.uint8))
    words = ("--grids", folders / "nothing", "--frames", 1, "--out", folders / "report")
    assert ogm("evaluate", folders / "truth", *words).exit_code == 0
    page = (folders / "report" / "report.html").read_text()
    assert 'id="pictures-1"' not in page
    assert page.count('id="pictures-') == 1


# --- Maps -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sequences of four frames."""
    folder = tmp_path_factory.mktemp("drive") / "data"
    store = Store.create(folder, {"seed": 1}, {"validation": 0, "sequences": 200}, [BEAMS], {"ogm": "0"})
    for first in (0, 100):
        frames = [driven(first + k) for k in range(10)]
        store.write("sequences", first // 10, frames)
    return folder


def simulated_scan(one: Sample) -> Scan:
    """Return a sample's scan with its beams without echo."""
    return Scan(one.points, no_returns=one.beams.directions[one.steps == 0])


def driven(index: int) -> Sample:
    """Return a frame of a vehicle that drives 1 m forward per frame."""
    frame = index % 100
    one = sample("sequences", 5)
    T = pose(float(frame), 0.0, one.T_vehicle_sensor[2, 3])
    return dataclasses.replace(one, T_world_sensor=T, index=index, stamp=0.1 * frame, scenario=index // 100)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_maps_are_those_of_the_mapper_and_begin_anew_with_every_sequence(drive: Path, tmp_path: Path) -> None:
    words = ("--ism", "ray", "--fused", "revise,bayes", "--every", 3, "--out", tmp_path)
    completed("evaluate", drive, *words)
    record = record_of(tmp_path)
    assert list(record["methods"]) == ["ray", "ray + revise", "ray + bayes"]
    names = [frame["name"] for frame in record["frames"]]
    assert names[:2] == ["sequence 0 frame 0", "sequence 0 frame 3"]
    assert names[-1] == "sequence 1 frame 8"

    first = driven(0)
    mount = first.T_vehicle_sensor.copy()
    mount[:2, 3] = 0
    model = RayISM(PAPER, Mount(mount[2, 3], mount))
    for begin, end in ((0, 10), (100, 110)):
        mapper = EvidentialMapper(GridSpec.centered(length=128, width=128, resolution=0.16))
        for index in range(begin, end):
            one = driven(index)
            mapper.update(model(simulated_scan(one)), one.T_world_sensor, stamp=one.stamp)
            name = f"sequence {index // 100} frame {index % 100}"
            if name in names:
                scores = score(accumulate(mapper.view(PAPER).mass, one.truth.crop(PAPER).state))
                found = record["methods"]["ray + revise"]["per frame"]["brier"][names.index(name)]
                assert found == pytest.approx(scores["brier"], rel=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_an_interrupted_map_fuses_its_past_again(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("evaluate", drive, "--ism", "ray", "--fused", "dempster", "--every", 4)
    with monkeypatch.context() as patch:
        fail_call(patch, tasks, "accumulate", 6)
        assert ogm(*words, "--out", tmp_path / "a").exit_code == 130
    assert ogm(*words, "--out", tmp_path / "a").exit_code == 0
    assert ogm(*words, "--out", tmp_path / "b").exit_code == 0
    assert record_of(tmp_path / "a")["methods"] == record_of(tmp_path / "b")["methods"]


# --- Errors -----------------------------------------------------------------------------------------


@each("words, text", [
        (("{nothing}",), "there is no"),
        (("{file}",), "file"),
        (("{data}", "--split", "sequences"), "has no split 'sequences'; it has training, validation, test"),
        (("{data}", "--samples", 5), "--samples must be in 1 ... 4"),
        (("{data}", "--every", 0), "--every must be at least 1"),
        (("{data}", "--frames", 0), "--frames must be at least 1"),
        (("{data}", "--ism", "rays"), "there is no sensor model 'rays': give ray, height-band"),
        (("{data}", "--ism", "{nothing}.safetensors"), "there is no"),
        (("{data}", "--ism", "ray", "ray"), "ray is given twice"),
        (("{data}", "--ism", "ray", "--out", "{file}"), "the report needs a folder"),
        (("{data}", "--fused", "bayes"), "has no split 'sequences'"),
        (("{data}", "--fused", "bayes", "--split", "validation"), "fuses sequences of frames"),
        (("{data}", "--fused", "best"), "--fused takes revise, cautious"),
        (("{data}", "--truth", "boxes"), "--truth is for recordings"),
        (("{data}", "--truth", "hearsay"), "--truth takes boxes"),
        (("{data}", "--grids", "{nothing}"), "there is no folder"),
        (("{data}", "--grids", "{data}"), "contains no grids"),
    ])  # fmt: skip
def test_errors_are_one_line_and_exit_code_2(data: Path, tmp_path: Path, words: tuple, text: str) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    names = {"data": data, "nothing": tmp_path / "nothing", "file": file}
    out = () if "--out" in words else ("--out", tmp_path / "report")
    ism = () if "--ism" in words else ("--ism", "ray")
    refused_command(text, "evaluate", *(str(word).format(**names) for word in words), *ism, *out)
    assert not (tmp_path / "report").exists()


# --- Recordings -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.slow
def test_a_real_drive_is_compared_with_its_boxes_and_its_other_scans(
    real: Callable[[str], Path], tmp_path: Path
) -> None:
    words = ("--ism", "ray", "--fused", "cautious", "--every", 10, "--out", tmp_path)
    completed("evaluate", real("kitti_raw_0005"), *words)
    record = record_of(tmp_path)
    assert record["data"]["kind"] == "KITTI raw drive"
    assert record["methods"]["ray"]["macro"]["auroc_unknown"]["value"] is None  # no label states what is unknown
    assert record["methods"]["ray"]["missing"]["auroc_unknown"]
    assert record["methods"]["ray"]["macro"]["iou_free_known"]["value"] > 0.5
