"""Scan, Mount, Boxes, Frame, and models that are run on frames."""

import math
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from cases import each, refused

from ogm import Boxes, EvidentialGrid, Frame, GridSpec, InverseSensorModel, Mount, Scan
from ogm.models import load_model
from ogm.pose import inverse, pose
from ogm.scan import LazyFrame, LazyScan, as_scan, mount_of, run_model

POINTS = np.arange(20, dtype=np.float32).reshape(5, 4)
RANGE: dict[str, Any] = {"kind": "planar", "max_range": 8.0, "beam_width": 0.0175}
SPEC = GridSpec.centered(8.0, 8.0, 0.5)

# --- Scan -----------------------------------------------------------------------------------------


def test_float32_points_are_not_copied_and_others_become_float32() -> None:
    assert Scan(POINTS).points is POINTS
    assert Scan(POINTS.astype(np.float64)).points.dtype == np.float32
    assert Scan(POINTS.astype(np.float16)).points.dtype == np.float32
    assert len(Scan(POINTS)) == 5
    np.testing.assert_array_equal(Scan(POINTS[:, :3]).points, POINTS * [1, 1, 1, 0])  # without intensities


def test_an_array_is_a_scan_without_extras_and_a_scan_is_itself() -> None:
    scan = Scan(POINTS, stamp=2.0)
    assert as_scan(scan) is scan
    bare = as_scan(POINTS)
    assert bare.points is POINTS
    assert (bare.stamp, bare.time, bare.ring, bare.no_returns, bare.sensor) == (None, None, None, None, "")
    refused(r"got list; give np\.asarray", as_scan, [[0.0, 0.0, 0.0, 0.0]], error=TypeError)
    refused(r"a Scan already; give scan\.points", Scan, scan, error=TypeError)


def test_columns_that_do_not_fit_are_refused() -> None:
    for name in ("time", "ring", "doppler", "rcs"):
        dtype = {"time": np.float64, "ring": np.uint16}.get(name, np.float32)
        column = getattr(Scan(POINTS, **{name: [5, 4, 3, 2, 1]}), name)
        assert column.dtype == dtype
        assert column.tolist() == [5, 4, 3, 2, 1]
        message = rf"{name} must be \(5,\) like points, got shape \(4,\)"
        refused(message, Scan, POINTS, **{name: np.zeros(4)})
    assert Scan(POINTS, no_returns=np.zeros((0, 3))).no_returns.dtype == np.float32
    for shape in ((3,), (7, 2), (7, 4), (1, 7, 3), (3, 5, 3)):
        message = r"no_returns must be directions of shape \(M, 3\), got"
        refused(message, Scan, POINTS, no_returns=np.zeros(shape))
    for width in (0.0, -1.0, np.inf, np.nan):
        refused("doppler_interval must be a width above 0", Scan, POINTS, doppler_interval=width)
        refused(r"max_range must be a range above 0 \[m\], got", Scan, POINTS, max_range=width)
        refused(r"beam_width must be an angle above 0, at most 2 pi \[rad\], got", Scan, POINTS, beam_width=width)
    refused("kind must be one of '', 'planar', 'depth', 'cone', got 'laser'", Scan, POINTS, kind="laser")


@each("keep", [np.array([True, False, True, False, False]), np.array([2, 0]), slice(1, None)])
def test_select_keeps_columns_with_their_points_and_all_beams_without_echo(keep: Any) -> None:
    columns = {name: np.arange(5) * 10 for name in ("time", "ring", "doppler", "rcs")}
    scan = Scan(POINTS, stamp=1.0, no_returns=np.eye(3), sensor="top", doppler_interval=40.0, **RANGE, **columns)
    some = scan.select(keep)
    np.testing.assert_array_equal(some.points, POINTS[keep])
    for name in columns:
        np.testing.assert_array_equal(getattr(some, name), columns[name][keep])
    assert (some.stamp, some.sensor, some.doppler_interval) == (1.0, "top", 40.0)
    np.testing.assert_array_equal(some.no_returns, np.eye(3))
    lazy = LazyScan.of(scan, lambda: Mount(0.3))
    for copied in (some, lazy, lazy.select(keep), pickle.loads(pickle.dumps(lazy)), pickle.loads(pickle.dumps(some))):
        assert {name: getattr(copied, name) for name in RANGE} == RANGE


@each("message, columns", [
        ("ring must be whole numbers from 0 to 65535, got -1 to 70000", {"ring": np.array([70_000, -1, 0, 0, 0])}),
        ("ring must be whole numbers", {"ring": np.array([1.0, np.nan, 0, 0, 0])}),
        ("ring must be whole numbers", {"ring": [0.5] * 5}),
        ("ring must be numbers, got <U1", {"ring": list("abcde")}),
        (r"time must be finite \[s\], time\[1\] is not", {"time": [0.0, np.nan, 0.1, 0.2, np.inf]}),
        ("time must be numbers, got datetime64", {"time": np.zeros(5, "M8[ns]")}),
        ("time must be numbers, got complex128", {"time": np.zeros(5, complex)}),
        ("doppler must be numbers, got object", {"doppler": [None] * 5}),
    ])  # fmt: skip
def test_columns_of_no_such_numbers_are_refused(message: str, columns: dict) -> None:
    refused(message, Scan, POINTS, **columns)


def test_a_matrix_of_points_becomes_an_array() -> None:
    with pytest.warns(PendingDeprecationWarning):
        matrix = np.matrix(POINTS)
    assert type(Scan(matrix).points) is np.ndarray


@each("stamp", [np.float32(1.7e9), np.float32(20_000.0), np.float16(10.0)])
def test_coarse_stamps_are_refused(stamp: np.floating) -> None:
    refused("stamp must resolve a millisecond, .* give a float64", Scan, POINTS, stamp=stamp)
    assert Scan(POINTS, stamp=np.float32(100.0)).stamp == 100.0


def test_a_scan_is_printed_on_one_line_and_cannot_be_changed() -> None:
    scan = Scan(POINTS, stamp=1.5, ring=np.zeros(5), no_returns=np.eye(3))
    assert repr(scan) == "Scan(5 points, stamp 1.5 s, ring, no_returns)"
    planar = "Scan(planar, 5 points, max_range 8 m, beam_width 0.0175 rad)"
    assert repr(Scan(POINTS, **RANGE)) == planar
    with pytest.raises(FrozenInstanceError):
        scan.points = POINTS


# --- Mount ----------------------------------------------------------------------------------------


def test_the_default_mount_is_level_and_its_footprint_lies_around_the_sensor() -> None:
    mount = Mount(1.7)
    np.testing.assert_array_equal(mount.T_vehicle_sensor, np.eye(4))
    assert mount.ego_footprint == (-2.5, 2.5, -1.1, 1.1)
    assert mount.ground_point == (0.0, 0.0, -1.7)
    moved = Mount(1.7, pose(1.0, 0.5, 2.0))
    assert moved.ego_footprint == (-1.5, 3.5, pytest.approx(-0.6), 1.6)
    assert moved.ground_point == pytest.approx((1.0, 0.5, 0.3))
    np.testing.assert_array_equal(moved.origin, [1.0, 0.5, 2.0])


def test_equal_mounts_have_one_hash() -> None:
    same = [Mount(1.7, pose(1, yaw=0.1)), Mount(1.7, pose(1, yaw=0.1).tolist())]
    assert len({*same}) == 1
    others = [
        Mount(1.8, pose(1, yaw=0.1)),
        Mount(1.7, pose(1, yaw=0.2)),
        Mount(1.7, pose(1, yaw=0.1), (0, 0, 0, 0)),
        Mount(1.7, pose(1, yaw=0.1), points_in="vehicle"),
    ]
    assert len({*same, *others}) == 5
    assert same[0] != "a mount"
    assert Mount(1.7, -0.0 * pose() + np.eye(4)) == Mount(1.7)


def test_a_mount_keeps_its_own_pose() -> None:
    T = pose(1.0)
    mount = Mount(1.7, T)
    T[0, 3] = 5.0
    assert mount.origin[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        mount.T_vehicle_sensor[0, 3] = 5.0


def test_the_level_frame_is_parallel_to_the_vehicle_and_centred_on_the_sensor() -> None:
    mount = Mount(1.7, pose(1.0, 2.0, 1.5, roll=0.1, pitch=-0.2, yaw=0.3))
    T_vehicle_level = mount.T_vehicle_sensor @ mount.T_sensor_level
    np.testing.assert_allclose(T_vehicle_level, pose(1.0, 2.0, 1.5), atol=1e-12)
    np.testing.assert_array_equal(mount.T_vehicle_points, mount.T_vehicle_sensor)
    there = Mount(1.7, mount.T_vehicle_sensor, points_in="vehicle")
    np.testing.assert_array_equal(there.T_vehicle_points, np.eye(4))


def test_impossible_mounts_are_refused() -> None:
    for name, value, message in (
        ("sensor_height", 0.0, "sensor_height must be above ground and below 100 m, got 0.0"),
        ("sensor_height", math.nan, "sensor_height"),
        ("sensor_height", 120.0, "sensor_height"),
        ("points_in", "map", 'points_in must be "sensor" or "vehicle", got \'map\''),
        ("T_vehicle_sensor", np.eye(3), "T_vehicle_sensor must be a 4x4"),
        ("T_vehicle_sensor", 2 * np.eye(4), "last row of T_vehicle_sensor"),
        ("ego_footprint", (1, 0, 0, 1), "ego_footprint must be finite x_min <= x_max"),
        ("ego_footprint", (0, 1, 1, 0), "ego_footprint"),
        ("ego_footprint", (0, math.inf, 0, 1), "ego_footprint"),
        ("ego_footprint", (0, 1, 0), "ego_footprint"),
    ):
        refused(message, Mount, **{"sensor_height": 1.7, name: value})


# --- Boxes ----------------------------------------------------------------------------------------

BOXES = Boxes(
    center=[(10, 0, 1), (0, 5, 2)],
    size=[(4, 2, 1.5), (1, 1, 2)],
    yaw=[0.0, 1.0],
    velocity=[(3, 0), (math.nan, math.nan)],
    label=["car", "person"],
    track=["a", "b"],
)


def test_boxes_have_a_bottom_and_a_top() -> None:
    assert BOXES.bottom.tolist() == [0.25, 1.0]
    assert BOXES.top.tolist() == [1.75, 3.0]
    assert len(BOXES) == 2
    assert repr(BOXES) == "Boxes(2: car, person)"
    assert len(Boxes.empty()) == 0
    assert repr(Boxes.empty()) == "Boxes(0)"


def test_moving_boxes_there_and_back_changes_nothing() -> None:
    T = pose(3.0, -2.0, 1.0, yaw=0.7)
    moved = BOXES.moved(T)
    np.testing.assert_allclose(moved.center[0], (T @ [10, 0, 1, 1])[:3])
    np.testing.assert_allclose(moved.velocity[0], [3 * math.cos(0.7), 3 * math.sin(0.7)])
    np.testing.assert_allclose(moved.yaw, [0.7, 1.7])
    assert (moved.label, moved.track) == (BOXES.label, BOXES.track)
    back = moved.moved(inverse(T))
    for name in ("center", "size", "yaw", "velocity"):
        np.testing.assert_allclose(getattr(back, name), getattr(BOXES, name), atol=1e-12)


def test_widened_boxes_grow_on_every_side() -> None:
    wide = BOXES.widened(0.5)
    np.testing.assert_array_equal(wide.size, BOXES.size + 1.0)
    np.testing.assert_array_equal(wide.center, BOXES.center)
    np.testing.assert_array_equal(wide.bottom, BOXES.bottom - 0.5)


@each("keep", [[False, True], [1], np.array([1])])
def test_selected_boxes_keep_their_columns(keep: Any) -> None:
    one = BOXES.select(keep)
    assert one.center.tolist() == [[0, 5, 2]]
    assert one.velocity.shape == (1, 2)
    assert (one.label, one.track) == (("person",), ("b",))
    assert len(BOXES.select([False, False])) == 0
    assert len(Boxes.empty().select([])) == 0


def test_what_are_no_boxes_is_refused() -> None:
    good = {"center": BOXES.center, "size": BOXES.size, "yaw": BOXES.yaw, "label": BOXES.label}
    for name, column, message in (
        ("yaw", [0.0], "one yaw per box, got 2 boxes and 1 of yaw"),
        ("label", ["car"], "one label per box"),
        ("velocity", [(1, 0)], "one velocity per box"),
        ("size", [(1, 1, 1), (1, 0, 1)], r"box 1 \(person\) must be finite"),
        ("center", [(0, 0, 0), (0, math.inf, 0)], r"box 1 \(person\)"),
        ("yaw", [math.nan, 0], r"box 0 \(car\)"),
    ):
        refused(message, Boxes, **good | {name: column})


# --- Frame ----------------------------------------------------------------------------------------


def test_a_lazy_frame_reads_once_and_only_when_asked() -> None:
    calls: list[str] = []

    def give(name: str, value: Any) -> Any:
        return lambda: calls.append(name) or value

    scan = Scan(POINTS)
    parts = (give("scan", scan), give("mount", Mount(1.7)), give("boxes", None), give("truth", None))
    frame = LazyFrame(*parts, name="007")
    assert repr(frame) == "Frame('007')"
    assert calls == []
    assert frame.scan is frame.scan
    assert frame.scan.points is scan.points
    assert calls == ["scan"]
    assert frame.scan.mount is frame.mount is frame.mount
    assert calls == ["scan", "mount"]
    assert pickle.loads(pickle.dumps(frame.scan)).mount == Mount(1.7)
    assert frame.boxes is None
    assert frame.truth is frame.boxes
    assert calls == ["scan", "mount", "boxes", "truth"]


def test_a_frame_holds_values_too_and_cannot_be_changed() -> None:
    frame = Frame(Scan(POINTS), Mount(1.7), BOXES, None, np.eye(4), 3.0, "7", "drive")
    assert frame.boxes is BOXES
    assert (frame.stamp, frame.sequence, repr(frame)) == (3.0, "drive", "Frame('7' of drive)")
    with pytest.raises(FrozenInstanceError):
        frame.scan = Scan(POINTS)


def test_a_field_that_cannot_be_read_raises_at_every_access() -> None:
    def broken() -> Scan:
        raise ValueError("damaged")

    frame = LazyFrame(broken, lambda: Mount(1.7))
    for _ in range(2):
        with pytest.raises(ValueError, match="damaged"):
            frame.scan  # noqa: B018
    assert frame.mount == Mount(1.7)


def test_a_frame_gives_its_mount_to_its_scan() -> None:
    for scan in (Scan(POINTS), Scan(POINTS, mount=Mount(3.0))):
        assert Frame(scan, Mount(1.7)).scan.mount == Mount(1.7)
    refused(r"mount must be an ogm.Mount, got 1.7", Scan, POINTS, mount=1.7, error=TypeError)


def test_a_scan_can_be_read_where_its_mount_is_not_known() -> None:
    def unknown() -> Mount:
        raise ValueError("no scan shows the ground")

    frame = LazyFrame(lambda: Scan(POINTS), unknown)
    assert len(frame.scan.select(slice(1))) == 1
    for scan in (frame.scan, frame.scan.select(slice(1))):
        refused("no scan shows the ground", ConstantModel(), scan)
    assert run_model(ConstantModel(Mount(2.0)), frame).free.max() == pytest.approx(0.2)
    refused("the mount of the sensor is unknown", ConstantModel(), Scan(POINTS))


# --- Models ---------------------------------------------------------------------------------------


class ConstantModel:
    """Gives every cell the sensor height's tenth as mass of free."""

    def __init__(self, mount: Mount | None = None) -> None:
        self.spec, self.mount = SPEC, mount

    def __call__(self, scan: Scan) -> EvidentialGrid:
        assert isinstance(scan, Scan)
        height = mount_of(scan, self.mount).sensor_height
        return EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), (height / 10, 0), np.float32))


def frame_at(height: float) -> Frame:
    return Frame(Scan(POINTS), Mount(height))


def test_any_callable_with_a_spec_is_a_model() -> None:
    model = ConstantModel(Mount(2.0))
    assert isinstance(model, InverseSensorModel)
    assert not isinstance(lambda scan: None, InverseSensorModel)
    assert run_model(model, frame_at(5.0)).free.max() == pytest.approx(0.2)


def test_a_model_without_a_mount_takes_that_of_each_scan() -> None:
    heights = [run_model(ConstantModel(), frame_at(height)).free.max() for height in (1.0, 3.0, 1.0, 3.0)]
    assert heights == pytest.approx([0.1, 0.3, 0.1, 0.3])


@pytest.mark.parametrize("name", ["ray", "height-band", "radar", "lite", "combined"])
def test_a_models_own_mount_wins_over_the_scans(name: str) -> None:
    spec = GridSpec.centered(length=10.24, width=10.24, resolution=0.16)
    points = np.random.default_rng(1).uniform((-4, -4, -2, 0.1), (4, 4, 0, 0.2), (4000, 4)).astype(np.float32)
    one, two = Mount(1.7, pose(0.5, 0.2, 1.7)), Mount(1.9, pose(-0.5, 0.1, 1.9))
    with_mount, without = load_model(name, spec, one), load_model(name, spec)
    expected = with_mount(Scan(points)).mass
    np.testing.assert_array_equal(with_mount(Scan(points, mount=two)).mass, expected)
    np.testing.assert_array_equal(without(Scan(points, mount=one)).mass, expected)
    assert not np.array_equal(without(Scan(points, mount=two)).mass, expected)
