"""Sizes and materials of a house, drawn by its style."""

from typing import NamedTuple

from numpy.random import Generator
from shapely import Polygon

from ogm.simulation.materials import Material as M


class HouseDesign(NamedTuple):
    """Sizes and materials of one house; lengths in m."""

    storeys: int
    ground_storey: float
    storey: float
    plinth: float  # floor above the highest ground at the front
    wall: int
    base: int  # material of the ground floor's wall
    bay: float  # from window to window
    window: tuple[float, float, float]  # width, sill and head above the floor
    recess: float
    ground_floor: str  # "home", "shop", "hall"
    balconies: float  # share of the front's columns
    panel: int  # of a balcony; METAL_POLE means bars
    bays: bool
    blind_sides: bool
    roof: str  # "flat", "gable", "hip"
    pitch: float
    eaves: float


def draw_design(style: str, outline: Polygon, rng: Generator) -> HouseDesign:
    """Draw sizes and materials of a house by its style and its footprint's size."""
    area = outline.area
    light, dark, brick, stone = int(M.PLASTER_LIGHT), int(M.PLASTER_DARK), int(M.BRICK), int(M.STONE)
    sheet, concrete, wood = int(M.METAL_SHEET), int(M.CONCRETE), int(M.WOOD)
    u = rng.uniform
    if style == "centre":
        old = rng.random() < 0.6
        wall = int(rng.choice([light, dark, brick, stone], p=[0.45, 0.25, 0.2, 0.1]))
        shop = rng.random() < 0.6
        storeys = int(rng.integers(3, 7)) if area > 60 else int(rng.integers(1, 4))
        window = (u(1.0, 1.35), u(0.5, 0.85), u(2.3, 2.7)) if old else (u(1.3, 2.0), u(0.8, 0.95), u(2.15, 2.3))
        return HouseDesign(
            storeys, u(3.7, 4.4), u(3.2, 3.7) if old else u(2.8, 3.0), 0.03 if shop else u(0.15, 0.9),
            wall, stone if rng.random() < 0.3 else wall, u(2.2, 2.8) if old else u(2.6, 3.4), window,
            u(0.08, 0.16), "shop" if shop else "home", u(0.0, 0.5) if rng.random() < 0.45 else 0.0,
            int(M.METAL_POLE) if old else int(rng.choice([light, int(M.CAR_GLASS), sheet])),
            old and rng.random() < 0.35, rng.random() < 0.75,
            "gable" if rng.random() < 0.6 else "flat", u(0.6, 1.1), u(0.2, 0.5),
        )  # fmt: skip
    if style == "suburb":
        hut = area < 40
        storeys = 1 if hut else int(rng.choice([2, 2, 2, 3] if area > 150 else [1, 2, 2, 2]))
        wall = int(rng.choice([light, dark, brick, wood], p=[0.6, 0.15, 0.18, 0.07]))
        return HouseDesign(
            storeys, u(2.4, 2.6) if hut else u(2.7, 2.9), u(2.6, 2.8), 0.0 if hut else u(0.1, 0.7),
            wall, wall, u(2.6, 3.6), (u(1.0, 1.9), u(0.8, 0.95), u(2.1, 2.25)),
            u(0.06, 0.14), "garage" if hut else "home", u(0.2, 0.7) if storeys > 1 and rng.random() < 0.4 else 0.0,
            int(rng.choice([int(M.METAL_POLE), wood])), not hut and rng.random() < 0.25, False,
            "flat" if rng.random() < (0.6 if hut else 0.1) else "gable" if rng.random() < 0.75 else "hip",
            u(0.55, 1.0), u(0.3, 0.7),
        )  # fmt: skip
    if style == "industrial" and area > 60:
        return HouseDesign(
            1, u(5.5, 10.5), 3.2, 0.0, int(rng.choice([sheet, concrete, brick], p=[0.55, 0.25, 0.2])), concrete,
            u(5.0, 7.0), (u(2.5, 4.5), 3.4, 4.6), 0.1, "hall", 0.0, sheet, False, False,
            "flat" if rng.random() < 0.6 else "gable", u(0.1, 0.25), u(0.1, 0.4),
        )  # fmt: skip
    if style == "park":
        return HouseDesign(
            1, u(2.7, 3.6), 2.8, 0.05, wood if rng.random() < 0.6 else light, wood, 2.2, (1.3, 0.95, 2.1), 0.1,
            "home", 0.0, wood, False, False, str(rng.choice(["gable", "hip", "flat"])), u(0.4, 0.8), u(0.3, 0.8),
        )  # fmt: skip
    kind = rng.random() if area > 120 else 0.5
    if style == "arterial" and kind < 0.3:  # a market
        wall = int(rng.choice([sheet, light, brick]))
        return HouseDesign(
            1, u(4.8, 6.8), 3.0, 0.0, wall, wall, u(2.8, 3.6), (2.4, 0.2, 2.7), 0.12, "shop", 0.0, sheet, False,
            False, "flat", 0.3, 0.6,
        )  # fmt: skip
    flats = style == "arterial" and kind > 0.65
    wall = int(rng.choice([light, dark, concrete, brick, sheet], p=[0.4, 0.15, 0.2, 0.15, 0.1]))
    bay = u(2.8, 3.8)
    storeys = int(rng.integers(3, 9)) if style == "arterial" else int(rng.integers(1, 4))
    return HouseDesign(
        storeys, u(3.0, 4.2), u(2.8, 3.5), u(0.0, 0.5), wall, concrete if rng.random() < 0.3 else wall, bay,
        (u(1.4, 2.0), 0.85, 2.25) if flats else (0.82 * bay, u(0.6, 0.9), 2.5),
        u(0.06, 0.18), "shop" if rng.random() < 0.5 else "home", u(0.3, 0.7) if flats else 0.0,
        int(rng.choice([sheet, concrete, int(M.CAR_GLASS)])), False, False, "flat", 0.3, 0.4,
    )  # fmt: skip
