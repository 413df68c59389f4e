"""Evaluation by several processes: the files of one, whoever is killed."""

import os
import pickle
import signal
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused

from ogm.evaluation import FusedMethod, SingleScanMethod, evaluate
from ogm.fusion import EvidentialMapper
from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics import METRICS
from ogm.models import load_model
from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan, run_model
from ogm.state import Truth
from ogm.storage import workers

SPEC = GridSpec.centered(length=7, width=7, resolution=1)


@dataclass(frozen=True)
class Drives(Sequence[Frame]):
    """Frames of some drives, which are numbers, so that they may go to other processes."""

    drives: int = 3
    each: int = 5

    def __len__(self) -> int:
        return self.drives * self.each

    def __getitem__(self, k: Any) -> Any:
        if not 0 <= k < len(self):
            raise IndexError(k)
        rng = np.random.default_rng(k)
        scan = Scan(np.concatenate([[[k, 0, 0, 0]], rng.random((20, 4))]).astype(np.float32))
        truth = Truth(SPEC, rng.choice(4, SPEC.shape, p=[0.4, 0.3, 0.2, 0.1]).astype(np.uint8))
        place = {"T_map_sensor": pose(0.3 * (k % self.each)), "stamp": 0.1 * k}
        return Frame(scan, Mount(1.5, pose(z=1.5)), None, truth, name=f"{k}", sequence=f"{k // self.each}", **place)


@dataclass(frozen=True)
class Random:
    """A model whose grid follows from the number of the frame; at one number its process is killed, or waits, once."""

    marker: str = field(default="", repr=False)  # not part of what the results depend on
    at: int = field(default=-1, repr=False)
    waits: bool = field(default=False, repr=False)
    spec: GridSpec = SPEC

    def __call__(self, scan: Scan) -> EvidentialGrid:
        k = int(scan.points[0, 0])
        if k == self.at and not os.path.exists(self.marker):
            Path(self.marker).write_text(str(os.getpid()))
            if self.waits:
                time.sleep(600)
            os.kill(os.getpid(), signal.SIGKILL)
        mass = np.random.default_rng((k, 1)).dirichlet((1, 1, 1), SPEC.shape)[..., :2]
        return EvidentialGrid(SPEC, mass.astype(np.float32))


def drawn(points: Any, state: Any, masses: Any, spec: Any, ground_z: Any) -> dict[str, bytes]:
    return {"truth": state.tobytes()}


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "frames").iterdir() if path.suffix == ".npz"}


def methods(model: Random = Random(), fused: bool = False) -> dict[str, Any]:  # noqa: B008
    found: dict[str, Any] = {"scans": SingleScanMethod(model)}
    return found | ({"map": FusedMethod(model, partial(EvidentialMapper, SPEC))} if fused else {})


@pytest.mark.slow
@pytest.mark.parametrize("fused", [False, True])
def test_two_workers_give_the_files_of_one_though_one_is_killed(tmp_path: Path, fused: bool) -> None:
    (tmp_path / "one").mkdir()
    shown: list[int] = []

    def show(numbers: Any) -> Any:
        for number in numbers:
            shown.append(number)
            yield number

    one = evaluate(methods(fused=fused), Drives(), SPEC, out=tmp_path / "one", draw=drawn)
    dies = methods(Random(str(tmp_path / "died"), 7), fused)
    options: Any = {"progress": show, "draw": drawn, "workers": 2}
    two = evaluate(dies, Drives(), SPEC, out=tmp_path / "two", **options)
    assert (tmp_path / "died").exists()
    assert sorted(shown) == list(range(15))
    for name in one.methods:
        for metric in METRICS:
            np.testing.assert_array_equal(one.of(name, metric), two.of(name, metric))
    assert files(tmp_path / "two") == files(tmp_path / "one")
    again = evaluate(methods(fused=fused), Drives(), SPEC, out=tmp_path / "two", draw=drawn)
    assert again.reused == 15  # by one process what two have made


@pytest.mark.slow
def test_without_a_folder_the_results_come_in_order() -> None:
    one = evaluate(methods(), Drives(), SPEC, frames=range(2, 15, 3))
    two = evaluate(methods(), Drives(), SPEC, frames=range(2, 15, 3), workers=2)
    np.testing.assert_array_equal(one.of("scans", "nll"), two.of("scans", "nll"))
    assert one.frames == two.frames


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from distributed import LocalCluster

    monkeypatch.chdir(tmp_path)  # the workers are elsewhere
    evaluate(methods(fused=True), Drives(), SPEC, out="one", draw=drawn)
    with LocalCluster(n_workers=2, threads_per_worker=2, dashboard_address=None) as cluster:
        evaluate(methods(fused=True), Drives(), SPEC, out="two", draw=drawn, scheduler=cluster.scheduler_address)
    assert files(tmp_path / "one") == files(tmp_path / "two")


@pytest.mark.slow
def test_an_interrupt_keeps_what_is_finished(tmp_path: Path) -> None:
    marker = tmp_path / "waits"

    def interrupt() -> None:
        while not (marker.exists() and marker.read_text()) or len(files(tmp_path / "two")) < 3:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    waits = methods(Random(str(marker), 7, waits=True))
    with pytest.raises(KeyboardInterrupt, match=r"\d+ of 15 frames are finished and kept"):
        evaluate(waits, Drives(), SPEC, out=tmp_path / "two", draw=drawn, workers=2)
    kept = len(files(tmp_path / "two"))
    assert kept >= 3
    assert not [path for path in (tmp_path / "two" / "frames").iterdir() if path.name.startswith(".")]
    result = evaluate(waits, Drives(), SPEC, out=tmp_path / "two", draw=drawn)
    assert result.reused == kept


def test_workers_that_die_again_and_again_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def dies(*_: Any) -> Any:
        raise workers.BrokenExecutor
        yield

    assert issubclass(workers.BrokenExecutor, RuntimeError)
    monkeypatch.setattr("ogm.evaluation.tasks.work_off", dies)
    monkeypatch.setattr(workers, "DEATH_ERRORS", ("BrokenExecutor",))
    with pytest.raises(OSError, match="workers died .* finished frames are kept"):
        evaluate(methods(), Drives(), SPEC, workers=2)


class Unpicklable(Random):
    def __reduce__(self) -> Any:
        raise TypeError("never")


def test_what_cannot_go_to_other_processes_is_refused() -> None:
    refused("must be picklable", evaluate, {"mine": Unpicklable()}, Drives(), SPEC, error=TypeError, workers=2)


@each("name", ["ray", "height-band-released", "radar", "ray+radar", "combined+radar"])
def test_models_by_name_go_to_other_processes(name: str) -> None:
    spec = GridSpec.centered(length=20.48, width=20.48, resolution=0.16)
    model = load_model(name, spec, drop_ego_returns=True)
    again = pickle.loads(pickle.dumps([model, model]))
    assert again[0] is again[1]
    scan = Scan(np.random.default_rng(0).uniform(-8, 8, (50, 4)).astype(np.float32) * [1, 1, 0.1, 0])
    frame = Frame(scan, Mount(1.6, pose(z=1.6)), None, None)
    np.testing.assert_array_equal(run_model(again[0], frame).mass, run_model(model, frame).mass)
