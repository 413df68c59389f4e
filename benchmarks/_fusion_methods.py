"""The maps that `fusion_quality` compares: families of one parameter each, and how an operating point is chosen."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from _trails import WINDOW, Mapper, ScanAlone

from ogm.evidence import (
    averaging,
    cumulative,
    dempster,
    discount_evidence,
    normalized_cautious,
    pcr6,
    weighted,
    yager,
)
from ogm.fusion import BinaryBayesMapper, EvidentialMapper

__all__ = ["BASELINE", "DEFAULT", "FAMILIES", "PLAIN", "SCAN", "SLOW", "Family", "chosen", "make", "named"]

INF = float("inf")
CLASSICAL = (0.12, 0.97)  # OctoMap's limits
MIN_UNKNOWN = 0.02  # of the evidential maps
MATCHED = (MIN_UNKNOWN / (1 + MIN_UNKNOWN), 1 / (1 + MIN_UNKNOWN))  # the plausibilities that it allows
HALF_LIVES = (0.5, 1.0, 2.0, 5.0, INF)
MOVING_HALF_LIVES = (0.02, 0.04, 0.1, 0.2, 0.5)
MOVING = "half life of what came [s]"
SLOW_HALF_LIVES = (2.0, INF)  # of the rules that run in numpy
TOLERANCE = 0.005  # of IoU: static accuracy that counts as equal


class Family(NamedTuple):
    """Maps that differ in one parameter.

    Attributes
    ----------
    make : function
        From the parameter to a new map.
    parameters : tuple of float
    what : str
        What the parameter is.
    """

    make: Callable[[float], Mapper]
    parameters: Sequence[float]
    what: str = "half life [s]"


def _evidential(rule: Callable, **options: object) -> Callable[[float], Mapper]:
    """Return maps by their half life, in which what came stays as long as all else."""
    return lambda h: EvidentialMapper(
        WINDOW,
        rule,
        h,
        moving_half_life=INF,
        min_unknown=MIN_UNKNOWN,
        **options,  # type: ignore[arg-type]
    )


def _leaving(rule: Callable, **options: object) -> Callable[[float], Mapper]:
    """Return maps by the half life of what came, of a half life of 2 s else."""
    return lambda h: EvidentialMapper(
        WINDOW,
        rule,
        2.0,
        moving_half_life=h,
        min_unknown=MIN_UNKNOWN,
        **options,  # type: ignore[arg-type]
    )


def _bayes(match: str, limits: tuple[float, float]) -> Callable[[float], Mapper]:
    return lambda h: BinaryBayesMapper(WINDOW, h, match=match, limits=limits)  # type: ignore[arg-type]


FAMILIES: dict[str, Family] = {
    "Bayes, pignistic": Family(_bayes("pignistic", CLASSICAL), HALF_LIVES),
    "Bayes, plausibility": Family(_bayes("plausibility", CLASSICAL), HALF_LIVES),
    "Bayes, plausibility, limits as Dempster": Family(_bayes("plausibility", MATCHED), HALF_LIVES),
    "Bayes, pignistic, never forgets": Family(
        lambda p: BinaryBayesMapper(WINDOW, limits=(1 - p, p)), (0.8, 0.9, 0.95, 0.98, 0.999), "limit"
    ),
    "Dempster": Family(_evidential(dempster), HALF_LIVES),
    "Dempster, evidence fades": Family(_evidential(dempster, discounting=discount_evidence), HALF_LIVES),
    "Dempster, where observed": Family(_evidential(dempster, forget="observed"), HALF_LIVES),
    "Dempster, occupied fades first": Family(
        lambda h: EvidentialMapper(WINDOW, dempster, (INF, h), moving_half_life=INF),
        HALF_LIVES[:-1],
        "half life of occupied [s]",
    ),
    "Dempster, free fades first": Family(
        lambda h: EvidentialMapper(WINDOW, dempster, (h, 4 * h), moving_half_life=INF),
        (0.25, 0.5, 1.0),
        "half life of free [s]",
    ),
    "Dempster, 2 s, bounded": Family(
        lambda u: EvidentialMapper(WINDOW, dempster, 2.0, moving_half_life=INF, min_unknown=u),
        (0.05, 0.1, 0.2),
        "least unknown",
    ),
    "Dempster, never forgets": Family(
        lambda u: EvidentialMapper(WINDOW, dempster, INF, moving_half_life=INF, min_unknown=u),
        (0.02, 0.05, 0.1, 0.2, 0.4),
        "least unknown",
    ),
    "Yager": Family(_evidential(yager), HALF_LIVES),
    "cumulative": Family(_evidential(cumulative), HALF_LIVES),
    "cumulative, evidence fades": Family(_evidential(cumulative, discounting=discount_evidence), HALF_LIVES),
    "cautious": Family(_evidential(normalized_cautious), HALF_LIVES),
    "cautious, evidence fades": Family(
        _evidential(normalized_cautious, discounting=discount_evidence), HALF_LIVES
    ),
    "cautious, what came leaves": Family(_leaving(normalized_cautious), MOVING_HALF_LIVES, MOVING),
    "Dempster, what came leaves": Family(_leaving(dempster), MOVING_HALF_LIVES, MOVING),
    "cumulative, what came leaves": Family(_leaving(cumulative), MOVING_HALF_LIVES, MOVING),
    "PCR6": Family(_evidential(pcr6), SLOW_HALF_LIVES),
    "averaging": Family(_evidential(averaging), SLOW_HALF_LIVES),
    "weighted": Family(_evidential(weighted), SLOW_HALF_LIVES),
}
SLOW = ("PCR6", "averaging", "weighted")  # ten times slower
SCAN = "scan alone"
BASELINE = ("Bayes, pignistic", INF)  # the classical filter
DEFAULT = ("cautious, what came leaves", 0.04)  # the mapper's
PLAIN = ("Dempster", 2.0)  # what most would take


def named(family: str, parameter: float) -> str:
    """Return what a map is called in tables."""
    if (family, parameter) == BASELINE:
        return "classical Bayes"
    unit = FAMILIES[family].what.split()[-1].strip("[]")
    value = "never forgets" if np.isinf(parameter) else f"{parameter:g}" + (" s" if unit == "s" else "")
    return f"{family}, {value}"


def make(family: str, parameter: float) -> Mapper:
    """Return a new map."""
    if family == SCAN:
        return ScanAlone(WINDOW)
    return FAMILIES[family].make(parameter)


def chosen(rows: Mapping[tuple[str, float], Mapping[str, float]]) -> dict[str, float]:
    """Choose each family's parameter: least ghost area at the static accuracy of the classical filter.

    Where no parameter reaches that accuracy less 0.005 of IoU, the one of the highest accuracy.
    """
    bar = rows[BASELINE]["static_iou_occupied"] - TOLERANCE
    result = {}
    for family in dict.fromkeys(family for family, _ in rows):
        mine = {p: row for (name, p), row in rows.items() if name == family}
        good = {p: row for p, row in mine.items() if row["static_iou_occupied"] >= bar}
        if good:
            result[family] = min(good, key=lambda p: good[p]["ghost_area"])
        else:
            result[family] = max(mine, key=lambda p: mine[p]["static_iou_occupied"])
    return result
