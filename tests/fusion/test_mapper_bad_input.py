"""Input that maps refuse, with helpful messages and without a change of the map; two errors of a known peer."""

import logging
import math

import numpy as np
import pytest
from cases import each, refused
from random_grids import layers, uniform

from ogm.evidence import conjunctive, dempster, probability_to_mass
from ogm.fusion import BinaryBayesMapper, DynamicMapper, EvidentialMapper, PoseJump
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose

SPEC = GridSpec.centered(length=6.4, width=4.8, resolution=0.2)
NAN_POSE = np.full((4, 4), np.nan)


MAPPERS = {
    "evidential": EvidentialMapper,
    "bayes": lambda spec: BinaryBayesMapper(spec, half_life=2.0),
    "dynamic": lambda spec: DynamicMapper(spec, 500, settings=DynamicSettings(static_share=1.0, to_dynamic_rate=0.0)),
}


def begun(name: str):
    mapper = MAPPERS[name](SPEC)
    mapper.update(uniform(SPEC), pose(1.0, 2.0), stamp=10.0)
    return mapper


@pytest.fixture(params=MAPPERS)
def mapper(request):
    return begun(request.param)


def test_a_refused_scan_changes_nothing(mapper):
    before = mapper.grid.mass, mapper.spec, mapper.stamp, mapper.scans
    far = EvidentialGrid.vacuous(GridSpec(0.2, (20, 20), (500.0, 0.0)))
    for name, value, error, words in (
        ("T_map_sensor", NAN_POSE, ValueError, "T_map_sensor must be finite"),
        ("T_map_sensor", np.eye(3), ValueError, "T_map_sensor must be a 4x4 transform, got shape"),
        ("T_map_sensor", np.diag([1.0, -1.0, 1.0, 1.0]), ValueError, "must be rigid"),
        ("T_map_sensor", 1.1 * np.eye(4), ValueError, "the last row of T_map_sensor"),
        ("T_map_sensor", pose(1.0, 2.0, roll=-math.pi / 2), PoseJump, "jumps by 0 m and 90 degrees from"),
        ("T_map_sensor", pose(31.0, 2.0), PoseJump, "jumps by 30 m and 0 degrees from"),
        ("T_vehicle_sensor", NAN_POSE, ValueError, "T_vehicle_sensor must be finite"),
        ("stamp", math.nan, ValueError, "stamp must be finite"),
        ("stamp", None, ValueError, "stamp is missing"),
        ("stamp", 9.0, ValueError, "1 s older than the map"),
        ("stamp", 1.1e11, ValueError, "give stamps in seconds|divide nanoseconds"),
        ("reliability", 1.5, ValueError, r"reliability must be a number in \[0, 1\], got 1.5"),
        ("reliability", math.nan, ValueError, "reliability must be"),
        ("grid", np.zeros((32, 24, 2)), TypeError, "updated with an EvidentialGrid, got ndarray"),
        (
            "grid",
            far,
            ValueError,
            "has no cell in the map's window: give T_map_sensor as the pose of the grid's own frame",
        ),
    ):
        given = {"grid": uniform(SPEC), "T_map_sensor": pose(1.05, 2.0), "stamp": 10.1} | {name: value}
        refused(words, mapper.update, error=error, **given)
        np.testing.assert_array_equal(mapper.grid.mass, before[0])
        assert (mapper.spec, mapper.stamp, mapper.scans) == before[1:], (name, value)
    mapper.update(uniform(SPEC), pose(1.05, 2.0), stamp=10.1)  # the next scan is fused


def test_a_pose_in_camera_axes_is_refused():
    message = "a pose is tilted by 90 degrees.*poses of a camera"
    refused(message, EvidentialMapper(SPEC).update, uniform(SPEC), pose(roll=math.pi / 2), stamp=0)


@each("name", MAPPERS)
def test_a_closed_loop_is_refused_until_reset_which_begins_a_new_map(name):
    mapper, fresh = begun(name), MAPPERS[name](SPEC)
    refused(
        r"begin a new map after a closed loop", mapper.update, uniform(SPEC), pose(200.0), stamp=10.1, error=PoseJump
    )
    mapper.reset()
    assert (mapper.stamp, mapper.T_map_vehicle, mapper.scans) == (None, None, 0)
    assert mapper.grid.unknown.min() == 1
    for one in (mapper, fresh):
        one.update(uniform(SPEC), pose(200.0), stamp=1.2)
    assert mapper.spec.contains(200.0, 0.0)
    assert mapper.grid == fresh.grid


def test_a_jump_stays_a_jump_however_often_it_is_offered(mapper):
    """20 m within a tenth of a second: not 70 m/s because two scans were refused in between."""
    message = "jumps by 20 m and 0 degrees from the last accepted scan"
    for k in range(1, 8):
        refused(message, mapper.update, uniform(SPEC), pose(21.0, 2.0), stamp=10.0 + 0.1 * k, error=PoseJump)
    mapper.update(uniform(SPEC), pose(1.5, 2.0), stamp=10.8)  # the glitch is over
    assert mapper.scans == 2


@each("name", MAPPERS)
@each(("off", "scans"), [(9.0, 20), (30.0, 5), (500.0, 1)])
def test_a_glitch_is_left_out_and_the_drive_goes_on(name, off, scans):
    """20 m/s at 10 Hz, some poses off to the side: leaving them out, as advised, loses no other scan."""
    left_out, mapper = [], begun(name)
    for k in range(1, 60):
        wrong = 20 <= k < 20 + scans
        try:
            mapper.update(uniform(SPEC), pose(1.0 + 2.0 * k, 2.0 + off * wrong), stamp=10.0 + 0.1 * k)
        except PoseJump:
            left_out.append(k)
    assert left_out == list(range(20, 20 + scans))


def test_repeated_stamps_are_scans_of_one_moment(mapper):
    before = mapper.grid.mass
    mapper.update(EvidentialGrid.vacuous(SPEC), pose(1.0, 2.0), stamp=10.0)
    np.testing.assert_allclose(mapper.grid.mass, before, atol=1e-6)


def test_a_long_gap_ages_the_map_and_is_logged(mapper, caplog):
    with caplog.at_level(logging.WARNING):
        mapper.update(EvidentialGrid.vacuous(SPEC), pose(1.0, 2.0), stamp=310.0)
    assert "no scan for 300.0 s" in caplog.text
    assert mapper.grid.unknown.min() > 0.999


def test_without_forgetting_no_stamps_are_needed_but_not_half_of_them():
    mapper = EvidentialMapper(SPEC, half_life=math.inf)
    mapper.update(uniform(SPEC), pose())
    mapper.update(uniform(SPEC), pose(500.0))  # without time there is no speed
    mapper.update(uniform(SPEC), pose(500.0), stamp=3.0)
    refused("stamp is missing", mapper.update, uniform(SPEC), pose(500.0))


def test_a_rule_that_fails_leaves_the_map_as_it_was():
    def failing(a, b):
        if b.any() and a.any():
            raise RuntimeError("no")
        return dempster(a, b)

    mapper = EvidentialMapper(SPEC, failing)
    mapper.update(uniform(SPEC), pose(), stamp=0)
    before = mapper.grid.mass, layers(mapper)
    with pytest.raises(RuntimeError):
        mapper.update(uniform(SPEC), pose(1.0), stamp=0.1)
    np.testing.assert_array_equal(mapper.grid.mass, before[0])
    np.testing.assert_array_equal(layers(mapper), before[1])
    assert mapper.spec == SPEC


def test_a_rule_that_returns_no_masses_is_named():
    for rule, message in (
        (conjunctive, r"rule conjunctive must return masses.*close_world"),
        (lambda a, b: a + b + 0.7, "mass"),
    ):
        refused(message, EvidentialMapper(SPEC, rule).update, uniform(SPEC), pose(), stamp=0)


def test_bad_options_are_named():
    for name, value, words in (
        ("half_life", 0.0, "half_life must be greater than 0 s"),
        ("half_life", math.nan, "half_life must be greater than 0 s"),
        ("half_life", (1.0, 2.0, 3.0), "one number or two"),
        ("forget", "never", "forget must be one of everywhere, observed, got 'never'"),
        ("window", "tumbling", "window must be one of rolling, fixed"),
        ("min_unknown", 1.0, r"min_unknown must be in \[0, 1\)"),
        ("min_unknown", -0.1, r"min_unknown must be in \[0, 1\)"),
        ("moving_half_life", 0.0, "moving_half_life must be greater than 0 s"),
        ("conflict_half_life", -1.0, "conflict_half_life must be 0 s or more"),
        ("max_speed", 0.0, "max_speed must be greater than 0"),
        ("max_delay", math.inf, "max_delay must be 0 s or more and finite"),
        ("discounting", dempster, "discounting must be discount or discount_evidence"),
    ):
        refused(words, EvidentialMapper, SPEC, **{name: value})
    refused("rule must be a function of two masses", EvidentialMapper, SPEC, "dempster", error=TypeError)
    refused("half_life must be greater than 0 s, got 0", BinaryBayesMapper, SPEC, 0)
    refused("match must be one of pignistic, plausibility, got 'best'", BinaryBayesMapper, SPEC, match="best")
    refused("limits must be two probabilities around 1/2", BinaryBayesMapper, SPEC, limits=(0.6, 0.9))
    refused("window must be one of rolling, fixed", BinaryBayesMapper, SPEC, window="moving")


def test_any_memory_layout_and_precision_is_taken():
    rng = np.random.default_rng(0)
    mass = rng.dirichlet([1, 1, 1], size=SPEC.shape)[..., :2].astype(np.float32)
    for make in (EvidentialMapper, BinaryBayesMapper):
        maps = []
        for one in (mass, np.asfortranarray(mass), mass.astype(np.float64), mass[::-1, ::-1][::-1, ::-1]):
            mapper = make(SPEC)
            mapper.update(EvidentialGrid(SPEC, one), pose(0.3, yaw=0.2), stamp=0)
            maps.append(mapper.grid.mass)
        for one in maps[1:]:
            np.testing.assert_allclose(one, maps[0], atol=1e-6)


def test_a_map_without_scans_has_no_view():
    for mapper in (EvidentialMapper(SPEC), BinaryBayesMapper(SPEC)):
        refused("the map has no scan yet", mapper.view)
        assert mapper.view(T_map_vehicle=pose(3.0)).unknown.min() == 1.0


def test_a_blind_sensor_does_not_weaken_the_belief_of_another():
    """Ignorance is not conflict. A peer turns P = 1/2 of a blind sensor into m(O) = m(F), and 0.77 falls to 0.73."""
    seen = 0.6 * probability_to_mass(np.full(SPEC.shape, 0.95), np.zeros(SPEC.shape))
    mapper = EvidentialMapper(SPEC, half_life=math.inf)
    mapper.update(EvidentialGrid(SPEC, seen.astype(np.float32)), pose())
    before = mapper.grid
    mapper.update(EvidentialGrid.vacuous(SPEC), pose())
    np.testing.assert_allclose(mapper.grid.mass, before.mass, atol=1e-6)
    np.testing.assert_allclose(mapper.grid.unknown, 0.4, atol=1e-5)


def test_there_is_no_jump_where_conflict_grows():
    """A peer switches to unknown at a conflict of 0.9: fusing 0.99 with 0.10 gives 0.917, with 0.09 it gives 0.540."""
    fused = []
    for p in np.linspace(0.02, 0.2, 181):
        mapper = EvidentialMapper(SPEC, dempster, math.inf, min_unknown=0)
        for probability in (0.99, p):
            mass = probability_to_mass(np.full(SPEC.shape, probability), np.zeros(SPEC.shape))
            mapper.update(EvidentialGrid(SPEC, mass.astype(np.float32)), pose())
        fused.append(float(mapper.grid.probability[0, 0]))
    steps = np.diff(fused)
    assert (steps > 0).all()
    assert steps.max() < 0.04


@each("name", MAPPERS)
def test_a_trusted_grid_that_is_none_changes_no_map(name):
    mapper, shape = MAPPERS[name](SPEC), (*SPEC.shape, 2)
    for mass, message in (
        (np.zeros(shape[1::-1] + (2,), np.float32), "wanted float32"),
        (np.zeros(shape), "wanted float32"),
        *((np.full(shape, value, np.float32), "in .0, 1.") for value in (np.nan, -0.5, 1.5)),
        *((np.full(shape, value, np.float32), "add up to 1 at most") for value in (1.0, 0.51)),
    ):
        refused(message, mapper.update, EvidentialGrid.trusted(SPEC, mass), np.eye(4), stamp=0.0)
    changed = EvidentialGrid.vacuous(SPEC)
    changed.mass[-1, -1] = 0.6
    refused("add up to 1 at most, got 1.2", mapper.update, changed, np.eye(4), stamp=0.0)
    assert mapper.scans == 0
    rounded = np.zeros(shape, np.float32)
    rounded[3, 3] = -0.0, -1e-9
    rounded[3, 2], rounded[2, 3] = (0.5, 0.5 + 1e-6), (0.0, 1.0)
    mapper.update(EvidentialGrid.trusted(SPEC, rounded), np.eye(4), stamp=0.0)
    assert np.isfinite(mapper.grid.mass).all()
