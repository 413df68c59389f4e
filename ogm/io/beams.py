"""Beams in one plane, as messages and logs of planar lasers have them: ranges by angle to a scan."""

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.columns import IntensityScale, scale_intensities
from ogm.io.labels import REACH
from ogm.io.notices import notice
from ogm.scan import Scan

log: logging.Logger = logging.getLogger(__name__)

_SLACK = 1e-3  # [m] below the greatest range, within which a range is the greatest: drivers round


class BeamRanges(NamedTuple):
    """Ranges of the beams of one planar scan.

    Attributes
    ----------
    ranges : (B,) float64
        [m]
    angles : (B,) float64
        Direction of each range, to the left of x [rad].
    beam : (B,) int64, optional
        Number of the beam of each range, where a beam has several echoes.
    time : (B,) float64, optional
        Time of each range, counted from the stamp [s].
    intensity : (B,) numbers, optional
    min_range : float
        Least range of the sensor [m]; 0 where unknown.
    max_range : float, optional
        Greatest range of the sensor [m]; None where unknown.
    """

    ranges: NDArray[np.float64]
    angles: NDArray[np.float64]
    beam: NDArray[np.int64] | None = None
    time: NDArray[np.float64] | None = None
    intensity: NDArray[np.float64] | None = None
    min_range: float = 0.0
    max_range: float | None = None


def echoes(
    ranges: NDArray[np.float64], min_range: float, max_range: float | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which ranges are those of an echo, and which those of beams without one, both (B,).

    The rest are unknown: too near (below `min_range`, or -inf), 0 or below, NaN, and absurdly far. A beam has no echo
    at +inf (REP 117), and from the greatest range on, which drivers report instead, or more than it.

    Parameters
    ----------
    ranges : (B,) float64
        [m]
    min_range, max_range : float
        See `BeamRanges`.
    """
    silent = np.isposinf(ranges)
    if max_range is not None:
        silent |= ranges >= max_range - _SLACK
    return (ranges > 0) & (ranges >= min_range) & (ranges <= REACH) & ~silent, silent


def planar_scan(
    beams: BeamRanges, where: str, stamp: float | None, intensity_max: IntensityScale | None = None
) -> Scan:
    """Return the scan of beams in the x-y plane.

    Parameters
    ----------
    beams : BeamRanges
    where : str
        Name of the scan, for notices.
    stamp : float or None
        [s]
    intensity_max : IntensityScale, optional
        See `ogm.io.read_scan`.

    Returns
    -------
    Scan
        Of kind "planar". Beams without echo are `Scan.no_returns`; those of unknown range are left out.
    """
    with_echo, silent = echoes(beams.ranges, beams.min_range, beams.max_range)
    if unknown := int(np.count_nonzero(~with_echo & ~silent)):
        text = "%s: %d of %d ranges are 0, too near or no number; their beams are unknown"
        notice(log, "unknown ranges", text, where, unknown, len(beams.ranges), level=logging.INFO)
    directions = np.column_stack([np.cos(beams.angles), np.sin(beams.angles), np.zeros(len(beams.angles))])
    points = np.zeros((np.count_nonzero(with_echo), 4), np.float32)
    points[:, :3] = beams.ranges[with_echo, None] * directions[with_echo]
    if beams.intensity is not None:
        points[:, 3] = scale_intensities(beams.intensity[with_echo], intensity_max, None, where)[0]
    if beams.beam is not None:
        silent &= ~np.isin(beams.beam, beams.beam[with_echo])
        silent[silent] = np.diff(beams.beam[silent], prepend=-1) > 0  # one direction for each beam
    time = None if beams.time is None else beams.time[with_echo]
    far = beams.max_range
    return Scan(points, stamp=stamp, time=time, no_returns=directions[silent], kind="planar", max_range=far)


def range_limits(low: float, high: float, where: str) -> tuple[float, float | None]:
    """Return the least and the greatest range that a driver states [m]; 0 and None if they are no limits.

    Parameters
    ----------
    low, high : float
        Stated limits [m].
    where : str
        Name of the measurement, for notices.
    """
    least = low if 0 < low < math.inf else 0.0
    greatest = high if 0 < high <= REACH else None
    if greatest is not None and least >= greatest:
        text = "%s states ranges from %g to %g m, which are no limits and not used; beams without echo are not free"
        notice(log, "range limits", text, where, low, high)
        return 0.0, None
    if greatest is None:
        text = "%s states no greatest range (%g m): beams without echo are not free"
        notice(log, "range limits", text, where, high, level=logging.INFO)
    return least, greatest
