"""Which drive a sample is from, and with which lidar."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from cases import each, refused

from ogm.simulation.moments import draw_mount
from ogm.simulation.mounts import MOUNTS, LidarMount, single_sensor
from ogm.simulation.plan import SPLITS, DatasetPlan, moment, sample_rng

PLAN = DatasetPlan(seed=3)


def test_the_default_is_the_papers_recipe() -> None:
    assert DatasetPlan().counts == {"training": 10_000, "validation": 1_000, "test": 100, "sequences": 0}
    assert sum(mount.share for mount in MOUNTS if mount.lidar == "vlp-32c") == pytest.approx(0.85)


def test_ten_drives_of_a_thousand_seconds_half_of_them_clockwise() -> None:
    moments = [moment(PLAN, "training", i) for i in range(10_000)]
    assert len({(one.scenario, one.time) for one in moments}) == 10_000
    assert [sum(one.scenario == k for one in moments) for k in range(10)] == [1000] * 10
    assert len({one.traffic for one in moments}) == 10
    assert sum(one.clockwise for one in moments) == 5_000
    assert len({one.town for one in moments}) == 1
    assert min(one.time for one in moments) == 20
    assert max(one.time for one in moments) < 1200
    within = [b.time - a.time for a, b in zip(moments, moments[1:], strict=False) if a.scenario == b.scenario]
    assert set(within) == {1.0}


def test_validation_is_the_same_town_and_test_another() -> None:
    train, valid, test = (moment(PLAN, split, 0) for split in SPLITS[:3])
    assert train.town == valid.town != test.town
    assert len({train.traffic, valid.traffic, test.traffic}) == 3
    assert moment(replace(PLAN, seed=4), "training", 0).town != train.town


def test_sequences_are_ten_seconds_at_ten_hertz() -> None:
    piece = [moment(PLAN, "sequences", i) for i in range(200)]
    assert {one.scenario for one in piece[:100]} == {0}
    assert {one.scenario for one in piece[100:]} == {1}
    np.testing.assert_allclose(np.diff([one.time for one in piece[:100]]), 0.1)
    mixed = replace(PLAN, mounts=(LidarMount("vlp-32c"), LidarMount("hdl-32e", 1.0, (1.5, 2.5), (0, 0.4), 0.05)))
    assert len({draw_mount(mixed, "sequences", i) for i in range(100)}) == 1
    assert len({draw_mount(mixed, "sequences", 100 * i) for i in range(20)}) > 5


def test_mounts_come_by_their_shares_and_in_their_bounds() -> None:
    draws = [draw_mount(PLAN, "training", i) for i in range(2000)]
    for mount in MOUNTS:
        got = sum(one is mount for one, _ in draws) / len(draws)
        assert got == pytest.approx(mount.share, abs=4 * np.sqrt(mount.share / len(draws)))
    for mount, (height, forward, roll, pitch) in draws:
        low, high = mount.height or (1.9, 1.9)
        assert low <= height <= high
        assert mount.forward[0] <= forward <= mount.forward[1]
        assert max(abs(roll), abs(pitch)) <= mount.tilt


def test_random_numbers_belong_to_one_sample_and_purpose() -> None:
    keys = [(p, s, i, k) for p in (PLAN, DatasetPlan(seed=4)) for s in SPLITS for i in (0, 1) for k in (0, 1)]
    assert len({sample_rng(*key).integers(2**60) for key in keys}) == len(keys)
    assert sample_rng(PLAN, "test", 5, 0).integers(2**60) == sample_rng(PLAN, "test", 5, 0).integers(2**60)


def test_plans_go_through_json() -> None:
    plan = DatasetPlan(seed=9, truth="hd", mounts=(LidarMount("os1-64", 2.0, (1.5, 1.6)), *single_sensor("vlp-32c")))
    assert DatasetPlan.from_dict(json.loads(json.dumps(asdict(plan)))) == plan
    refused("unknown to this version.*colour", DatasetPlan.from_dict, asdict(plan) | {"colour": "red"})


def test_plans_of_older_data_sets_lack_settings_that_came_later() -> None:
    older = {name: value for name, value in asdict(PLAN).items() if name not in ("drives", "test_towns", "spacing")}
    assert DatasetPlan.from_dict(older) == PLAN
    del older["town_size"]
    refused("or lacks some.*town_size", DatasetPlan.from_dict, older)


def test_only_the_counts_of_a_plan_may_grow() -> None:
    counts = {samples: DatasetPlan.from_options(samples=samples).counts for samples in (1, 9, 25, 200)}
    assert [one["validation"] for one in counts.values()] == [1, 1, 2, 20]
    assert [one["test"] for one in counts.values()] == [0, 0, 0, 2]
    assert replace(PLAN, samples=20).grown(replace(PLAN, test=200)) == replace(PLAN, test=200)
    refused("begun with truth = hd, got aimed", PLAN.grown, replace(PLAN, truth="hd"))
    refused(
        "begun with mounts = 1 x hdl-32e, got 0.8 x vlp-32c", PLAN.grown, replace(PLAN, mounts=single_sensor("hdl-32e"))
    )


@each("wrong, message", [
        ({"samples": -1}, "samples must be a whole number"),
        ({"seed": 1.5}, "seed must be a whole number"),
        ({"samples": 0, "validation": 0, "test": 0}, "would be empty"),
        ({"truth": "drawn"}, '"aimed", "hd" or "none"'),
        ({"mounts": ()}, "mounts are empty"),
        ({"town_size": 3.0}, "town_size must be in 240 ... 1000 m"),
        ({"towns": 11}, "towns must be in 1 ... 10, the number of drives"),
        ({"drives": 0}, "drives must be in 1 ... 1000"),
        ({"drives": 4, "test_towns": 5}, "test_towns must be in 1 ... 4, the number of drives"),
        ({"test_towns": 1.5}, "test_towns must be a whole number"),
        ({"spacing": 0.0}, "spacing must be in 0.1 ... 100 s"),
        ({"spacing": float("nan")}, "spacing must be in 0.1 ... 100 s"),
        ({"bad_weather": 1.2}, "bad_weather must be in 0 ... 1, a share"),
        ({"in_motion": float("nan")}, "in_motion must be in 0 ... 1, a share"),
    ])  # fmt: skip
def test_impossible_plans_are_reported(wrong: dict, message: str) -> None:
    refused(message, DatasetPlan, **wrong)


@each("wrong, message", [
        ({"share": 0.0}, "share of vlp-32c"),
        ({"height": (2.0, 1.0)}, "height of vlp-32c must be an ascending pair"),
        ({"height": (0.0, 1.0)}, "height of vlp-32c"),
        ({"forward": (-9.0, 1.0)}, "forward of vlp-32c"),
        ({"tilt": 1.0}, "tilt of vlp-32c"),
    ])  # fmt: skip
def test_impossible_mounts_are_reported(wrong: dict, message: str) -> None:
    refused(message, LidarMount, "vlp-32c", **wrong)


def test_unknown_splits_and_numbers_are_reported() -> None:
    refused("split must be one of", moment, PLAN, "train", 0)
    refused("index must be 0 or more", moment, PLAN, "training", -1)


def test_drives_take_turns_through_several_towns_and_never_the_tests() -> None:
    plan = DatasetPlan(towns=3)
    towns = [moment(plan, "training", 10 * run).town for run in range(20)]
    assert len(set(towns)) == 3
    assert towns[:3] == towns[3:6]
    assert towns[0] == moment(DatasetPlan(), "training", 0).town  # the first one is the paper's only one
    assert moment(plan, "validation", 0).town == towns[0]
    tests = {moment(plan, "test", k).town for k in range(0, 200, 10)}
    assert len(tests) == 1
    assert tests.isdisjoint(towns)
    refused("towns", DatasetPlan, towns=0)


@each("towns", [1, 2, 3, 4, 5, 10])
def test_every_town_is_driven_both_ways(towns: int) -> None:
    plan = DatasetPlan(towns=towns)
    drives = {moment(plan, "training", 10 * run)[:3] for run in range(10)}
    ways = {(drive[0], drive[2]) for drive in drives}
    assert sum(way for *_, way in drives) == 5
    assert len(ways) == (2 * towns if towns <= 5 else towns)


def test_a_test_of_many_drives_goes_through_towns_that_no_training_uses() -> None:
    plan = DatasetPlan(test=240, drives=24, test_towns=6, spacing=5.0, towns=24)
    moments = [moment(plan, "test", i) for i in range(240)]
    drives: dict[int, list] = {}
    for one in moments:
        drives.setdefault(one.scenario, []).append(one)
    assert sorted(drives) == [*range(24)]
    for drive in drives.values():
        assert [one.time for one in drive] == [20.0 + 5.0 * k for k in range(10)]
        assert len({one[:4] for one in drive}) == 1
    towns = {one.town for one in moments}
    assert len(towns) == 6
    assert len({one[:3] for one in moments}) == 24
    assert all(sum(drive[0].clockwise for drive in drives.values() if drive[0].town == town) == 2 for town in towns)
    training = {moment(plan, split, 10 * k).town for split in ("training", "validation") for k in range(24)}
    assert len(training) == 24
    assert towns.isdisjoint(training)
    assert moment(plan, "test", 240).time == 20.0 + 50.0  # the first drive goes on


def test_drives_end_before_the_traffic_does() -> None:
    for spacing in (0.1, 100.0):
        plan = DatasetPlan(drives=2, spacing=spacing)
        times = [one.time for one in (moment(plan, "training", i) for i in range(21_000)) if one.scenario == 0]
        assert len(times) >= 10
        assert max(times) <= 1020


def test_the_moments_of_the_default_are_those_of_older_data_sets() -> None:
    """The data sets in use were made from these towns and this traffic."""
    found = [moment(DatasetPlan(), split, 57) for split in SPLITS]
    assert [one[:2] for one in found] == [
        (917752063, 1086352446), (917752063, 242265286), (594516694, 1743390123), (917752063, 1911094848),
    ]  # fmt: skip
    later = moment(DatasetPlan(seed=2, towns=4), "test", 10_015)
    assert later == (153813223, 1263981984, False, 11, 25.0)
