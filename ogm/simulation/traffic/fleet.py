"""Who takes part: a choice of bodies for one scenario, and how each kind of driver drives."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from ogm.simulation.materials import Material as M
from ogm.simulation.traffic.bodies import CARS, VANS, Body, Shape, car
from ogm.simulation.traffic.heavy import bus, trailer, truck
from ogm.simulation.traffic.people import bicycle, motorcycle, standing, walking

PAINTS = (M.PAINT_LIGHT, M.PAINT_MEDIUM, M.PAINT_DARK, M.PAINT_BLACK)
PAINT_SHARES = (0.38, 0.27, 0.17, 0.18)
SHAPE_SHARES = {
    "small": 0.16, "hatchback": 0.27, "saloon": 0.13, "estate": 0.16, "suv": 0.17, "coupe": 0.04,
    "people carrier": 0.07,
}  # fmt: skip
# How each kind of driver drives: acceleration, braking, hardest braking [m/s^2], time gap [s], highest speed [m/s].
MANNERS = {
    "ego": (1.8, 1.9, 4.0, 1.2, 50.0),
    "car": (1.7, 2.0, 6.0, 1.2, 50.0),
    "van": (1.4, 2.0, 6.0, 1.3, 40.0),
    "truck": (0.9, 1.6, 5.0, 1.6, 22.0),
    "bus": (1.0, 1.5, 5.0, 1.6, 22.0),
    "motorcycle": (2.4, 2.2, 6.0, 1.1, 50.0),
    "bicycle": (0.8, 1.6, 4.0, 1.0, 6.2),
}


class Fleet(NamedTuple):
    """Bodies to draw participants from; each is shared by all of its kind.

    Attributes
    ----------
    vehicles : dict of list of Body
        By kind: the keys of `MANNERS` but "ego", and "trailer".
    walkers : list of list of Body
        Pedestrians, each in the poses of a walking cycle.
    standers : list of Body
    """

    vehicles: dict[str, list[Body]]
    walkers: list[list[Body]]
    standers: list[Body]


def make_fleet(rng: Generator) -> Fleet:
    """Draw the bodies of one scenario: no two of the cars have the same measures."""

    def paint() -> M:
        return PAINTS[int(rng.choice(4, p=PAINT_SHARES))]

    names = rng.choice(list(SHAPE_SHARES), 28, p=np.array(list(SHAPE_SHARES.values())))
    vans = rng.choice(list(VANS), 6)
    vehicles = {
        "car": [car(_vary(CARS[str(name)], rng), paint()) for name in names],
        "van": [car(_vary(VANS[str(name)], rng), paint(), label="van", mirrors=0.16) for name in vans],
        "truck": [truck(rng, paint()) for _ in range(3)],
        "trailer": [trailer(rng) for _ in range(2)],
        "bus": [bus(rng, paint()) for _ in range(2)],
        "motorcycle": [motorcycle(rng, paint()) for _ in range(2)],
        "bicycle": [bicycle(rng) for _ in range(4)],
    }
    walkers = [walking(rng, grown=rng.random() > 0.12) for _ in range(20)]
    return Fleet(vehicles, walkers, [standing(rng) for _ in range(6)])


_ALONG = ("length", "wheelbase", "overhang", "cowl_at", "roof_at", "roof_end", "deck_at")
_UP = ("height", "nose", "cowl", "deck")


def _vary(shape: Shape, rng: Generator) -> Shape:
    """Stretch a shape by a few per cent in each direction."""
    along, across, up = rng.normal(1.0, [0.025, 0.012, 0.02])
    factors = dict.fromkeys(_ALONG, along) | dict.fromkeys(_UP, up) | {"width": across}
    return replace(shape, **{name: getattr(shape, name) * factor for name, factor in factors.items()})
