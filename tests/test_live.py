"""Live maps: what a viewer receives, the drop policy, playing at stamps, scans from a socket, and a clean stop."""

import json
import math
import os
import platform
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from foxglove_client import Client, fields_of, grid_fields
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ogm import EvidentialGrid, Frame, GridSpec, Mount, OgmError, Scan, UnknownCause
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, rolling_window
from ogm.geometric import RayISM
from ogm.live import FoxglovePublisher, LiveReport, receive_frames, serve, stream, warm_up
from ogm.live.playback import NewestFrames
from ogm.live.stream import frame_bytes
from ogm.planning import costmap
from ogm.plot.colours import CAUSE_COLOURS
from ogm.pose import inverse, pose
from ogm.scan import LazyFrame

SPEC = GridSpec(0.5, (20, 16), (-5.0, -4.0))
MOUNT = Mount(1.8, pose(1.2, 0.1, 1.8, yaw=0.2))


class LShape:
    """A sensor model that finds an L of obstacles whatever it gets, after some time."""

    spec = SPEC

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds

    def __call__(self, scan: Scan) -> EvidentialGrid:
        time.sleep(self.seconds)
        mass = np.zeros((*SPEC.shape, 2), np.float32)
        mass[..., 0] = 0.5
        mass[12:18, 10] = mass[12, 10:14] = 0.0, 0.75
        return EvidentialGrid(SPEC, mass)


def frame(k: int, sensor: str = "", sequence: str = "drive", period: float = 0.1) -> Frame:
    points = np.full((k + 1, 4), 0.25, np.float32) + np.arange(k + 1)[:, None] * np.array([1, 1, 1, 0], np.float32)
    T = pose(0.3 * k, 0.1 * k, 1.8, yaw=0.05 * k)
    scan = Scan(points, stamp=period * k, sensor=sensor)
    return Frame(scan, MOUNT, None, None, T_map_sensor=T, stamp=period * k, name=f"{sensor}{k}", sequence=sequence)


def mapper() -> EvidentialMapper:
    return EvidentialMapper(rolling_window(SPEC))


def one_by_one(fused: EvidentialMapper, *frames: Frame) -> Iterator[Frame]:
    """Yield each frame when the one before is in the map, or cannot be."""
    for one in frames:
        scans = fused.scans
        yield one
        until(lambda: fused.scans > scans or one.name in ("bad", "placeless"))  # noqa: B023
        time.sleep(0.02)  # until it is published


def ignore(*_: object) -> None:
    """Publish nothing."""


def until(condition: Callable[[], object], seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    dummies = threading._DummyThread  # what a thread of the SDK leaves in the list when it logs
    until(lambda: {one for one in threading.enumerate() if not isinstance(one, dummies)} <= before)


# What a viewer receives.


def test_a_viewer_receives_the_map_the_points_and_the_poses() -> None:
    fused = mapper()
    costs = partial(costmap, inscribed_radius=0.5, inflation_radius=2.0, cost_scaling=1.0)
    topics = ("/tf", "/points", "/map", "/layers")
    with FoxglovePublisher(port=0, costs=costs) as publisher, Client(publisher.port, topics) as client:
        until(
            lambda: all(
                one.has_sinks() for one in (publisher._map, publisher._layers, publisher._points, publisher._tf)
            )
        )
        report = serve(one_by_one(fused, *(frame(k, "lidar") for k in range(3))), LShape(), fused, publisher)
        received = [client.receive() for _ in range(12)]
    assert (report.mapped, report.dropped, report.failed) == (3, 0, 0)
    assert tuple(one.topic for one in received) == topics * 3
    assert [one.time for one in received[::4]] == [0, 100_000_000, 200_000_000]
    tf, points, grid, layers = (one.message for one in received[-4:])
    conflict = grid_fields(layers)
    assert list(conflict) == ["free_to_occupied", "occupied_to_free"]
    np.testing.assert_array_equal(conflict["free_to_occupied"], fused.conflict["free_to_occupied"])

    # Masses and cells, as they are in Python.
    fields, spec = grid_fields(grid), fused.grid.spec
    np.testing.assert_array_equal(fields["free"], fused.grid.free)
    np.testing.assert_array_equal(fields["occupied"], fused.grid.occupied)
    np.testing.assert_array_equal(fields["unknown"], fused.grid.unknown)
    np.testing.assert_array_equal(fields["cost"], costs(fused.grid))
    assert {253, 254} < set(fields["cost"].ravel())
    assert grid.frame_id == "map"
    assert (grid.cell_size.x, grid.cell_size.y, grid.column_count) == (0.5, 0.5, spec.shape[0])
    assert (grid.pose.position.x, grid.pose.position.y) == spec.origin
    assert grid.pose.orientation.w == 1
    assert (grid.timestamp.seconds, grid.timestamp.nanos) == (0, 200_000_000)

    # Where the L stands in the map, by the geometry alone: its corner is occupied, the cell beyond its corner is not.
    last = frame(2)
    T_map_vehicle = last.T_map_sensor @ inverse(MOUNT.T_vehicle_sensor)
    for x, y, there in ((1.25, 1.25, True), (3.75, 1.25, True), (1.25, 2.75, True), (3.75, 2.75, False)):
        where = T_map_vehicle @ (x, y, 0, 1)
        i, j = np.floor((where[:2] - [grid.pose.position.x, grid.pose.position.y]) / 0.5).astype(int)
        assert (fields["occupied"][i, j] > fields["free"][i, j]) == there, (x, y)

    # The ground below the sensor is where the map lies.
    assert grid.pose.position.z == pytest.approx(0.0)

    # The points, in the sensor's frame.
    assert points.frame_id == "lidar"
    assert points.point_stride == 16
    columns = fields_of(points, 16)
    np.testing.assert_array_equal(np.stack([columns[n] for n in ("x", "y", "z", "intensity")], -1), last.scan.points)

    # The chain of transforms gives the pose of the sensor.
    T = np.eye(4)
    for one, (parent, child) in zip(tf.transforms, (("map", "vehicle"), ("vehicle", "lidar")), strict=True):
        assert (one.parent_frame_id, one.child_frame_id) == (parent, child)
        step, q = np.eye(4), one.rotation
        step[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        step[:3, 3] = one.translation.x, one.translation.y, one.translation.z
        T = T @ step
    np.testing.assert_allclose(T, last.T_map_sensor, atol=1e-12)


def test_points_in_the_vehicle_frame_are_published_there() -> None:
    inside = Mount(1.8, pose(1.2, 0.1, 1.8), points_in="vehicle")
    one = Frame(frame(0).scan, inside, None, None, T_map_sensor=pose(z=1.8), stamp=0.0)
    with FoxglovePublisher(port=0) as publisher, Client(publisher.port, ("/points",)) as client:
        until(publisher._points.has_sinks)
        serve([one], LShape(), mapper(), publisher)
        assert client.receive().message.frame_id == "vehicle"


def test_a_viewer_receives_why_cells_are_unknown_with_a_legend() -> None:
    fused, behind = mapper(), np.full(SPEC.shape, UnknownCause.BEHIND_OBSTACLE, np.uint8)

    def explained(scan: Scan) -> EvidentialGrid:
        return EvidentialGrid.vacuous(SPEC).with_cause(behind)

    explained.spec = SPEC  # type: ignore[attr-defined]
    with FoxglovePublisher(port=0) as publisher:
        serve([frame(0)], explained, fused, publisher)
        with Client(publisher.port, ("/cause", "/cause_legend")) as client:
            until(lambda: all(channel.has_sinks() for channel in publisher._causes))
            serve([frame(1)], explained, fused, publisher)
            grid, legend = (client.receive().message for _ in range(2))
    fields, expected = grid_fields(grid), fused.cause["cause"]
    np.testing.assert_array_equal(fields["cause"], expected)
    red = np.where(expected == UnknownCause.BEHIND_OBSTACLE, fields["red"], 0).max()
    assert red == round(255 * CAUSE_COLOURS[UnknownCause.BEHIND_OBSTACLE][0])
    assert [text.text for text in legend.entities[0].texts] == [cause.label for cause in UnknownCause]


def test_what_nobody_subscribed_to_is_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ogm.live.foxglove_server.foxglove_grid", lambda *_, **__: pytest.fail("a grid was made"))
    with FoxglovePublisher(port=0) as publisher, Client(publisher.port, ("/tf",)) as client:
        until(publisher._tf.has_sinks)
        assert serve([frame(0)], LShape(), mapper(), publisher).mapped == 1
        assert client.receive().topic == "/tf"


@pytest.mark.slow
def test_a_viewer_that_reads_nothing_holds_up_nothing() -> None:
    """The SDK's own backlog of 1024 messages would take gigabytes."""
    wide = EvidentialMapper(GridSpec.centered(160, 160, 0.25))  # 6.6 MB a message
    with FoxglovePublisher(port=0) as publisher, closing(deaf_viewer(publisher)):
        until(publisher._map.has_sinks)
        serve([frame(0)], LShape(), wide, publisher)
        before = resident()
        report = serve(one_by_one(wide, *(frame(k + 1) for k in range(60))), LShape(), wide, publisher)
        assert (report.mapped, report.dropped) == (60, 0)
        assert resident() - before < 200  # [MB]; all of them would be 400


def deaf_viewer(publisher: FoxglovePublisher) -> socket.socket:
    """Return a connection that has subscribed to the map, and is never read."""
    viewer = socket.create_connection(("127.0.0.1", publisher.port))
    viewer.sendall(
        b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
    )
    assert viewer.recv(1000).startswith(b"HTTP/1.1 101")
    text = json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": publisher._map.id()}]}).encode()
    viewer.sendall(bytes([0x81, 0x80 | len(text)]) + bytes(4) + text)  # a text, "masked" by zeros
    return viewer


def resident() -> float:
    """Return the memory of this process [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def test_a_port_is_free_again_and_one_in_use_is_refused_in_words() -> None:
    with (
        FoxglovePublisher(port=0) as publisher,
        pytest.raises(OSError, match=r"cannot serve at 127.0.0.1:\d+: .*in use.*; give another port"),
    ):
        FoxglovePublisher(port=publisher.port)
    with socket.create_server(("127.0.0.1", publisher.port)):
        pass
    refused("port must be from 0", FoxglovePublisher, port=70_000)


@each("begun", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", b"\x00" * 7])
def test_a_client_that_never_finishes_its_handshake_does_not_hold_up_the_end(
    begun: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.live.foxglove_server.CLOSING_TIME", 0.3)
    publisher = FoxglovePublisher(port=0)
    with socket.create_connection((publisher.host, publisher.port)) as client:
        client.sendall(begun)
        with closing(publisher), Client(publisher.port, ("/tf",)):
            time.sleep(0.1)
            start = time.monotonic()
        assert time.monotonic() - start < 1.0
        with socket.create_server((publisher.host, publisher.port)):
            pass


def test_an_interrupt_does_not_wait_for_clients() -> None:
    publisher = FoxglovePublisher(port=0)
    with socket.create_connection((publisher.host, publisher.port)):
        time.sleep(0.1)
        start = time.monotonic()
        publisher.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
        assert time.monotonic() - start < 0.5


def test_a_missing_sdk_is_named_with_the_line_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    refused(r"pip install .*\[live\]", FoxglovePublisher, error=ImportError, port=0)


# Never falling behind.


def at_rate(count: int, period: float, sensors: tuple[str, ...] = ("",)) -> Iterator[Frame]:
    """Yield frames of several sensors at a time, as drivers would."""
    start = time.monotonic()
    for k in range(count):
        time.sleep(max(start + k * period - time.monotonic(), 0.0))
        yield from (frame(k, sensor, period=period) for sensor in sensors)


def test_a_slow_model_drops_scans_and_keeps_its_latency() -> None:
    taken: list[str] = []
    report = serve(at_rate(100, 0.01), LShape(0.05), mapper(), lambda step, _: taken.append(step.frame.name))
    assert report.mapped == len(taken)
    assert report.mapped + report.dropped == 100
    assert 5 <= report.mapped <= 25
    assert 0.05 <= report.p50 <= report.p99 <= report.worst < 0.4  # [s]; in a queue the last would wait for 4 s
    numbers = list(map(int, taken))
    assert numbers == sorted(numbers)
    assert numbers[-1] == 99  # the newest is mapped, also at the end


@each(("turn", "distorted"), [(0.1, 3), (0.02, 0)])
def test_scans_that_a_turn_distorts_are_counted(turn: float, distorted: int) -> None:
    scan = Scan(np.full((2, 4), 0.25, np.float32), time=np.array([-0.1, 0.0], np.float32))
    frames = [Frame(scan, MOUNT, T_map_sensor=pose(yaw=turn * k), stamp=0.1 * k, name=f"{k}") for k in range(4)]
    fused = mapper()
    report = serve(one_by_one(fused, *frames), LShape(), fused, ignore)
    assert report.distorted == distorted
    assert ("distorted by a turn" in str(report)) == bool(distorted)


def test_a_quick_model_drops_nothing() -> None:
    report = serve(at_rate(30, 0.02), LShape(), mapper(), ignore)
    assert (report.mapped, report.dropped) == (30, 0)


def test_no_sensor_takes_the_place_of_another() -> None:
    taken: list[str] = []
    sensors = ("front", "left", "right")
    report = serve(at_rate(6, 0.2, sensors), LShape(0.02), mapper(), lambda s, _: taken.append(s.frame.scan.sensor))
    assert (report.mapped, report.dropped) == (18, 0)
    taken.clear()
    report = serve(at_rate(30, 0.02, sensors), LShape(0.03), mapper(), lambda s, _: taken.append(s.frame.scan.sensor))
    assert report.dropped > 0
    assert min(map(taken.count, sensors)) >= max(map(taken.count, sensors)) - 2


@given(st.lists(st.one_of(st.sampled_from("abc"), st.none())))
def test_the_queue_keeps_the_newest_of_each_sensor(actions: list[str | None]) -> None:
    """Against a list of all that was put: None takes."""
    queue, waiting, dropped = NewestFrames(), [], 0
    frames = iter(queue)
    for k, sensor in enumerate(actions):
        if sensor is not None:
            queue.put(frame(k, sensor), float(k))
            sensors = [one for one, _ in waiting]
            dropped += sensor in sensors
            waiting = [(one, k if one == sensor else n) for one, n in waiting]
            waiting += [(sensor, k)] if sensor not in sensors else []
        elif waiting:
            one = next(frames)
            assert (one.scan.sensor, round(one.stamp * 10)) == waiting.pop(0)
            assert queue.due == round(one.stamp * 10)
        assert queue.dropped == dropped
    queue.close()
    assert [one.scan.sensor for one in frames] == [sensor for sensor, _ in waiting]


# At their stamps.


def test_recorded_frames_come_at_their_stamps() -> None:
    times: list[float] = []
    report = serve([frame(k) for k in range(8)], LShape(), mapper(), lambda *_: times.append(time.monotonic()), rate=2)
    assert (report.mapped, report.dropped) == (8, 0)
    assert times[-1] - times[0] == pytest.approx(7 * 0.1 / 2, abs=0.1)
    assert report.worst < 0.1


def test_a_new_sequence_or_a_clock_put_back_begin_anew() -> None:
    later = [Frame(one.scan, MOUNT, None, None, T_map_sensor=one.T_map_sensor, stamp=1e6 + k / 10, sequence="b")
             for k, one in enumerate(map(frame, range(3)))]  # fmt: skip
    start = time.monotonic()
    report = serve([*map(frame, range(3)), *later], LShape(), mapper(), ignore, rate=1.0)
    assert report.mapped == 6
    assert time.monotonic() - start < 5
    errors: list[str] = []
    report = serve(
        [*later, frame(0, sequence="b"), frame(1, sequence="b")], LShape(), mapper(), ignore, rate=1.0,
        on_error=lambda _, error: errors.append(str(error)),
    )  # fmt: skip
    assert (report.mapped, report.dropped, report.failed) == (3, 0, 2)  # by the mapper's rules
    assert "older than the map" in errors[0]


def test_slow_reading_drops_scans_unread_and_keeps_the_latency() -> None:
    read: list[int] = []

    def slow(k: int) -> Frame:
        def scan() -> Scan:
            read.append(k)
            time.sleep(0.05)
            return frame(k).scan

        whole = frame(k, period=0.01)
        return LazyFrame(scan, lambda: MOUNT, T_map_sensor=whole.T_map_sensor, stamp=whole.stamp, name=str(k))

    report = serve([slow(k) for k in range(100)], LShape(), mapper(), ignore, rate=1.0)
    assert report.mapped + report.dropped == 100
    assert report.mapped <= len(read) <= 25
    assert report.worst < 0.3


def test_what_cannot_be_played_is_refused() -> None:
    nameless = Frame(frame(0).scan, MOUNT, None, None, T_map_sensor=np.eye(4), name="first")
    refused("first has no stamp", serve, [nameless], LShape(), mapper(), ignore, error=OgmError, rate=1.0)
    for rate in (0, -1, math.inf, math.nan):
        refused("rate must be above 0", serve, [frame(0)], LShape(), mapper(), ignore, rate=rate)
    refused("duration must be above 0 s", serve, [frame(0)], LShape(), mapper(), ignore, duration=0)
    refused("report_every must be above 0 s", serve, [frame(0)], LShape(), mapper(), ignore, report_every=0)


# Damage, and the end.


def test_damaged_frames_are_counted_and_left_out() -> None:
    def damaged() -> Scan:
        raise OgmError("it is cut short")

    bad = LazyFrame(damaged, lambda: MOUNT, T_map_sensor=np.eye(4), stamp=0.05, name="bad", sequence="drive")
    placeless = Frame(frame(1).scan, MOUNT, None, None, stamp=0.07, name="placeless", sequence="drive")
    for rate in (None, 1.0):
        errors, fused = {}, mapper()
        report = serve(
            [frame(0), bad, placeless, frame(3)] if rate else one_by_one(fused, frame(0), bad, placeless, frame(3)),
            LShape(),
            fused,
            ignore,
            rate=rate,
            on_error=lambda frame, error: errors.update({frame.name: str(error)}),  # noqa: B023
        )
        assert (report.mapped, report.failed, report.dropped) == (2, 2, 0)
        assert errors["bad"] == "it is cut short"
        assert "no pose" in errors["placeless"]


@each("rate", [None, 1.0])
def test_an_error_of_the_publisher_ends_it(rate: float | None) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("the link is down")

    start = time.monotonic()
    refused("the link is down", serve, endless(), LShape(), mapper(), broken, error=RuntimeError, rate=rate)
    assert time.monotonic() - start < 5


def endless() -> Iterator[Frame]:
    for k in range(10**6):
        time.sleep(0.005)
        yield frame(k)


def test_an_error_of_the_driver_is_raised_after_what_came_was_mapped() -> None:
    def driver() -> Iterator[Frame]:
        yield frame(0)
        raise ConnectionError("the lidar is unplugged")

    taken: list[str] = []
    with pytest.raises(ConnectionError, match="unplugged"):
        serve(driver(), LShape(), mapper(), lambda step, _: taken.append(step.frame.name))
    assert taken == ["0"]


@pytest.mark.parametrize("rate", [None, pytest.param(0.001, marks=pytest.mark.slow)])
def test_a_duration_an_event_and_ctrl_c_end_it(rate: float | None) -> None:
    frames = endless() if rate is None else [frame(k) for k in range(3)]
    report = serve(frames, LShape(), mapper(), ignore, rate=rate, duration=0.5)
    assert 0.4 < report.seconds < 3
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    assert serve(endless() if rate is None else frames, LShape(), mapper(), ignore, rate=rate, stop=stop).seconds < 3
    interrupt = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    interrupt.start()
    report = serve(endless() if rate is None else frames, LShape(), mapper(), ignore, rate=rate)
    assert report.seconds < 3
    assert report.mapped >= 1


def test_reports_come_regularly_and_add_up() -> None:
    reports: list[LiveReport] = []
    last = serve(at_rate(40, 0.02), LShape(), mapper(), ignore, on_report=reports.append, report_every=0.2)
    assert 2 <= len(reports) <= 4
    assert [one.mapped for one in reports] == sorted(one.mapped for one in reports)
    assert last.mapped == 40
    assert str(last).startswith("1 s: 40 mapped, 0 dropped, 0 failed; latency p50 ")
    empty = serve([], LShape(), mapper(), ignore)
    assert empty.mapped == 0
    assert math.isnan(empty.p99)


@each("fused", [mapper(), BinaryBayesMapper(rolling_window(SPEC))])
def test_warming_up_leaves_the_map_as_it_is(fused: EvidentialMapper | BinaryBayesMapper) -> None:
    serve([frame(5)], LShape(), fused, ignore)
    before = fused.grid
    for example in (None, frame(3)):
        assert warm_up(RayISM(SPEC, Mount(1.8)), fused, example) > 0
    assert fused.grid == before
    assert (fused.scans, fused.stamp) == (1, 0.5)
    refused("no pose", warm_up, LShape(), fused, Frame(frame(0).scan, MOUNT, None, None, stamp=0.0))


# Scans from a socket.


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as one:
        yield one


def sender(listener: socket.socket) -> socket.socket:
    return socket.create_connection(listener.getsockname(), timeout=5)


class Receiver:
    """Receives in a thread."""

    def __init__(self, listener: socket.socket) -> None:
        self.frames: list[Frame] = []
        self.lines: list[str] = []
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._run, args=(listener,))

    def _run(self, listener: socket.socket) -> None:
        for one in receive_frames(listener, MOUNT, stop=self.stop, on_end=self.lines.append):
            self.frames.append(one)

    def __enter__(self) -> "Receiver":
        self.thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop.set()
        self.thread.join(5)
        assert not self.thread.is_alive()


def test_frames_arrive_as_they_were_sent(listener: socket.socket) -> None:
    sent = [frame(k) for k in (0, 7, 4000)]
    with Receiver(listener) as receiver, sender(listener) as driver:
        data = b"".join(frame_bytes(one.scan, one.T_map_sensor) for one in sent)
        for k in range(0, len(data), 997):  # in pieces that end anywhere
            driver.sendall(data[k : k + 997])
        until(lambda: len(receiver.frames) == 3)
    for one, there in zip(receiver.frames, sent, strict=True):
        np.testing.assert_array_equal(one.scan.points, there.scan.points)
        np.testing.assert_array_equal(one.T_map_sensor, there.T_map_sensor)
        assert (one.stamp, one.scan.stamp, one.mount) == (there.stamp, there.stamp, MOUNT)


def test_the_format_is_what_its_table_has(listener: socket.socket) -> None:
    """As a driver in C would write it; intensities, empty scans and rows without a point."""
    points = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 0], [0, 0, 0, 0.25], [-4, 5, -6, 1]], "<f4")
    head = struct.pack("<4sId", b"OGM1", 4, 12.5) + struct.pack("<12d", 0, -1, 0, 7, 1, 0, 0, 8, 0, 0, 1, 9)
    assert len(head) == 112
    with Receiver(listener) as receiver, sender(listener) as driver:
        driver.sendall(head + points.tobytes())
        driver.sendall(head[:4] + bytes(4) + head[8:])
        until(lambda: len(receiver.frames) == 2)
    one, empty = receiver.frames
    np.testing.assert_array_equal(one.scan.points, points[[0, 3]])
    np.testing.assert_array_equal(one.T_map_sensor, pose(7, 8, 9, yaw=math.pi / 2).round(12))
    assert one.stamp == 12.5
    assert len(empty.scan) == 0


def changed(at: int, new: bytes) -> bytes:
    data = frame_bytes(frame(3).scan, np.eye(4))
    return data[:at] + new + data[at + len(new) :]


WRONG = {
    b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + bytes(200): r"a message must begin with b'OGM1', got b'GET '",
    changed(4, struct.pack("<I", stream.MAX_POINTS + 1)): "at most 4194304 points, got 4194305",
    changed(4, b"\xff" * 4): "at most 4194304 points, got 4294967295",
    changed(8, struct.pack("<d", math.nan)): "a stamp from 0 to .*, got nan s",
    changed(8, struct.pack("<d", 1.7e18)): r"a stamp from 0 to .*, got 1.7e\+18 s",
    changed(40, struct.pack("<d", math.inf)): "must have a finite pose",
    changed(16, struct.pack("<d", 2.0)): "scan 1 of .*: T_map_sensor must be rigid",
    changed(112, struct.pack("<f", 1e7) * 16): "coordinates up to 1e",
    changed(0, b"")[:60]: "in the middle of a message",
    changed(0, b"")[:130]: "in the middle of a message",
}


@each("data", WRONG)
def test_a_wrong_message_ends_its_connection_alone(listener: socket.socket, data: bytes) -> None:
    with Receiver(listener) as receiver:
        with sender(listener) as driver:
            driver.sendall(data)
            with suppress(OSError):  # the receiver may have ended it
                driver.shutdown(socket.SHUT_WR)
            until(lambda: receiver.lines)
        with sender(listener) as driver:
            driver.sendall(changed(0, b""))
            until(lambda: receiver.frames)
        until(lambda: len(receiver.lines) == 2)
    line, last = receiver.lines
    assert last.endswith("after 1 scans: closed by the sender")
    assert re.search(WRONG[data], line)
    assert line.startswith("connection from 127.0.0.1:")


def test_a_driver_that_was_started_anew_begins_a_sequence(listener: socket.socket) -> None:
    runs = ([10.0, 10.1], [10.2], [1.0, 1.1], [0.5])  # stamps of each connection: one that was lost, two restarts
    with Receiver(listener) as receiver:
        for n, stamps in enumerate(runs):
            with sender(listener) as driver:
                for stamp in stamps:
                    driver.sendall(frame_bytes(replace(frame(3).scan, stamp=stamp), np.eye(4)))
                until(lambda n=n: len(receiver.frames) == sum(map(len, runs[: n + 1])))
    assert [one.sequence for one in receiver.frames] == ["live"] * 3 + ["live 2"] * 2 + ["live 3"]


@given(st.binary(max_size=300))
def test_no_bytes_are_a_crash(data: bytes) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(data)
        theirs.shutdown(socket.SHUT_WR)
        connection = stream._Connection(ours, ("test", 0))
        with pytest.raises(OgmError):  # at the end, if not before
            list(iter(connection.receive, ...))


def test_a_new_connection_replaces_the_one_before(listener: socket.socket) -> None:
    with Receiver(listener) as receiver, sender(listener) as first:
        first.sendall(changed(0, b"")[:150])
        with sender(listener) as second:
            second.sendall(changed(0, b""))
            until(lambda: receiver.frames)
        assert "replaced by a new connection" in receiver.lines[0]
        with suppress(ConnectionResetError):
            assert first.recv(1) == b""


def test_clients_that_send_nothing_do_not_disturb_the_driver(listener: socket.socket) -> None:
    message, silent = changed(0, b""), stream.MAX_SILENT + 20
    with Receiver(listener) as receiver, ExitStack() as clients, sender(listener) as driver:
        for k in range(3):
            driver.sendall(message)
            until(lambda: len(receiver.frames) == k + 1)  # noqa: B023
            sender(listener).close()  # a health check
            for _ in range(silent // 3):  # a load balancer that keeps its connections
                clients.enter_context(sender(listener))
            for _ in range(2):
                with sender(listener) as other:  # a health check of another protocol
                    other.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            driver.sendall(message[:200])  # half of the next scan
            time.sleep(0.02)
            driver.sendall(message[200:])
            until(lambda: len(receiver.frames) == k + 2)  # noqa: B023
            receiver.frames.pop()
        driver.sendall(message)
        until(lambda: len(receiver.frames) == 4)
        assert [line.rpartition(": ")[2] for line in receiver.lines] == ["closed in the middle of a message"]


def test_a_message_needs_a_stamp_and_a_pose() -> None:
    refused("a message needs a stamp", frame_bytes, Scan(np.zeros((1, 4), np.float32)), np.eye(4))
    refused("T_map_sensor must be rigid", frame_bytes, frame(0).scan, 2 * np.eye(4) - np.diag([0, 0, 0, 1.0]))


def test_scans_from_a_socket_are_served(listener: socket.socket) -> None:
    stop, fused = threading.Event(), mapper()
    warm_up(LShape(), fused)  # else scans are dropped while kernels are loaded

    def drive() -> None:
        try:
            with sender(listener) as driver:
                for k in range(5):
                    driver.sendall(frame_bytes(frame(k).scan, frame(k).T_map_sensor))
                    until(lambda: fused.scans == k + 1)  # noqa: B023
        finally:
            stop.set()

    driver = threading.Thread(target=drive)
    driver.start()
    report = serve(receive_frames(listener, MOUNT, stop=stop, on_end=ignore), LShape(), fused, ignore, stop=stop)
    driver.join()
    assert (report.mapped, report.dropped, report.failed) == (5, 0, 0)
    direct = mapper()
    serve(one_by_one(direct, *map(frame, range(5))), LShape(), direct, ignore)
    assert fused.grid == direct.grid


HELD = """
from pathlib import Path
import numpy as np
from ogm.live.memory import release_free_memory
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6
np.ones(2_000_000)  # is freed: glibc keeps blocks up to its size from now on
before, large, small = resident(), [], []
for _ in range(100):
    large.append(np.ones(125_000))
    small.append(np.ones(4000))
del large
print(resident() - before, release_free_memory(), resident() - before)
"""


def test_free_blocks_go_back_to_the_system_though_used_ones_lie_between_them() -> None:
    if not sys.platform.startswith("linux") or platform.libc_ver()[0] != "glibc":
        pytest.skip("of glibc")
    held, released, left = subprocess.run(
        [sys.executable, "-c", HELD], capture_output=True, text=True, check=True
    ).stdout.split()
    assert float(held) > 50  # [MB] of 100
    assert released == "True"
    assert float(left) < 20


def test_a_live_run_releases_free_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    monkeypatch.setattr("ogm.live.pipeline.RELEASE_EVERY", 0.0)
    monkeypatch.setattr("ogm.live.pipeline.release_free_memory", lambda: calls.append(1))
    fused = mapper()
    assert serve(one_by_one(fused, *map(frame, range(3))), LShape(), fused, ignore).mapped == len(calls) == 3
