"""Which field of a file means what, however its writer spells it."""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

__all__ = ["INTENSITY", "KNOWN", "PLACE", "RING", "TIME", "plain", "refuse_doubles"]

PLACE = ("x", "y", "z")
INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "i")  # the first that is there counts
RING = ("ring", "laser_number", "channel", "laser_id", "line")
TIME = ("time", "timestamp", "time_stamp", "t", "offset_ns", "offset_time", "gps_time", "gpstime")
KNOWN = frozenset(PLACE + INTENSITY + RING + TIME)


def plain(name: str) -> str:
    """Spell a field's name as above: in small letters, without the ``scalar_`` of CloudCompare."""
    return name.lower().removeprefix("scalar_")


def refuse_doubles(names: Iterable[str], path: Path) -> None:
    """Raise where two fields have one name, or one meaning but for capitals and ``scalar_``.

    Parameters
    ----------
    names : iterable of str
        The file's own names, without those of padding.
    path : Path
        The file's name, for messages.
    """
    names = list(names)
    exact, known = Counter(names), Counter(plain(name) for name in names if plain(name) in KNOWN)
    doubled = [name for name in names if exact[name] > 1 or known[plain(name)] > 1]
    if doubled:
        raise ValueError(
            f"{path} has the fields {', '.join(doubled)[:200]}, wanted one of each name (capitals and scalar_ "
            "make no difference): which counts cannot be told, so write the file with one, or rename the other"
        )
