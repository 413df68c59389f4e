"""Triangle meshes with a material per triangle, builders of basic shapes, and types of their arrays.

>>> from ogm.simulation.materials import Material
>>> from ogm.simulation.mesh import box, merge
>>> road = box([0, -5, -1], [90, 5, 0], Material.ASPHALT)
>>> car = box([20, -1, 0], [24, 1, 1.5], Material.PAINT_DARK)
>>> merge([road, car]).triangles.shape
(24, 3)
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.simulation.materials import Material

__all__ = ["Mesh", "box", "cylinder", "ellipsoid", "empty", "loft", "merge", "quads", "sheet", "wall"]

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Array = NDArray[Any]
HeightAt = Callable[[Floats, Floats], Array]  # ground height [m] at x, y [m]


class Mesh(NamedTuple):
    """A triangle mesh with materials.

    Attributes
    ----------
    vertices : (V, 3) float32
        x, y, z [m].
    triangles : (T, 3) uint32
        Vertex indices of each triangle, in any order: both sides are visible.
    material : (T,) uint8
        `Material` of each triangle.
    """

    vertices: Floats32
    triangles: NDArray[np.uint32]
    material: Bytes

    def moved(self, T: ArrayLike) -> "Mesh":
        """Return the mesh transformed to another frame by a (4, 4) `T`, a ``T_to_from``."""
        T = np.asarray(T, np.float64)
        vertices = self.vertices @ T[:3, :3].T + T[:3, 3]
        return Mesh(vertices.astype(np.float32), self.triangles, self.material)

    def painted(self, material: Material) -> "Mesh":
        """Return the mesh with one material on all triangles."""
        return self._replace(material=np.full(len(self.triangles), material, np.uint8))

    @property
    def normals(self) -> Floats32:
        """Unit normals (T, 3); zero for a triangle without area."""
        a, b, c = (self.vertices[self.triangles[:, k]].astype(np.float64) for k in range(3))
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(np.divide(normals, length, out=np.zeros_like(normals), where=length > 0).astype(np.float32))


def _mesh(vertices: ArrayLike, triangles: ArrayLike, material: int | ArrayLike) -> Mesh:
    triangles = np.asarray(triangles, np.uint32).reshape(-1, 3)
    materials = np.broadcast_to(np.asarray(material, np.uint8), (len(triangles),)).copy()
    return Mesh(np.asarray(vertices, np.float32).reshape(-1, 3), triangles, materials)


def empty() -> Mesh:
    """Return a mesh without triangles."""
    return _mesh(np.zeros((0, 3)), np.zeros((0, 3)), 0)


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """Merge meshes into one."""
    if not (parts := list(meshes)):
        return empty()
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + np.uint32(k) for part, k in zip(parts, starts, strict=True)]),
        np.concatenate([part.material for part in parts]),
    )


def quads(corners: ArrayLike, material: int | ArrayLike) -> Mesh:
    """Make quadrilaterals.

    Parameters
    ----------
    corners : (N, 4, 3) array
        Corners of each quadrilateral, in order around it.
    material : Material or (N,) array
        One material for all, or one for each quadrilateral.
    """
    corners = np.asarray(corners, np.float64).reshape(-1, 4, 3)
    first = 4 * np.arange(len(corners))[:, None]
    triangles = np.stack([first + [0, 1, 2], first + [0, 2, 3]], axis=1)
    materials = np.repeat(np.broadcast_to(np.asarray(material, np.uint8), (len(corners),)), 2)
    return _mesh(corners, triangles, materials)


def sheet(left: ArrayLike, right: ArrayLike, material: int) -> Mesh:
    """Make a strip between two lines of equal length, such as a road between its edges or a fence."""
    left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
    return quads(np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1), material)


def wall(line: ArrayLike, height: float | ArrayLike, material: int, *, depth: float = 0.0) -> Mesh:
    """Make an upright sheet along a line (M, 3), from `depth` below the line to `height` above it [m]."""
    line = np.asarray(line, np.float64)
    up = np.zeros_like(line)
    up[:, 2] = height
    return sheet(line - [0, 0, depth], line + up, material)


def box(lower: ArrayLike, upper: ArrayLike, material: int) -> Mesh:
    """Make an axis-aligned box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    p = np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)])
    faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return quads(p[np.array(faces)], material)


def loft(sections: ArrayLike, material: int | ArrayLike, *, caps: int | None = None) -> Mesh:
    """Make a surface through closed cross sections, such as a car body.

    Parameters
    ----------
    sections : (S, P, 3) array
        S closed outlines of P points each; point p of an outline connects to point p of the next.
    material : Material or (S - 1, P) array
        One for all, or one per quadrilateral between sections s and s + 1, points p and p + 1.
    caps : Material, optional
        Material of end caps on the first and last outline, which should be convex; without caps if None.
    """
    sections = np.asarray(sections, np.float64)
    following = np.roll(sections, -1, axis=1)
    corners = np.stack([sections[:-1], following[:-1], following[1:], sections[1:]], axis=2)
    materials = np.broadcast_to(np.asarray(material, np.uint8), corners.shape[:2])
    parts = [quads(corners.reshape(-1, 4, 3), materials.ravel())]
    if caps is not None:
        fan = [(0, k, k + 1) for k in range(1, sections.shape[1] - 1)]
        parts += [_mesh(outline, fan, caps) for outline in (sections[0], sections[-1])]
    return merge(parts)


def cylinder(
    start: ArrayLike,
    end: ArrayLike,
    radius: float,
    material: int,
    *,
    end_radius: float | None = None,
    sides: int = 8,
    caps: bool = True,
) -> Mesh:
    """Make a cylinder between two distinct points [m], or a cone with another `end_radius`."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = np.linalg.norm(end - start)
    if not length > 0:
        raise ValueError(f"start and end of a cylinder must differ, got {start} and {end}")
    axis = (end - start) / length
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    angles = 2 * np.pi * np.arange(sides) / sides
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    last = radius if end_radius is None else end_radius
    return loft([start + radius * ring, end + last * ring], material, caps=material if caps else None)


def ellipsoid(center: ArrayLike, radii: ArrayLike, material: int, *, sides: int = 10) -> Mesh:
    """Make an axis-aligned ellipsoid."""
    polar = np.linspace(0, np.pi, sides // 2 + 1)
    around = 2 * np.pi * np.arange(sides) / sides
    sine, cosine = np.sin(polar)[:, None], np.cos(polar)[:, None]
    unit = np.stack(np.broadcast_arrays(sine * np.cos(around), sine * np.sin(around), cosine), axis=-1)
    return loft(np.asarray(center, np.float64) + unit * np.asarray(radii, np.float64), material)


SUNK = 0.3  # [m] depth of feet in the ground, so that they also reach it on a slope


def upright(x: float, y: float, z: float, yaw: float = 0.0) -> Floats:
    """Return the transform (4, 4) of an upright part at a position [m] and yaw [rad]."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def triangles(corners: ArrayLike, material: int) -> Mesh:
    """Make separate triangles from their corners (N, 3, 3)."""
    vertices = np.asarray(corners, np.float32).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))
