"""Fitting the parameters of a geometric model: `calibrate`, its file, and the command."""

import json
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from typer.testing import CliRunner

from ogm.calibration import calibrate
from ogm.calibration.fit import BOUNDS, FITTED
from ogm.calibration.likelihood import Likelihood
from ogm.calibration.search import Axis
from ogm.cli import app
from ogm.evaluation import evaluate
from ogm.geometric import HeightBandISM, RayISM
from ogm.grid import GridSpec
from ogm.models import Calibration, load_model
from ogm.models.fitted import default_parameters
from ogm.models.named import describe_model, short_names
from ogm.scan import Frame, Mount, Scan
from ogm.state import CellState, Truth

SPEC = GridSpec.centered(length=16, width=16, resolution=0.4)
MOUNT = Mount(1.8)
TRUE = {"p_miss": 0.7, "p_false_alarm": 0.2}
FIT = {name: BOUNDS[name] for name in TRUE}


def scan(seed: int) -> Scan:
    """Return a scan of a road, and of posts in front of some of its points."""
    rng = np.random.default_rng(seed)
    azimuth, near = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(2, 11, 6000)
    road = np.column_stack([near * np.cos(azimuth), near * np.sin(azimuth), np.full(6000, -1.8), np.zeros(6000)])
    posts = road[:600] * [0.6, 0.6, 0.0, 0.0] - [0, 0, 0.9, 0]
    return Scan(np.concatenate([road, posts]).astype(np.float32))


def frame(k: int, truth: Truth | None, sequence: str = "") -> Frame:
    return Frame(scan(k), MOUNT, None, truth, name=f"frame {k}", sequence=sequence)


def drawn_frames(count: int, drives: int) -> list[Frame]:
    """Return frames whose truth is drawn with the model's P(occupied), so that its parameters are the true ones."""
    model, frames = RayISM(SPEC, MOUNT, **TRUE), []
    for k in range(count):
        mass = model(scan(k)).mass.astype(np.float64)
        occupied = np.random.default_rng([1, k]).random(SPEC.shape) < 0.5 * (1 + mass[..., 1] - mass[..., 0])
        state = np.where(occupied, CellState.OCCUPIED, CellState.FREE)
        state[~mass.any(axis=-1)] = CellState.UNKNOWN
        frames.append(frame(k, Truth(SPEC, state.astype(np.uint8)), f"drive {k % drives}"))
    return frames


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return drawn_frames(24, drives=8)


@pytest.fixture(scope="module")
def fitted(frames: list[Frame]) -> Calibration:
    return calibrate(frames, "ray", SPEC, fit=FIT, base_rate=0.5)


# --- The fit ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_parameters_that_the_truth_was_drawn_with_are_found(fitted: Calibration) -> None:
    assert fitted.finished
    assert fitted.start == {name: default_parameters("ray")[name] for name in TRUE}
    for name, value in TRUE.items():
        error = fitted.errors[name]
        assert error is not None
        assert 0.003 < error < 0.05
        assert abs(fitted.parameters[name] - value) < 4 * error
        assert abs(fitted.parameters[name] - value) < abs(fitted.start[name] - value) / 2
    assert fitted.after["nll"] < fitted.before["nll"]
    assert (fitted.data["frames"], fitted.data["drives"]) == (24, 8)


@pytest.mark.slow
def test_no_parameters_nearby_are_likelier(frames: list[Frame], fitted: Calibration) -> None:
    likelihood = Likelihood("ray", frames, SPEC)
    least = likelihood(fitted.parameters).mean()
    assert least == pytest.approx(fitted.after["nll"], rel=1e-9)
    for name in TRUE:
        for step in (-0.03, 0.03):
            assert likelihood(fitted.parameters | {name: fitted.parameters[name] + step}).mean() > least


@pytest.mark.slow
def test_the_likelihood_is_the_metric_of_an_evaluation(frames: list[Frame]) -> None:
    """Each frame's NLL, its mean over the frames of each drive; drives need not be of one length."""
    some = frames[:11]
    result = evaluate({"ray": RayISM(SPEC, MOUNT, p_miss=0.6)}, some, SPEC)
    nll, drive = result.of("ray", "nll"), [one.sequence for one in some]
    expected = [
        np.mean([value for value, name in zip(nll, drive, strict=True) if name == f"drive {k}"]) for k in range(8)
    ]
    likelihood = Likelihood("ray", some, SPEC)
    np.testing.assert_allclose(likelihood({"p_miss": 0.6}), expected, rtol=1e-12)
    assert likelihood.scores({"p_miss": 0.6})["nll"] == pytest.approx(np.mean(expected))
    alone = Likelihood("ray", [frame(k, frames[k].truth) for k in range(3)], SPEC)
    np.testing.assert_allclose(alone({"p_miss": 0.6}), nll[:3], rtol=1e-12)


def test_a_base_rate_takes_the_place_of_one_half(frames: list[Frame]) -> None:
    mass, state = RayISM(SPEC, MOUNT)(frames[0].scan).mass.astype(np.float64), frames[0].truth.state
    known = state != CellState.UNKNOWN
    free, occupied = mass[known].T
    p = occupied + 0.1 * (1 - free - occupied)
    expected = -np.log(np.where(state[known] == CellState.OCCUPIED, p, 1 - p)).mean()
    one = Likelihood("ray", frames[:1], SPEC, base_rate=0.1)
    np.testing.assert_allclose(one({}), [expected], rtol=1e-6)
    share = (state[known] == CellState.OCCUPIED).mean()
    assert Likelihood("ray", frames[:1], SPEC, base_rate=None).base_rate == pytest.approx(share)


def test_threads_do_not_change_the_result(frames: list[Frame]) -> None:
    one, two = (Likelihood("ray", frames[:8], SPEC, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one(TRUE), two(TRUE))


def test_a_parameter_without_effect_keeps_its_value(frames: list[Frame]) -> None:
    """These scans have no beams without echo."""
    fit = {name: BOUNDS[name] for name in ("no_return_weight", "p_miss")}
    found = calibrate(frames[:5], "ray", SPEC, fit=fit)
    assert found.parameters["no_return_weight"] == found.start["no_return_weight"]
    assert found.errors["no_return_weight"] is None
    assert found.parameters["p_miss"] != found.start["p_miss"]
    assert found.data["frames"] == 5
    message = "no_return_weight have no effect on these frames"
    refused(message, calibrate, frames[:2], "ray", SPEC, fit={"no_return_weight": (0, 1)})


def test_few_drives_give_no_standard_errors(frames: list[Frame]) -> None:
    found = calibrate(frames[:3], "ray", SPEC, fit={"p_miss": BOUNDS["p_miss"]})
    assert (found.data["drives"], found.errors) == (3, {"p_miss": None})


def test_an_interrupt_keeps_the_best_parameters(frames: list[Frame]) -> None:
    seen = []

    def stop(evaluations: int, nll: float) -> None:
        seen.append(nll)
        if evaluations == 12:
            raise KeyboardInterrupt

    found = calibrate(frames[:8], "ray", SPEC, fit=FIT, base_rate=0.5, progress=stop)
    assert not found.finished
    assert found.evaluations == 12
    assert seen == sorted(seen, reverse=True)
    assert found.after["nll"] == pytest.approx(seen[-1])
    assert found.after["nll"] < found.before["nll"]
    assert set(found.errors.values()) == {None}


def test_parameters_that_do_not_go_together_are_avoided(frames: list[Frame]) -> None:
    """The band must not be empty: z_min below z_max."""
    fit = {"z_min": (0.1, 1.9), "z_max": (0.2, 2.5)}
    found = calibrate(frames[:3], "height-band", SPEC, fit=fit)
    assert found.parameters["z_min"] < found.parameters["z_max"]
    assert found.after["nll"] <= found.before["nll"]


@each(("name", "value"), [("p_miss", 0.3), ("p_miss", 0.999), ("obstacle_height", 0.1)])
def test_coordinates_go_from_bound_to_bound_and_back(name: str, value: float) -> None:
    axis = Axis(name, *BOUNDS[name])
    assert axis.value(axis.coordinate(value)) == pytest.approx(value, rel=1e-5)
    assert (axis.value(0.0), axis.value(1.0)) == BOUNDS[name]
    assert (axis.value(-1e-9), axis.value(1 + 1e-9)) == BOUNDS[name]


def test_models_can_be_made_with_their_bounds() -> None:
    for model, kind in (("ray", RayISM), ("height-band", HeightBandISM)):
        for name in FITTED[model]:
            for bound in BOUNDS[name]:
                kind(SPEC, MOUNT, **{name: bound})


def test_bad_input_is_refused(frames: list[Frame]) -> None:
    unknown = frame(0, Truth(SPEC, np.zeros(SPEC.shape, np.uint8)))
    for name, value, message in (
        ("model", "lite", "geometric model .* got 'lite'"),
        ("fit", {"colour": (0, 1)}, "ray has no parameter 'colour'; it has obstacle_height"),
        ("fit", {}, "fit must not be empty"),
        ("fit", {"p_miss": (0.9, 0.95)}, "bounds of p_miss must contain its start value"),
        ("fit", {"p_miss": (0.2, float("inf"))}, "must contain its start value"),
        ("threads", 0, "threads must be at least 1"),
        ("base_rate", 1.0, "base_rate must lie between 0 and 1"),
        ("frames", [], "no frame has a cell"),
        ("frames", [frame(0, None)], "frame 0 has no truth"),
        ("frames", [unknown], "no frame has a cell with a true state"),
    ):
        given = {"frames": frames[:1], "model": "ray", "spec": SPEC} | {name: value}
        refused(message, calibrate, given.pop("frames"), given.pop("model"), given.pop("spec"), **given)


# --- The file ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_file_is_a_model(fitted: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    fitted.save(path)
    assert Calibration.load(path) == fitted
    model = load_model(str(path), SPEC, MOUNT)
    assert isinstance(model, RayISM)
    assert {name: getattr(model, name) for name in TRUE} == fitted.parameters
    description, facts = describe_model(str(path))
    assert f"p_miss {fitted.parameters['p_miss']:g}" in description
    assert facts["file"] == "mine.json"
    assert short_names(["ray", str(path)]) == {"ray": "ray", "mine.json": str(path)}


def test_few_drives_and_a_less_safe_model_are_warned_of() -> None:
    before = {"false_free": 0.1, "missed_occupied": 0.2, "nll": 0.3}
    for drives, after, words in (
        (4, before, []),
        (3, before, ["3 drives"]),
        (8, before | {"nll": 0.4, "missed_occupied": 0.25}, ["missed_occupied rises from 0.2000 to 0.2500"]),
        (1, {"false_free": 0.11, "missed_occupied": 0.3}, ["1 drives", "false_free", "missed_occupied"]),
    ):
        found = Calibration("ray", {}, before=before, after=after, data={"drives": drives}).warnings
        assert len(found) == len(words)
        assert all(word in line for word, line in zip(words, found, strict=True))


def test_a_fit_goes_on_from_a_file(frames: list[Frame], tmp_path: Path) -> None:
    path = tmp_path / "before.json"
    Calibration("ray", {"max_mass": 0.9, "p_miss": 0.6}).save(path)
    found = calibrate(frames[:2], str(path), SPEC, fit={"p_miss": BOUNDS["p_miss"]})
    assert found.start == {"max_mass": 0.9, "p_miss": 0.6}
    assert found.parameters["max_mass"] == 0.9
    assert found.parameters["p_miss"] != 0.6


def test_damaged_files_are_reported_with_their_path(tmp_path: Path) -> None:
    path = tmp_path / "bad.json"
    begin = '{"format": "ogm.calibration/1", "model": "ray'
    for text, message in (
        ("{", "Expecting"),
        ("[]", "no ogm.calibration/1"),
        ('{"format": "ogm.calibration/9"}', "no ogm.calibration/1"),
        (begin + '"}', "parameters"),
        (begin + 's", "parameters": {}}', "geometric model .* got 'rays'"),
        (begin + '", "parameters": {"colour": 1}}', "no parameter 'colour'"),
        (begin + '", "parameters": {"p_miss": "0.5"}}', "finite number, got '0.5'"),
        (begin + '", "parameters": {"p_miss": NaN}}', "finite number, got nan"),
        (begin + '", "parameters": []}', "has no attribute"),
        ("\xff", "utf-8"),
    ):
        path.write_bytes(text.encode("latin-1"))
        assert refused(message, load_model, str(path), SPEC, MOUNT).startswith(f"{path}: ")
    refused("", load_model, str(tmp_path / "none.json"), SPEC, MOUNT, error=FileNotFoundError)


# --- The command ------------------------------------------------------------------------------------


def run(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


@pytest.fixture
def data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder that opens as six frames on the default grid."""
    spec = GridSpec.centered()
    frames = []
    for k in range(6):
        state = np.full(spec.shape, CellState.IGNORE, np.uint8)
        state[200:300, 130:230] = np.random.default_rng(k).choice([1, 1, 1, 2], (100, 100))
        frames.append(frame(k, Truth(spec, state), f"drive {k}"))
    monkeypatch.setattr("ogm.datasets.open_dataset", lambda path, **options: frames)
    return tmp_path


@pytest.mark.slow
def test_the_command_writes_a_model(data: Path) -> None:
    out = data / "mine.json"
    code, output = run(
        "calibrate", data, "--fit", "p_miss,p_false_alarm=0.01:0.5", "--every", 2, "--base-rate", 0.5, "--out", out
    )
    assert code == 0, output
    assert "ray, 3 frames of 3 drives" in output
    assert f"written {out}" in output
    record = json.loads(out.read_text())
    assert set(record["parameters"]) == {"p_miss", "p_false_alarm"}
    assert 0.01 <= record["parameters"]["p_false_alarm"] <= 0.5
    assert record["after"]["nll"] <= record["before"]["nll"]
    assert {"false_free", "iou_free", "iou_occupied"} <= set(record["before"]) & set(record["after"])


def test_an_interrupted_command_writes_the_best_so_far(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*args: object, **options: object) -> Calibration:
        return Calibration("ray", {"p_miss": 0.6}, {"p_miss": 0.8}, data={"frames": 1, "drives": 1}, finished=False)

    monkeypatch.setattr("ogm.calibration.calibrate", interrupted)
    code, output = run("calibrate", data, "--out", data / "part.json")
    assert code == 130
    assert "the best parameters so far are in" in output
    assert Calibration.load(data / "part.json").parameters == {"p_miss": 0.6}


@each(("words", "message"), [
    (("--fit", "colour"), "--fit takes NAME=LOW:HIGH, or one of p_miss"),
    (("--fit", "p_miss=0.1"), "got 'p_miss=0.1'"),
    (("--fit", "colour=0:1"), "ray has no parameter 'colour'"),
    (("--every", 0), "--every must be at least 1"),
    (("--base-rate", "half"), "--base-rate takes a number or data, got 'half'"),
    (("--out", "ray.npz"), "--out must end in .json"),
    (("--out", "nowhere/ray.json"), "there is no folder nowhere"),
])  # fmt: skip
def test_the_command_reports_errors_in_one_line(
    data: Path, monkeypatch: pytest.MonkeyPatch, words: tuple, message: str
) -> None:
    monkeypatch.chdir(data)
    code, output = run("calibrate", data, *words)
    assert code == 2, output
    assert message in output
    assert sum(line.startswith("ogm: ") for line in output.splitlines()) == 1
    assert not list(data.iterdir())
