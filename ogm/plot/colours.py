"""The colours of free, occupied and unknown: one definition for pictures, films, reports, viewers and messages.

>>> from ogm.plot.colours import colours, use_colours
>>> colours().text
'blue free, orange occupied, black unknown'
>>> use_colours("paper")  # green and red, as in van Kempen et al. (2021)
>>> colours().text
'green free, red occupied, black unknown'
>>> use_colours("safe")
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.unknown_cause import UnknownCause

__all__ = ["CAUSE_COLOURS", "COLOURS", "Colour", "Colours", "colours", "use_colours"]

Colour = tuple[float, float, float]  # red, green, blue [0, 1]


class Colours(NamedTuple):
    """The colours of a cell that is free, occupied or unknown, and of one that is occupied by what moves.

    Attributes
    ----------
    free, occupied, unknown, dynamic : (red, green, blue)
        [0, 1]
    text : str
        Their names, for alternative texts.
    """

    free: Colour
    occupied: Colour
    unknown: Colour
    dynamic: Colour
    text: str

    @property
    def legend(self) -> dict[str, Colour]:
        """The colours of free, occupied and unknown, by name."""
        return {"free": self.free, "occupied": self.occupied, "unknown": self.unknown}

    def mix(self, mass: NDArray[Any]) -> NDArray[np.float32]:
        """Return the colours of masses of free and occupied, (..., 2), mixed by them, (..., 3); unknown is black."""
        return np.asarray(mass, np.float32) @ np.array([self.free, self.occupied], np.float32)


COLOURS: dict[str, Colours] = {
    # Blue and orange differ for eyes that confuse red and green, and in lightness.
    "safe": Colours(
        free=(0.16, 0.47, 0.85),
        occupied=(1.0, 0.65, 0.12),
        unknown=(0.0, 0.0, 0.0),
        dynamic=(0.0, 0.75, 0.6),
        text="blue free, orange occupied, black unknown",
    ),
    # van Kempen et al. (2021)
    "paper": Colours(
        free=(0.10, 0.80, 0.20),
        occupied=(0.93, 0.16, 0.16),
        unknown=(0.0, 0.0, 0.0),
        dynamic=(0.1, 0.55, 1.0),
        text="green free, red occupied, black unknown",
    ),
}
# Why a cell is unknown: known is light, what no beam reached dark; after Tol's "muted" scheme.
CAUSE_COLOURS: dict[UnknownCause, Colour] = {
    UnknownCause.KNOWN: (0.92, 0.92, 0.92),
    UnknownCause.OUTSIDE_VIEW: (0.28, 0.30, 0.33),
    UnknownCause.BEHIND_OBSTACLE: (0.80, 0.40, 0.47),
    UnknownCause.BETWEEN_BEAMS: (0.40, 0.75, 0.93),
    UnknownCause.NO_ECHO: (0.25, 0.17, 0.60),
    UnknownCause.NEAR_VEHICLE: (0.07, 0.55, 0.25),
    UnknownCause.ABOVE_CLEARANCE: (0.87, 0.80, 0.42),
    UnknownCause.FORGOTTEN: (0.60, 0.25, 0.70),
    UnknownCause.CONTRADICTED: (1.0, 0.42, 0.0),
}
_chosen = ["safe"]


def colours() -> Colours:
    """Return the colours that are in use: blue and orange, unless `use_colours` chose others."""
    return COLOURS[_chosen[0]]


def use_colours(name: str) -> None:
    """Choose the colours of all that is drawn from now on by this process: "safe" or "paper".

    Raises
    ------
    ValueError
        If there are no colours of that name.
    """
    if name not in COLOURS:
        raise ValueError(f"there are no colours {name!r}: choose {' or '.join(COLOURS)}")
    _chosen[0] = name
