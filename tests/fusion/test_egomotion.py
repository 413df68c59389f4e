"""Ego motion: closed forms, a simulated drive, and sensors that lie."""

import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from cases import each, refused
from scipy.stats import chi2

from ogm.fusion.ego.smoothing import EgoMotion, EgoStates
from ogm.pose import pose

pytest.importorskip("filterpy", reason="no filterpy: pip install ogm-toolkit[track]")

GNSS = 1.0  # [m]
WHEELS, GYRO = 0.2, 0.02  # [m/s], [rad/s]


class Drive(NamedTuple):
    """What a vehicle did, and the measurements of its sensors: (stamp, kind, value, deviation), in order."""

    stamps: np.ndarray
    states: np.ndarray
    measured: list[tuple[float, str, Any, float]]


def simulated(seed: int, seconds: float = 10.0, glitch: float | None = None, gnss: float = 2.0) -> Drive:
    """Drive with white accelerations of 1 m/s^2 and 0.2 rad/s^2, in steps of 10 ms."""
    rng = np.random.default_rng(seed)
    dt, count = 0.01, round(seconds * 100)
    states = np.empty((count + 1, 5))
    states[0] = 3, -2, 3.0, 8, 0.2  # begins near the cut of the yaw at pi
    for k in range(count):
        x, y, yaw, speed, yaw_rate = states[k]
        middle = yaw + 0.5 * dt * yaw_rate
        states[k + 1] = (
            x + speed * dt * math.cos(middle),
            y + speed * dt * math.sin(middle),
            yaw + yaw_rate * dt,
            speed + rng.normal(0, 1.0 * math.sqrt(dt)),
            yaw_rate + rng.normal(0, 0.2 * math.sqrt(dt)),
        )
    stamps = np.arange(count + 1) * dt
    measured: list[tuple[float, str, Any, float]] = []
    for k in range(5, count + 1, 5):
        t = float(stamps[k])
        measured.append((t, "yaw_rate", states[k, 4] + rng.normal(0, GYRO), GYRO))
        if k % 10 == 0:
            measured.append((t, "speed", states[k, 3] + rng.normal(0, WHEELS), WHEELS))
        if k % round(100 / gnss) == 0:
            off = 30.0 if glitch is not None and abs(t - glitch) < 1e-6 else 0.0
            measured.append((t, "position", states[k, :2] + rng.normal(0, GNSS, 2) + [off, 0], GNSS))
    return Drive(stamps, states, measured)


def begin(drive: Drive, seed: int = 0, **settings: Any) -> EgoMotion:
    """Begin near the true state, as wrong as the deviations say."""
    deviation = np.array([0.5, 0.5, 0.05, 0.5, 0.05])
    start = drive.states[0] + np.random.default_rng(seed).normal(0, deviation)
    return EgoMotion(
        0.0,
        pose(start[0], start[1], yaw=start[2]),
        speed=start[3],
        yaw_rate=start[4],
        deviation=deviation,
        **{"acceleration": 1.0, "yaw_acceleration": 0.2, **settings},
    )


def run(ego: EgoMotion, measured: list) -> list[bool]:
    feed: dict[str, Callable[..., bool]] = {
        "speed": ego.speed,
        "yaw_rate": ego.yaw_rate,
        "position": ego.position,
        "pose": ego.pose,
    }
    return [feed[kind](stamp, value, deviation) for stamp, kind, value, deviation in measured]


def errors(drive: Drive, motion: EgoStates) -> np.ndarray:
    """Return departures from the truth, with those of the yaw in -pi ... pi."""
    away = motion.states - drive.states[np.searchsorted(drive.stamps, motion.stamps - 1e-6)]
    away[:, 2] = (away[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return away


def rms(away: np.ndarray) -> float:
    return float(np.sqrt((away[:, :2] ** 2).sum(axis=1).mean()))


def test_a_straight_line_is_straight() -> None:
    ego = EgoMotion(10.0, pose(1, 2, yaw=0.5), speed=5.0, deviation=[0.01] * 5)
    for t in np.arange(10.1, 12.05, 0.1):
        assert ego.speed(t, 5.0, 0.01)
        assert ego.yaw_rate(t, 0.0, 0.001)
    np.testing.assert_allclose(ego.state, [1 + 10 * math.cos(0.5), 2 + 10 * math.sin(0.5), 0.5, 5, 0], atol=0.02)
    T = ego.filtered().trajectory()
    np.testing.assert_allclose(T.poses[0], pose(1, 2, yaw=0.5), atol=1e-12)
    np.testing.assert_allclose(T.stamps, np.arange(10.0, 12.05, 0.1), atol=1e-9)


def test_a_circle_closes() -> None:
    # 2 pi rad at 0.5 rad/s and 5 m/s: a circle of 10 m.
    ego = EgoMotion(0.0, speed=5.0, yaw_rate=0.5, deviation=[0.001] * 5)
    stamps = np.linspace(0, 4 * math.pi, 127)[1:]
    for t in stamps:
        ego.speed(t, 5.0, 0.001)
        ego.yaw_rate(t, 0.5, 0.0001)
    path = ego.filtered().trajectory().poses
    np.testing.assert_allclose(np.hypot(path[:, 0, 3], path[:, 1, 3] - 10), 10, atol=0.03)
    np.testing.assert_allclose(path[-1], np.eye(4), atol=0.03)
    assert ego.state[2] == pytest.approx(2 * math.pi, abs=0.003)


def test_a_long_gap_is_the_same_as_many_short_ones() -> None:
    settings: dict[str, Any] = {"speed": 6.0, "yaw_rate": 0.4, "deviation": [0.3, 0.2, 0.02, 0.1, 0.02]}
    once, often = EgoMotion(0.0, **settings), EgoMotion(0.0, **settings)
    once.speed(2.0, 6.0, 1e6)
    for t in np.arange(0.05, 2.01, 0.05):
        often.speed(t, 6.0, 1e6)
    np.testing.assert_allclose(once.state, often.state, rtol=0.01, atol=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(once.covariance)), np.sqrt(np.diag(often.covariance)), rtol=0.1)


def test_the_filter_beats_its_sensors_and_the_smoother_beats_the_filter() -> None:
    raw, dead, filtered, smoothed = [], [], [], []
    for seed in range(2):
        drive = simulated(seed, seconds=12.0)
        ego = begin(drive, seed)
        run(ego, drive.measured)
        filtered.append(rms(errors(drive, ego.filtered())))
        smoothed.append(rms(errors(drive, ego.smoothed())))
        blind = begin(drive, seed)
        run(blind, [one for one in drive.measured if one[1] != "position"])
        dead.append(rms(errors(drive, blind.filtered())))
        raw.append(math.sqrt(2) * GNSS)
    assert np.mean(filtered) < 0.6 * np.mean(dead)
    assert np.mean(filtered) < 0.6 * np.mean(raw)
    assert np.mean(smoothed) < 0.8 * np.mean(filtered)
    assert all(s < f for s, f in zip(smoothed, filtered, strict=True))


@pytest.mark.slow
def test_the_errors_are_as_large_as_the_covariances_say() -> None:
    # Normalised estimation error squared: chi-square with 5 degrees of freedom. States of one drive depend on
    # each other, so independent drives are counted, each at one time.
    filtered, smoothed = [], []
    for seed in range(16):
        drive = simulated(100 + seed, seconds=3.0)
        ego = begin(drive, seed)
        run(ego, drive.measured)
        for counted, motion, k in ((filtered, ego.filtered(), -1), (smoothed, ego.smoothed(), 30)):
            away = errors(drive, motion)[k]
            counted.append(away @ np.linalg.solve(motion.covariances[k], away))
    low, high = chi2.ppf([0.001, 0.999], 5 * 16) / 16
    assert low < np.mean(filtered) < high
    assert low < np.mean(smoothed) < high


def test_a_glitch_is_refused_and_changes_nothing() -> None:
    drive = simulated(1, seconds=6.0, glitch=4.0)
    without = [one for one in drive.measured if not (one[1] == "position" and one[0] == pytest.approx(4.0))]
    ego, calm = begin(drive), begin(drive)
    accepted = run(ego, drive.measured)
    run(calm, without)
    assert ego.refused == {**calm.refused, "position": 1}
    assert accepted.count(False) == sum(ego.refused.values())
    np.testing.assert_allclose(ego.state, calm.state, atol=1e-9)
    drunk = begin(drive, gate=1.0)
    run(drunk, drive.measured)
    at = slice(-40, -20)
    assert rms(errors(drive, drunk.filtered())[at]) > 3 * rms(errors(drive, ego.filtered())[at])


def test_a_lost_filter_comes_back() -> None:
    drive = simulated(2)
    elsewhere = EgoMotion(
        0.0,
        pose(80, 60, yaw=drive.states[0, 2]),
        speed=8,
        deviation=[0.1, 0.1, 0.05, 0.5, 0.2],
        acceleration=1.0,
        yaw_acceleration=0.2,
        patience=4,
    )
    accepted = run(elsewhere, drive.measured)
    fixes = [yes for yes, one in zip(accepted, drive.measured, strict=True) if one[1] == "position"]
    assert fixes[:4] == [False, False, False, True]
    assert elsewhere.refused["position"] == 3 + fixes[4:].count(False)
    assert rms(errors(drive, elsewhere.filtered())[-100:]) < 2.0
    assert rms(errors(drive, elsewhere.smoothed())[-150:]) < 2.0


def test_an_unknown_heading_is_found() -> None:
    for wrong in (-1.5, 1.0):
        drive = simulated(5, gnss=10.0)
        ego = EgoMotion(
            0.0, pose(*drive.states[0, :2], yaw=drive.states[0, 2] + wrong), deviation=[1, 1, math.pi / 2, 10, 0.3]
        )
        run(ego, drive.measured)
        away = errors(drive, ego.filtered())
        assert np.abs(away[-100:, 2]).max() < 0.15
        assert rms(away[-100:]) < 1.0


def test_the_yaw_passes_pi_without_a_jump() -> None:
    ego = EgoMotion(0.0, pose(yaw=3.0), speed=3.0, yaw_rate=1.0, deviation=[0.1] * 5)
    for t in np.arange(0.1, 7.0, 0.1):
        turn = (3.0 + t + np.pi) % (2 * np.pi) - np.pi  # as a compass message it
        assert ego.pose(
            t, [3 * (math.sin(3 + t) - math.sin(3)), -3 * (math.cos(3 + t) - math.cos(3)), turn], [0.1, 0.1, 0.05]
        )
    for motion in (ego.filtered(), ego.smoothed()):
        np.testing.assert_allclose(np.diff(motion.states[:, 2]), 0.1, atol=0.03)
        np.testing.assert_allclose(motion.states[:, 2], 3 + motion.stamps, atol=0.05)


def test_poses_are_taken_as_numbers_or_as_a_matrix() -> None:
    one, other = EgoMotion(0.0), EgoMotion(0.0)
    assert one.pose(0.1, [0.2, 0.01, 0.02], [0.1, 0.1, 0.01])
    assert other.pose(0.1, pose(0.2, 0.01, 7.0, yaw=0.02), [0.1, 0.1, 0.01])
    np.testing.assert_allclose(one.state, other.state, atol=1e-12)


def test_the_order_of_simultaneous_measurements_does_not_matter() -> None:
    drive = simulated(3, seconds=5.0)
    there, back = begin(drive), begin(drive)
    run(there, drive.measured)
    run(back, sorted(reversed(drive.measured), key=lambda one: one[0]))
    np.testing.assert_allclose(back.state, there.state, atol=1e-6)
    np.testing.assert_allclose(back.covariance, there.covariance, atol=1e-6)


def test_a_stamp_that_repeats_counts_twice_and_adds_no_pose() -> None:
    ego = EgoMotion(0.0)
    for _ in range(10):
        ego.position(1.0, [2.0, 0.0], 1.0)
    assert len(ego.filtered().stamps) == 5  # 0 and four steps of a quarter second
    assert ego.covariance[0, 0] == pytest.approx(1 / 10, rel=0.01)
    assert ego.position(1.0 - 5e-4, [2.0, 0.0], 1.0)
    assert ego.stamp == 1.0


def test_what_makes_no_sense_changes_nothing() -> None:
    ego = EgoMotion(0.0)
    ego.speed(1.0, 1.0, 0.1)
    before = ego.state, ego.covariance, ego.stamp, len(ego.filtered().stamps)
    for measure, arguments, message in (
        (ego.speed, (0.9, 1.0, 0.1), "sort the measurements"),
        (ego.speed, (1.0 + 61, 1.0, 0.1), "start a new filter"),
        (ego.speed, (math.nan, 1.0, 0.1), "sort"),
        (ego.speed, (1.1, math.nan, 0.1), "finite"),
        (ego.speed, (1.1, 1.0, 0.0), "above 0"),
        (ego.yaw_rate, (1.1, 1.0, -1), "above 0"),
        (ego.position, (1.1, [1.0], 1), "2 finite numbers"),
        (ego.position, (1.1, [1.0, 2.0], [1, 1, 1]), "2 numbers"),
        (ego.pose, (1.1, [1.0, 2.0], [1, 1, 1]), "3 finite numbers"),
        (ego.pose, (1.1, np.diag([2.0, 2, 2, 1]), [1, 1, 1]), "rigid"),
        (ego.pose, (1.1, [1, 2, 3], 1.0), "3 numbers"),
    ):
        refused(message, measure, *arguments)
        now = ego.state, ego.covariance, ego.stamp, len(ego.filtered().stamps)
        for one, other in zip(before, now, strict=True):
            np.testing.assert_array_equal(one, other, err_msg=message)


def test_impossible_settings_are_refused() -> None:
    refused("stamp must be finite", EgoMotion, math.inf)
    for name, value, message in (
        ("T_map_vehicle", np.zeros((4, 4)), "T_map_vehicle"),
        ("deviation", [1, 1, 1], "5 numbers"),
        ("deviation", [1, 1, 1, 1, 0], "above 0"),
        ("acceleration", 0.0, "acceleration"),
        ("gate", 0.0, "gate"),
        ("patience", 0, "patience"),
    ):
        refused(message, EgoMotion, 0.0, **{name: value})


def test_a_missing_package_is_named_with_its_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    with pytest.raises(ImportError, match="ogm-toolkit\\[track\\]"):
        EgoMotion(0.0)


@each("off", [20.0, 1000.0])
def test_a_jump_of_the_position_leaves_heading_and_speed_alone(off: float) -> None:
    """GNSS that is off from some time on: after some patience the filter follows, and drives on straight ahead."""
    ego = EgoMotion(0.0, speed=10.0, deviation=(0.5, 0.5, 0.02, 0.3, 0.02), acceleration=1.0, yaw_acceleration=0.2)
    for k in range(1, 300):
        t = 0.1 * k
        ego.speed(t, 10.0, 0.1)
        ego.yaw_rate(t, 0.0, 0.01)
        ego.position(t, (10.0 * t, off if k >= 200 else 0.0), 1.0)
        assert abs(ego.state[2]) < 0.1
        assert abs(ego.state[3] - 10.0) < 0.5
    assert abs(ego.state[1] - off) < 3.0
