import csv
import math
import pickle
import resource
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import each, fail_call, refused
from lightning.fabric import Fabric

from ogm.deep import losses
from ogm.deep.checkpoint import load_network
from ogm.deep.data import Batch, PillarDataset
from ogm.deep.network import PAPER
from ogm.deep.recipe import LOSSES, PAPER_RECIPE, Recipe, mean_loss
from ogm.deep.training_loop import make_loader, validate
from ogm.deep.training_run import TrainingRun, nonfinite_loss_error
from ogm.evidence import evidence_to_mass
from ogm.state import CellState, predict_state
from ogm.storage.locks import locked

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def recipe(tiny):
    return Recipe(tiny, epochs=2, batch=4, warmup=2, learning_rate=1e-2, average=0.5)


@pytest.fixture
def go(frames, small, recipe, tmp_path):
    from ogm.deep.training import train

    def run(out="run", training=frames[:8], validation=frames[8:], **options):
        fixed = {"workers": 0, "accelerator": "cpu", "progress": False, "picture_every": 0, "recipe": recipe}
        options = fixed | options
        return train(training, validation, small, tmp_path / out, **options)

    return run


def curve(folder):
    with open(folder / "log.csv") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def test_training_learns(go, recipe, tmp_path):
    path = go(recipe=replace(recipe, epochs=24), picture_every=24)
    rows = curve(tmp_path / "run")
    assert [row["epoch"] for row in rows] == list(range(1, 25))
    assert rows[-1]["loss"] < 0.5 * rows[0]["loss"]
    assert rows[-1]["free"] > 0.75
    network, description = load_network(path)
    assert description["result"]["validation"]["loss"] == pytest.approx(min(row["loss"] for row in rows), rel=1e-4)
    assert description["recipe"]["learning_rate"] == 1e-2
    assert (tmp_path / "run" / "epoch-024.png").stat().st_size > 10_000


class Interrupted(list):
    """Frames of which reading the n-th is interrupted."""

    def __init__(self, frames, reads):
        super().__init__(frames)
        self.left = reads

    def __getitem__(self, i):
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return super().__getitem__(i)


def test_a_resumed_run_ends_as_one_that_was_not_stopped(go, recipe, frames, tmp_path):
    recipe = replace(recipe, network=replace(recipe.network, dropout=0.1))
    whole = go("whole", recipe=recipe)
    with pytest.raises(KeyboardInterrupt):
        go("stopped", recipe=recipe, training=Interrupted(frames[:8], 13))  # in the second epoch
    stopped = go("stopped", recipe=recipe, resume=True)
    for name, value in torch.load(tmp_path / "whole" / "state.pt", weights_only=True)["network"].items():
        other = torch.load(tmp_path / "stopped" / "state.pt", weights_only=True)["network"][name]
        assert value.equal(other), name
    assert whole.read_bytes() == stopped.read_bytes()


def test_an_interrupt_within_a_step_changes_nothing(go, tmp_path, monkeypatch):
    """The forward pass has changed the statistics of the batch norms when the backward pass is interrupted."""
    from lightning.fabric import Fabric

    whole = go("whole")
    with monkeypatch.context() as patch:
        fail_call(patch, Fabric, "backward", 3)
        with pytest.raises(KeyboardInterrupt):
            go("stopped")
    assert go("stopped", resume=True).read_bytes() == whole.read_bytes()


def test_a_full_disk_under_the_state_is_an_error_that_names_it(go, tmp_path):
    """As in test_faults: files grow to a size only. torch would hide the error behind one of its own."""
    size = go("whole").stat().st_size
    assert (tmp_path / "whole" / "state.pt").stat().st_size > 2 * size
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2 * size, before[1]))
    try:
        refused(r"state\.pt", go, "full", error=OSError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert not (tmp_path / "full" / "state.pt").exists()


@pytest.mark.parametrize("epoch", [1, 2])
def test_a_run_that_is_killed_between_the_record_and_the_state_of_an_epoch(go, tmp_path, monkeypatch, epoch):
    go("whole")
    from ogm.deep.training_run import TrainingRun

    save = TrainingRun.save
    with monkeypatch.context() as patch:  # what stands on disk then is what a kill leaves
        patch.setattr(TrainingRun, "save", lambda run: save(run) if run.epoch < epoch else sys.exit(9))
        with pytest.raises(SystemExit):
            go("killed")
    assert len(curve(tmp_path / "killed")) == epoch
    assert (tmp_path / "killed" / "state.pt").exists() == (epoch == 2)
    go("killed", resume=True)
    speedless = [[{k: v for k, v in row.items() if k != "samples_per_s"} for row in curve(tmp_path / name)]
                 for name in ("whole", "killed")]  # fmt: skip
    assert speedless[0] == speedless[1]
    for name in ("best.safetensors", "best.json"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_only_one_process_trains_in_a_folder(go, tmp_path):
    (tmp_path / "run").mkdir()
    with locked(tmp_path / "run"), pytest.raises(BlockingIOError, match="another process is writing"):
        go(resume=True)
    go(resume=True)


@pytest.mark.slow
def test_workers_change_nothing(go):
    assert go("none").read_bytes() == go("two", workers=2).read_bytes()


def test_a_run_is_not_overwritten(go):
    go()
    refused("`resume`", go)


def test_another_recipe_or_data_does_not_resume(go, recipe, frames):
    go()
    refused("another recipe", go, resume=True, recipe=replace(recipe, weight_decay=0.5))
    refused("another frames", go, resume=True, training=frames[:7])


def test_a_run_goes_on_with_another_learning_rate(go, recipe, frames, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        go(training=Interrupted(frames[:8], 13))
    go(resume=True, recipe=replace(recipe, learning_rate=1e-4))
    assert len(curve(tmp_path / "run")) == 2


def test_an_epoch_is_validated_even_if_its_validation_was_interrupted(go, monkeypatch, tmp_path):
    from ogm.deep import training_loop as module

    def stop(*_):
        raise KeyboardInterrupt

    whole = go("whole")
    with monkeypatch.context() as patch:
        patch.setattr(module, "validate", stop)
        with pytest.raises(KeyboardInterrupt):
            go("stopped")
    assert go("stopped", resume=True).read_bytes() == whole.read_bytes()
    assert [row["epoch"] for row in curve(tmp_path / "stopped")] == [1, 2]


def test_a_hostile_state_is_not_unpickled(go, tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "owned"), "w"))

    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "state.pt").write_bytes(pickle.dumps({"recipe": Evil()}))
    refused("cannot resume", go, resume=True)
    assert not (tmp_path / "owned").exists()


def test_a_loss_that_is_not_finite_stops_and_keeps_the_batch(go, recipe, tmp_path):
    with pytest.raises(FloatingPointError, match="batch"):
        go(recipe=replace(recipe, epochs=9, learning_rate=1e30, clip=math.inf, warmup=0))
    (kept,) = (tmp_path / "run").glob("batch-*.npz")
    with np.load(kept, allow_pickle=False) as batch:
        assert batch["features"].shape[1] == 9
        assert len(batch["numbers"]) == 4


def test_a_gradient_that_is_not_finite_changes_nothing(frames, small, recipe, tmp_path, monkeypatch):
    run = TrainingRun(Fabric(accelerator="cpu", devices=1, precision="32-true"), recipe, small, tmp_path, 8, 4)
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    monkeypatch.setattr(run.fabric, "clip_gradients", lambda *_, **__: torch.tensor(math.inf))
    with pytest.raises(FloatingPointError, match="gradient became inf at step 0"):
        run.do_step(Batch.joined([one for one in PillarDataset(frames[:4], small)]))
    for name, value in run.network.state_dict().items():
        torch.testing.assert_close(value, before[name], rtol=0, atol=0, msg=name)


def test_only_the_process_whose_loss_it_was_keeps_its_batch(frames, small, tmp_path):
    batch = PillarDataset(frames, small)[0]
    assert "another process" in str(nonfinite_loss_error(tmp_path, batch, 0.5, 3))
    assert not list(tmp_path.iterdir())
    assert "nan" in str(nonfinite_loss_error(tmp_path, batch, math.nan, 3))
    assert [file.name for file in tmp_path.iterdir()] == ["batch-3.npz"]


def test_the_error_for_too_little_memory_has_the_way_out(go, monkeypatch):
    def full(*_):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("ogm.deep.training_run.mean_loss", full)
    refused("`batch`", go, error=MemoryError)


def test_validation_in_batches_equals_a_loop_over_frames(frames, small, tiny):
    cpu, recipe = torch.device("cpu"), Recipe(tiny, loss="log", occupied_weight=3.0)
    torch.manual_seed(3)
    network, data = tiny.build(small).eval(), PillarDataset(frames[:7], small)
    found = validate(network, make_loader(data, range(7), 4, 0, cpu), recipe, cpu)
    sums, table = np.zeros(3), np.zeros((3, 3))
    for one in data:
        with torch.no_grad():
            evidence, count = network(one.pillars), int((one.state != CellState.IGNORE).sum())
            target, valid = losses.targets(one.state)
            kl = losses.reverse_kl(evidence, target, recipe.strength)[valid].mean()
            sums += count * float(mean_loss(evidence, one.state, recipe, math.inf)), count * float(kl), count
        np.add.at(table, (one.state[valid].numpy(), predict_state(evidence_to_mass(evidence.numpy()))[valid]), 1)
    assert (table.sum(axis=0) > 0).sum() > 1
    iou = np.diag(table) / (table.sum(0) + table.sum(1) - np.diag(table))
    np.testing.assert_allclose(found, [*sums[:2] / sums[2], *iou[1:]], rtol=1e-5)


def test_the_average_follows_the_weights(frames, small, recipe, tmp_path):
    fabric = Fabric(accelerator="cpu", devices=1, precision="32-true")
    run = TrainingRun(fabric, recipe, small, tmp_path, 8, 4)
    batch = Batch.joined([one for one in PillarDataset(frames[:4], small)])
    want = {name: value.clone() for name, value in run.average.state_dict().items()}
    for step in range(1, 4):
        run.do_step(batch)
        kept = min(recipe.average, step / (step + 10))
        for name, value in run.network.state_dict().items():
            want[name] = kept * want[name] + (1 - kept) * value
    for name, value in run.average.state_dict().items():
        if value.is_floating_point():
            np.testing.assert_allclose(value, want[name], rtol=1e-5, atol=1e-6, err_msg=name)


def test_every_loss_and_the_published_recipe_can_be_trained_with(go, recipe, tmp_path):
    small = replace(PAPER, pillar=8, blocks=((8, 1), (8, 1), (8, 1)), up=8, evidence="relu")
    recipes = {loss: replace(recipe, epochs=1, loss=loss, uniform_kl=0.1) for loss in LOSSES}
    for name, one in (recipes | {"paper": replace(PAPER_RECIPE, network=small, epochs=1, batch=4)}).items():
        go(name, recipe=one)
        assert np.isfinite(curve(tmp_path / name)[0]["loss"]), name


@each("change, match", [
        ({"loss": "hinge"}, "loss must be one of"),
        ({"epochs": 0}, "epochs"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"batch": 9}, "fewer than one batch"),
    ])  # fmt: skip
def test_recipes_out_of_range_are_refused(go, recipe, change, match):
    refused(match, go, recipe=replace(recipe, **change))


def test_weights_are_not_chosen_without_validation(go):
    refused("validation", go, validation=[])
