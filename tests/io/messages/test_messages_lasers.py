"""Messages of planar lasers and range sensors: conventions of drivers for ranges, angles, times and intensities."""

import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each, refused

from ogm.io.messages import scan_from_laser_scan, scan_from_range
from ogm.io.messages.plain import header

NAN, INF = np.nan, np.inf


def laser(ranges: Any, **changed: Any) -> SimpleNamespace:
    """Return a LaserScan of 1 degree per beam, from -2 degrees on, of 0.1 to 8 m."""
    step, count = np.radians(1.0), np.size(ranges)
    given = {
        "angle_min": -2 * step, "angle_max": (count - 3) * step, "angle_increment": step, "time_increment": 0.0,
        "scan_time": 0.0, "range_min": 0.1, "range_max": 8.0, "intensities": [], "ranges": ranges, **changed,
    }  # fmt: skip
    return SimpleNamespace(header=header(12.5, "laser"), **given)


def sonar(distance: float, **changed: Any) -> SimpleNamespace:
    given = {"field_of_view": 0.5, "min_range": 0.2, "max_range": 4.0, "range": distance, **changed}
    return SimpleNamespace(header=header(12.5, "sonar"), radiation_type=0, **given)


def azimuths(directions: np.ndarray) -> list[float]:
    return np.degrees(np.arctan2(directions[:, 1], directions[:, 0])).round(2).tolist()


def test_a_laser_scan_has_points_in_its_plane_and_beams_without_echo() -> None:
    scan = scan_from_laser_scan(laser(np.array([1.0, 2.0, INF, 4.0, 8.0], np.float32)))
    np.testing.assert_allclose(np.hypot(*scan.points[:, :2].T), [1, 2, 4], atol=1e-6)
    assert azimuths(scan.points) == [-2, -1, 1]
    assert not scan.points[:, 2:].any()
    assert azimuths(scan.no_returns) == [0, 2]
    assert (scan.kind, scan.max_range, scan.beam_width, scan.stamp, scan.time) == ("planar", 8.0, None, 12.5, None)


@each("distance, free", [
        (INF, True), (8.0, True), (7.9999995, True), (9.0, True), (81.91, True), (65.533, True),
        (-INF, False), (NAN, False), (0.0, False), (-1.0, False), (0.05, False),
    ])  # fmt: skip
def test_only_no_echo_is_free_and_what_is_too_near_or_bad_is_unknown(distance: float, free: bool) -> None:
    for scan in (scan_from_laser_scan(laser([distance])), scan_from_range(sonar(distance))):
        assert len(scan) == 0
        assert len(scan.no_returns) == free


@each("limits, echoes, far", [
        ((0.1, 0.0), 3, None), ((0.1, NAN), 3, None), ((0.1, INF), 3, None), ((0.1, 3.4e38), 3, None),
        ((8.0, 0.1), 4, None), ((NAN, 8.0), 2, 8.0), ((-1.0, 8.0), 2, 8.0),
    ])  # fmt: skip
def test_limits_that_are_none_are_not_used(limits: tuple[float, float], echoes: int, far: float | None) -> None:
    scan = scan_from_laser_scan(laser([0.05, 7.0, 20.0, 9.0, INF, NAN], range_min=limits[0], range_max=limits[1]))
    assert (len(scan), scan.max_range) == (echoes, far)
    assert len(scan.no_returns) == (1 if far is None else 3)


@each("angles, expected, text", [
        ((-90, 90, 45), [-90, -45, 0, 45, 90], ""),
        ((90, -90, -45), [90, 45, 0, -45, -90], ""),  # to the right
        ((-90, 135, 45), [-90, -45, 0, 45, 90], ""),  # the angle after the last beam
        ((100, -80, 45), [100, 145, -170, -125, -80], ""),  # over the back
        ((-90, 90, 0), [-90, -45, 0, 45, 90], "angle_max is used"),
        ((-90, 90, NAN), [-90, -45, 0, 45, 90], "angle_max is used"),
        ((-90, 90, 45 * 180 / np.pi), [-90, -45, 0, 45, 90], "angle_max is used"),  # in degrees
        ((-90, NAN, 45), [-90, -45, 0, 45, 90], "the increment is used"),
        ((-90, 90, 20), [-90, -70, -50, -30, -10], "the increment is used"),
        ((90, -90, 45), [90, 135, 180, -135, -90], ""),
        ((90, -45, 40), [90, 130, 170, -150, -110], "the increment is used"),
    ])  # fmt: skip
def test_angles_come_from_the_increment_unless_it_gives_none(
    angles: tuple[float, ...], expected: list[float], text: str, caplog: pytest.LogCaptureFixture
) -> None:
    start, end, step = np.radians(angles)
    scan = scan_from_laser_scan(laser([1.0] * 5, angle_min=start, angle_max=end, angle_increment=step))
    difference = (np.array(azimuths(scan.points)) - expected + 180) % 360 - 180
    np.testing.assert_allclose(difference, 0, atol=0.02)
    assert (text in caplog.text) if text else not caplog.text


@each("changed, message", [
        ({"angle_increment": 0.0, "angle_max": -0.5, "angle_min": -0.5}, "give no directions within a turn"),
        ({"angle_min": -90.0, "angle_max": 90.0, "angle_increment": 1.0}, "wanted radians"),
        ({"angle_min": NAN}, "wanted radians"),
        ({"ranges": ["a"] * 4}, "ranges that are not numeric"),
        ({"ranges": 4.0}, "no lists"),
    ])  # fmt: skip
def test_angles_and_ranges_that_decide_the_scan_are_refused(changed: dict[str, Any], message: str) -> None:
    refused(message, scan_from_laser_scan, laser(**{"ranges": [1.0] * 4, **changed}))


def test_times_count_from_the_stamp_unless_they_are_of_no_scan() -> None:
    scan = scan_from_laser_scan(laser([1.0, NAN, 2.0, INF, 3.0], time_increment=0.01, scan_time=0.05))
    np.testing.assert_allclose(scan.time, [0, 0.02, 0.04])
    assert scan_from_laser_scan(laser([1.0, 2.0], time_increment=-0.01)).time.tolist() == [0, -0.01]
    for step, length in ((1e6, 0.05), (NAN, 0.0), (5.0, 0.0), (0.05, 0.05)):
        assert scan_from_laser_scan(laser([1.0] * 5, time_increment=step, scan_time=length)).time is None


def test_intensities_are_those_of_the_echoes_unless_their_number_differs() -> None:
    raw = np.array([51.0, 102.0, 204.0, 255.0, 0.0], np.float32)
    scan = scan_from_laser_scan(laser([1.0, INF, 2.0, NAN, 3.0], intensities=raw))
    np.testing.assert_allclose(scan.points[:, 3], [0.2, 0.8, 0.0], atol=1e-6)
    assert not scan_from_laser_scan(laser([1.0, 2.0], intensities=raw)).points[:, 3].any()
    assert not scan_from_laser_scan(laser([1.0] * 5, intensities=np.zeros(5))).points[:, 3].any()


def test_all_echoes_of_a_beam_are_points_and_a_beam_with_one_is_not_without() -> None:
    lists = [[1.0, 5.0], [], [INF], [9.0, 9.5], [2.0, INF]]
    echoes = [SimpleNamespace(echoes=np.array(one, np.float32)) for one in lists]
    scan = scan_from_laser_scan(laser(echoes, intensities=echoes))
    np.testing.assert_allclose(np.hypot(*scan.points[:, :2].T), [1, 5, 2], atol=1e-6)
    assert azimuths(scan.points) == [-2, -2, 2]
    assert azimuths(scan.no_returns) == [0, 1]  # the empty list is unknown
    np.testing.assert_allclose(scan.points[:, 3] * 255, [1, 5, 2], rtol=1e-6)


def test_a_range_is_one_point_on_the_axis_of_a_cone(caplog: pytest.LogCaptureFixture) -> None:
    scan = scan_from_range(sonar(1.5))
    assert scan.points.tolist() == [[1.5, 0, 0, 0]]
    assert (scan.kind, scan.max_range, scan.beam_width, len(scan.no_returns)) == ("cone", 4.0, 0.5, 0)
    assert scan_from_range(sonar(4.0)).no_returns.tolist() == [[1, 0, 0]]
    assert scan_from_range(sonar(1.5, field_of_view=0.0)).beam_width is None
    assert "field of view of 0 rad" in caplog.text


def test_a_binary_ranger_is_free_without_detection_and_unknown_with_one(caplog: pytest.LogCaptureFixture) -> None:
    binary = {"min_range": 0.5, "max_range": 0.5}
    silent, detected = (scan_from_range(sonar(value, **binary)) for value in (INF, -INF))
    assert (len(silent), silent.no_returns.tolist(), silent.max_range) == (0, [[1, 0, 0]], 0.5)
    assert (len(detected), len(detected.no_returns)) == (0, 0)
    assert "a detection at an unknown distance up to 0.5 m" in caplog.text


def test_unknown_ranges_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        scan_from_laser_scan(laser([1.0, 0.0, NAN, INF]))
    assert "2 of 4 ranges are 0, too near or NaN; their beams are unknown" in caplog.text
