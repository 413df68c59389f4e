"""``ogm evaluate``, as a person uses it."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import Result
from PIL import Image
from typer.testing import CliRunner

from ogm.cli import app
from ogm.deep.checkpoint import save_network
from ogm.deep.network import Network, NetworkConfig
from ogm.grid import GridSpec
from ogm.metrics import METRICS
from ogm.simulation.sample import OBJECT, RANGE_STEP, Beams, Sample
from ogm.simulation.store import Store
from ogm.truth import CANVAS, FREE, OCCUPIED, UNKNOWN, Truth

MODULE = importlib.import_module("ogm.cli.evaluate")  # its function of the same name hides it
PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
LAYERS = 16
BEAMS = Beams(
    "test-16",
    elevation=tuple(np.radians(np.linspace(-20, 3, LAYERS))),
    azimuth=(np.pi,) * LAYERS,
    step=-2 * np.pi / 360,
    columns=360,
    rate=10.0,
    origin=((0.0, 0.0, 0.0),) * LAYERS,
)


def ogm(*words: object) -> Result:
    """Run a command in this process."""
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def sample(split: str, index: int) -> Sample:
    """Flat ground before a wall that stands across the way, the farther the higher the index."""
    height, wall = 1.9 if index % 3 else 2.1, 10.0 + 3 * index
    x, _, z = np.moveaxis(BEAMS.directions.astype(np.float64), -1, 0)
    with np.errstate(divide="ignore"):
        distance = np.minimum(np.where(z < 0, -height / z, np.inf), np.where(x > 0, wall / x, np.inf))
    steps = np.where(distance < 100, distance / RANGE_STEP, 0).astype(np.uint16)
    cx, _ = CANVAS.cell_centers
    column = np.where(cx < wall - 0.16, FREE, np.where(cx < wall + 0.16, OCCUPIED, UNKNOWN))
    T = np.eye(4)
    T[:3, 3] = [0.3, 0.0, height]
    return Sample(
        beams=BEAMS,
        steps=steps,
        intensities=np.where(steps > 0, 30, 0).astype(np.uint8),
        truth=Truth(CANVAS, np.broadcast_to(column, CANVAS.shape).astype(np.uint8)),
        objects=np.zeros(0, OBJECT),
        T_world_sensor=np.eye(4),
        T_vehicle_sensor=T,
        velocity=np.zeros(3),
        yaw_rate=0.0,
        stamp=float(index),
        split=split,
        index=index,
        scenario=0,
    )


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
    config = NetworkConfig(
        pillar=4,
        blocks=((4, 1), (4, 1), (4, 1)),
        join="add",
        bearings=False,
        scale=(15, 10, 2, 0.5, 0.2, 0.2, 0.3, 0.3, 0.3),
    )
    return save_network(tmp_path_factory.mktemp("run") / "small.safetensors", Network(config, PAPER), {})


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes longest."""
    monkeypatch.setattr(MODULE, "draw", lambda *_: None)


def test_models_are_judged_on_the_same_samples(
    data: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MODULE, "FRAMES", 2)
    folder = tmp_path / "new" / "report"
    result = ogm("evaluate", data, "--ism", "height-band", "ray", weights, "--out", folder)
    assert result.exit_code == 0, result.output
    for said in ("Means over validation, 4 frames", "IoU occupied", "small against ray", "ratio of means"):
        assert said in result.output
    record = json.loads((folder / "report.json").read_text())
    assert record["samples"] == [0, 1, 2, 3]
    assert list(record["models"]) == ["height-band", "ray", "small"]
    assert record["weights"]["ray"] is None
    assert len(record["weights"]["small"]["sha256"]) == 64
    assert record["data"] == {"plan": {"seed": 1}, "versions": {"ogm": "0"}, "split": "validation"}
    for one in record["models"].values():
        assert set(one["macro"]) == set(one["micro"]) == set(one["per frame"]) == set(METRICS)
        for metric, values in one["per frame"].items():
            assert len(values) == 4
            if None not in values:
                assert one["macro"][metric]["value"] == pytest.approx(np.mean(values), abs=1e-6)
    assert set(record["paired"]) == {
        "ray against height-band",
        "small against height-band",
        "small against ray",
    }
    for name in ("metrics.png", "frames.png"):
        with Image.open(folder / name) as picture:
            assert min(picture.size) > 500
    for one in record["paired"]["small against ray"].values():
        assert one["wins"] + one["ties"] + one["losses"] == one["frames"]


@pytest.mark.usefixtures("no_pictures")
def test_the_released_baseline_is_judged_on_the_fine_cells(data: Path, tmp_path: Path) -> None:
    result = ogm("evaluate", data, "--ism", "height-band-released", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["grid"]["shape"] == [512, 352]
    assert record["models"]["height-band-released"]["macro"]["iou_free"]["value"] == 0.0
    assert record["models"]["height-band-released"]["macro"]["ece_called"]["value"] is None


@pytest.mark.usefixtures("no_pictures")
def test_samples_are_drawn_by_the_seed_and_the_report_repeats(data: Path, tmp_path: Path) -> None:
    def numbers(seed: int, folder: str) -> bytes:
        words = ("--ism", "ray", "--samples", 2, "--seed", seed, "--out", tmp_path / folder)
        result = ogm("evaluate", data, *words)
        assert result.exit_code == 0, result.output
        return (tmp_path / folder / "report.json").read_bytes()

    one, again = numbers(3, "a"), numbers(3, "b")
    assert one == again
    assert len(json.loads(one)["samples"]) == 2
    drawn = {tuple(json.loads(numbers(seed, "c"))["samples"]) for seed in range(4)}
    assert len(drawn) > 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("{nothing}",), "holds no data set; `ogm simulate"),
        (("{file}",), "is a file; a data set is a folder"),
        (("{data}", "--split", "sequences"), "has no split 'sequences'; it has training, validation, test"),
        (("{data}", "--split", "test"), "has no sample of test"),
        (("{data}", "--split", "training"), "has no sample of training; go on with `ogm simulate"),
        (("{data}", "--samples", 5), "--samples must be in 1 ... 4"),
        (("{data}", "--samples", 0), "--samples must be in 1 ... 4"),
        (("{data}", "--ism", "rays"), "there is no model 'rays'; there are height-band"),
        (("{data}", "--ism", "{nothing}.safetensors"), "is not there"),
        (("{data}", "--ism", "{nothing}.pt"), "there are no weights"),
        (("{data}", "--ism", "{file}.safetensors"), "is not there"),
        (("{data}", "--ism", "ray", "ray"), "ray is given twice"),
        (("{data}", "--ism", "ray", "--out", "{file}"), "--out writes a folder"),
    ],
)
def test_errors_are_one_line_and_exit_code_2(data: Path, tmp_path: Path, words: tuple, says: str) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    names = {"data": data, "nothing": tmp_path / "nothing", "file": file}
    out = () if "--out" in words else ("--out", tmp_path / "report")
    ism = () if "--ism" in words else ("--ism", "ray")
    result = ogm("evaluate", *(str(word).format(**names) for word in words), *ism, *out)
    assert result.exit_code == 2, result.output
    assert says in result.output
    assert sum(line.startswith("ogm: ") for line in result.output.splitlines()) == 1
    assert not (tmp_path / "report").exists()


def test_help_has_an_example() -> None:
    result = ogm("evaluate", "--help")
    assert "Example:  ogm evaluate data/ --ism height-band ray lite --out report/" in result.output
