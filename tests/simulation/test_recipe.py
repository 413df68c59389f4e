"""Laws of recipes: shares, towns, faults, calibration errors, and samples that hold to them."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused

from ogm.datasets import open_dataset
from ogm.simulation import dataset, moments
from ogm.simulation.conditions import Conditions, draw_conditions, draw_density, layer_errors
from ogm.simulation.dataset import beams_of, make_sample
from ogm.simulation.moments import draw_mount
from ogm.simulation.mounts import FULL_TURN, LidarMount
from ogm.simulation.plan import SPLITS, DatasetPlan, moment
from ogm.simulation.recipe import GEN2, GEN3, RECIPES, DataRecipe
from ogm.simulation.sample import Beams, SimulatedSample
from ogm.simulation.sensors import LIDARS
from ogm.simulation.store import FORMAT, GAPS, Store
from ogm.simulation.traffic.departure import Density
from ogm.state import CellState

pytestmark = pytest.mark.usefixtures("kept_towns")
PLAN = DatasetPlan.of_recipe("gen2", seed=5)
NO_MOVERS = np.zeros((0, 5))


def draw(number: int, lidar: str = "vlp-32c", recipe: DataRecipe = GEN2, view: float = FULL_TURN) -> Conditions:
    return draw_conditions(recipe, beams_of(LIDARS[lidar]), view, NO_MOVERS, np.random.default_rng([7, number]))


def azimuths(beams: Beams) -> np.ndarray:
    return np.arctan2(beams.directions[..., 1], beams.directions[..., 0])


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch) -> DataRecipe:
    """The recipe gen2 in small towns, as "gen2"; the last town is kept from test to test."""
    small = replace(GEN2, town_size=240.0)
    monkeypatch.setitem(RECIPES, "gen2", small)
    return small


def altered(monkeypatch: pytest.MonkeyPatch, recipe: DataRecipe, **changes: object) -> DatasetPlan:
    """Return a plan of the recipe with other numbers; the towns stay the same."""
    monkeypatch.setitem(RECIPES, "gen2", replace(recipe, **changes))
    return DatasetPlan.of_recipe("gen2", seed=5)


def test_gen3_draws_a_density_for_every_drive_and_gen2_has_the_usual_one() -> None:
    drawn = np.array([draw_density(GEN3.crowds, traffic) for traffic in range(500)])
    ends = np.log([GEN3.crowds.vehicles, GEN3.crowds.people, GEN3.crowds.bicycles]).T
    share = (np.log(drawn) - ends[0]) / (ends[1] - ends[0])
    assert share.min() >= 0
    assert share.max() <= 1
    np.testing.assert_allclose(share.mean(axis=0), 0.5, atol=0.05)
    assert draw_density(GEN2.crowds, 8) == Density()


# --- plans ---


def test_a_recipe_has_its_usual_size_and_a_twentieth_for_validation() -> None:
    assert PLAN.counts == {"training": 4800, "validation": 240, "test": 0, "sequences": 0}
    assert DatasetPlan.of_recipe("gen2", samples=200, test=7).counts["validation"] == 10
    assert DatasetPlan.from_dict(json.loads(json.dumps(asdict(PLAN)))) == PLAN


def test_a_new_town_every_70_samples_and_none_in_two_splits() -> None:
    towns = {split: [moment(PLAN, split, i).town for i in range(4800)] for split in SPLITS[:3]}
    assert len(set(towns["training"])) == 69
    assert len(set(towns["validation"][:240])) == 6
    for split, size in (("training", 70), ("validation", 40), ("test", 40)):
        runs = [len(set(towns[split][k : k + size])) for k in range(0, 4800, size)]
        assert set(runs) == {1}, split
    assert not set(towns["training"]) & set(towns["validation"])
    assert not set(towns["test"]) & {*towns["training"], *towns["validation"]}
    shipped = [DatasetPlan(seed=seed, test_towns=6, drives=24) for seed in (1, 2, 3, 62)]
    plain = {moment(plan, "test", i).town for plan in shipped for i in range(240)}
    assert not plain & {*towns["training"], *towns["validation"]}


def test_every_ten_samples_are_a_drive_of_their_own() -> None:
    moments = [moment(PLAN, "training", i) for i in range(140)]
    assert [one.scenario for one in moments] == [i // 10 for i in range(140)]
    assert len({one.traffic for one in moments}) == 14
    times = np.array([one.time for one in moments]).reshape(14, 10)
    np.testing.assert_allclose(np.diff(times, axis=1), 8.0)
    assert times.min() >= 20
    assert times.max() < 200
    town = [one for one in moments if one.town == moments[0].town]
    assert {one.clockwise for one in town} == {True, False}


def test_sequences_stay_in_one_town_with_one_sensor() -> None:
    piece = [moment(PLAN, "sequences", i) for i in range(200)]
    assert len({one.town for one in piece[:100]}) == 1
    assert piece[0].town != piece[100].town
    np.testing.assert_allclose(np.diff([one.time for one in piece[:100]]), 0.1)
    assert len({draw_mount(PLAN, "sequences", i) for i in range(100)}) == 1


@each("wrong, message", [
        ({"mounts": (LidarMount("vlp-16"),)}, "gen2 sets mounts itself, got 1 x vlp-16"),
        ({"towns": 3}, "gen2 sets towns itself, got 3"),
        ({"bad_weather": 0.5}, "gen2 sets bad_weather itself"),
        ({"recipe": "gen9"}, "unknown recipe 'gen9'; known recipes: gen2"),
    ])  # fmt: skip
def test_what_a_recipe_sets_cannot_be_chosen(wrong: dict, message: str) -> None:
    refused(message, DatasetPlan, **{"recipe": "gen2"} | wrong)
    refused("unknown recipe 'gen9'", DatasetPlan.of_recipe, "gen9")


# --- sensors ---


def test_lidars_have_fair_shares() -> None:
    assert sum(mount.share for mount in GEN2.mounts) == pytest.approx(1)
    wanted: dict[str, float] = {}
    for mount in GEN2.mounts:
        wanted[mount.lidar] = wanted.get(mount.lidar, 0) + mount.share
    assert set(wanted) == set(LIDARS)
    assert 0.03 < min(wanted.values()) < max(wanted.values()) < 0.12
    drawn = [draw_mount(PLAN, "training", i)[0].lidar for i in range(4800)]
    for name, share in wanted.items():
        assert drawn.count(name) / 4800 == pytest.approx(share, abs=4 * np.sqrt(share / 4800)), name


@each("name", LIDARS)
def test_calibration_errors_are_bounded_and_belong_to_the_unit(name: str) -> None:
    size, layers = GEN2.calibration_of(name), LIDARS[name].layers
    units = [layer_errors(GEN2, name, layers, unit) for unit in range(200)]
    assert units[3] == layer_errors(GEN2, name, layers, 3)
    assert len(set(units)) == 200
    elevation, distance = np.array(units).transpose(1, 0, 2)
    assert np.abs(elevation).max() <= size.offset + 2 * size.elevation
    assert np.abs(distance).max() <= 2 * size.range
    assert elevation.std(axis=1).mean() == pytest.approx(0.88 * size.elevation, rel=0.25)  # cut at two deviations
    assert GEN2.calibration_of("hdl-64e").elevation > 2 * size.elevation or name == "hdl-64e"


# --- conditions ---


@pytest.mark.slow
def test_conditions_come_by_their_shares() -> None:
    draws = [draw(i) for i in range(3000)]
    weather = [one.weather for one in draws]
    whole = [bool(one.measured.all() and not one.hidden.any()) for one in draws]
    dead = [bool((~one.measured).all(axis=1).any()) for one in draws]
    skies, faults = GEN2.skies, GEN2.faults
    for found, share in (
        ([np.isfinite(one.fog) for one in weather], skies.fog),
        ([one.rain > 0 for one in weather], skies.rain),
        ([one.dust > 0 for one in weather], skies.dust),
        ([one.in_motion for one in draws], GEN2.in_motion),
        ([not one.intensity for one in draws], GEN2.no_intensity),
        (dead, faults.dead),
        (whole, (1 - faults.sector) * (1 - faults.blocked) * (1 - faults.lost) * (1 - faults.dead)),
    ):
        assert np.mean(found) == pytest.approx(share, abs=4 * np.sqrt(share / 3000))
    fog = np.array([one.fog for one in weather if np.isfinite(one.fog)])
    assert fog.min() >= skies.visibility[0]
    assert fog.max() <= skies.visibility[1]
    assert np.mean(fog < np.sqrt(np.prod(skies.visibility))) == pytest.approx(0.5, abs=0.15)  # graded by the logarithm
    assert all((len(one.dust) > 0) == (one.weather.dust > 0) for one in draws)
    assert all(one.active.any() for one in draws)


def test_sectors_are_60_to_270_degrees_wide() -> None:
    only = replace(GEN2, faults=replace(GEN2.faults, sector=1.0, blocked=0.0, lost=0.0, dead=0.0))
    azimuth = azimuths(beams_of(LIDARS["hdl-32e"]))[0]
    widths = []
    for i in range(300):
        measured = draw(i, "hdl-32e", only).measured
        assert (measured == measured[0]).all()
        turn = np.sort(azimuth[measured[0]])
        gaps = np.diff(np.append(turn, turn[0] + FULL_TURN))
        assert np.count_nonzero(gaps > 0.02) == 1  # in one piece
        widths.append(np.degrees(FULL_TURN - gaps.max()))
    assert 59 < min(widths) < 80
    assert 250 < max(widths) < 271


def test_blocked_views_are_left_out_or_without_echo() -> None:
    only = replace(GEN2, faults=replace(GEN2.faults, sector=0.0, blocked=1.0, lost=0.0, dead=0.0))
    draws = [draw(i, recipe=only) for i in range(400)]
    left_out = [not one.measured.all() for one in draws]
    assert np.mean(left_out) == pytest.approx(0.5, abs=0.1)
    for one, out in zip(draws, left_out, strict=True):
        assert one.hidden.any()
        np.testing.assert_array_equal(one.measured, ~one.hidden if out else True)
        np.testing.assert_array_equal(one.active, ~one.hidden)
        lowest = one.hidden[:, one.hidden.any(axis=0)][0]
        assert lowest.any()  # what hides, hides from below
    assert np.mean([one.hidden.mean() for one in draws]) < 0.25


# --- samples ---


def outside(sample: SimulatedSample, measured: np.ndarray) -> np.ndarray:
    """Return the cells at azimuths, from the middle of the grid, where no beam was measured."""
    bins = np.zeros(720, bool)
    found = np.floor((azimuths(sample.beams)[measured] + np.pi) * 720 / FULL_TURN).astype(int) % 720
    for shift in (-1, 0, 1):
        bins[(found + shift) % 720] = True
    x, y = sample.truth.spec.cell_centers
    cell = np.floor((np.arctan2(y, x) + np.pi) * 720 / FULL_TURN).astype(int) % 720
    return ~bins[cell]


@pytest.fixture
def sector(recipe: DataRecipe, monkeypatch: pytest.MonkeyPatch) -> SimulatedSample:
    faults = replace(GEN2.faults, sector=1.0, blocked=0.0, lost=0.0, dead=1.0)
    plan = altered(monkeypatch, recipe, faults=faults, mounts=(LidarMount("hdl-32e", 1.0, (1.8, 2.0)),))
    return make_sample(plan, "training", 3)


@pytest.mark.slow
def test_a_sector_sample_has_nothing_outside_its_sector(sector: SimulatedSample) -> None:
    assert sector.measured is not None
    assert 0.1 < sector.measured.mean() < 0.8
    assert len(sector.points) + len(sector.no_returns) == sector.measured.sum()
    assert (sector.steps[~sector.measured] == 0).all()
    seen = azimuths(sector.beams)[sector.measured]
    for xyz in (sector.points, sector.no_returns):
        apart = (np.arctan2(xyz[:, 1], xyz[:, 0])[:, None] - np.unique(seen) + np.pi) % FULL_TURN - np.pi
        assert np.abs(apart).min(axis=1).max() < 1e-3
    beyond = outside(sector, sector.measured)
    assert 0.2 < beyond.mean() < 0.9
    state = sector.truth.state
    assert not (state[beyond] == CellState.FREE).any()
    assert (state[~beyond] == CellState.FREE).sum() > 1000


@pytest.mark.slow
def test_dead_layers_have_no_points_and_no_beams_without_echo(sector: SimulatedSample) -> None:
    assert sector.measured is not None
    dead = ~sector.measured.any(axis=1)
    assert 1 <= dead.sum() <= np.ceil(0.2 * 32)
    assert not np.isin(sector.ring, np.flatnonzero(dead)).any()
    elevation = np.arcsin(sector.no_returns[:, 2])
    near = np.abs(elevation[:, None] - np.array(sector.beams.elevation)).argmin(axis=1)
    assert not dead[near].any()


@pytest.mark.slow
def test_half_of_the_scans_have_no_intensities(recipe: DataRecipe) -> None:
    plan = DatasetPlan.of_recipe("gen2", seed=5)
    found = []
    for i in range(6):
        sample = make_sample(plan, "training", i)
        wanted = dataset.set_up(plan, "training", i).conditions
        assert wanted is not None
        assert bool(sample.intensities.any()) == wanted.intensity
        found.append(wanted.intensity)
    assert {*found} == {True, False}


@pytest.mark.slow
def test_a_sample_depends_on_plan_and_number_alone(recipe: DataRecipe) -> None:
    plan = DatasetPlan.of_recipe("gen2", seed=5)
    first = make_sample(plan, "training", 7, threads=1)
    make_sample(plan, "training", 15)
    moments._drive.cache_clear()
    again = make_sample(replace(plan, samples=70), "training", 7, threads=2)
    for name in ("steps", "intensities", "measured", "objects", "T_world_sensor", "T_vehicle_sensor"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name), err_msg=name)
    np.testing.assert_array_equal(first.truth.state, again.truth.state)
    np.testing.assert_array_equal(first.truth.height_cm, again.truth.height_cm)


@pytest.mark.slow
def test_data_sets_of_recipes_keep_what_was_not_measured(recipe: DataRecipe, tmp_path: Path) -> None:
    plan = DatasetPlan.of_recipe("gen2", seed=5, samples=1, validation=0)
    store = dataset.simulate(tmp_path / "data", plan, workers=1)
    assert store.format == GAPS
    for i, one in enumerate(Store.open(tmp_path / "data")["training"]):
        made = make_sample(plan, "training", i)
        np.testing.assert_array_equal(one.measured, made.measured)
        np.testing.assert_array_equal(one.points, made.points)
        np.testing.assert_array_equal(one.no_returns, made.no_returns)
        assert one.weather == made.weather
    made = open_dataset(tmp_path / "data", split="training")
    assert made.facts["towns"] == 1
    scan = made[0].scan
    np.testing.assert_array_equal(scan.no_returns, one.no_returns)

    other = Store.create(tmp_path / "other", asdict(DatasetPlan()), {"training": 1}, (one.beams,), {})
    assert other.format == FORMAT
    refused("cannot store unmeasured beams", other.write, "training", 0, [replace(one, index=0)])
