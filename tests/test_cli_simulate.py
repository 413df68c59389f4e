"""``ogm simulate``, as a person uses it."""

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import each
from commands import completed, ogm, refused_command
from PIL import Image

from ogm.simulation import studio
from ogm.simulation.recipe import RECIPES
from ogm.simulation.store import FORMAT, GAPS, Store
from ogm.storage.locks import locked

pytestmark = pytest.mark.usefixtures("kept_towns")
TINY = ("--samples", 1, "--validation", 1, "--town-size", 240, "--lidar", "hdl-32e")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training and a validation sample of a small town, with the pictures and the export."""
    folder = tmp_path_factory.mktemp("simulate")
    result = completed("simulate", folder / "data", *TINY, "--workers", 1, "--export", folder / "paper")
    assert "2 samples: about" in result.output
    assert "kB each" in result.output
    assert "contact-sheet.png" in result.output
    return folder / "data"


def test_it_makes_samples_a_contact_sheet_and_an_export(data: Path) -> None:
    store = Store.open(data)
    assert len(store["training"][0].points) > 5_000
    assert store["validation"][0].lidar == "hdl-32e"
    assert (data / "contact-sheet.png").stat().st_size > 20_000
    names = {str(path.relative_to(data.parent)) for path in (data.parent / "paper").rglob("*.*")}
    assert names == {
        f"paper/{kind}_{part}/0000000001{end}"
        for part in ("train", "valid")
        for kind, end in (("input", ".pcd"), ("label", ".png"))
    }


def test_nothing_of_time_or_place_is_kept(data: Path) -> None:
    attributes = json.loads((data / "zarr.json").read_text())["attributes"]
    assert attributes["format"] == FORMAT
    assert set(attributes) == {"format", "plan", "splits", "lidars", "range_step", "labels", "versions", "sha256"}
    assert attributes["plan"]["samples"] == 1


def test_info_describes_a_data_set(data: Path) -> None:
    result = completed("info", data)
    assert "1 samples (1 hdl-32e)" in result.output
    assert "kB per sample" in result.output
    assert "town_size 240" in result.output


@pytest.mark.slow
def test_resume_makes_what_is_missing_with_the_same_bytes(data: Path) -> None:
    before = contents(data)
    for folder in [*data.glob("*/*/c")]:
        shutil.rmtree(folder)
    (data / "contact-sheet.png").unlink()
    result = completed("simulate", data, "--resume", "--workers", 1)
    assert "2 samples: about" in result.output
    assert "with 1 worker (" in result.output
    assert contents(data) == before


@each("words, description", [
        ((), "give a folder for the dataset, or --preview"),
        (("--resume",), "need the dataset's folder"),
        (("--export", "x", "--preview", "x.png"), "need the dataset's folder"),
        (("{data}",), "contains a dataset already; give --resume"),
        (("{data}", "--resume", "--seed", 2), "begun with seed = 1, got 2"),
        (("{data}", "--resume", "--lidar", "os1-64"), "begun with mounts = 1 x hdl-32e, got 1 x os1-64"),
        (("{new}", "--resume"), "no dataset to resume"),
        (("{other}", "--samples", 1), "holds other files"),
        (("{new}", "--samples", 0), "would be empty"),
        (("{new}", "--samples", 1, "--workers", 0), "workers must be in 1 ..."),
        (("--preview", "{new}.jpg"), "must end in .png"),
        (("{file}", "--samples", 1), "is a file"),
        (("{new}", "--samples", 2_000_000, "--workers", 1), "must be in 0 ... 1,000,000"),
        (("--preview", "{new}.png", "--lidar", "vlp-99"), "unknown lidar 'vlp-99'"),
        (("--preview", "{new}/x.png"), "there is no folder"),
        (("{new}", "--samples", 1, "--export", "{file}"), "is a file"),
    ])  # fmt: skip
def test_errors_are_one_line_and_exit_code_2(data: Path, tmp_path: Path, words: tuple, description: str) -> None:
    other, file = tmp_path / "other", tmp_path / "file"
    other.mkdir()
    (other / "thesis.tex").write_text("dear")
    file.write_text("x")
    names = {"data": data, "new": tmp_path / "new", "other": other, "file": file}
    before = contents(data)
    result = refused_command(description, "simulate", *(str(word).format(**names) for word in words))
    assert sum(line.startswith("ogm: ") for line in result.output.splitlines()) == 1
    assert contents(data) == before
    assert [path.name for path in other.iterdir()] == ["thesis.tex"]


def test_another_version_and_damage_are_reported(data: Path, tmp_path: Path) -> None:
    old, hurt = tmp_path / "old", tmp_path / "hurt"
    shutil.copytree(data, old)
    (old / "zarr.json").write_text((old / "zarr.json").read_text().replace(FORMAT, "ogm.samples/0"))
    for words in (("info", old), ("simulate", old, "--resume")):
        refused_command("has the format ogm.samples/0, this version of ogm reads", *words)
    shutil.copytree(data, hurt)
    file = hurt / "training/truth/c/0/0/0"
    file.write_bytes(file.read_bytes()[:-30])
    result = refused_command("sample 0 of training", "simulate", hurt, "--resume", "--workers", 1)
    assert f"rm {hurt}/training/facts/c/0/0" in result.output.replace("\n", "")


def test_one_process_makes_a_data_set_at_a_time(tmp_path: Path) -> None:
    with locked(tmp_path):
        result = ogm("simulate", tmp_path, *TINY)
    assert result.exit_code == 2
    assert "another process is writing to this folder" in result.output
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_an_interrupt_names_how_to_go_on(tmp_path: Path) -> None:
    # More samples than are made before the signal comes, however busy the machine
    many = ("--samples", 20, *TINY[2:], "--workers", 1)
    words = [sys.executable, "-m", "ogm.cli", "simulate", str(tmp_path / "data"), *map(str, many)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, env=os.environ | {"COLUMNS": "200"}) as child:
        while not (tmp_path / "data" / "zarr.json").exists():
            time.sleep(0.05)
            assert child.poll() is None
        time.sleep(0.5)
        child.send_signal(signal.SIGINT)
        _, message = child.communicate(timeout=60)
    assert child.returncode == 130
    assert f"`ogm simulate {tmp_path / 'data'} --resume` continues" in message.replace("\n", " ")
    assert "Traceback" not in message


@pytest.mark.slow
def test_a_recipe_is_named_in_the_data_set_and_goes_on_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(RECIPES, "gen2", replace(RECIPES["gen2"], town_size=240.0))
    sizes = ("--samples", 1, "--validation", 0, "--workers", 1)
    completed("simulate", tmp_path / "data", "--recipe", "gen2", "--seed", 5, *sizes)
    assert ogm("simulate", tmp_path / "data", "--resume", "--samples", 2, "--workers", 1).exit_code == 0
    store = Store.open(tmp_path / "data")
    assert store.format == GAPS
    assert store.plan["recipe"] == "gen2"
    assert store["training"].finished.tolist() == [0, 1]
    assert store["training"][1].measured is not None
    assert "ogm.samples/4" in ogm("info", tmp_path / "data").output


@pytest.mark.slow
def test_preview_draws_a_sample_and_its_town(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("_from_the_air", "_from_behind"):  # the same views with fewer pixels
        camera = getattr(studio, name)
        smaller = functools.partial(lambda here, made: made(here)._replace(width=360, height=200), made=camera)
        monkeypatch.setattr(studio, name, smaller)
    completed("simulate", "--preview", tmp_path / "p.png", "--town-size", 240, "--lidar", "hdl-32e")
    assert (tmp_path / "p.png").stat().st_size > 50_000
    town = np.asarray(Image.open(tmp_path / "p-town.png"))
    assert town.shape[0] < 2 * 200 + 150  # two views below each other, and their titles
    for view in (town[60:180], town[-180:-60]):
        assert len(np.unique(view.reshape(-1, 3), axis=0)) > 500
