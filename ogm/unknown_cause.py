"""Reasons why a cell is unknown: the codes of the layer ``cause``.

>>> from ogm import UnknownCause
>>> UnknownCause(2).label
'behind an obstacle'
"""

from enum import IntEnum

__all__ = ["UnknownCause"]


class UnknownCause(IntEnum):
    """The reason why a cell is unknown; as a layer ``cause`` float32, as `EvidentialGrid.cause` uint8.

    Attributes
    ----------
    label : str
        Text for legends.
    """

    label: str

    def __new__(cls, code: int, label: str) -> "UnknownCause":
        """Return the member with a code and a label."""
        cause = int.__new__(cls, code)
        cause._value_, cause.label = code, label
        return cause

    KNOWN = 0, "known"
    """The cell is free or occupied, see `ogm.state.predict_state`."""
    OUTSIDE_VIEW = 1, "outside the view"
    """No beam points there, or the cell is beyond the range of the sensor; of a map: no scan has covered it."""
    BEHIND_OBSTACLE = 2, "behind an obstacle"
    """An obstacle stops a beam that would pass the cell, or the cell lies below an edge that hides it from beams."""
    BETWEEN_BEAMS = 3, "between beams"
    """Between two rings or beams: none passes low enough, or too few do."""
    NO_ECHO = 4, "no echo"
    """Beams point there, but the lowest has no echo from the cell or from beyond."""
    NEAR_VEHICLE = 5, "under or near the vehicle"
    """Under the vehicle, or so near to it that even the lowest beam passes too high."""
    ABOVE_CLEARANCE = 6, "seen above clearance only"
    """All beams over the cell pass higher than the vehicle needs."""
    FORGOTTEN = 7, "forgotten"
    """The cell was known, but no scan has confirmed it for too long."""
    CONTRADICTED = 8, "contradicted"
    """Scans, beams or models contradict each other: free by some, occupied by others."""
