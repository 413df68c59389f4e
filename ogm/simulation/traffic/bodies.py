"""Bodies of cars and vans: lofted shells with wheel arches, glass, wheels and ground clearance."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, Mesh, box, loft, merge, quads


class Body(NamedTuple):
    """Body of a traffic participant.

    Attributes
    ----------
    label : str
        Class, see `Object.label`.
    mesh : Mesh
        Mesh in its own frame: x forward, y left, the middle of its box at x = y = 0, the lowest point at z = 0.
    size : (3,) float64
        Length, width and height of the mesh [m], exact.
    axles : (2,) float64
        x of the front and rear points that follow the lane's centre line [m].
    """

    label: str
    mesh: Mesh
    size: Floats
    axles: Floats


def centered(label: str, mesh: Mesh, axles: ArrayLike) -> Body:
    """Return a body with its mesh shifted: box centred on x = y = 0, bottom at z = 0; `axles` are x of both [m]."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    shift = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]], np.float32)
    mesh = mesh._replace(vertices=mesh.vertices - shift)
    size = (mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).astype(np.float64)
    return Body(label, mesh, size, np.asarray(axles, np.float64) - float(shift[0]))


def wheel(x: float, y: float, radius: float, width: float, *, sides: int = 8) -> Mesh:
    """Make a wheel on the ground with its outer face at `y` [m] and a metal rim; the inner face is open.

    `sides` must be even.
    """
    angles = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    radius /= float(np.cos(np.pi / sides))  # the wheel stands on a flat, not on a corner
    ring = np.stack([x + radius * np.cos(angles), np.zeros(sides), radius * np.sin(angles)], axis=1)
    ring[:, 2] -= ring[:, 2].min()
    hub = np.array([x, 0.0, ring[:, 2].max() / 2])
    side = 1.0 if y > 0 else -1.0
    outer, inner, rim = ring.copy(), ring.copy(), hub + 0.66 * (ring - hub)
    outer[:, 1], inner[:, 1], rim[:, 1] = y - side * 0.01, y - side * width, y
    skin = loft([inner, outer, rim], M.TYRE)
    fan = np.stack([rim[:-3:2], rim[1:-2:2], rim[2:-1:2], np.broadcast_to(rim[-1], rim[:-3:2].shape)], axis=1)
    return merge([skin, quads(fan, M.METAL_SHEET)])


@dataclass(frozen=True)
class Shape:
    """Dimensions of a car [m]; ``..._at`` are distances from its front end.

    Attributes
    ----------
    length, width, height : float
        Outer dimensions without mirrors.
    wheelbase, overhang : float
        Distance between the axles, and from the front end to the front axle.
    nose, cowl, deck : float
        Height of the bonnet's front edge, of the windscreen's base, and of the boot or the rear window's base.
    cowl_at, roof_at, roof_end, deck_at : float
        Positions of the windscreen's start and end, the roof's end, and the rear window's lower end.
    floor, tyre : float
        Height of the underbody, and radius of a wheel.
    roof_width : float
        Width between the roof's rails as a share of the width.
    side_glass : float
        Share of the cabin's length with side windows, from its front; below 1 for vans without a rear window.
    """

    length: float
    width: float
    height: float
    wheelbase: float
    overhang: float
    nose: float
    cowl: float
    deck: float
    cowl_at: float
    roof_at: float
    roof_end: float
    deck_at: float
    floor: float = 0.17
    tyre: float = 0.32
    roof_width: float = 0.68
    side_glass: float = 1.0


# Rounded dimensions of common European cars.
CARS: dict[str, Shape] = {
    "small": Shape(3.62, 1.64, 1.49, 2.42, 0.76, 0.74, 1.00, 1.00, 0.86, 1.62, 3.18, 3.54, tyre=0.29),
    "hatchback": Shape(4.27, 1.79, 1.46, 2.63, 0.88, 0.72, 0.98, 1.00, 1.18, 2.05, 3.66, 4.14),
    "saloon": Shape(4.76, 1.83, 1.45, 2.84, 0.88, 0.72, 0.97, 1.05, 1.40, 2.32, 3.42, 4.14),
    "estate": Shape(4.78, 1.83, 1.48, 2.79, 0.92, 0.73, 0.98, 1.02, 1.34, 2.20, 4.30, 4.66),
    "suv": Shape(4.56, 1.88, 1.68, 2.68, 0.90, 0.90, 1.10, 1.12, 1.24, 2.02, 4.02, 4.42, floor=0.23, tyre=0.36),
    "coupe": Shape(4.50, 1.84, 1.36, 2.62, 0.92, 0.66, 0.92, 0.98, 1.52, 2.40, 2.98, 4.08, floor=0.14),
    "people carrier": Shape(4.62, 1.84, 1.66, 2.79, 0.92, 0.80, 1.06, 1.08, 1.02, 2.00, 4.16, 4.52),
}
VANS: dict[str, Shape] = {
    "small van": Shape(
        4.45, 1.82, 1.82, 2.72, 0.88, 0.82, 1.10, 1.10, 0.98, 1.78, 4.32, 4.42, roof_width=0.82, side_glass=0.36
    ),
    "bus van": Shape(
        4.92, 1.93, 1.97, 3.02, 0.92, 0.92, 1.18, 1.12, 0.88, 1.66, 4.72, 4.86, floor=0.2, tyre=0.33, roof_width=0.84
    ),
    "panel van": Shape(
        5.55, 2.00, 2.52, 3.42, 0.98, 1.00, 1.30, 1.25, 0.86, 1.92, 5.44, 5.52, floor=0.22, tyre=0.35,
        roof_width=0.86, side_glass=0.22,
    ),
}  # fmt: skip


def _stations(shape: Shape) -> Floats:
    """Return the positions of the car's cross-sections, from the front [m]."""
    reach = shape.tyre + 0.07
    axles = (shape.overhang, shape.overhang + shape.wheelbase)
    arches = [axle + side * reach for axle in axles for side in (-1.0, -0.72, 0.72, 1.0)]
    ends = [0.0, 0.10, shape.length - 0.10, shape.length]
    tub = [shape.cowl_at + 0.05, shape.cowl_at + 0.15, shape.deck_at - 0.12, shape.deck_at - 0.02]
    inside = [s for s in arches + tub if 0.12 < s < shape.length - 0.12]
    return np.unique(np.round(ends + inside, 3))


def _shell(shape: Shape, paint: int) -> Mesh:
    """Make the body below the windows, from cross-sections of 12 points."""
    s = _stations(shape)
    end, half = shape.length, shape.width / 2
    width = half * np.interp(
        s, [0, 0.1, 0.35, 0.8, end - 0.8, end - 0.25, end - 0.1, end], [0.7, 0.88, 0.965, 1, 1, 0.97, 0.92, 0.8]
    )
    knots = [0, 0.1, shape.cowl_at, shape.deck_at, end - 0.1, end]
    heights = np.array([shape.nose] * 2 + [shape.cowl] + [shape.deck] * 3)
    belt = np.interp(s, knots, heights + [-0.14, -0.05, -0.05, -0.02, -0.05, -0.12])
    top = np.interp(s, knots, heights + [-0.1, 0, 0, 0.01, -0.01, -0.1])
    floor = np.interp(s, [0, 0.3, end - 0.5, end], [shape.floor + 0.07, shape.floor, shape.floor, shape.floor + 0.14])
    sill = floor.copy()
    reach = shape.tyre + 0.07
    for axle in (shape.overhang, shape.overhang + shape.wheelbase):
        away = np.abs(s - axle) / reach
        sill = np.where(away < 0.99, shape.tyre + reach * np.sqrt(np.maximum(1 - away**2, 0)), sill)
    sill = np.minimum(sill, belt - 0.08)
    cabin = (s > shape.cowl_at + 0.1) & (s < shape.deck_at - 0.1)
    inner = np.minimum(half - 0.24, 0.85 * width)
    middle = np.maximum(sill + 0.03, 0.35 * floor + 0.62 * belt)
    left = [
        (inner, floor),
        (inner, sill),
        (0.965 * width, sill),
        (width, middle),
        (0.945 * width, belt),
        (np.where(cabin, 0.86, 0.80) * width, np.where(cabin, belt - 0.28, top)),
    ]
    outline = left + [(-y, z) for y, z in reversed(left)]
    sections = np.stack([np.stack([end / 2 - s, y, z], axis=1) for y, z in outline], axis=1)
    material = np.full((len(s) - 1, 12), paint, np.uint8)
    material[:, [0, 1, 9, 10, 11]] = M.PLASTIC_DARK  # wheel arches and floor
    between = cabin[1:] | cabin[:-1]
    material[between, 4:7] = M.PLASTIC_DARK  # interior of the cabin
    material[0, [3, 7]] = material[-1, [3, 7]] = M.LAMP
    return merge([loft(sections, material), _ends(sections, paint)])


def _ends(sections: Floats, paint: int) -> Mesh:
    """Make the front with a grille between painted bands, and the painted rear, both with a number plate."""
    front, rear = sections[0], sections[-1]
    bands = [(0, 11, 9, 2), (2, 9, 8, 3), (3, 8, 7, 4), (4, 7, 6, 5)]
    materials = [M.PLASTIC_DARK, paint, M.PLASTIC_DARK, paint]
    faces = quads([front[list(band)] for band in bands], materials)
    back = quads([rear[list(band)] for band in bands], [M.PLASTIC_DARK, paint, paint, paint])
    plates = [
        plate(end[0, 0] + side * 0.01, end[:, 2].min() + share * np.ptp(end[:, 2]), 0.055)
        for end, side, share in ((front, 1, 0.35), (rear, -1, 0.55))
    ]
    return merge([faces, back, quads(plates, M.PLATE)])


def plate(x: float, z: float, half: float = 0.06) -> Floats:
    """Return the corners (4, 3) of a number plate of half height `half` [m]."""
    y, up = np.array([-0.26, 0.26, 0.26, -0.26]), half * np.array([-1, -1, 1, 1])
    return np.stack([np.full(4, x), y, z + up], axis=1)


def _greenhouse(shape: Shape, paint: int) -> Mesh:
    """Make windows, pillars and roof from outlines of 14 points at the belt line, the roof rails and the roof."""
    half, end = shape.width / 2, shape.length
    front, back = shape.cowl_at + 0.12, shape.deck_at - 0.06
    roof, tail = shape.roof_at + 0.04, shape.roof_end
    glass_end = front + shape.side_glass * (back - front)
    share = np.array([0.0, 0.07, 0.44, 0.48, 0.86, 1.0])
    if shape.side_glass < 1:  # panel van: one window, sheet metal behind
        share = np.array([0.0, 0.05, 0.06, (glass_end - front) / (back - front), 0.7, 1.0])
    low_s, high_s = front + share * (back - front), roof + share * (tail - roof)
    if shape.side_glass == 1:  # upright pillars in the middle
        middle = (low_s[2:4] + high_s[2:4]) / 2
        low_s[2:4], high_s[2:4] = middle + 0.04, middle - 0.02

    def ring(along: Floats, sides: Floats, nose: float, rear: float, z: Floats, tip: Floats) -> Floats:
        s = np.concatenate([[nose], along, [rear], along[::-1]])
        y = np.concatenate([[0.0], sides, [0.0], -sides[::-1]])
        height = np.concatenate([[tip[0]], z, [tip[1]], z[::-1]])
        return np.stack([end / 2 - s, y, height], axis=1)

    belt = np.interp(low_s, [shape.cowl_at, shape.deck_at], [shape.cowl - 0.06, shape.deck - 0.04])
    taper = np.array([0.94, 1, 1, 1, 1, 0.94])
    rail = half * shape.roof_width
    base = ring(low_s, 0.925 * half * taper, shape.cowl_at - 0.02, shape.deck_at + 0.02, belt, belt[[0, -1]] + 0.03)
    z = shape.height - 0.075 - np.array([0.02, 0, 0, 0, 0, 0.03])
    rails = ring(high_s, rail * taper, roof - 0.12, tail + 0.04, z, z[[0, -1]] + 0.045)
    crown_s = roof + 0.12 + share * (tail - roof - 0.22)
    top = np.full(6, shape.height) - np.array([0.015, 0, 0, 0, 0, 0.02])
    crown = ring(crown_s, 0.8 * rail * taper, roof, tail - 0.06, top, top[[0, -1]])
    whole = shape.side_glass == 1
    rear = M.CAR_GLASS if whole else paint
    sides = [paint, M.CAR_GLASS, paint, M.CAR_GLASS, paint] if whole else [paint, paint, M.CAR_GLASS, paint, paint]
    around = np.array([int(m) for m in (M.CAR_GLASS, *sides, rear, rear, *sides[::-1], M.CAR_GLASS)], np.uint8)
    skin = loft([base, rails, crown], np.stack([around, np.full(14, paint, np.uint8)]))
    left, right = crown[1:7], crown[:7:-1]
    lid = [np.array([a, b, d, c]) for a, b, c, d in zip(left[:-1], left[1:], right[:-1], right[1:], strict=True)]
    tips = [crown[[0, 1, 13, 13]], crown[[7, 6, 8, 8]]]
    return merge([skin, quads(lid + tips, paint)])


def _seats(shape: Shape) -> Mesh:
    """Make the backs of the front seats, which rays through the windows hit."""
    x = shape.length / 2 - (shape.cowl_at + 0.42 * (shape.deck_at - shape.cowl_at)) - 0.1
    low, high = shape.cowl - 0.35, min(shape.cowl + 0.34, shape.height - 0.2)
    backs = [
        [(x, y - 0.23, low), (x, y + 0.23, low), (x - 0.16, y + 0.12, high), (x - 0.16, y - 0.12, high)]
        for y in (-0.19 * shape.width, 0.19 * shape.width)
    ]
    return quads(backs, M.PLASTIC_DARK)


def car(shape: Shape, paint: M, *, label: str = "car", mirrors: float = 0.13) -> Body:
    """Make a car or van.

    Parameters
    ----------
    shape : Shape
    paint : Material
        Paint of the sheet metal.
    label : str
    mirrors : float
        Width of the mirrors beyond either side [m].
    """
    half, front = shape.width / 2, shape.length / 2
    axles = np.array([front - shape.overhang, front - shape.overhang - shape.wheelbase])
    parts = [_shell(shape, paint), _greenhouse(shape, paint), _seats(shape)]
    parts += [wheel(x, y, shape.tyre, 0.2) for x in axles for y in (0.985 * half, -0.985 * half)]
    x, z = front - shape.cowl_at - 0.28, shape.cowl + 0.02
    for side in (-1.0, 1.0):
        y = sorted((side * (half - 0.06), side * (half + mirrors)))
        parts.append(box((x - 0.1, y[0], z - 0.07), (x, y[1], z + 0.09), paint))
    return centered(label, merge(parts), axles)


def ego_vehicle() -> Mesh:
    """Return the mesh of the ego vehicle: an estate car in the vehicle frame, roof at 1.48 m.

    All triangles have `Material.EGO_VEHICLE`.
    """
    return ego_body().mesh


def ego_body() -> Body:
    """Return the body of the ego vehicle."""
    body = car(CARS["estate"], M.PAINT_MEDIUM, mirrors=0.12)
    return body._replace(mesh=body.mesh.painted(M.EGO_VEHICLE))
