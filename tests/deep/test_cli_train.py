"""``ogm train``, as a person uses it."""

import csv
import json
from pathlib import Path
from typing import get_args

import pytest
import torch
from commands import completed, ogm, refused_command

from ogm.deep import DeepISM
from ogm.scan import Mount

EXTENT = ("--length", 30.72, "--width", 20.48, "--resolution", 0.64)
SMALL = (*EXTENT, "--workers", 0, "--accelerator", "cpu", "--batch", 4)
pytestmark = pytest.mark.usefixtures("one_thread")


def test_train_writes_weights_that_can_be_used(store: Path, frames: list, tmp_path: Path) -> None:
    run = tmp_path / "run"
    completed("train", store, "--out", run, "--epochs", 2, "--samples", 8, *SMALL)
    assert {file.name for file in run.iterdir()} == {
        *("best.json", "best.safetensors", "epoch-001.png", "epoch-002.png", "log.csv", "state.pt")
    }
    with open(run / "log.csv") as file:
        assert [row["epoch"] for row in csv.DictReader(file)] == ["1", "2"]
    description = json.loads((run / "best.json").read_text())
    assert {name: part["frames"] for name, part in description["data"].items()} == {"training": 8, "validation": 10}
    assert description["seen"]["height"] == [1.8, 1.8]
    assert description["recipe"]["batch"] == 4
    assert DeepISM.load(run, mount=Mount(1.8))(frames[0].scan).spec.shape == (48, 32)


def test_an_interrupted_run_is_saved_and_resumes(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ogm.deep import training_run

    steps = []

    def loss(*args: object) -> torch.Tensor:
        steps.append(1)
        if len(steps) == 2:
            raise KeyboardInterrupt
        return kept(*args)

    kept = training_run.mean_loss
    monkeypatch.setattr(training_run, "mean_loss", loss)
    arguments = ("train", store, "--out", tmp_path / "run", "--epochs", 1, *SMALL)
    result = ogm(*arguments)
    assert result.exit_code == 130
    assert "--resume" in result.output
    assert torch.load(tmp_path / "run" / "state.pt", weights_only=True)["step"] == 1
    refused_command("--resume", *arguments)
    assert ogm(*arguments, "--resume").exit_code == 0


def test_missing_data_and_bad_grids_are_refused(store: Path, tmp_path: Path) -> None:
    refused_command("there is no", "train", tmp_path / "nothing", "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()
    refused_command("--samples must be 1 to 10", "train", store, "--out", tmp_path / "run", "--samples", 11)
    result = ogm("train", store, "--out", tmp_path / "run", "--length", 30.08, "--width", 20.48, "--resolution", 0.64)
    assert result.exit_code == 2
    assert "multiples of 16 cells" in result.output


def test_the_command_offers_every_loss_and_preset() -> None:
    from ogm.cli.train_command import LossName, Preset
    from ogm.deep.recipe import LOSSES, PRESETS

    assert get_args(LossName) == tuple(LOSSES)
    assert get_args(Preset) == tuple(PRESETS)
