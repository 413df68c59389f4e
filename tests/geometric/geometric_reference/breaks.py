"""Breaks of the ground along profiles, and classes of the rays that meet them, return by return."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels import breaks as constants
from ogm.geometric.kernels import classify as kinds
from ogm.geometric.kernels.arguments import RayNumbers

__all__ = ["Beam", "Break", "classify", "find_breaks", "profiles_of"]


class Beam(NamedTuple):
    """A ray in a sector."""

    slope: float  # rise over run
    run: float  # horizontal range of its return [m]
    above: float  # height of the return above the ground map [m]
    is_return: bool


class Bin(NamedTuple):
    """A bin of a profile that holds ground returns."""

    number: int
    run: float  # mean horizontal range of the returns [m]
    height: float  # mean height of the returns, relative to the sensor [m]


@dataclass
class Break:
    """A break (step, fall or hole) of the ground in a bin of a profile."""

    kind: int
    limit: float  # returns above it (step) or below it (hole) belong to the break; relative to the sensor [m]
    begin: int  # first polar bin
    end: int  # last bin of the profile

    def covers(self, wide: int) -> set[int]:
        """Return the polar bins from the ground before the break to its end."""
        return set(range(self.begin, (self.end + 1) * wide))


class Line(NamedTuple):
    """Line that continues the ground before a bin."""

    run: float  # horizontal range of the last ground [m]
    height: float  # at `run` [m]
    incline: float  # rise over run
    rough: float  # standard deviation of the ground about the line [m]

    def rest(self, run: float, height: float) -> float:
        """Return the height of a point above the line [m]."""
        return height - self.height - self.incline * (run - self.run)


def profiles_of(sectors: Sequence[Sequence[Beam]], step: float, obstacle_height: float, bins: int) -> list[list[Bin]]:
    """Return the profiles of neighbouring sectors, 2**PROFILE_BITS each."""
    together, wide = 2**constants.PROFILE_BITS, _width(step)
    result = []
    for begin in range(0, len(sectors), together):
        beams = [beam for sector in sectors[begin : begin + together] for beam in sector]
        found: dict[int, list[Beam]] = {}
        for beam in beams:
            number = int(beam.run / (wide * step))
            in_profile = number <= int(constants.PROFILE_RADII * bins) // wide
            if beam.is_return and beam.above <= obstacle_height and in_profile:
                found.setdefault(number, []).append(beam)
        result.append(
            [
                Bin(number, float(np.mean([b.run for b in held])), float(np.mean([b.slope * b.run for b in held])))
                for number, held in sorted(found.items())
                if len(held) >= constants.MIN_RETURNS
            ]
        )
    return result


def find_breaks(
    profiles: Sequence[list[Bin]], lowest: float, step: float, bins: int, below_ground: float
) -> tuple[list[dict[int, Break]], NDArray[np.float64]]:
    """Return the breaks of each profile by bin number, and the reliability of belief, (profiles, bins).

    Parameters
    ----------
    profiles : list of lists of Bin
        Profiles around the sensor: the last is a neighbour of the first.
    lowest : float
        Height of the ground under the sensor, relative to it [m].
    step : float
        Depth of a polar bin [m].
    bins : int
        Number of polar bins.
    below_ground : float
        See `RayISM`.
    """
    alone, wide = [_compare(profile, lowest, step, below_ground) for profile in profiles], _width(step)
    result: list[dict[int, Break]] = []
    reliability = np.ones((len(profiles), bins))
    for row, found in enumerate(alone):
        beside = [other for side in (row - 1, (row + 1) % len(alone)) for other in alone[side].values()]
        kept = {
            number: found_break
            for number, found_break in found.items()
            if any(
                (found_break.kind == constants.STEP) == (other.kind == constants.STEP)
                and found_break.covers(wide) & other.covers(wide)
                for other in beside
            )
        }
        result.append(kept)
        for kept_break in kept.values():
            share = 0 if kept_break.kind == constants.HOLE else constants.DOUBTFUL_RELIABILITY
            part = reliability[row, kept_break.begin : (kept_break.end + 1) * wide + 1]
            part[:] = np.minimum(part, share)
    return result, reliability


def _width(step: float) -> int:
    """Return the depth of a profile bin, in polar bins."""
    return max(int(constants.DEPTH / step + 0.5), 1)


def _compare(profile: list[Bin], lowest: float, step: float, below_ground: float) -> dict[int, Break]:
    """Return the breaks of a profile by bin number, from a comparison of each bin with the continued ground."""
    found: dict[int, Break] = {}
    known: list[tuple[float, float]] = []  # runs and heights of the ground that the line is fitted to
    horizon, incline, resume = -math.inf, 0.0, 0
    last_ground: list[float] = []  # runs of all ground
    hole: tuple[Line, int] | None = None  # the ground before a hole, and its bin
    for k, (number, run, height) in enumerate(profile):
        if not known or k < resume:
            horizon = max(horizon, height / run)
            if not known:
                lowest = min(lowest, height)
                known, last_ground = [(run, height)], [run]
            continue
        line = _line(known, run, incline)
        incline, slack = line.incline, constants.BEND * (run - line.run) + constants.ROUGHNESS_FACTOR * line.rough
        rise, is_near = line.rest(run, height), run - line.run < constants.MAX_GAP
        edge = max([r for r in last_ground if r <= run - constants.EDGE], default=last_ground[0])
        begin = max(int(edge / step) - 1, 0)

        if is_near and rise > constants.ONSET + slack:
            end = _end(profile, k, line, 1)
            high = line.rest(*profile[end][1:]) if end is not None else 0.0
            least = constants.RISE + constants.RISE_ANGLE * run + constants.ROUGHNESS_FACTOR * line.rough
            min_jump = constants.MIN_JUMP_SHARE * high
            if end is not None and high > least and max(_jumps(profile, k, end, line)) > min_jump:
                face = height - rise + constants.FACE + constants.ROUGHNESS_FACTOR * line.rough
                limit = face if high > constants.OBSTACLE_STEP else math.inf
                found[number] = Break(constants.STEP, limit, begin, profile[end].number)
                known, resume, hole = [profile[end][1:]], end + 1, None
                last_ground.append(profile[end].run)
                horizon = max(horizon, height / run)
                continue
        elif rise < -constants.HOLE_ONSET - slack:
            if height / run < horizon:
                continue
            goes_on = False
            if hole is None:
                goes_on = _end(profile, k, line, -1) is None
                before = line
            else:
                before = hole[0]
            if not goes_on:
                far = max(run - before.run - constants.DESCENT_GAP, 0)
                level = min(before.height + before.incline * (run - before.run), lowest)
                floor = level - below_ground - constants.DESCENT * far - slack
                if height < floor:
                    hole = hole or (before, begin)
                    found[number] = Break(constants.HOLE, floor, hole[1], number)
                    continue
                if is_near and min(_jumps(profile, k, k, line)) < constants.MIN_JUMP_SHARE * rise:
                    found[number] = Break(constants.FALL, -math.inf, begin, number)
                    known = []
        hole, horizon, lowest = None, max(horizon, height / run), min(lowest, height)
        known.append((run, height))
        last_ground.append(run)
    return found


def _line(known: list[tuple[float, float]], run: float, before: float) -> Line:
    """Fit a line to the ground before `run`; with too little ground it keeps the incline `before`."""
    at = max((n for n, (r, _) in enumerate(known) if r <= run - constants.GAP), default=0)
    base = max((n for n in range(at + 1) if known[n][0] <= known[at][0] - constants.BASELINE), default=0)
    r, z = np.array(known[base : at + 1]).T
    if ((r - r.mean()) ** 2).sum() > 0.5:
        incline = min(max(float(np.polyfit(r, z, 1)[0]), -constants.MAX_INCLINE), constants.MAX_INCLINE)
    else:
        incline = before
    rest = ((z - z.mean()) ** 2).sum() - incline * ((r - r.mean()) * (z - z.mean())).sum()
    rough = math.sqrt(max(rest, 0) / (len(r) - 2)) if len(r) >= constants.MIN_ROUGHNESS_BINS else 0.0
    return Line(known[at][0], float(z.mean() + incline * (known[at][0] - r.mean())), incline, rough)


def _jumps(profile: list[Bin], first: int, last: int, line: Line) -> list[float]:
    """Return the changes of height from bin to bin, relative to the line [m]."""
    pairs = [(profile[k - 1], profile[k]) for k in range(max(first, 1), last + 1)]
    return [b.height - a.height - line.incline * (b.run - a.run) for a, b in pairs]


def _end(profile: list[Bin], k: int, line: Line, sign: int) -> int | None:
    """Return the last bin of a rise (`sign` 1) or fall (-1) that begins in bin `k`, None for a slope or noise."""
    last = k
    while True:
        later = [j for j in range(last + 1, len(profile)) if profile[j].run - profile[last].run > constants.GAP]
        if not later:
            return last
        before, rest = (line.rest(*profile[j][1:]) for j in (last, later[0]))
        run, grown = profile[last].run, profile[later[0]].run - profile[last].run
        if sign * rest <= sign * before * (1 + grown / (run - line.run) / 2):
            is_noise = sign > 0 and rest < before / 2 and grown < constants.BUMP
            return None if is_noise else last
        last = later[0]
        if profile[last].run - line.run > constants.MAX_RISE_RUN or rest > constants.MAX_RISE:
            return None


def classify(beams: Sequence[Beam], breaks: dict[int, Break], step: float, numbers: RayNumbers) -> list[int]:
    """Return the class of each ray of a sector, see `kernels.classify`, given the breaks of its profile."""
    result = []
    for slope, run, above, is_return in beams:
        met = breaks.get(int(run / step) // _width(step))
        height = slope * run
        if run < step:
            kind = kinds.NONE
        elif not is_return:
            kind = kinds.NO_RETURN
        elif above >= numbers.clearance:
            kind = kinds.OVERHEAD
        elif above > numbers.obstacle_height:
            kind = kinds.OBSTACLE
        elif met and met.kind == constants.HOLE and height < met.limit:
            kind = kinds.DEEP
        elif above < -numbers.below_ground:
            kind = kinds.NONE
        elif met and met.kind == constants.STEP and height > met.limit:
            kind = kinds.FACE_OF_STEP
        else:
            kind = kinds.GROUND
        result.append(kind)
    return result
