"""Names of the rules by which maps fuse scans, for mappers, evaluation and commands.

>>> from ogm.evidence.map_rules import MAP_RULES, RULES
>>> RULES["cautious"].__name__, MAP_RULES[-3:]
('cautious', ('bayes', 'dynamic', 'nuss'))
"""

from collections.abc import Callable
from typing import Any

from ogm.evidence.proportional import pcr6
from ogm.evidence.rules import cautious, dempster, revise, smooth, yager
from ogm.evidence.subjective import averaging, cumulative, weighted

__all__ = ["ADDING_RULES", "BAYES", "DYNAMIC", "MAP_RULES", "NUSS", "REVISE", "RULES", "SMOOTH"]

REVISE, SMOOTH = "revise", "smooth"  # defaults for maps of streets and of buildings
RULES: dict[str, Callable[..., Any]] = {  # name: rule of two masses, map and scan
    REVISE: revise,
    "cautious": cautious,
    **{"dempster": dempster, "yager": yager, "cumulative": cumulative, "pcr6": pcr6},
    **{"averaging": averaging, "weighted": weighted},
    SMOOTH: smooth,
}
BAYES, DYNAMIC, NUSS = "bayes", "dynamic", "nuss"  # filters with a different cell state
MAP_RULES = (*RULES, BAYES, DYNAMIC, NUSS)
ADDING_RULES = ("dempster", "yager", "cumulative", "pcr6", SMOOTH, BAYES)  # repeated equal scans increase the mass
