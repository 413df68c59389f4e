"""Ray casting in a world of static and moving meshes; static meshes are prepared once, moving ones for each frame.

>>> import numpy as np
>>> from ogm.pose import pose
>>> from ogm.simulation.materials import Material
>>> from ogm.simulation.mesh import box
>>> from ogm.simulation.scene import Scene
>>> road = Scene(box([-100, -100, -1], [100, 100, 0], Material.ASPHALT))
>>> road.cast(pose(z=2.0), np.array([[0, 0, -1]], np.float32)).distance      # [m]
array([2.], dtype=float32)
"""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ogm.extras import import_extra
from ogm.pose import check_pose
from ogm.simulation import kernels
from ogm.simulation.kernels import Answer, Hits
from ogm.simulation.materials import table
from ogm.simulation.mesh import Array, Floats32, Ints32, Mesh, empty, merge

__all__ = ["EGO", "NO_MATERIAL", "STATIC", "Hits", "Scene"]

STATIC, EGO = -1, -2  # `Hits.object` of static surfaces or no hit, and of the ego vehicle
NO_MATERIAL = 255  # `Hits.material` without a hit
BATCH = 2**17  # rays per call of Open3D, whose results then fit in the processor's cache
PASSES = 3  # largest number of glass panes that a ray passes
_NONE = np.empty((0, 3), np.float32)
SKIN = np.float32(1e-3)  # [m] distance behind a pane at which a ray continues


class Scene:
    """Static and moving meshes for ray casting; used by one caller at a time.

    Parameters
    ----------
    static : Mesh
        Static mesh in the world frame; may be empty.
    threads : int
        Number of processor cores for Open3D; 0 for all. The results do not depend on it. Open3D holds Python's global
        lock, so threads do not cast in parallel: use processes, or `threads`.
    """

    def __init__(self, static: Mesh, *, threads: int = 0) -> None:
        if threads < 0:
            raise ValueError(f"threads must be 0 (all cores) or a positive number of cores, got {threads}")
        self.threads = threads or len(os.sched_getaffinity(0))
        self._static = _Shape(static, np.full(len(static.triangles), STATIC, np.int32), self.threads)
        self._moving = _Shape(empty(), np.zeros(0, np.int32), self.threads)
        self.object_count = 0  # number of moving objects, without the ego vehicle
        self._transmission = np.ascontiguousarray(table()[:, 4])

    def place(self, meshes: Sequence[Mesh], ego: Mesh | None = None) -> None:
        """Place the moving objects of a new frame instead of the last frame's.

        Parameters
        ----------
        meshes : sequence of Mesh
            Moving objects in the world frame; `Hits.object` is an index into this sequence.
        ego : Mesh, optional
            The vehicle that carries the sensor, in the world frame.
        """
        self.object_count = len(meshes)
        parts = [*meshes] if ego is None else [*meshes, ego]
        numbers = np.arange(len(parts), dtype=np.int32)
        numbers[len(meshes) :] = EGO
        objects = np.repeat(numbers, [len(part.triangles) for part in parts])
        self._moving = _Shape(merge(parts), objects, self.threads)

    def cast(
        self,
        origin: ArrayLike,
        directions: Floats32,
        *,
        salt: int = 0,
        number: int = 0,
        normals: Floats32 | None = None,
    ) -> Hits:
        """Find the first hit of each ray.

        Glass lets a share of the rays pass, through three panes at most. The selection depends only on `salt` and the
        number of the ray.

        Parameters
        ----------
        origin : (3,), (N, 3) or (4, 4) array
            Start of all rays or of each ray, in the world frame [m]; or the sensor's pose ``T_world_sensor``, with
            `directions` in the sensor frame.
        directions : (N, 3) float32
            Unit vectors.
        salt : int
            Seed of the selection of rays that pass through glass, 0 or more.
        number : int
            Number of the first ray, for a set of rays that is cast in several calls.
        normals : (N, 3) float32, optional
            Output: unit normals of the hit triangles, on either side.

        Raises
        ------
        TypeError
            If `directions` are not float32.
        ValueError
            If shapes do not match, or the origin is not finite or not a pose.
        """
        origins, rotation = _aim(origin, directions)
        count = len(directions)
        hits = Hits.allocate(count)
        for start in range(0, count, BATCH):
            stop = min(start + BATCH, count)
            places = origins if len(origins) == 1 else origins[start:stop]
            rays = kernels.aim(places, directions[start:stop], rotation)
            wanted = _NONE if normals is None else normals[start:stop]
            self._cast_batch(rays, hits.part(start, stop), wanted, salt, number + start)
        return hits

    def _cast_batch(self, rays: Floats32, hits: Hits, normals: Array, salt: int, number: int) -> None:
        """Find the first hits, and cast rays again behind glass; `number` counts from the first ray."""
        index = np.arange(len(rays), dtype=np.int32)
        self._keep_nearest(hits, normals, index, rays, np.zeros(len(rays), np.float32))
        for turn in range(PASSES):
            index = kernels.transmitted(hits.material, self._transmission, number, PASSES * salt + turn, index)
            if not len(index):
                return
            self._keep_nearest(hits, normals, index, *kernels.restart(hits, index, rays, SKIN))

    def _keep_nearest(self, hits: Hits, normals: Array, index: Array, rays: Array, base: Array) -> None:
        for shape in (self._static, self._moving):
            if not shape.empty:
                kernels.keep_nearer(hits, index, rays, base, shape.cast(rays), normals)


class _Shape:
    """An Open3D scene with the attributes of its triangles."""

    def __init__(self, mesh: Mesh, objects: Ints32, threads: int) -> None:
        _check(mesh)
        self.materials, self.objects, self.threads = np.ascontiguousarray(mesh.material), objects, threads
        self.empty = not len(mesh.triangles)
        self._scene = import_extra("open3d", "sim").t.geometry.RaycastingScene(nthreads=threads)
        if not self.empty:
            self._scene.add_triangles(_tensor(mesh.vertices), _tensor(mesh.triangles))

    def cast(self, rays: Floats32) -> Answer:
        """Return the result of Open3D for rays (n, 6)."""
        answer = self._scene.cast_rays(_tensor(rays), nthreads=self.threads)
        names = ("t_hit", "primitive_ids", "primitive_normals")
        t, primitive, normals = (answer[name].numpy() for name in names)
        return Answer(t, primitive, normals, self.materials, self.objects)


def _tensor(array: Array) -> Any:
    return import_extra("open3d", "sim").core.Tensor.from_numpy(np.ascontiguousarray(array))


def _check(mesh: Mesh) -> None:
    """Raise an error for a mesh that would crash Open3D."""
    for name, row, dtype in (("vertices", (3,), "float32"), ("triangles", (3,), "uint32"), ("material", (), "uint8")):
        array, shape = getattr(mesh, name), "(N, 3)" if row else "(N,)"
        if array.dtype != dtype or array.shape[1:] != row:
            raise TypeError(f"mesh {name} must be {dtype} {shape}, got {array.dtype} {array.shape}")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("vertices of the mesh must be finite, got NaN or inf")
    if len(mesh.triangles) and mesh.triangles.max() >= len(mesh.vertices):
        raise ValueError(
            f"triangles must refer to the {len(mesh.vertices)} vertices of the mesh, got vertex {mesh.triangles.max()}"
        )
    if len(mesh.material) != len(mesh.triangles):
        raise ValueError(
            f"the mesh needs one material per triangle, got {len(mesh.material)} for {len(mesh.triangles)}"
        )


def _aim(origin: ArrayLike, directions: Floats32) -> tuple[Floats32, Floats32]:
    """Return origins (1 or N, 3), and the rotation of directions to the world frame."""
    if getattr(directions, "dtype", None) != np.float32:
        raise TypeError(f"directions must be a float32 array of shape (N, 3), got {np.asarray(directions).dtype}")
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions must have shape (N, 3), got {directions.shape}")
    place, rotation = np.asarray(origin, np.float64), np.eye(3, dtype=np.float32)
    if place.shape == (4, 4):
        T = check_pose(place, "origin")
        place, rotation = T[:3, 3], T[:3, :3].astype(np.float32)
    if place.shape not in ((3,), directions.shape):
        raise ValueError(f"origin must have shape (3,), (4, 4) or {directions.shape} of directions, got {place.shape}")
    if not np.isfinite(place).all():
        raise ValueError("origin must be finite, got NaN or inf")
    return np.ascontiguousarray(place.reshape(-1, 3), np.float32), rotation
