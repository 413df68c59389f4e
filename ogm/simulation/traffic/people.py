"""Bodies of pedestrians, and of riders with their bicycles and motorcycles."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, Mesh, box, cylinder, ellipsoid, loft, merge
from ogm.simulation.traffic.bodies import Body, centered

PHASES = 8  # poses of one walking cycle
STRIDE = 1.45  # [m] covered per cycle (two steps) by a person of 1.75 m


class Clothes(NamedTuple):
    """Materials of a person's upper body, legs and shoes."""

    top: M
    legs: M
    shoes: M


def clothes(rng: Generator) -> Clothes:
    """Draw a person's clothes; one person in sixteen wears a high-visibility vest."""
    cloth = (M.CLOTH_LIGHT, M.CLOTH_DARK, M.CLOTH_DARK)
    top = M.HIGH_VIS if rng.random() < 1 / 16 else cloth[rng.integers(3)]
    return Clothes(top, cloth[rng.integers(3)], (M.CLOTH_DARK, M.CLOTH_LIGHT)[rng.integers(2)])


def _swing(length: float, angle: float) -> Floats:
    """Return the vector of a limb turned forward from hanging down by an angle [rad]."""
    return length * np.array([np.sin(angle), 0.0, -np.cos(angle)])


def _limb(points: ArrayLike, radii: tuple[float, ...], material: int, *, sides: int = 6) -> list[Mesh]:
    """Make tapered cylinders between joints."""
    joints = np.asarray(points, np.float64)
    return [
        cylinder(a, b, r, material, end_radius=q, sides=sides, caps=False)
        for a, b, r, q in zip(joints[:-1], joints[1:], radii[:-1], radii[1:], strict=True)
    ]


class Posture(NamedTuple):
    """Joint angles [rad] from hanging down, (left, right); knees bend backward, all others forward.

    `lean` is the angle of the back [rad], `spread` the additional distance between the feet [m].
    """

    thighs: tuple[float, float]
    knees: tuple[float, float]
    arms: tuple[float, float]
    elbows: tuple[float, float]
    lean: float = 0.03
    spread: float = 0.0


def _person(height: float, build: float, wear: Clothes, posture: Posture) -> Mesh:
    """Make a person with the middle of the hips at the origin; `build` is a factor of the girth."""
    thighs, knees, arms, elbows, lean, spread = posture
    k = height / 1.75
    parts: list[Mesh] = []
    for side, thigh, knee in zip((1.0, -1.0), thighs, knees, strict=True):
        hip = np.array([0.0, side * 0.09 * k, 0.0])
        joint = hip + _swing(0.44 * k, thigh) + [0, side * spread / 2, 0]
        ankle = joint + _swing(0.41 * k, thigh - knee) + [0, side * spread / 2, 0]
        girth = (0.085 * k * build, 0.06 * k * build, 0.045 * k)
        parts += _limb([hip, joint, ankle], girth, wear.legs)
        heel = ankle + [0.02, 0, -0.075 * k]
        parts.append(box(heel - [0.07 * k, 0.045, 0], heel + [0.18 * k, 0.045, 0.08 * k], wear.shoes))
    ax = np.array([np.sin(lean), 0.0, np.cos(lean)])
    angles = 2 * np.pi * np.arange(8) / 8
    sections = []
    profile = [(-0.08, 0.11, 0.16), (0.12, 0.11, 0.15), (0.38, 0.125, 0.19), (0.52, 0.07, 0.17), (0.56, 0.05, 0.06)]
    for up, depth, width in profile:
        ring = np.stack([depth * np.cos(angles), width * np.sin(angles), 0 * angles], axis=1) * build * k
        sections.append(ring + up * k * ax)
    parts.append(loft(sections, wear.top, caps=wear.top))
    for side, arm, elbow in zip((1.0, -1.0), arms, elbows, strict=True):
        shoulder = 0.49 * k * ax + [0, side * 0.2 * k * build, 0]
        bend = shoulder + _swing(0.29 * k, arm) + [0, side * 0.05 * k, 0]
        hand = bend + _swing(0.33 * k, arm + elbow)
        parts += _limb([shoulder, bend, hand], (0.055 * k * build, 0.042 * k, 0.032 * k), wear.top)
    head = 0.72 * k * ax + [0.01, 0, 0]
    parts.append(ellipsoid(head, (0.1 * k, 0.08 * k, 0.125 * k), M.SKIN, sides=8))
    return merge(parts)


def walking(rng: Generator, *, grown: bool = True) -> list[Body]:
    """Make a pedestrian in `PHASES` poses of a walking cycle.

    One adult in ten each has a pushchair, an umbrella or a backpack. A child is 1.0 to 1.4 m tall.
    """
    height = rng.normal(1.72, 0.08) if grown else rng.uniform(1.0, 1.4)
    height = float(np.clip(height, 0.95, 2.0))
    build, wear = float(rng.uniform(0.88, 1.25)), clothes(rng)
    extra = int(rng.integers(10)) if grown else 9
    bodies = []
    for phase in 2 * np.pi * np.arange(PHASES) / PHASES:
        left, right = 0.42 * np.sin(phase), -0.42 * np.sin(phase)
        knees = (0.1 + 0.75 * max(np.cos(phase), 0.0), 0.1 + 0.75 * max(-np.cos(phase), 0.0))
        arms, elbows = (0.75 * right, 0.75 * left), (0.3, 0.3)
        if extra == 0:  # both hands on the pushchair
            arms, elbows = (0.35, 0.35), (0.7, 0.7)
        elif extra == 1:  # one hand holds the umbrella
            arms, elbows = (arms[0], 0.3), (0.3, 1.7)
        mesh = _person(height, build, wear, Posture((left, right), knees, arms, elbows))
        carried = _carried(extra, height, float(mesh.vertices[:, 2].min()))
        bodies.append(centered("pedestrian", merge([mesh, *carried]), (0.1, -0.1)))
    return bodies


def _carried(extra: int, height: float, ground: float) -> list[Mesh]:
    """Make a pedestrian's pushchair, umbrella or backpack in the frame of the hips; `ground` is below them [m]."""
    if extra == 0:
        wheels = [
            cylinder((x, y, ground + 0.12), (x, y + 0.03, ground + 0.12), 0.12, M.TYRE, sides=8)
            for x in (0.55, 1.05)
            for y in (-0.25, 0.22)
        ]
        outline = [(0.5, 0.75), (1.1, 0.6), (1.05, 0.3), (0.6, 0.35)]
        sides = [[(x, y, ground + z) for x, z in outline] for y in (-0.2, 0.2)]
        seat = loft(sides, M.CLOTH_DARK, caps=M.CLOTH_DARK)
        bars = [cylinder((0.42, y, 0.1), (0.7, y, ground + 0.35), 0.015, M.METAL_POLE, sides=4) for y in (-0.22, 0.22)]
        return [*wheels, seat, *bars]
    if extra == 1:
        grip, top = np.array([0.32, -0.25, 0.3]), np.array([0.2, -0.15, 0.25 + 0.55 * height])
        return [
            cylinder(grip, top, 0.012, M.METAL_POLE, sides=4, caps=False),
            cylinder(top - [0, 0, 0.22], top, 0.52, M.CLOTH_DARK, end_radius=0.03, sides=8, caps=False),
        ]
    if extra == 2:
        return [box((-0.32, -0.15, 0.1), (-0.1, 0.15, 0.52), M.CLOTH_DARK)]
    return []


def standing(rng: Generator) -> Body:
    """Make a standing person with arms hanging, on the hips or in front of the chest."""
    height, build = float(np.clip(rng.normal(1.72, 0.08), 1.5, 2.0)), float(rng.uniform(0.88, 1.25))
    arms, elbows = [((0.05, 0.0), (0.1, 0.15)), ((-0.3, -0.3), (1.2, 1.2)), ((0.2, 0.4), (1.6, 1.9))][rng.integers(3)]
    stance = float(rng.uniform(0.0, 0.12))
    posture = Posture((0.05, -0.05), (0.05, 0.05), arms, elbows, spread=stance)
    return centered("pedestrian", _person(height, build, clothes(rng), posture), (0.1, -0.1))


def _tyre(x: float, radius: float, tube: float, *, sides: int = 14) -> Mesh:
    """Make an open wheel without a disc on the ground at `x` [m]."""
    angles = 2 * np.pi * np.arange(sides + 1) / sides
    circle = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    center = np.array([x, 0, radius])
    side = np.array([0.0, tube, 0.0])
    outer, inner = center + radius * circle, center + (radius - 2 * tube) * circle
    sections = np.stack([outer, (outer + inner) / 2 + side, inner, (outer + inner) / 2 - side], axis=1)
    return loft(sections, M.TYRE)


def bicycle(rng: Generator) -> Body:
    """Make a bicycle with a rider, about 1.75 m long."""
    height, build = float(np.clip(rng.normal(1.74, 0.08), 1.5, 2.0)), float(rng.uniform(0.9, 1.15))
    wear = clothes(rng)
    k, r = height / 1.75, 0.34
    hips = np.array([-0.28, 0.0, 0.98 * k])
    turn = float(rng.uniform(0, 2 * np.pi))
    thighs = (0.85 + 0.42 * np.sin(turn), 0.85 - 0.42 * np.sin(turn))
    knees = (0.95 + 0.35 * np.sin(turn + 0.6), 0.95 - 0.35 * np.sin(turn + 0.6))
    rider = _person(height, build, wear, Posture(thighs, knees, (1.05, 1.05), (0.15, 0.15), lean=0.45))
    rider = rider._replace(vertices=(rider.vertices + hips).astype(np.float32))
    axle, head, crank, saddle = (0.54, 0, r), (0.36, 0, 0.9), (-0.05, 0, 0.3), (-0.24, 0, 0.88 * k)
    rear = (-0.52, 0, r)
    tubes = [(rear, crank), (rear, saddle), (crank, saddle), (crank, head), (saddle, head), (head, axle)]
    frame = [cylinder(a, b, 0.02, M.METAL_POLE, sides=4, caps=False) for a, b in tubes]
    bar = cylinder((0.3, -0.3, 1.02), (0.3, 0.3, 1.02), 0.018, M.METAL_POLE, sides=4)
    stem = cylinder(head, (0.3, 0, 1.02), 0.02, M.METAL_POLE, sides=4, caps=False)
    lamp = box((-0.62, -0.03, 0.62), (-0.58, 0.03, 0.7), M.LAMP)
    parts = [_tyre(0.54, r, 0.02), _tyre(-0.52, r, 0.02), *frame, bar, stem, lamp, rider]
    return centered("bicycle", merge(parts), (0.54, -0.52))


def motorcycle(rng: Generator, paint: M) -> Body:
    """Make a motorcycle with a rider, about 2.1 m long."""
    height = float(np.clip(rng.normal(1.76, 0.07), 1.6, 2.0))
    wear = Clothes(M.CLOTH_DARK, M.CLOTH_DARK, M.CLOTH_DARK)
    r = 0.31
    hips = np.array([-0.3, 0.0, 0.86])
    posture = Posture((1.15, 1.15), (1.35, 1.35), (0.95, 0.95), (0.3, 0.3), lean=0.3, spread=0.28)
    rider = _person(height, 1.12, wear, posture)
    rider = rider._replace(vertices=(rider.vertices + hips).astype(np.float32))
    wheels = [cylinder((x, -0.07, r), (x, 0.07, r), r, M.TYRE, sides=12) for x in (0.72, -0.7)]
    parts = [
        *wheels,
        ellipsoid((0.18, 0, 0.86), (0.36, 0.17, 0.17), paint, sides=8),
        ellipsoid((0.05, 0, 0.5), (0.34, 0.2, 0.24), M.METAL_SHEET, sides=8),
        box((-0.85, -0.12, 0.72), (-0.05, 0.12, 0.84), M.PLASTIC_DARK),
        ellipsoid((0.58, 0, 0.95), (0.16, 0.15, 0.2), paint, sides=6),
        box((0.72, -0.09, 0.86), (0.76, 0.09, 1.0), M.LAMP),
        box((-0.9, -0.08, 0.78), (-0.86, 0.08, 0.86), M.LAMP),
        box((-0.93, -0.1, 0.55), (-0.91, 0.1, 0.68), M.PLATE),
        cylinder((0.45, -0.36, 1.08), (0.45, 0.36, 1.08), 0.025, M.METAL_POLE, sides=4),
        *[cylinder((0.48, y, 1.0), (0.72, y, r), 0.035, M.METAL_POLE, sides=4, caps=False) for y in (-0.1, 0.1)],
        rider,
    ]
    return centered("motorcycle", merge(parts), (0.72, -0.7))
