"""Pipelines from frames to grids and maps: `map_scans`, `fuse`, and their step `update_map`."""

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.ego.deskewing import deskew, extrapolate
from ogm.fusion.mapper import Mapper
from ogm.fusion.update_gate import LONG_GAP, PoseJump, StampJump
from ogm.geometric.doppler import radial_velocities
from ogm.grid import EvidentialGrid
from ogm.pose import Trajectory, inverse
from ogm.scan import Frame, LazyFrame, Scan, SensorModels, of_sensor, run_model
from ogm.threads import one_ahead

_DAMAGED = (ValueError, TypeError, OSError)  # errors of a single frame; others are errors of the program
MAX_TURN = math.radians(2.0)  # within a scan: points at 20 m are then off by 0.7 m

_MAX_JUMPS = 3  # consecutive jumps; the last one restarts the map
_MARGIN = 0.5  # [s] by which a trajectory is extrapolated for points of the first and last scans

_log = logging.getLogger(__name__)

OnError = Callable[[Frame, Exception], None]
Reliability = float | Mapping[str, float]


def log_error(frame: Frame, error: Exception) -> None:
    """Log a warning that a frame is skipped, with the reason."""
    _log.warning("%s is skipped: %s", frame.name, error)


def map_scans(
    frames: Iterable[Frame], ism: SensorModels, *, on_error: OnError = log_error
) -> Iterator[tuple[Frame, EvidentialGrid]]:
    """Yield each frame with its measurement grid.

    Parameters
    ----------
    frames : iterable of Frame
        A dataset, or any other frames.
    ism : callable with `spec`, or mapping of str to these
        Sensor model, ``ism(scan) -> EvidentialGrid``; for several sensors one for each `Scan.sensor`.
    on_error : function
        Called with each frame that is damaged or cannot be mapped, and its error; the frame is skipped. By default the
        error is logged. A function that raises it ends the loop.
    """
    for frame in frames:
        try:
            grid = run_model(ism, frame)
        except _DAMAGED as error:
            on_error(frame, error)
            continue
        yield frame, grid


class FusionStep(NamedTuple):
    """Result of `fuse` for one frame.

    Attributes
    ----------
    frame : Frame
        The frame; its scan is de-skewed if requested.
    grid : EvidentialGrid or None
        Its measurement grid; None if the frame was skipped.
    T_map_grid : (4, 4) float64 or None
        Pose at which the grid was fused: the levelled vehicle frame.
    error : Exception or None
        Reason why the frame was skipped.
    restart : str
        Reason why a new map was begun with this frame: "pose jump", "stamp jump" or "sequence"; "" if none was begun.
    previous_map : EvidentialGrid or None
        The map before a restart, which the mapper no longer holds.
    seconds : (float, float)
        Run time of the sensor model and of the mapper [s].
    """

    frame: Frame
    grid: EvidentialGrid | None = None
    T_map_grid: NDArray[np.float64] | None = None
    error: Exception | None = None
    restart: str = ""
    previous_map: EvidentialGrid | None = None
    seconds: tuple[float, float] = (0.0, 0.0)


def fuse(
    frames: Iterable[Frame],
    ism: SensorModels,
    mapper: Mapper,
    *,
    deskew: bool | Trajectory = False,
    reliability: Reliability = 1.0,
    on_error: OnError = log_error,
    read_ahead: bool = False,
) -> Iterator[FusionStep]:
    """Fuse the scans of a drive into a map, one step per frame.

    A new map is begun at every new `Frame.sequence`, and at the third jump in a row. Jumps are of the pose, or of the
    stamp; stamp jumps count only if their stamps follow each other.

    Parameters
    ----------
    frames : iterable of Frame
        Frames in the order of their stamps. Each needs `T_map_sensor` and, unless the map never forgets, `stamp`. With
        several sensors of a vehicle, each has its own poses, and a mount in one common vehicle frame.
    ism : callable with `spec`, or mapping of str to these
        Sensor model, ``ism(scan) -> EvidentialGrid``; for several sensors one for each `Scan.sensor`. Frames of other
        sensors are skipped.
    mapper : EvidentialMapper, BinaryBayesMapper or DynamicMapper
        Updated in place.
    deskew : bool or Trajectory
        Undo the ego motion during each scan, by the times of its points. True uses the poses of `frames`, which must
        then be a sequence; a trajectory of the sensor may have a higher rate. For several sensors, de-skew the frames
        of each sensor beforehand by its own poses: `deskew_frame`.
    reliability : float or mapping of str to float
        Reliability, [0, 1], by which masses are discounted: for all sensors, or by `Scan.sensor`, with "" for others.
    on_error : function
        Called with every skipped frame and its error; by default the error is logged.
    read_ahead : bool
        Iterate over `frames` and read the next scan in another thread, while this one maps a scan. Other code must
        not read from the dataset meanwhile.

    Yields
    ------
    FusionStep
        Also for skipped frames: damaged, without pose, or with a pose jump. These leave the map unchanged.

    Raises
    ------
    ValueError
        If de-skewing has no poses, or `ism` has models of several sensors.

    Examples
    --------
    >>> mapper = EvidentialMapper(rolling_window(ism.spec))                 # doctest: +SKIP
    >>> for step in fuse(open_dataset("drive/"), ism, mapper):             # doctest: +SKIP
    ...     print(step.frame.name, step.error or step.grid)
    >>> mapper.grid.save("map.npz")                                        # doctest: +SKIP
    """
    if deskew is not False and isinstance(ism, Mapping):
        raise ValueError(
            "deskew takes the poses of one sensor, got the models of several: de-skew the frames of each sensor by its "
            "own trajectory, `deskew_frame`"
        )
    trajectory = _trajectory(frames, deskew)
    jumps, sequence = _Jumps(), None
    if trajectory is not None:
        frames = (deskew_frame(frame, trajectory) for frame in frames)
    for frame in one_ahead(_read(frames)) if read_ahead else frames:
        restart, previous = "", None
        try:
            T_map_grid = grid_pose(frame)
            frame.scan  # noqa: B018  read here, so that `seconds` leaves reading out
            start = time.perf_counter()
            grid = run_model(ism, frame)
            between = time.perf_counter()
            if sequence not in (None, frame.sequence) and mapper.scans:
                restart, previous = "sequence", mapper.grid
                mapper.reset()
                jumps.clear()
            try:
                update_map(mapper, grid, frame, restart=False, reliability=reliability)
            except (PoseJump, StampJump) as jump:
                if not jumps.add(jump, frame.stamp):
                    raise
                restart, previous = "pose jump" if isinstance(jump, PoseJump) else "stamp jump", mapper.grid
                mapper.reset()
                update_map(mapper, grid, frame, restart=False, reliability=reliability)
            seconds = between - start, time.perf_counter() - between
        except _DAMAGED as error:
            on_error(frame, error)
            yield FusionStep(frame, error=error, restart=restart, previous_map=previous)
            continue
        jumps.clear()
        sequence = frame.sequence
        yield FusionStep(frame, grid, T_map_grid, None, restart, previous, seconds)


def _read(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield frames; scan and mount of frames with a pose are read. A damaged one raises its error again when used."""
    for frame in frames:
        if frame.T_map_sensor is not None:
            with suppress(*_DAMAGED):
                frame.scan, frame.mount  # noqa: B018
        yield frame


class _Jumps:
    """Counts of pose and stamp jumps since the last fused scan."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Set both counts to 0."""
        self._poses = self._stamps = 0
        self._last = math.inf  # stamp of the last stamp jump

    def add(self, jump: PoseJump | StampJump, stamp: float | None) -> bool:
        """Count a jump; return whether it restarts the map. Stamp jumps count if their stamps follow each other."""
        if isinstance(jump, PoseJump):
            self._poses += 1
            return self._poses >= _MAX_JUMPS
        time = math.inf if stamp is None else float(stamp)
        self._stamps = self._stamps + 1 if 0 < time - self._last <= LONG_GAP else 1
        self._last = time
        return self._stamps >= _MAX_JUMPS


def turn_within_scan(previous: FusionStep, step: FusionStep) -> float:
    """Return the angle by which the vehicle turns while a scan is measured [rad], 0 or more.

    Without de-skewing, points at a distance r are off by up to r times this angle, so that static objects appear to
    move.

    Parameters
    ----------
    previous, step : FusionStep
        Successive steps of a drive. The angle is 0 at a restart of the map, and without poses, stamps or times of the
        points.
    """
    time, (now, then) = step.frame.scan.time, (step.frame.stamp, previous.frame.stamp)
    if step.restart or time is None or not len(time) or now is None or then is None or now <= then:
        return 0.0
    if step.T_map_grid is None or previous.T_map_grid is None:
        return 0.0
    R = previous.T_map_grid[:2, :2].T @ step.T_map_grid[:2, :2]
    turn = abs(math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))
    return turn * float(np.ptp(time)) / (now - then)


def update_map(
    mapper: Mapper, grid: EvidentialGrid, frame: Frame, *, restart: bool = True, reliability: Reliability = 1.0
) -> EvidentialGrid | None:
    """Fuse the measurement grid of a frame, levelled by its mount, and its radial velocities if it has Doppler.

    Parameters
    ----------
    mapper : EvidentialMapper, BinaryBayesMapper or DynamicMapper
    grid : EvidentialGrid
        Grid in the frame's levelled vehicle frame, as returned by sensor models.
    frame : Frame
    restart : bool
        Whether a pose jump begins a new map; else the `PoseJump` is raised.
    reliability : float or mapping of str to float
        Reliability, [0, 1], by which masses are discounted: for all sensors, or by `Scan.sensor`.

    Returns
    -------
    EvidentialGrid or None
        The map before a pose jump, if a new map was begun.

    Raises
    ------
    ValueError
        If the frame has no pose, its sensor has no reliability, or the mapper refuses the scan.
    """
    T_map_grid, scan = grid_pose(frame), frame.scan
    share = of_sensor(reliability, scan.sensor, "reliability") if isinstance(reliability, Mapping) else reliability
    radial = radial_velocities(scan, frame.mount)
    try:
        mapper.update(grid, T_map_grid, stamp=frame.stamp, reliability=share, radial=radial)
    except PoseJump:
        if not restart:
            raise
        before = mapper.grid
        mapper.reset()
        mapper.update(grid, T_map_grid, stamp=frame.stamp, reliability=share, radial=radial)
        return before
    return None


def deskew_frame(frame: Frame, trajectory: Trajectory) -> Frame:
    """Return a frame whose points are de-skewed when its scan is read.

    Parameters
    ----------
    frame : Frame
        Frame with a stamp, and with times of its points.
    trajectory : Trajectory
        Poses of the sensor, ``T_map_sensor``, around the stamp.
    """

    def read() -> Scan:
        scan = frame.scan
        if scan.time is None:
            raise ValueError("the points have no times: fuse without de-skewing, or give scans with times")
        if frame.stamp is None:
            raise ValueError("the frame has no stamp, which de-skewing needs: fuse without de-skewing, or give a stamp")
        poses = trajectory
        if frame.mount.points_in == "vehicle":
            poses = Trajectory(poses.stamps, poses.poses @ inverse(frame.mount.T_vehicle_sensor))
        return replace(scan, points=deskew(scan.points, scan.time, poses, frame.stamp))

    return LazyFrame(
        read,
        lambda: frame.mount,
        lambda: frame.boxes,
        lambda: frame.truth,
        T_map_sensor=frame.T_map_sensor,
        stamp=frame.stamp,
        name=frame.name,
        sequence=frame.sequence,
    )


def grid_pose(frame: Frame) -> NDArray[np.float64]:
    """Return the pose of a frame's measurement grid: the vehicle's axes and origin, at sensor height.

    The window of a map and its check for jumps follow this pose. It belongs to the vehicle, whichever sensor measured.

    Parameters
    ----------
    frame : Frame

    Returns
    -------
    (4, 4) float64
        Takes the coordinates of the grid to the map [m].

    Raises
    ------
    ValueError
        If the frame has no pose.
    """
    T = frame.T_map_sensor
    if T is None:
        raise ValueError("the frame has no pose, so it cannot be fused: give poses or odometry")
    T_level_vehicle = np.eye(4)
    T_level_vehicle[:2, 3] = -frame.mount.origin[:2]
    T_map_grid: NDArray[np.float64] = T @ frame.mount.T_sensor_level @ T_level_vehicle
    return T_map_grid


def _trajectory(frames: Iterable[Frame], given: bool | Trajectory) -> Trajectory | None:
    """Return the poses for de-skewing, extrapolated at both ends; None without de-skewing."""
    if given is False:
        return None
    if isinstance(given, Trajectory):
        return extrapolate(given, _MARGIN)
    if not isinstance(frames, Sequence):
        raise ValueError("de-skewing needs the poses of all frames: give a sequence of frames, or a trajectory")
    posed = [frame for frame in frames if frame.T_map_sensor is not None and frame.stamp is not None]
    stamps, first = np.unique([frame.stamp for frame in posed], return_index=True)
    if len(stamps) < 2:
        raise ValueError(f"de-skewing needs two frames or more with pose and stamp, got {len(stamps)}")
    return extrapolate(Trajectory(stamps, np.array([posed[k].T_map_sensor for k in first])), _MARGIN)
