"""The pipelines: frames in, grids and maps out, with any callable as sensor model."""

import math
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cases import each, refused

from ogm import EvidentialGrid, Frame, GridSpec, Mount, Scan
from ogm.evidence.map_rules import RULES
from ogm.fusion import (
    BinaryBayesMapper,
    EvidentialMapper,
    covering_window,
    fuse,
    make_mapper,
    map_scans,
    rolling_window,
    update_map,
)
from ogm.fusion.pipeline import deskew_frame
from ogm.pose import Trajectory, pose, transform_points
from ogm.scan import LazyFrame, run_model

SPEC = GridSpec.centered(length=8.0, width=6.0, resolution=0.5)
MOUNT = Mount(1.8)


class Marks:
    """A sensor model of a few lines: cells with points are occupied."""

    spec = SPEC

    def __call__(self, scan: Scan) -> EvidentialGrid:
        mass = np.zeros((*SPEC.shape, 2), np.float32)
        inside = SPEC.contains(scan.points[:, 0], scan.points[:, 1])
        mass[SPEC.index(scan.points[inside, 0], scan.points[inside, 1])] = 0.0, 0.8
        return EvidentialGrid(SPEC, mass)


def scan_of(T: np.ndarray) -> Scan:
    """Return what a sensor at a pose measures of one post at (2.25, 1.25) m."""
    post = np.array([[2.25, 1.25, 0.0, 0.0]])
    return Scan(transform_points(np.linalg.inv(T), post).astype(np.float32))


def drive(count: int = 6, **changed: object) -> list[Frame]:
    """Return frames along x, 0.1 m and 0.1 s apart."""
    poses = [pose(0.1 * k) for k in range(count)]
    return [
        Frame(scan_of(T), MOUNT, None, None, T_map_sensor=T, stamp=0.1 * k, name=f"frame {k}", sequence="a")
        for k, T in enumerate(poses)
    ]


def changed(frame: Frame, **fields: object) -> Frame:
    """Return a frame with some other fields."""
    given = {"T_map_sensor": frame.T_map_sensor, "stamp": frame.stamp, "sequence": frame.sequence}
    scan, mount = fields.pop("scan", lambda: frame.scan), fields.pop("mount", lambda: frame.mount)
    return LazyFrame(scan, mount, name=frame.name, **given | fields)


def damaged() -> Scan:
    raise ValueError("the file is cut off")


def test_fusing_with_any_callable_equals_updating_by_hand() -> None:
    mapper, by_hand = EvidentialMapper(SPEC), EvidentialMapper(SPEC)
    steps = list(fuse(drive(), Marks(), mapper))
    for frame, step in zip(drive(), steps, strict=True):
        assert step.error is None
        assert step.grid == Marks()(frame.scan)
        by_hand.update(step.grid, frame.T_map_sensor, stamp=frame.stamp)
    assert mapper.scans == 6
    assert mapper.grid == by_hand.grid
    assert mapper.grid.at(2.25, 1.25).occupied == pytest.approx(0.8)
    np.testing.assert_array_equal(steps[3].T_map_grid, pose(0.1 * 3))
    assert min(steps[3].seconds) > 0


def test_map_scans_yields_grids_and_reports_damaged_frames(caplog: pytest.LogCaptureFixture) -> None:
    frames = drive(3)
    frames[1] = changed(frames[1], scan=damaged)
    reported = []
    found = list(map_scans(frames, Marks(), on_error=lambda frame, error: reported.append((frame, error))))
    assert [frame.name for frame, _ in found] == ["frame 0", "frame 2"]
    assert found[1][1] == Marks()(frames[2].scan)
    assert [(frame.name, str(error)) for frame, error in reported] == [("frame 1", "the file is cut off")]
    assert len(list(map_scans(frames, Marks()))) == 2
    assert "frame 1 is skipped: the file is cut off" in caplog.text  # by default


def test_an_error_that_on_error_raises_ends_the_loop() -> None:
    def strict(frame: Frame, error: Exception) -> None:
        raise error

    frames = [changed(drive(1)[0], scan=damaged)]
    refused("cut off", list, map_scans(frames, Marks(), on_error=strict))
    refused("cut off", list, fuse(frames, Marks(), EvidentialMapper(SPEC), on_error=strict))


def test_an_error_of_the_program_is_not_taken_for_a_damaged_frame() -> None:
    def broken() -> Scan:
        raise RuntimeError("no memory on the device")

    frames = drive(3)
    frames[1] = changed(frames[1], scan=broken)
    mapper = EvidentialMapper(SPEC)
    refused("device", list, fuse(frames, Marks(), mapper), error=RuntimeError)
    assert mapper.scans == 1  # the map so far is kept


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError("the program"), None], ids=repr)
def test_reading_ahead_changes_no_step_and_leaves_no_thread(error: BaseException | None) -> None:
    """Each scan is read by the other thread, at most one ahead, and every error comes at its frame."""
    read = list[tuple[int, str]]()

    def broken() -> Scan:
        raise error or ValueError("the file is cut off")

    def logged(frame: Frame) -> Scan:
        read.append((int(frame.name.split()[1]), threading.current_thread().name))
        return frame.scan

    def frames() -> list[Frame]:
        made = [changed(frame, scan=partial(logged, frame)) for frame in drive()]
        made[1] = changed(made[1], scan=damaged)
        made[2] = changed(made[2], T_map_sensor=None)
        made[4] = changed(made[4], scan=broken)
        return made

    results = []
    for ahead in (False, True):
        read.clear()
        found, mapper = list[tuple[object, ...]](), EvidentialMapper(SPEC)
        try:
            for k, step in enumerate(fuse(frames(), Marks(), mapper, on_error=lambda *_: None, read_ahead=ahead)):
                found.append(
                    (step.frame.name, str(step.error), None if step.grid is None else step.grid.mass.tobytes())
                )
                assert max(number for number, _ in read) <= k + ahead
        except BaseException as raised:  # KeyboardInterrupt is none of Exception
            found.append((type(raised), str(raised)))
        assert {name[:9] for _, name in read} == {"ogm-ahead" if ahead else "MainThrea"}
        results.append((found, mapper.scans, mapper.grid.mass.tobytes()))
    assert results[0] == results[1]
    assert not any(thread.name.startswith("ogm-ahead") for thread in threading.enumerate())


def test_a_loop_that_ends_early_ends_the_thread_that_reads_ahead() -> None:
    steps = fuse(drive(), Marks(), EvidentialMapper(SPEC), read_ahead=True)
    next(steps)
    assert any(thread.name.startswith("ogm-ahead") for thread in threading.enumerate())
    steps.close()
    assert not any(thread.name.startswith("ogm-ahead") for thread in threading.enumerate())


def test_skipped_frames_leave_the_map_as_it_was() -> None:
    frames = drive()
    frames[1] = changed(frames[1], scan=damaged)
    frames[2] = changed(frames[2], T_map_sensor=None)
    frames[4] = changed(frames[4], T_map_sensor=pose(500.0))
    mapper, without = EvidentialMapper(SPEC), EvidentialMapper(SPEC)
    steps = list(fuse(frames, Marks(), mapper, on_error=lambda *_: None))
    assert [step.frame.name for step in steps] == [f"frame {k}" for k in range(6)]
    assert [str(step.error)[:14] for step in steps if step.error] == [
        "the file is cu",
        "the frame has ",
        "the pose jumps",
    ]
    list(fuse([frames[k] for k in (0, 3, 5)], Marks(), without))
    assert mapper.grid == without.grid


def test_after_jumps_in_a_row_the_map_so_far_is_handed_out_and_a_new_one_begins() -> None:
    frames = drive()
    frames[3:] = [changed(one, T_map_sensor=pose(500.0) @ one.T_map_sensor) for one in frames[3:]]
    mapper, before = EvidentialMapper(SPEC), EvidentialMapper(SPEC)
    steps = list(fuse(frames, Marks(), mapper, on_error=lambda *_: None))
    list(fuse(frames[:3], Marks(), before))
    assert [step.error is None for step in steps] == [True, True, True, False, False, True]
    assert [step.restart for step in steps] == ["", "", "", "", "", "pose jump"]
    assert steps[-1].previous_map == before.grid
    assert mapper.scans == 1
    assert mapper.grid.at(502.25, 1.25).occupied == pytest.approx(0.8)


def test_a_new_sequence_begins_a_new_map() -> None:
    frames = drive(4)
    frames[2:] = [changed(one, sequence="b") for one in frames[2:]]
    mapper = EvidentialMapper(SPEC)
    steps = list(fuse(frames, Marks(), mapper))
    assert [step.restart for step in steps] == ["", "", "sequence", ""]
    assert steps[2].previous_map is not None
    assert mapper.scans == 2


@each("offset", [0.0, 1.5])
def test_tilted_and_shifted_mounts_are_levelled(offset: float) -> None:
    """A post stays in its cell: grids lie in the level vehicle frame, poses are the sensor's."""
    T_vehicle_sensor = pose(offset, 0.0, 1.8, pitch=0.2)
    mount = Mount(1.8, T_vehicle_sensor)

    class Levelled(Marks):
        def __call__(self, scan: Scan) -> EvidentialGrid:
            return super().__call__(Scan(transform_points(T_vehicle_sensor, scan.points)))

    frames = []
    for k in range(4):
        T = pose(0.1 * k) @ T_vehicle_sensor
        post = np.array([[2.25, 1.25, 0.0, 0.0]])
        scan = Scan(transform_points(np.linalg.inv(T), post).astype(np.float32))
        frames.append(Frame(scan, mount, None, None, T_map_sensor=T, stamp=0.1 * k, name=str(k)))
    mapper = EvidentialMapper(SPEC)
    assert all(step.error is None for step in fuse(frames, Levelled(), mapper))
    assert mapper.grid.at(2.25, 1.25).occupied == pytest.approx(0.8)
    assert np.count_nonzero(mapper.grid.occupied > 0.1) == 1


class Within(Marks):
    """`Marks` of a sensor that is mounted somewhere, in its levelled vehicle frame; other masses by sensor."""

    def __init__(self, mount: Mount, occupied: float = 0.8) -> None:
        self.mount, self.occupied = mount, occupied

    def __call__(self, scan: Scan) -> EvidentialGrid:
        grid = super().__call__(Scan(transform_points(self.mount.T_vehicle_sensor, scan.points)))
        return EvidentialGrid(SPEC, grid.mass * np.float32(self.occupied / 0.8))


LIDAR, RADAR = Mount(1.8, pose(0.2, 0.0, 1.8, pitch=0.1)), Mount(0.6, pose(1.5, 0.8, 0.6, yaw=2.2))


STAMPS = 0.1 * np.arange(40)


def later(numbers: slice, seconds: float) -> np.ndarray:
    """Return stamps of which some are later."""
    stamps = 1000.0 + STAMPS
    stamps[numbers] += seconds
    return stamps


@each("stamps, mapped, restart", [
        (np.r_[0.0, later(slice(0), 0)[1:] + 1.7e9], 38, 3),  # a driver before its clock is set
        (np.r_[0.0, 0.1, later(slice(0), 0)[2:] + 1.7e9], 38, 4),
        (later(slice(20, None), -30.0), 38, 22),
        (later(slice(20, None), -3.0), 38, 22),
        (later(slice(20, None), 2 * 86_400.0), 38, 22),
        (later(slice(20, 21), -3600.0), 39, None),
        (later(slice(20, 21), 400 * 86_400.0), 39, None),
        (later(slice(20, 23), -np.array([900.0, 500.0, 700.0])), 37, None),  # that do not agree
        (later(slice(20, 40, 2), -30.0), 30, None),  # one after the other in turns
    ])  # fmt: skip
def test_stamps_that_jump_cost_a_few_scans(stamps: np.ndarray, mapped: int, restart: int | None) -> None:
    frames = [changed(frame, stamp=float(t)) for frame, t in zip(drive(40), stamps, strict=True)]
    mapper, skipped = EvidentialMapper(SPEC), []
    steps = list(fuse(frames, Marks(), mapper, on_error=lambda frame, error: skipped.append(str(error))))
    assert sum(step.error is None for step in steps) == mapped
    assert [k for k, step in enumerate(steps) if step.restart] == ([] if restart is None else [restart])
    assert len(skipped) == 40 - mapped
    if restart is not None:
        assert steps[restart].restart == "stamp jump"
        assert steps[restart].previous_map is not None
        assert mapper.scans == 40 - restart


def two_sensors(speed: float = 1.0) -> list[Frame]:
    """Return frames of a lidar at 10 Hz and of a corner radar in between, of one vehicle that turns."""
    frames = []
    for k in range(8):
        name, mount = (("lidar", LIDAR), ("radar", RADAR))[k % 2]
        T = pose(0.05 * k * speed, yaw=0.02 * k) @ mount.T_vehicle_sensor
        scan = replace(scan_of(T), sensor=name)
        frames.append(Frame(scan, mount, None, None, T_map_sensor=T, stamp=0.05 * k, name=f"{name} {k}"))
    return frames


MODELS = {"lidar": Within(LIDAR), "radar": Within(RADAR, 0.4)}


def test_several_sensors_of_one_vehicle_mark_the_same_cell_by_their_own_models() -> None:
    mapper = EvidentialMapper(SPEC, RULES["dempster"], half_life=math.inf)
    steps = list(fuse(two_sensors(), MODELS, mapper))
    assert [step.error for step in steps] == [None] * 8
    assert [round(float(step.grid.occupied.max()), 6) for step in steps] == [0.8, 0.4] * 4
    assert mapper.grid.at(2.25, 1.25).occupied > 0.97
    assert np.count_nonzero(mapper.grid.occupied > 0.01) == 1
    by_model = list(map_scans(two_sensors(), MODELS))
    assert all(a.grid == grid for a, (_, grid) in zip(steps, by_model, strict=True))


def test_the_window_and_the_check_for_jumps_follow_the_vehicle_whichever_sensor_measures() -> None:
    """At 0.1 m/s the sensors of a vehicle, 1.5 m apart and one looking backwards, make no jump."""
    mapper = EvidentialMapper(SPEC, max_speed=0.5)
    for k, step in enumerate(fuse(two_sensors(0.1), MODELS, mapper)):
        assert step.error is None
        T = pose(0.005 * k, yaw=0.02 * k)
        np.testing.assert_allclose(mapper.T_map_vehicle[:2, 3], T[:2, 3], atol=1e-9)
        np.testing.assert_allclose(mapper.T_map_vehicle[:3, :3], T[:3, :3], atol=1e-9)
        np.testing.assert_allclose(mapper.spec.origin, SPEC.origin)


def test_reliabilities_by_sensor_discount_its_masses() -> None:
    mapper, by_hand = (EvidentialMapper(SPEC, RULES["dempster"]) for _ in range(2))
    for step in fuse(two_sensors(), MODELS, mapper, reliability={"lidar": 0.9, "radar": 0.5}):
        share = 0.9 if step.frame.scan.sensor == "lidar" else 0.5
        by_hand.update(step.grid, step.T_map_grid, stamp=step.frame.stamp, reliability=share)
    assert mapper.grid == by_hand.grid
    for_all = EvidentialMapper(SPEC)
    update_map(for_all, MODELS["lidar"](two_sensors()[0].scan), two_sensors()[0], reliability=0.5)
    assert for_all.grid.occupied.max() == pytest.approx(0.4)


def test_a_sensor_without_a_model_or_a_reliability_is_named() -> None:
    frames, lidar = two_sensors(), MODELS["lidar"]
    refused("no model for the sensor 'radar' .*, only for 'lidar'", run_model, {"lidar": lidar}, frames[1])
    rest = run_model({"": lidar, "other": MODELS["radar"]}, frames[0])
    np.testing.assert_array_equal(rest.mass, lidar(frames[0].scan).mass)
    refused("no model for the sensor '' .*, only for none", run_model, {}, drive(1)[0])
    mapper, message = EvidentialMapper(SPEC), "no reliability for the sensor 'lidar' .*, only for 'front'"
    refused(message, update_map, mapper, lidar(frames[0].scan), frames[0], reliability={"front": 1.0})
    steps = list(fuse(frames, {"lidar": lidar}, EvidentialMapper(SPEC), on_error=lambda *_: None))
    assert [step.error is None for step in steps] == [True, False] * 4
    refused("poses of one sensor", next, fuse(frames, MODELS, EvidentialMapper(SPEC), deskew=True))


def test_update_map_begins_anew_at_a_jump_and_returns_the_map_before() -> None:
    for make in (EvidentialMapper, lambda spec: BinaryBayesMapper(spec, 2.0)):
        mapper, (first, second) = make(SPEC), drive(2)
        assert update_map(mapper, Marks()(first.scan), first) is None
        before = mapper.grid
        far = changed(second, T_map_sensor=pose(500.0))
        refused("the pose jumps", update_map, mapper, Marks()(far.scan), far, restart=False)
        assert mapper.grid == before
        assert update_map(mapper, Marks()(far.scan), far) == before
        assert mapper.scans == 1


def test_deskewing_by_the_poses_of_the_frames() -> None:
    """At 20 m/s points move by 2 m during a scan."""
    poses = [pose(2.0 * k) for k in range(5)]
    time = np.linspace(-0.05, 0.05, 50)
    still, moving = [], []
    for k, T in enumerate(poses):
        points = np.repeat(scan_of(T).points, 50, axis=0)
        one = Frame(Scan(points), MOUNT, None, None, T_map_sensor=T, stamp=0.1 * k, name=str(k))
        distorted = points.copy()
        distorted[:, 0] -= 20.0 * time.astype(np.float32)
        still.append(one)
        moving.append(changed(one, scan=partial(Scan, distorted, time=time)))
    maps = []
    for frames, way in (
        (still, False),
        (moving, True),
        (moving, Trajectory(0.1 * np.arange(5), poses)),
        (moving, False),
    ):
        mapper = EvidentialMapper(GridSpec.centered(length=32.0, width=32.0, resolution=0.5))
        assert all(step.error is None for step in fuse(frames, Marks(), mapper, deskew=way))
        maps.append(mapper.grid.mass)
        mapper.reset()
        list(fuse(frames, Marks(), mapper, deskew=way, read_ahead=True))
        np.testing.assert_array_equal(mapper.grid.mass, maps[-1])
    np.testing.assert_allclose(maps[1], maps[0], atol=1e-5)
    np.testing.assert_allclose(maps[2], maps[0], atol=1e-5)
    assert np.abs(maps[3] - maps[0]).max() > 0.5


def test_points_in_the_vehicle_frame_are_deskewed_by_the_poses_of_the_vehicle() -> None:
    """On a turn, the vehicle's origin moves otherwise than the sensor."""
    T_vehicle_sensor = pose(2.0, 0.5, 1.8)
    t = np.linspace(-0.3, 0.3, 7)
    turns = np.array([pose(yaw=3.0 * s) for s in t])
    time = np.array([-0.05, 0.0, 0.04])
    world = np.array([[5.0, 1.0, 0.0, 0.0]] * 3)
    points = np.concatenate(
        [transform_points(pose(yaw=-3.0 * s), one[None]) for s, one in zip(time, world, strict=True)]
    )
    mount = Mount(1.8, T_vehicle_sensor, points_in="vehicle")
    scan = Scan(points.astype(np.float32), time=time, kind="planar", max_range=8.0, beam_width=0.02)
    frame = Frame(scan, mount, None, None, stamp=0.0)
    moved = deskew_frame(frame, Trajectory(t, turns @ T_vehicle_sensor)).scan
    np.testing.assert_allclose(moved.points, world, atol=1e-5)
    assert (moved.kind, moved.max_range, moved.beam_width) == ("planar", 8.0, 0.02)


def test_deskewing_needs_a_trajectory_and_times() -> None:
    for frames, message in ((drive(1), "two frames or more"), (iter(drive(3)), "sequence of frames, or a trajectory")):
        refused(message, next, fuse(frames, Marks(), EvidentialMapper(SPEC), deskew=True))
    (step, *_) = fuse(drive(2), Marks(), EvidentialMapper(SPEC), deskew=True, on_error=lambda *_: None)
    assert "no times" in str(step.error)


def test_maps_by_name_and_their_representation() -> None:
    for rule in RULES:
        assert make_mapper(rule, SPEC).rule is RULES[rule]
    bayes = make_mapper("bayes", SPEC, window="fixed")
    assert math.isinf(bayes.half_life)
    assert make_mapper("yager", SPEC, 3.0).half_life == (3.0, 3.0)
    refused("there is no rule 'magic'; there are revise, cautious, dempster", make_mapper, "magic", SPEC)
    for mapper in (bayes, make_mapper("yager", SPEC, 3.0)):
        assert "\n" not in repr(mapper)
        assert "0 scans, 16 x 12 cells of 0.5 m" in repr(mapper)
    assert "half-life 3 s" in repr(mapper)


def test_a_rolling_window_holds_the_view_at_any_yaw_and_a_covering_one_the_whole_drive() -> None:
    turned = np.array([pose(0, yaw=a) for a in np.linspace(0, 3, 4)] + [pose(100, 30)])
    rolling = rolling_window(SPEC)
    assert rolling.shape[0] == rolling.shape[1]
    assert rolling.length >= np.hypot(8, 6) + 0.5
    covering = covering_window(SPEC, turned)
    corners = np.array([(x, y, 0) for x in (-4, 4) for y in (-3, 3)], float)
    for T in turned:
        x, y, _ = transform_points(T, corners).T
        assert covering.contains(x, y).all()
    refused("give `window=rolling`", covering_window, SPEC, np.array([pose(), pose(1e5, 1e5)]))
    refused("the extent of a fixed window is unknown", covering_window, SPEC, turned[:0])
