"""General frames: mass functions on up to 6 states as arrays ``[..., 2**K]``, from their general definitions.

For frames such as {free, static, dynamic}; for {free, occupied} the rules of `ogm.evidence` do the same a
hundred times faster on pairs, and are tested against these.

The last axis is the power set: place ``A`` belongs to the set whose states are the bits of ``A``. With the
states (free, static, dynamic), place 0b000 is the empty set, 0b001 is {free}, 0b110 is {static, dynamic} and
0b111 is the whole frame; `subset` returns the places. For K = 2 and (free, occupied) the four numbers are
(conflict, free, occupied, unknown). Arrays are float32 or float64, numpy or torch; rules combine any number of sources.
Multinomial opinions, beliefs in single states, are converted by `from_beliefs` and `to_beliefs`.

>>> import numpy as np
>>> from ogm.evidence import powerset
>>> FREE, STATIC, DYNAMIC = 0, 1, 2
>>> scan = np.zeros(8)  # an obstacle, which may or may not move
>>> scan[powerset.subset(STATIC, DYNAMIC)] = 0.8
>>> scan[powerset.subset(FREE, STATIC, DYNAMIC)] = 0.2
>>> track = np.zeros(8)
>>> track[powerset.subset(DYNAMIC)] = 0.5
>>> track[powerset.subset(FREE, STATIC, DYNAMIC)] = 0.5
>>> powerset.pignistic(powerset.dempster(scan, track)).round(3)
array([0.033, 0.233, 0.733])
"""

from ogm.evidence.powerset import frames, rules, transforms
from ogm.evidence.powerset.frames import *  # noqa: F403
from ogm.evidence.powerset.rules import *  # noqa: F403
from ogm.evidence.powerset.transforms import *  # noqa: F403

__all__ = sorted([*transforms.__all__, *frames.__all__, *rules.__all__])
