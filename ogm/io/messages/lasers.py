"""Planar lasers and range sensors: ``LaserScan``, ``MultiEchoLaserScan`` and ``Range`` to a scan."""

import logging
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.beams import BeamRanges, echoes, planar_scan, range_limits
from ogm.io.columns import IntensityRange, IntensityScale, intensity_range
from ogm.io.messages.plain import describe_message, reads_message, stamp_seconds
from ogm.io.notices import notice
from ogm.scan import Scan
from ogm.storage.files import OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

_TURN = 2 * math.pi
_FITS = 1.5  # increments between the last beam and angle_max: some drivers state the angle after the last beam
_LONGEST = 10.0  # [s] longer than any scan


@reads_message
def scan_from_laser_scan(message: Any, *, intensity_max: IntensityScale | None = None) -> Scan:
    """Return the scan of a ``sensor_msgs/LaserScan`` or ``sensor_msgs/MultiEchoLaserScan``.

    Ranges follow REP 117 and the common deviations of drivers, see `ogm.io.beams.echoes`. Beams begin at ``angle_min``
    in steps of ``angle_increment``, negative for lasers that rotate to the right. ``angle_max`` is used only if the
    increment is 0 or gives more than a turn.

    Parameters
    ----------
    message : object
        Object with the fields of the message, from rosbags, rclpy, rospy, or a decoded MCAP.
    intensity_max : IntensityScale, optional
        See `ogm.io.read_scan`.

    Returns
    -------
    Scan
        Scan of kind "planar", in the frame of the laser. `Scan.no_returns` has the beams without echo, `Scan.max_range`
        is ``range_max``, `Scan.time` counts from the stamp by ``time_increment``. All echoes of a beam are points; a
        beam with an empty list of echoes is unknown.

    Raises
    ------
    OgmError
        If angles are not finite, not in radians, or give no directions.
    """
    where = describe_message(message, "LaserScan")
    ranges, beam, count = _per_echo(message.ranges, where)
    least, greatest = range_limits(float(message.range_min), float(message.range_max), where)
    angles, times = _angles(message, count, where), _times(message, count, where)
    beams = BeamRanges(
        ranges,
        angles[beam],
        beam,
        None if times is None else times[beam],
        _intensities(message, ranges, where),
        least,
        greatest,
    )
    return planar_scan(beams, where, stamp_seconds(message.header.stamp), intensity_max)


@reads_message
def laser_intensity_range(message: Any) -> IntensityRange | None:
    """Return the intensities of one laser scan that become 0 and 1 by their values; None without intensities."""
    where = describe_message(message, "LaserScan")
    ranges = _per_echo(message.ranges, where)[0]
    intensities = _intensities(message, ranges, where)
    return None if intensities is None else intensity_range(intensities)


@reads_message
def scan_from_range(message: Any) -> Scan:
    """Return the scan of a ``sensor_msgs/Range`` of an ultrasonic or infrared sensor.

    A range of at least the greatest range, and +inf, is no echo. A range below the least range, 0, NaN and -inf are
    unknown. Sensors that detect without measuring have two equal limits: they are free at +inf, and unknown at -inf, as
    the position of the detection is unknown.

    Parameters
    ----------
    message : object
        Object with the fields of the message.

    Returns
    -------
    Scan
        Scan of kind "cone", in the frame of the sensor: one point on the x axis, or one beam without echo, or neither.
        `Scan.beam_width` is ``field_of_view``, `Scan.max_range` is ``max_range``.

    Raises
    ------
    OgmError
        If it is no such message.
    """
    where = describe_message(message, "Range")
    with error_context(f"{where} has limits or a range that are not numeric", TypeError, ValueError):
        low, high, distance = (float(getattr(message, name)) for name in ("min_range", "max_range", "range"))
        width = float(message.field_of_view)
    binary = low == high and 0 < low < math.inf
    if binary and distance == -math.inf:
        text = "%s: a detection at an unknown distance up to %g m; such detections are unknown, not occupied"
        notice(log, "detections without range", text, where, high)
    least, greatest = range_limits(0.0 if binary else low, high, where)
    if not 0 < width <= _TURN:
        text = "%s has a field of view of %g rad, wanted above 0 and at most 2 pi: its beam width is unknown"
        notice(log, "field of view", text, where, width)
    with_echo, silent = echoes(np.array([distance]), least, greatest)
    if not (with_echo | silent).any():
        notice(log, "unknown ranges", "%s: the range %g m is unknown", where, distance, level=logging.INFO)
    axis = np.array([[1.0, 0.0, 0.0]], np.float32)
    return Scan(
        distance * axis[with_echo],
        stamp=stamp_seconds(message.header.stamp),
        no_returns=axis[silent],
        kind="cone",
        max_range=greatest,
        beam_width=width if 0 < width <= _TURN else None,
    )


def _numbers(values: Any, where: str, name: str) -> NDArray[np.float64]:
    """Return numbers of a message as an array, (N,)."""
    with error_context(f"{where} has {name} that are not numeric", TypeError, ValueError, OverflowError):
        return np.asarray(values, np.float64).reshape(-1)


def _per_echo(values: Any, where: str) -> tuple[NDArray[np.float64], NDArray[np.int64], int]:
    """Return the values of all echoes, the beam of each echo, and the number of beams."""
    with error_context(f"{where} has ranges or intensities that are no lists", TypeError):
        several = len(values) > 0 and hasattr(values[0], "echoes")
    if several:
        lists = [_numbers(beam.echoes, where, "echoes") for beam in values]
        return np.concatenate(lists), np.repeat(np.arange(len(lists)), [len(values) for values in lists]), len(lists)
    numbers = _numbers(values, where, "ranges")
    return numbers, np.arange(len(numbers)), len(numbers)


def _intensities(message: Any, ranges: NDArray[np.float64], where: str) -> NDArray[np.float64] | None:
    """Return the intensity of each range; None unless the counts agree."""
    values = _per_echo(message.intensities, where)[0]
    if len(values) and len(values) != len(ranges):
        text = "%s has %d intensities for %d ranges: they are left out"
        notice(log, "wrong intensities", text, where, len(values), len(ranges))
    return values if len(values) == len(ranges) and len(values) else None


def _times(message: Any, count: int, where: str) -> NDArray[np.float64] | None:
    """Return the time of each beam, counted from the stamp [s]; None if missing or too long for a scan."""
    step = float(message.time_increment)
    if step == 0:
        return None
    length, scan_time = abs(step) * max(count - 1, 0), float(message.scan_time)
    longest = min(_LONGEST, 1.5 * scan_time) if scan_time > 0 else _LONGEST
    if not length <= longest:
        text = "%s has a time_increment of %g s, by which %d beams last %.3g s, wanted at most %.3g s: it is left out"
        notice(log, "times of no scan", text, where, step, count, length, longest)
        return None
    return np.asarray(step * np.arange(count))


def _angles(message: Any, count: int, where: str) -> NDArray[np.float64]:
    """Return the angle of each beam to the left of x [rad]."""
    start, end, step = (float(getattr(message, f"angle_{name}")) for name in ("min", "max", "increment"))
    stated = f"angle_min {start:g}, angle_max {end:g}, angle_increment {step:g}"
    if not math.isfinite(start) or abs(start) > 2 * _TURN:
        raise OgmError(f"{where} has {stated} for {count} beams, wanted radians within two turns: correct the driver")
    if count < 2:
        return np.full(count, start)
    fit = (end - start) / (count - 1)  # the increment that puts the last beam at angle_max
    fits, sane = _is_step(fit, count), _is_step(step, count)
    if not (fits or sane):
        way_out = "use radians instead of degrees, or correct the driver"
        raise OgmError(f"{where} has {stated} for {count} beams, which give no directions within a turn: {way_out}")
    if not sane:
        text = "%s has %s for %d beams: angle_max is used, with an increment of %.6g rad"
        notice(log, "wrong angles", text, where, stated, count, fit)
        return np.asarray(start + fit * np.arange(count))
    apart = start + step * (count - 1) - end
    if math.isfinite(apart) and abs(step) * count < 0.99 * _TURN:  # sectors across the rear, where angles jump
        apart = math.remainder(apart, _TURN)
    if not abs(apart) <= _FITS * abs(step):
        text = "%s has %s for %d beams, which is inconsistent: the increment is used, the last beam is at %.4g rad"
        notice(log, "wrong angles", text, where, stated, count, start + step * (count - 1))
    return np.asarray(start + step * np.arange(count))


def _is_step(step: float, count: int) -> bool:
    """Return whether an angular step [rad] spreads the beams over different directions, within about a turn."""
    return math.isfinite(step) and abs(step) > 1e-9 and abs(step) * (count - _FITS - 1) <= _TURN
