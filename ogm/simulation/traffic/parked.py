"""Parked vehicles: choice of bays, and poses of bodies on the ground."""

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from ogm.simulation.mesh import Floats, HeightAt
from ogm.simulation.traffic.bodies import Body

MARGIN = 0.65  # [m] free space between a lane's traffic and a parked vehicle
ON_FOOT = 0.75  # [m] free space on either side of a walkway's line
SHIFT = 0.4  # [m] largest shift of a vehicle away from a lane
HALF_TRAFFIC = 1.05  # [m] half the width of a car with mirrors


def _stand(places: Floats, reach: Floats, side: Floats, height_at: HeightAt) -> Floats:
    """Return ``T_world_object`` (N, 4, 4) of bodies at x, y, yaw, on the best-fitting plane through their four wheels.

    `reach` and `side` (N,) are the distances of the wheels from the middle, lengthwise and sideways [m].
    """
    x, y, yaw = places.T
    c, s = np.cos(yaw), np.sin(yaw)
    along = np.stack([reach, reach, -reach, -reach], axis=1)
    across = np.stack([side, -side, side, -side], axis=1)
    wx = x[:, None] + c[:, None] * along - s[:, None] * across
    wy = y[:, None] + s[:, None] * along + c[:, None] * across
    z = np.asarray(height_at(wx.ravel(), wy.ravel()), np.float64).reshape(wx.shape)
    slope = (z[:, 0] + z[:, 1] - z[:, 2] - z[:, 3]) / (4 * reach)  # along the body
    bank = (z[:, 0] + z[:, 2] - z[:, 1] - z[:, 3]) / (4 * side)  # to its left
    return frames(np.stack([x, y, z.mean(axis=1)], axis=1), yaw, slope, bank)


def frames(middle: Floats, yaw: Floats, slope: Floats, bank: Floats) -> Floats:
    """Return transforms (N, 4, 4) of bodies from yaw, and slopes ahead and to the left (rise per metre)."""
    c, s = np.cos(yaw), np.sin(yaw)
    forward = np.stack([c, s, slope], axis=1)
    up = np.cross(forward, np.stack([-s, c, bank], axis=1))
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(yaw), 1, 1))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = forward, np.cross(up, forward), up
    T[:, :3, 3] = middle
    return T


def park(
    bays: Floats, lanes: Floats, walkways: Floats, bodies: list[Body], height_at: HeightAt, rng: Generator
) -> list[tuple[Body, Floats]]:
    """Return vehicles parked in some of the bays.

    Parameters
    ----------
    bays : (B, 6) float64
        Bays: x, y, z [m], yaw [rad], length, width [m].
    lanes : (P, 3) float64
        Points of all lanes' centre lines, which parked vehicles keep clear.
    walkways : (Q, 3) float64
        Points of all walkways, which parked vehicles keep clear.
    bodies : list of Body
        Pool of bodies; only bodies that fit into a bay are used.
    height_at : callable
        Function of the ground height [m] at x, y [m].
    rng : np.random.Generator

    Returns
    -------
    list of (Body, (4, 4) float64)
        Bodies and their ``T_world_object``.
    """
    share = rng.uniform(0.5, 0.9)
    size = np.array([body.size for body in bodies])
    chosen, places = [], []
    for x, y, _, yaw, length, width in bays:
        draw = rng.random(4)
        shift, skew = rng.normal(0, [0.18, 0.07]), rng.normal(0, 0.025 if draw[1] < 0.9 else 0.09)
        fits = np.flatnonzero((size[:, 0] < length - 0.25) & (size[:, 1] < width + 0.35))
        pick = rng.random()
        if draw[0] > share or len(fits) == 0:
            continue
        body = bodies[fits[int(pick * len(fits))]]
        slack = max(length - body.size[0] - 0.5, 0.0) / 2
        ahead, left = np.clip(shift[0], -slack, slack), np.clip(shift[1], -0.25, 0.25)
        if draw[1] > 0.96:  # across the line of the bay
            left += 0.3 * (1 if draw[2] < 0.5 else -1)
        yaw = yaw + skew
        x, y = x + np.cos(yaw) * ahead - np.sin(yaw) * left, y + np.sin(yaw) * ahead + np.cos(yaw) * left
        if draw[3] < 0.12:
            yaw += np.pi
        chosen.append(body)
        places.append((x, y, yaw))
    if not chosen:
        return []
    x, y, yaw = _keep_clear(np.array(places), np.array([body.size for body in chosen]), lanes)
    reach = np.array([abs(body.axles).mean() for body in chosen])
    side = np.array([body.size[1] * 0.38 for body in chosen])
    boxes = np.column_stack([x, y, yaw, [body.size[:2] for body in chosen]])
    free = np.isfinite(x)
    rim = _rim(x[free], y[free], yaw[free], boxes[free, 3:5])
    if len(walkways):
        free[free] = cKDTree(walkways[:, :2]).query(rim)[0].min(axis=1) > ON_FOOT
    kept: list[int] = []
    for k in np.flatnonzero(free):
        near = [n for n in kept if np.hypot(*(boxes[n, :2] - boxes[k, :2])) < 12]
        if not any(overlap(boxes[k], boxes[n]) for n in near):
            kept.append(int(k))
    poses = _stand(np.stack([x, y, yaw], axis=1)[kept], reach[kept], side[kept], height_at)
    return [(chosen[k], pose) for k, pose in zip(kept, poses, strict=True)]


def _keep_clear(places: Floats, size: Floats, lanes: Floats) -> tuple[Floats, Floats, Floats]:
    """Shift vehicles away from lanes; x and y become NaN if that takes more than `SHIFT`."""
    tree = cKDTree(lanes[:, :2])
    need = HALF_TRAFFIC + MARGIN
    x, y, yaw = places.T.copy()
    moved = np.zeros(len(x))
    for _ in range(4):
        rim = _rim(x, y, yaw, size)
        distance, nearest = tree.query(rim)
        worst = distance.argmin(axis=1)
        rows = np.arange(len(x))
        lack = np.maximum(need - distance[rows, worst], 0)
        away = rim[rows, worst] - lanes[nearest[rows, worst], :2]
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-6)
        x, y = x + lack * away[:, 0], y + lack * away[:, 1]
        moved += lack
    distance, _ = tree.query(_rim(x, y, yaw, size))
    bad = (distance.min(axis=1) < need - 0.15) | (moved > SHIFT)
    return np.where(bad, np.nan, x), np.where(bad, np.nan, y), yaw


def _rim(x: Floats, y: Floats, yaw: Floats, size: Floats) -> Floats:
    """Return points (N, 20, 2) around each box."""
    t = np.linspace(-0.5, 0.5, 9)
    edge = np.concatenate([np.stack([t, t * 0 + s], axis=1) for s in (-0.5, 0.5)] + [[[-0.5, 0], [0.5, 0]]])
    local = edge[None] * size[:, None, :2]
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    turned = (c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1])
    return np.stack([x[:, None] + turned[0], y[:, None] + turned[1]], axis=2)


def overlap(a: Floats, b: Floats) -> bool:
    """Return whether two rectangles (x, y, yaw, length, width) overlap."""
    c, s = np.cos([a[2], b[2]]), np.sin([a[2], b[2]])
    axes = np.array([[c[0], s[0]], [-s[0], c[0]], [c[1], s[1]], [-s[1], c[1]]])
    reach_a = np.abs(axes @ axes[:2].T) @ a[3:5] / 2
    reach_b = np.abs(axes @ axes[2:].T) @ b[3:5] / 2
    return bool((np.abs(axes @ (b[:2] - a[:2])) < reach_a + reach_b).all())
