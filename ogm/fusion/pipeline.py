"""From frames to grids and maps: `map_scans`, `fuse`, and the step that both share with evaluation, `update_map`."""

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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

_DAMAGED = (ValueError, TypeError, OSError)  # what is wrong with one frame, not with the program
MAX_TURN = math.radians(2.0)  # while a scan is taken: points at 20 m are then off by 0.7 m

_MAX_JUMPS = 3  # in a row, at the last of which the map begins anew
_MARGIN = 0.5  # [s] by which a trajectory is extrapolated for the points of its first and last scans

_log = logging.getLogger(__name__)

OnError = Callable[[Frame, Exception], None]
Reliability = float | Mapping[str, float]


def log_error(frame: Frame, error: Exception) -> None:
    """Log that a frame is skipped, and why."""
    _log.warning("%s is skipped: %s", frame.name, error)


def map_scans(
    frames: Iterable[Frame], ism: SensorModels, *, on_error: OnError = log_error
) -> Iterator[tuple[Frame, EvidentialGrid]]:
    """Yield each frame with its measurement grid.

    Parameters
    ----------
    frames : iterable of Frame
        A data set, or any other.
    ism : callable with `spec`, or mapping of str to these
        The sensor model, ``ism(scan) -> EvidentialGrid``; of several sensors one for each `Scan.sensor`.
    on_error : function
        Called with a frame that is damaged or cannot be mapped, and its error; the frame is left out. By default it is
        logged. A function that raises the error ends the loop.
    """
    for frame in frames:
        try:
            grid = run_model(ism, frame)
        except _DAMAGED as error:
            on_error(frame, error)
            continue
        yield frame, grid


class FusionStep(NamedTuple):
    """What `fuse` did with a frame.

    Attributes
    ----------
    frame : Frame
        With the scan that was mapped, de-skewed if that was wanted.
    grid : EvidentialGrid or None
        Its measurement grid; None if the frame was skipped.
    T_map_grid : (4, 4) float64 or None
        The pose at which the grid was fused: that of the levelled vehicle frame.
    error : Exception or None
        Why the frame was skipped.
    restart : str
        Why the map began anew with this frame: "pose jump", "stamp jump" or "sequence"; "" if it did not.
    previous_map : EvidentialGrid or None
        The map up to there, if it began anew: nothing else keeps it.
    seconds : (float, float)
        Time that the sensor model and the mapper took [s].
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
) -> Iterator[FusionStep]:
    """Fuse the scans of a drive into a map, one step per frame.

    The map begins anew with every new `Frame.sequence`, and after three jumps in a row, at the last of them: jumps of
    poses, or of stamps that follow each other.

    Parameters
    ----------
    frames : iterable of Frame
        In the order of their stamps; each needs `T_map_sensor` and, unless the map never forgets, `stamp`. Of several
        sensors of a vehicle each has its own poses, and its mount in one vehicle frame.
    ism : callable with `spec`, or mapping of str to these
        The sensor model, ``ism(scan) -> EvidentialGrid``; of several sensors one for each `Scan.sensor`. Frames of a
        sensor without one are skipped.
    mapper : EvidentialMapper, BinaryBayesMapper or DynamicMapper
        Updated in place.
    deskew : bool or Trajectory
        Undo the ego motion during each scan, by the times of its points: with the poses of `frames`, which must then be
        a sequence, or with a trajectory of the sensor, for example of higher rate. Scans of several sensors are
        de-skewed before, each by its own poses: `deskew_frame`.
    reliability : float or mapping of str to float
        [0, 1]: masses are discounted by it; by `Scan.sensor`, "" for the rest, or for all.
    on_error : function
        Called with every frame that is skipped, and its error; by default it is logged.

    Yields
    ------
    FusionStep
        Also for frames that were skipped: damaged, without pose, or with a pose jump. These leave the map as it was.

    Raises
    ------
    ValueError
        If de-skewing has no poses, or `ism` is of several sensors.

    Examples
    --------
    >>> mapper = EvidentialMapper(rolling_window(ism.spec))                 # doctest: +SKIP
    >>> for step in fuse(open_dataset("drive/"), ism, mapper):             # doctest: +SKIP
    ...     print(step.frame.name, step.error or step.grid)
    >>> mapper.grid.save("map.npz")                                        # doctest: +SKIP
    """
    if deskew is not False and isinstance(ism, Mapping):
        raise ValueError("poses are of one sensor: de-skew each sensor's frames by its own trajectory, `deskew_frame`")
    trajectory = _trajectory(frames, deskew)
    jumps, sequence = _Jumps(), None
    for frame in frames:
        if trajectory is not None:
            frame = deskew_frame(frame, trajectory)
        restart, previous = "", None
        try:
            T_map_grid = grid_pose(frame)
            frame.scan  # noqa: B018  reading is not the model's time
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


class _Jumps:
    """Jumps since the last scan that was fused."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self._poses = self._stamps = 0
        self._last = math.inf  # stamp of the last jump of a stamp

    def add(self, jump: PoseJump | StampJump, stamp: float | None) -> bool:
        """Count a jump; return whether it is the last that is refused: of stamps, only those that agree count."""
        if isinstance(jump, PoseJump):
            self._poses += 1
            return self._poses >= _MAX_JUMPS
        time = math.inf if stamp is None else float(stamp)
        self._stamps = self._stamps + 1 if 0 < time - self._last <= LONG_GAP else 1
        self._last = time
        return self._stamps >= _MAX_JUMPS


def turn_within_scan(previous: FusionStep, step: FusionStep) -> float:
    """Return the angle by which the vehicle turns while the points of a scan are measured [rad], 0 or more.

    Of scans that are not de-skewed, points at a distance r are off by up to r times this angle, so that static objects
    seem to move.

    Parameters
    ----------
    previous, step : FusionStep
        Successive steps of one drive. Without times of the points, poses or stamps, and where the map begins anew, the
        angle is 0.
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
    """Fuse the measurement grid of a frame, levelled by the frame's mount, and its radial velocities if it has Doppler.

    Parameters
    ----------
    mapper : EvidentialMapper, BinaryBayesMapper or DynamicMapper
    grid : EvidentialGrid
        In the frame's levelled vehicle frame, as sensor models return it.
    frame : Frame
    restart : bool
        Whether the map begins anew at a pose jump; else the `PoseJump` is raised.
    reliability : float or mapping of str to float
        [0, 1]: masses are discounted by it; by `Scan.sensor` or for all.

    Returns
    -------
    EvidentialGrid or None
        The map up to a pose jump, if it began anew.

    Raises
    ------
    ValueError
        If the frame has no pose, its sensor no reliability, and for all that the mapper refuses.
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
        With a stamp, and times of its points.
    trajectory : Trajectory
        Poses of the sensor, ``T_map_sensor``, around the stamp.
    """

    def read() -> Scan:
        scan = frame.scan
        if scan.time is None:
            raise ValueError("its points have no times, so that they cannot be de-skewed")
        if frame.stamp is None:
            raise ValueError("it has no stamp, so that it cannot be de-skewed")
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
    """Return the pose of the frame in which a measurement grid lies: the vehicle's axes and origin, at sensor height.

    The window of a map and its check for jumps follow it: it is of the vehicle, whichever sensor measured.

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
        raise ValueError("it has no pose, so that it cannot be fused")
    T_level_vehicle = np.eye(4)
    T_level_vehicle[:2, 3] = -frame.mount.origin[:2]
    T_map_grid: NDArray[np.float64] = T @ frame.mount.T_sensor_level @ T_level_vehicle
    return T_map_grid


def _trajectory(frames: Iterable[Frame], given: bool | Trajectory) -> Trajectory | None:
    """Return the poses by which scans are de-skewed, extrapolated at both ends."""
    if given is False:
        return None
    if isinstance(given, Trajectory):
        return extrapolate(given, _MARGIN)
    if not isinstance(frames, Sequence):
        raise ValueError("de-skewing needs the poses of all frames: give a sequence of frames, or a trajectory")
    posed = [frame for frame in frames if frame.T_map_sensor is not None and frame.stamp is not None]
    stamps, first = np.unique([frame.stamp for frame in posed], return_index=True)
    if len(stamps) < 2:
        raise ValueError("de-skewing needs two frames or more with pose and stamp")
    return extrapolate(Trajectory(stamps, np.array([posed[k].T_map_sensor for k in first])), _MARGIN)
