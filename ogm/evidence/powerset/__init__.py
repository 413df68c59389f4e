"""General frames: mass functions on up to 6 states as arrays ``[..., 2**K]``.

For frames such as {free, static, dynamic}; for {free, occupied} the rules of `ogm.evidence` do the same a
hundred times faster on pairs.

>>> import numpy as np
>>> from ogm.evidence import powerset
>>> FREE, STATIC, DYNAMIC = 0, 1, 2
>>> scan = np.zeros(8)  # something is there; it may or may not move
>>> scan[powerset.subset(STATIC, DYNAMIC)] = 0.8
>>> scan[powerset.subset(FREE, STATIC, DYNAMIC)] = 0.2
>>> track = np.zeros(8)
>>> track[powerset.subset(DYNAMIC)] = 0.5
>>> track[powerset.subset(FREE, STATIC, DYNAMIC)] = 0.5
>>> powerset.pignistic(powerset.dempster(scan, track)).round(3)
array([0.033, 0.233, 0.733])
"""

from ogm.evidence.powerset.frames import (
    coarsen,
    contextual_discount,
    discount,
    pignistic,
    plausibility_transform,
    refine,
)
from ogm.evidence.powerset.rules import (
    averaging,
    bold,
    cautious,
    conjunctive,
    consensus_compromise,
    cumulative,
    dempster,
    disjunctive,
    dubois_prade,
    murphy,
    pcr5,
    weighted,
    yager,
)
from ogm.evidence.powerset.transforms import (
    belief_to_mass,
    check_powerset,
    commonality_to_mass,
    from_pair,
    implicability_to_mass,
    mass_to_belief,
    mass_to_commonality,
    mass_to_implicability,
    mass_to_plausibility,
    plausibility_to_mass,
    subset,
    to_pair,
    to_triple,
)

__all__ = [
    "averaging",
    "belief_to_mass",
    "bold",
    "cautious",
    "check_powerset",
    "coarsen",
    "commonality_to_mass",
    "conjunctive",
    "consensus_compromise",
    "contextual_discount",
    "cumulative",
    "dempster",
    "discount",
    "disjunctive",
    "dubois_prade",
    "from_pair",
    "implicability_to_mass",
    "mass_to_belief",
    "mass_to_commonality",
    "mass_to_implicability",
    "mass_to_plausibility",
    "murphy",
    "pcr5",
    "pignistic",
    "plausibility_to_mass",
    "plausibility_transform",
    "refine",
    "subset",
    "to_pair",
    "to_triple",
    "weighted",
    "yager",
]
