"""A guarantee of false free: coverage over draws of drives, the model, its maps and the command."""

from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from typer.testing import CliRunner

from ogm.calibration import guarantee
from ogm.calibration.drives import chosen_factor, exceeded, largest_factor
from ogm.cli import app
from ogm.fusion import EvidentialMapper, rolling_window
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.models import Calibration, CombinedISM, ExplainedISM, load_model
from ogm.models.bounded import BoundedISM, discounted_free
from ogm.models.fitted import Guarantee
from ogm.models.named import describe_model
from ogm.pose import pose
from ogm.scan import Frame, InverseSensorModel, Mount, Scan, run_model
from ogm.state import CellState, Truth
from ogm.unknown_cause import UnknownCause

SPEC, MOUNT = GridSpec.centered(length=16, width=16, resolution=0.4), Mount(1.8)
BOUND = Guarantee(0.01, 0.9, 0.6, drives=12)


def drawn_masses(rng: np.random.Generator, shift: float = 0.0) -> np.ndarray:
    """Return masses of free in the occupied cells of a drive; drives differ in how often these are high."""
    wrong = rng.beta(1, 30) + shift
    return np.where(rng.random(200) < wrong, rng.beta(8, 2, 200), rng.beta(1, 8, 200)).astype(np.float32)


def share_over_the_limit(drives: int, confidence: float, shift: float = 0.0, draws: int = 200) -> float:
    """Return the share of further drives with false free above 1 %, over draws of calibrated drives."""
    rng, over = np.random.default_rng(drives), []
    for _ in range(draws):
        factors = [largest_factor(exceeded(drawn_masses(rng)), 0.01) for _ in range(drives)]
        factor = np.float32(chosen_factor(factors, confidence))
        over += [(drawn_masses(rng, shift) * factor > 0.5).mean() > 0.01 for _ in range(10)]
    return float(np.mean(over))


# --- The choice -------------------------------------------------------------------------------------


@each(("drives", "confidence"), [(9, 0.9), (20, 0.9), (12, 0.8)])
def test_further_drives_are_within_the_limit_as_often_as_stated(drives: int, confidence: float) -> None:
    """200 draws of ten further drives; those of a draw depend on each other, hence a standard error of draws."""
    k = int((drives + 1) * (1 - confidence) + 1e-9)
    expected = k / (drives + 1)  # ties make it rarer
    found, error = share_over_the_limit(drives, confidence), np.sqrt(expected * (1 - expected) / 200)
    assert expected / 3 < found < expected + 3 * error


def test_drives_of_another_kind_are_not_covered() -> None:
    assert share_over_the_limit(20, 0.9, shift=0.1) > 0.2


def test_the_largest_factor_keeps_the_limit_and_a_larger_one_exceeds_it() -> None:
    rng = np.random.default_rng(1)
    for limit in (0.001, 0.01, 0.1, 0.5):
        free = rng.beta(2, 2, 1000).astype(np.float32)
        factor = largest_factor(exceeded(free), limit)
        mass = np.stack([free, np.zeros_like(free)], axis=-1)
        assert (discounted_free(mass, factor)[:, 0] > 0.5).mean() <= limit
        assert factor == 1 or (discounted_free(mass, 1.002 * factor)[:, 0] > 0.5).mean() > limit - 0.003
    assert largest_factor(exceeded(np.array([0.4, 0.5], np.float32)), 0.01) == 1.0
    worst = largest_factor(exceeded(np.ones(3, np.float32)), 0.01)
    assert np.float32(worst) * np.float32(1) <= 0.5


def test_few_drives_are_refused_with_the_number_that_is_needed() -> None:
    refused("8 drives .* confidence of at most 0.89, wanted 0.9: give 9 drives", chosen_factor, [0.5] * 8, 0.9)
    assert chosen_factor([0.9, 0.5, *[1.0] * 7], 0.9) == 0.5
    assert chosen_factor([0.5, *[1.0] * 98], 0.99) == 0.5
    refused("0 drives .* none", chosen_factor, [], 0.5)


# --- The model and its maps -------------------------------------------------------------------------


def scan(seed: int) -> Scan:
    rng = np.random.default_rng(seed)
    azimuth, near = rng.uniform(-np.pi, np.pi, 6000), rng.uniform(2, 11, 6000)
    road = np.column_stack([near * np.cos(azimuth), near * np.sin(azimuth), np.full(6000, -1.8), np.zeros(6000)])
    return Scan(road.astype(np.float32))


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """Two frames of each of 18 drives; the share of obstacles that no ray detects grows with the drive."""
    found = []
    for k in range(36):
        rng, drive = np.random.default_rng(k), k // 2
        state = np.full(SPEC.shape, CellState.FREE, np.uint8)
        state[:, 20:] = CellState.UNKNOWN
        state[20:, 20:30] = CellState.OCCUPIED
        state[rng.random(SPEC.shape) < 0.002 * drive] = CellState.OCCUPIED
        found.append(Frame(scan(k), MOUNT, None, Truth(SPEC, state), name=f"{k}", sequence=f"drive {drive}"))
    return found


def wrong_share(ism: InverseSensorModel, frame: Frame) -> float:
    grid = run_model(ism, frame)
    return float((grid.free[frame.truth.state == CellState.OCCUPIED] > 0.5).mean())


def test_the_file_is_a_model_within_the_limit(frames: list[Frame], tmp_path: Path) -> None:
    path, limit = tmp_path / "bounded.json", 0.5
    found = guarantee(frames, "ray", limit, 0.8, SPEC)
    found.save(path)
    assert Calibration.load(path) == found
    assert found.guarantee is not None
    assert (found.guarantee.drives, found.data["frames"]) == (18, 36)
    model = load_model(str(path), SPEC)
    assert isinstance(model, BoundedISM)
    false_free = {
        name: np.reshape([wrong_share(ism, frame) for frame in frames], (18, 2)).mean(axis=1)
        for name, ism in (("bounded", model), ("ray", load_model("ray", SPEC)))
    }
    assert np.mean(false_free["ray"]) == pytest.approx(found.before["false_free"], abs=1e-3)
    assert np.mean(false_free["bounded"]) == pytest.approx(found.after["false_free"], abs=1e-3)
    assert np.count_nonzero(false_free["bounded"] > limit) <= 3 < np.count_nonzero(false_free["ray"] > limit)
    assert "at most 50 % of the occupied cells" in describe_model(str(path))[0]
    message = "has a guarantee already"
    refused(message, guarantee, frames, str(path), 0.5, 0.8, SPEC)


def test_fitted_parameters_are_kept_and_drives_of_the_fit_warned_of(frames: list[Frame], tmp_path: Path) -> None:
    path = tmp_path / "ray.json"
    Calibration("ray", {"p_miss": 0.3}, data={"name": "frames"}).save(path)
    found = guarantee(frames, str(path), 0.5, 0.8, SPEC)
    assert found.parameters == {"p_miss": 0.3}
    assert any("drives of no fit" in warning for warning in found.warnings)
    found.save(path)
    assert isinstance(load_model(str(path), SPEC).model, RayISM)
    assert load_model(str(path), SPEC).model.p_miss == 0.3


def test_maps_state_the_guarantee_and_their_files_keep_it(tmp_path: Path) -> None:
    ray = RayISM(SPEC, MOUNT)
    combined = CombinedISM([ray, ray], reliability=0.7)
    for inner in (ray, combined):
        model = BoundedISM(inner, BOUND, "ray")
        alone, grid = inner(scan(0)), model(scan(0))
        np.testing.assert_allclose(grid.free, 0.6 * alone.free, rtol=1e-6)
        np.testing.assert_array_equal(grid.occupied, alone.occupied)
        explained = ExplainedISM(model)(scan(0))
        assert explained == grid
        assert explained.cause is not None
        assert not (explained.cause[grid.unknown > 0.5] == UnknownCause.KNOWN).any()
        mapper, plain = (EvidentialMapper(rolling_window(SPEC)) for _ in range(2))
        for k in range(3):
            mapper.update(model(scan(k)), pose(), 0.1 * k)
            plain.update(inner(scan(k)), pose(), 0.1 * k)
        assert mapper.grid.free.max() <= plain.grid.free.max()
        if inner is combined:  # discounted when the map is read
            np.testing.assert_allclose(mapper.grid.free, 0.6 * plain.grid.free, rtol=1e-6)
        for seen in (grid, explained, mapper.grid, mapper.view(SPEC, pose())):
            assert seen.meta == {"guarantee": f"ray: {BOUND}"}
        mapper.grid.save(tmp_path / "map.npz")
        assert EvidentialGrid.load(tmp_path / "map.npz").meta == mapper.grid.meta
        mapper.reset()
        mapper.update(inner(scan(0)), pose(), 0.0)
        assert not mapper.grid.meta


def test_other_weights_are_refused(tmp_path: Path) -> None:
    path, spec = tmp_path / "lite.json", GridSpec.centered(20.48, 20.48)
    _, weights = describe_model("lite")
    Calibration("lite", {}, guarantee=Guarantee(0.01, 0.9, 0.6, 12, weights["sha256"])).save(path)
    assert isinstance(load_model(str(path), spec), BoundedISM)
    Calibration("lite", {}, guarantee=Guarantee(0.01, 0.9, 0.6, 12, "0" * 64)).save(path)
    refused(
        "lite with weights of SHA-256 0{12}, got .*: repeat `ogm calibrate --guarantee`", load_model, str(path), spec
    )


def test_bad_input_is_refused(frames: list[Frame]) -> None:
    for name, value, message in (
        ("limit", 0.0, "limit and confidence must lie between 0 and 1"),
        ("confidence", 1.0, "limit and confidence must lie between 0 and 1"),
        ("confidence", 0.99, "18 drives with occupied cells allow a confidence of at most 0.95, wanted 0.99: give 99"),
        ("dataset", [Frame(scan(0), MOUNT, name="a")], "frame a has no truth"),
        ("model", "rays", "there is no sensor model 'rays'"),
    ):
        given = {"dataset": frames, "model": "ray", "limit": 0.5, "spec": SPEC} | {name: value}
        refused(message, guarantee, **given)


# --- The command ------------------------------------------------------------------------------------


def test_the_command_writes_and_prints_the_bound(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    spec = GridSpec.centered()
    state = np.full(spec.shape, CellState.FREE, np.uint8)
    state[300:310, 100:250] = CellState.OCCUPIED
    drives = [Frame(scan(k), MOUNT, None, Truth(spec, state), name="a", sequence=f"{k}") for k in range(4)]
    monkeypatch.setattr("ogm.datasets.open_dataset", lambda path, **options: drives)

    def run(*words: str) -> tuple[int, str]:
        found = CliRunner().invoke(app, ["calibrate", str(tmp_path), *words], env={"COLUMNS": "250"})
        return found.exit_code, found.output

    out = tmp_path / "ray.json"
    code, output = run("--guarantee", "false-free", "0.2", "--confidence", "0.8", "--out", str(out))
    assert code == 0, output
    assert "at most 20 % of the occupied cells of a drive are free, for 80 % of drives like the 4 calibrated" in output
    assert Calibration.load(out).guarantee is not None
    for words, message in (
        (("--guarantee", "iou", "0.2"), "--guarantee takes false-free and a share"),
        (("--guarantee", "false-free", "0.2", "--fit", "p_miss"), "--guarantee fits nothing"),
        (("--guarantee", "false-free", "0.2"), "4 drives with occupied cells allow a confidence of at most 0.8"),
    ):
        code, output = run(*words)
        assert code == 2
        assert message in output
