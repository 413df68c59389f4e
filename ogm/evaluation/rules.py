"""Rules by which scans are fused, by name."""

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ogm.fusion import BinaryBayesMapper, EvidentialMapper
    from ogm.fusion.window import Kind
    from ogm.grid import GridSpec

__all__ = ["BAYES", "RULES", "mapper_of", "rolling"]

RULES = {  # names of functions of ogm.evidence
    "cautious": "normalized_cautious",
    "dempster": "dempster",
    "yager": "yager",
    "cumulative": "cumulative",
    "pcr6": "pcr6",
    "averaging": "averaging",
    "weighted": "weighted",
}
BAYES = "bayes"


def rolling(spec: "GridSpec") -> "GridSpec":
    """Return a square as wide as the diagonal of a scan's grid, which holds the grid at any heading."""
    from ogm.grid import GridSpec

    side = 2 * math.ceil(math.hypot(spec.length, spec.width) / 2 / spec.resolution + 1)
    corner = -side * spec.resolution / 2
    return GridSpec(spec.resolution, (side, side), (corner, corner))


def mapper_of(
    rule: str, spec: "GridSpec", half_life: float | None = None, window: "Kind" = "rolling"
) -> "EvidentialMapper | BinaryBayesMapper":
    """Make a map that fuses by a rule, with defaults else.

    Parameters
    ----------
    rule : str
        One of `RULES`, or `BAYES`.
    spec : GridSpec
        Its window.
    half_life : float, optional
        [s]; by default 2, and infinity for `BAYES`.
    window : {"rolling", "fixed"}
    """
    from ogm import evidence
    from ogm.fusion import BinaryBayesMapper, EvidentialMapper

    if rule == BAYES:
        return BinaryBayesMapper(spec, math.inf if half_life is None else half_life, window=window)
    if rule not in RULES:
        raise ValueError(f"there is no rule {rule!r}; there are {', '.join(RULES)}, {BAYES}")
    function = getattr(evidence, RULES[rule])
    return EvidentialMapper(spec, function, 2.0 if half_life is None else half_life, window=window)
