"""Beams of planar lasers, from messages and logs: ranges and angles to a scan."""

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

_SLACK = 1e-3  # [m] below the greatest range that still counts as the greatest: drivers round


class BeamRanges(NamedTuple):
    """Ranges of the beams of one planar scan.

    Attributes
    ----------
    ranges : (B,) float64
        [m]
    angles : (B,) float64
        Direction of each range, to the left of x [rad].
        Number of the beam of each range, if beams have several echoes.
    time : (B,) float64, optional
        Time of each range, counted from the stamp [s].
    intensity : (B,) numbers, optional
    min_range : float
        Least range of the sensor [m]; 0 if unknown.
    max_range : float, optional
        Greatest range of the sensor [m]; None if unknown.
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
    """Return masks of the ranges with an echo and of the beams without echo, both (B,).

    The rest are unknown: too near (below `min_range`, or -inf), 0 or below, NaN, and absurdly far. A range means no
    echo if it is +inf (REP 117), or at least the greatest range, which many drivers report instead.

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
        Scan of kind "planar". `Scan.no_returns` has the beams without echo; unknown ranges are left out.
    """
    with_echo, silent = echoes(beams.ranges, beams.min_range, beams.max_range)
    if unknown := int(np.count_nonzero(~with_echo & ~silent)):
        text = "%s: %d of %d ranges are 0, too near or NaN; their beams are unknown"
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
    """Return the least and greatest range stated by a driver [m]; 0 and None if unusable.

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
        text = "%s states the unusable range limits %g to %g m; beams without echo are not free"
        notice(log, "range limits", text, where, low, high)
        return 0.0, None
    if greatest is None:
        text = "%s states no greatest range (%g m): beams without echo are not free"
        notice(log, "range limits", text, where, high, level=logging.INFO)
    return least, greatest
