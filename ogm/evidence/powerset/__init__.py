"""Mass functions on general frames of up to 6 states, as arrays ``[..., 2**K]``.

For frames such as {free, static, dynamic}. For {free, occupied} use the rules of `ogm.evidence` on pairs, which are a
hundred times faster and are tested against this module.

The last axis is the power set: the bits of an index are the states of its set. With the states (free, static, dynamic),
index 0b000 is the empty set, 0b001 is {free}, 0b110 is {static, dynamic} and 0b111 is the whole frame; `subset` returns
the index. For (free, occupied) the four numbers are (conflict, free, occupied, unknown). Arrays are float32 or float64,
numpy or torch. Rules combine any number of sources. `from_beliefs` and `to_beliefs` convert multinomial opinions, which
are beliefs in single states.

>>> import numpy as np
>>> from ogm.evidence import powerset
>>> FREE, STATIC, DYNAMIC = 0, 1, 2
>>> scan = np.zeros(8)  # an obstacle, static or dynamic
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
