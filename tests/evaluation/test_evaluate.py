"""`evaluate` with own models and frames in Python."""

import dataclasses
import io
import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused

from ogm import evidence
from ogm.evaluation import (
    FusedMethod,
    MethodRunner,
    PrecomputedGrids,
    SingleScanMethod,
    evaluate,
    evaluate_agreement,
    write_report,
)
from ogm.evaluation.cache import ResultCache
from ogm.fusion import EvidentialMapper, PoseJump
from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics import METRICS, accumulate, score
from ogm.models.named import MODELS, load_model, short_names
from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan
from ogm.state import CellState, Truth

SPEC = GridSpec.centered(length=7, width=7, resolution=1)
WIDE = GridSpec.centered(length=9, width=9, resolution=1)


@dataclass
class Flat:
    """A model: all cells are free, with a mass that grows with the points and the sensor's height."""

    spec: GridSpec = SPEC
    height: float = 1.0
    scans: list[Scan] = field(default_factory=list, repr=False)

    def __call__(self, scan: Scan) -> EvidentialGrid:
        self.scans.append(scan)
        mass = np.zeros((*self.spec.shape, 2), np.float32)
        mass[..., 0] = len(scan) * self.height / 100
        return EvidentialGrid(self.spec, mass)


def truth(seed: int) -> Truth:
    states = np.random.default_rng(seed).choice(4, WIDE.shape, p=[0.4, 0.3, 0.2, 0.1])
    return Truth(WIDE, states.astype(np.uint8))


def frame(k: int, height: float = 1.0, x: float | None = None) -> Frame:
    """Return a frame of 10 (k + 1) points and one beam without echo; with x [m], one of a drive."""
    scan = Scan(np.zeros((10 * (k + 1), 4), np.float32), no_returns=np.array([[1, 0, 0]], np.float32))
    place = {} if x is None else {"T_map_sensor": pose(x), "stamp": 0.1 * k, "sequence": "drive"}
    return Frame(scan, Mount(height, pose(z=height)), None, truth(k), name=f"frame {k}", **place)


FRAMES = [frame(0), frame(1, 2.0), frame(2)]


def test_every_method_has_every_metric_in_every_frame() -> None:
    result = evaluate({"flat": Flat(), "high": Flat(height=3.0)}, FRAMES, SPEC)
    assert (result.methods, result.spec) == (("flat", "high"), SPEC)
    assert [one.name for one in result.frames] == ["frame 0", "frame 1", "frame 2"]
    for k, one in enumerate(FRAMES):
        state = one.truth.crop(SPEC).state
        expected = score(accumulate(Flat(height=3.0)(one.scan).mass, state))
        assert {m: result.of("high", m)[k] for m in METRICS} == pytest.approx(expected, nan_ok=True)
        np.testing.assert_allclose(result.truth[k], np.bincount(state.ravel(), minlength=4) / 49)
    np.testing.assert_allclose(result.of("flat", "mean_free"), [0.1, 0.2, 0.3], rtol=1e-6)
    assert result.macro("flat")["mean_free"] == pytest.approx(0.2)
    known = 1 - result.truth[:, 3]
    assert result.micro("flat")["mean_free"] == pytest.approx(result.of("flat", "mean_free") @ known / known.sum())


def test_a_table_has_means_of_methods_and_leaves_out_rows_without_a_value() -> None:
    result = evaluate({"flat": Flat(), "high": Flat(height=3.0)}, FRAMES, SPEC)
    table = result.table()
    assert list(table) == ["flat", "high"]
    assert table["high"] == pytest.approx(result.macro("high"), nan_ok=True)
    missing = sum(np.isnan([one[metric] for one in table.values()]).all() for metric in METRICS)
    assert missing > 0
    lines = str(result).splitlines()
    assert lines[-1] == f"({missing} metrics without a value in these frames)"
    assert len(lines) == 2 + len(METRICS) - missing


@dataclass
class Drawn:
    """A model with random masses; of another seed in every scan."""

    spec: GridSpec = SPEC
    seed: int = 0

    def __call__(self, scan: Scan) -> EvidentialGrid:
        rng = np.random.default_rng([self.seed, len(scan)])
        return EvidentialGrid(self.spec, rng.dirichlet([1, 1, 1], self.spec.shape)[..., :2].astype(np.float32))


def test_methods_are_compared_with_each_other_without_truth() -> None:
    """Each metric by its definition, cell by cell; the reverse of a pair is the pair reversed."""
    frames = [dataclasses.replace(one, truth=None) for one in FRAMES]
    methods = {"a": Drawn(), "b": Drawn(seed=1), "unknown": Flat(height=0.0)}
    result = evaluate_agreement(methods, frames, SPEC)
    assert result.pairs == (("a", "b"), ("a", "unknown"), ("b", "unknown"))
    for k, one in enumerate(frames):
        a, b = (methods[name](one.scan).mass.reshape(-1, 2).astype(float) for name in ("a", "b"))
        alphas = [2 * mass / (1 - mass.sum(-1, keepdims=True)) + 1 for mass in (a, b)]
        expected = {
            "conflict": np.mean(a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0]),
            "kl": evidence.dirichlet_kl(*alphas).mean(),
            "kl_reverse": evidence.dirichlet_kl(*alphas[::-1]).mean(),
        }
        states = [np.where(m.max(-1) > 1 - m.sum(-1), 1 + m.argmax(-1), 0) for m in (a, b)]
        known = np.maximum(*states) > 0
        expected["agreement"] = (states[0] == states[1])[known].mean()
        assert {name: rows[0, k] for name, rows in result.values.items()} == pytest.approx(expected, rel=1e-4)
    assert result.interval("b", "a", "kl").value == pytest.approx(result.values["kl_reverse"][0].mean())
    assert result.table()["a, unknown"]["agreement"] == 0
    assert "a, b" in str(result)
    same = evaluate_agreement({"a": Drawn(), "again": Drawn()}, frames, SPEC, frames=[1]).table()["a, again"]
    assert (same["agreement"], same["kl"], same["kl_reverse"]) == (1, 0, 0)
    nothing = evaluate_agreement({"a": Flat(height=0.0), "b": Flat(height=0.0)}, frames, SPEC)
    assert np.isnan(nothing.values["agreement"]).all()
    refused("two or more, .*, got a", evaluate_agreement, {"a": Drawn()}, frames, SPEC)
    refused("evaluate_agreement", evaluate, {"a": Drawn()}, frames, SPEC)


def test_maps_are_compared_with_each_other_after_the_frames_before() -> None:
    drive = [dataclasses.replace(frame(k, x=float(k)), truth=None) for k in range(3)]
    model = Flat()
    fused = FusedMethod(model, lambda: EvidentialMapper(WIDE, half_life=float("inf"), max_speed=float("inf")))
    found = evaluate_agreement({"scan": SingleScanMethod(model), "map": fused}, drive, SPEC, frames=[2])
    assert len(model.scans) == 3
    assert found.values["kl"].shape == (1, 1)


def test_methods_may_be_a_list_of_names() -> None:
    frames = [dataclasses.replace(FRAMES[0], truth=truth(0))]
    found = evaluate(["height-band"], frames, SPEC)
    assert found.methods == ("height-band",)
    refused("a dict from name to method, or a list of names of models", evaluate, "ray", frames, SPEC, error=TypeError)
    refused("a dict from name to method", evaluate, [Flat()], frames, SPEC, error=TypeError)


def test_methods_are_compared_frame_by_frame() -> None:
    result = evaluate({"flat": Flat(), "high": Flat(height=3.0)}, FRAMES, SPEC)
    compared = result.compare("high", "flat")
    assert set(compared) == {name for name, metric in METRICS.items() if metric.better}
    one = compared["false_free"]
    assert (one.wins, one.ties, one.losses) == (0, 1, 2)
    assert result.interval("high", "kl_e10").value == result.macro("high")["kl_e10"]
    assert result.select(["high"]).macro("high") == pytest.approx(result.macro("high"), nan_ok=True)
    refused("no method 'deep', only flat, high", result.of, "deep", "ece", error=KeyError)
    refused("no metric 'iou'", result.of, "flat", "iou", error=KeyError)


def test_beams_without_echo_reach_every_model() -> None:
    model = Flat()
    evaluate({"mine": model}, FRAMES, SPEC)
    assert all(scan.no_returns is not None for scan in model.scans)


@dataclass
class High(Flat):
    """`Flat`, whose mass grows with the height of the scan's mount."""

    def __call__(self, scan: Scan) -> EvidentialGrid:
        self.height = scan.mount.sensor_height
        return super().__call__(scan)


def test_models_see_the_mount_of_each_frame() -> None:
    result = evaluate({"flat": High()}, FRAMES, SPEC)
    np.testing.assert_allclose(result.of("flat", "mean_free"), [0.1, 0.4, 0.3], rtol=1e-6)


def test_a_scan_is_mapped_once_for_a_model_and_its_maps() -> None:
    model, drive = Flat(), [frame(k, x=0.1 * k) for k in range(4)]
    fused = FusedMethod(model, lambda: EvidentialMapper(SPEC))
    result = evaluate({"flat": model, "map": fused}, drive, SPEC, frames=[1, 3])
    assert len(model.scans) == len(drive)
    mapper = EvidentialMapper(SPEC)
    for one in drive:
        mapper.update(Flat()(one.scan), one.T_map_sensor, stamp=one.stamp)
    expected = float(mapper.view(SPEC).free[drive[3].truth.crop(SPEC).state != CellState.IGNORE].mean())
    assert result.of("map", "mean_free")[1] == pytest.approx(expected, rel=1e-5)


def test_a_map_begins_again_with_a_sequence_and_after_a_jump(caplog: pytest.LogCaptureFixture) -> None:
    fused = FusedMethod(Flat(), lambda: EvidentialMapper(SPEC))
    runner = MethodRunner({"map": fused}, SPEC)
    for k, x in enumerate((0.0, 0.1)):
        runner.update(frame(k, x=x))
    with pytest.raises(PoseJump):
        fused._mapper.update(EvidentialGrid.vacuous(SPEC), pose(900.0), stamp=0.2)
    one = frame(2, x=900.0)
    fresh = EvidentialMapper(SPEC)
    fresh.update(Flat()(one.scan), one.T_map_sensor, stamp=one.stamp)
    runner.update(one)
    np.testing.assert_array_equal(runner.grids()["map"].mass, fresh.view(SPEC).mass)
    assert "frame 2: the pose jumps; a new map begins" in caplog.text


def test_a_report_of_own_frames_and_an_own_model(tmp_path: Path) -> None:
    methods = {"mine": Flat(), "again": SingleScanMethod(Flat(height=2.0), "twice as high")}
    result = evaluate(methods, FRAMES, SPEC, out=tmp_path / "report")
    record = write_report(tmp_path / "report", result)
    assert record == json.loads((tmp_path / "report" / "report.json").read_text())
    assert record["methods"]["mine"]["description"] == "A sensor model in Python (Flat)."
    assert record["methods"]["again"]["description"] == "twice as high"
    found = {path.name for path in (tmp_path / "report").iterdir()}
    assert found == {"report.html", "report.json", "frames.csv", "metrics.png", "frames.png", "frames"}


def test_without_a_folder_nothing_is_kept_and_the_report_has_no_pictures(tmp_path: Path) -> None:
    result = evaluate({"mine": Flat()}, FRAMES, SPEC)
    write_report(tmp_path, result)
    assert 'id="pictures-' not in (tmp_path / "report.html").read_text()
    assert not (tmp_path / "frames.png").exists()


def test_a_finished_run_is_reused_for_the_same_model_only(tmp_path: Path) -> None:
    assert evaluate({"mine": Flat()}, FRAMES, SPEC, out=tmp_path).reused == 0
    again = Flat()
    assert evaluate({"mine": again}, FRAMES, SPEC, out=tmp_path).reused == 3
    assert again.scans == []
    assert evaluate({"mine": Flat(height=2.0)}, FRAMES, SPEC, out=tmp_path).reused == 0


def test_an_interrupted_run_counts_its_frames_and_resumes(tmp_path: Path) -> None:
    def interrupted(numbers: list[int]) -> Iterator[int]:
        yield from numbers[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="2 of 3 frames are finished and kept"):
        evaluate({"mine": Flat()}, FRAMES, SPEC, out=tmp_path, progress=interrupted)
    result = evaluate({"mine": Flat()}, FRAMES, SPEC, out=tmp_path)
    assert result.reused == 2
    whole = evaluate({"mine": Flat()}, FRAMES, SPEC)
    for metric in METRICS:
        np.testing.assert_array_equal(result.values[metric], whole.values[metric])


def test_a_repaired_model_is_not_scored_with_frames_of_the_broken_one(tmp_path: Path) -> None:
    """Also without a source file, as in a console."""
    names = {
        "SPEC": SPEC,
        "grid": lambda free: EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), (free, 0.0), np.float32)),
    }
    code = "class Mine:\n    spec = SPEC\n    def __call__(self, scan):\n        return grid({})"
    found = []
    for free in (0.25, 0.5):
        exec(code.format(free), names)
        result = evaluate({"mine": names["Mine"]()}, FRAMES, SPEC, out=tmp_path)
        found.append(result.macro("mine")["mean_free"])
    assert found == [0.25, 0.5]


def test_what_cannot_be_evaluated_is_refused() -> None:
    for methods, text in (
        ({}, "no methods to evaluate"),
        ({"mine": "rays"}, "there is no sensor model 'rays'"),
        ({"mine": Flat(WIDE)}, "the grid has 9 x 9 cells .*, wanted 7 x 7 cells"),
        ({"grids": PrecomputedGrids({})}, "there is no grid for frame 0 and 2 more of 3 frames"),
    ):
        refused(text, evaluate, methods, FRAMES, SPEC)
    mine = Flat()
    mine.__class__ = type("Mine", (Flat,), {"__call__": lambda self, scan: np.zeros((*SPEC.shape, 2))})
    refused("Mine returned ndarray, wanted an EvidentialGrid", evaluate, {"mine": mine}, FRAMES, SPEC, error=TypeError)
    refused(
        "mine must be a callable with a .spec", evaluate, {"mine": lambda scan: scan}, FRAMES, SPEC, error=TypeError
    )
    refused("`frames` must be numbers", evaluate, {"mine": Flat()}, [], SPEC)
    unlabelled = Frame(FRAMES[0].scan, FRAMES[0].mount, None, None, name="dark")
    refused("frame dark has no truth", evaluate, {"mine": Flat()}, [unlabelled], SPEC)
    fused = FusedMethod(Flat(), lambda: EvidentialMapper(SPEC))
    message = "map fuses sequences of frames .* but frame 0 has no sequence"
    refused(message, evaluate, {"map": fused}, FRAMES, SPEC)


# --- Models by name ---------------------------------------------------------------------------------


@each("name", MODELS)
def test_every_named_model_fills_the_area_of_the_grid(name: str) -> None:
    spec = GridSpec.centered(length=12.8, width=12.8, resolution=0.16)
    model = load_model(name, spec, Mount(1.7, pose(z=1.7)))
    grid = model(Scan(np.zeros((0, 4), np.float32)))
    assert grid.spec.extent == pytest.approx(spec.extent)
    assert (grid.mass == 0).all()


def test_the_released_model_refuses_what_it_cannot_do() -> None:
    name = "height-band-released"
    refused("even number of cells along x and y, got 7 x 7", load_model, name, SPEC)
    even = GridSpec.centered(length=8, width=8, resolution=1)
    refused("runs on the CPU only, got device='cuda'", load_model, name, even, device="cuda")
    model, message = load_model(name, even), "points in the frame of a level sensor and a grid around the sensor"
    for mount in (Mount(1.7, pose(1.0, z=1.7)), Mount(1.7, pose(z=1.7), points_in="vehicle")):
        refused(message, load_model, name, even, mount)
        refused(message, model, Scan(np.zeros((1, 4), np.float32), mount=mount))


def test_weights_have_short_names_that_differ() -> None:
    names = ["ray", "runs/a/best.safetensors", "runs/b/best.safetensors", "c.safetensors", "d/c.safetensors"]
    assert list(short_names(names)) == ["ray", "a", "b", "c", "d/c.safetensors"]
    refused("ray is given twice", short_names, ["ray", "ray"])


# --- Kept frames ------------------------------------------------------------------------------------

HEADERS = [
    b"\x93NUMPY\x01\x00\x06\x00{'a':\n",  # its text ends too early
    b"\x93NUMPY\x01\x00\x02\x00((",
    b"\x93NUMPY\x01\x00\x04\x00None",
    b"\x93NUMPY\x01\x00\x3a\x00" + b"{'descr': [1], 'fortran_order': False, 'shape': (1,)}     ",
    b"\x93NUMPY\x01\x00\x50\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}".ljust(80),
    b"",
]


@each("header", HEADERS)
def test_a_damaged_frame_is_missing(header: bytes, tmp_path: Path) -> None:
    cache = ResultCache(tmp_path, {"a": 1})
    key = io.BytesIO()
    np.save(key, np.array(cache.key))
    with zipfile.ZipFile(tmp_path / "000000.npz", "w") as archive:
        archive.writestr("key.npy", key.getvalue())
        for name in ("truth", "sums counts", "sums log_loss"):
            archive.writestr(f"{name}.npy", header)
    (tmp_path / "000001.npz").write_bytes(b"PK")
    assert cache.missing([0, 1, 2]) == [0, 1, 2]
