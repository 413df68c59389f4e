"""Evidence algebra on arrays: Dempster-Shafer rules and subjective logic for occupancy grids.

Masses are arrays of pairs ``(free, occupied)`` with any leading shape, in numpy or torch, float32 or float64; the rest
is unknown. Lists, triples (free, occupied, unknown) and `Opinion` are masses too. Results have the kind, library and
dtype of the masses. Torch gradients are supported.

See `docs/evidence.md` for the formula, properties and edge cases of every rule.

>>> import numpy as np
>>> from ogm import evidence
>>> a, b = np.array([0.5, 0.2]), np.array([0.1, 0.6])
>>> evidence.dempster(a, b).round(3), evidence.discount(a, 0.5)
(array([0.338, 0.529]), array([0.25, 0.1 ]))
"""

from ogm.evidence.arrays import check_mass, renormalize
from ogm.evidence.base_rates import confidence_base_rate, cumulative_base_rate
from ogm.evidence.conversions import alpha_to_evidence, evidence_to_alpha, evidence_to_mass, mass_to_evidence, unknown
from ogm.evidence.decisions import decide, degree_of_falsity, reconciling_reliability
from ogm.evidence.dirichlet import dirichlet_entropy, dirichlet_kl
from ogm.evidence.discounting import (
    contextual_discount,
    discount,
    discount_evidence,
    discount_over_time,
    trust_discount,
    trust_discount_opposite,
)
from ogm.evidence.logic import abduction, comultiplication, deduction, multiplication
from ogm.evidence.measures import (
    conflict,
    conflict_direction,
    degree_of_conflict,
    deng_entropy,
    dissonance,
    jirousek_shenoy_entropy,
    jousselme_distance,
    kl_divergence,
    nonspecificity,
    pignistic_entropy,
    specificity,
    vacuity,
    yager_entropy,
)
from ogm.evidence.open_world import close_world, conjunctive, disjunctive
from ogm.evidence.opinion import Conclusion, Opinion
from ogm.evidence.probability import (
    counts_to_mass,
    log_odds_to_mass,
    mass_to_log_odds,
    mass_to_probability,
    maximize_uncertainty,
    pignistic,
    plausibility_transform,
    probability_to_mass,
)
from ogm.evidence.proportional import consensus_compromise, murphy, pcr5, pcr6, pcr6_plus
from ogm.evidence.rules import cautious, dempster, dubois_prade, revise, smooth, yager
from ogm.evidence.subjective import (
    averaging,
    belief_constraint,
    cumulative,
    cumulative_epistemic,
    cumulative_unfusion,
    weighted,
)

__all__ = [
    "Conclusion", "Opinion", "abduction", "alpha_to_evidence", "averaging", "belief_constraint", "cautious",
    "check_mass", "close_world", "comultiplication", "confidence_base_rate", "conflict", "conflict_direction",
    "conjunctive", "consensus_compromise", "contextual_discount", "counts_to_mass", "cumulative",
    "cumulative_base_rate", "cumulative_epistemic", "cumulative_unfusion", "decide", "deduction",
    "degree_of_conflict", "degree_of_falsity", "dempster", "deng_entropy", "dirichlet_entropy", "dirichlet_kl",
    "discount", "discount_evidence", "discount_over_time", "disjunctive", "dissonance", "dubois_prade",
    "evidence_to_alpha", "evidence_to_mass", "jirousek_shenoy_entropy", "jousselme_distance", "kl_divergence",
    "log_odds_to_mass", "mass_to_evidence", "mass_to_log_odds", "mass_to_probability", "maximize_uncertainty",
    "multiplication", "murphy", "nonspecificity", "pcr5", "pcr6", "pcr6_plus", "pignistic",
    "pignistic_entropy", "plausibility_transform", "probability_to_mass", "reconciling_reliability", "renormalize",
    "revise", "smooth", "specificity", "trust_discount", "trust_discount_opposite", "unknown", "vacuity", "weighted",
    "yager", "yager_entropy",
]  # fmt: skip
