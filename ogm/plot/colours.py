"""Colours of free, occupied and unknown, for pictures, films, reports, viewers and messages.

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
    """Colours of free, occupied (or static), unknown and dynamic cells.

    Attributes
    ----------
    free, occupied, unknown, dynamic : (red, green, blue)
        Colours, [0, 1].
    text : str
        Names of the colours, for alternative texts.
    """

    free: Colour
    occupied: Colour
    unknown: Colour
    dynamic: Colour
    text: str

    @property
    def legend(self) -> dict[str, Colour]:
        """Colours of free, occupied and unknown by name."""
        return {"free": self.free, "occupied": self.occupied, "unknown": self.unknown}

    def mix(self, mass: NDArray[Any]) -> NDArray[np.float32]:
        """Return colours, (..., 3), mixed by masses of free and occupied, (..., 2); unknown is black."""
        return np.asarray(mass, np.float32) @ np.array([self.free, self.occupied], np.float32)


COLOURS: dict[str, Colours] = {
    # Blue and orange differ in lightness, and for red-green colour blindness.
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
# Known cells are light, cells without beams dark; after Tol's "muted" scheme.
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
    """Return the colours in use: by default blue and orange, see `use_colours`."""
    return COLOURS[_chosen[0]]


def use_colours(name: str) -> None:
    """Set the colours of later pictures in this process: "safe" or "paper".

    Raises
    ------
    ValueError
        If the name is unknown.
    """
    if name not in COLOURS:
        raise ValueError(f"colours must be {' or '.join(COLOURS)}, got {name!r}")
    _chosen[0] = name
