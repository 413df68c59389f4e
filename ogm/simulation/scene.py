"""The world that rays are cast at: what stands still built once, what moves built anew for each frame."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import open3d
from numpy.typing import ArrayLike, NDArray

from ogm.pose import check_pose
from ogm.simulation import kernels
from ogm.simulation.materials import table
from ogm.simulation.mesh import Mesh, box, empty, merge

__all__ = ["NOTHING", "OWN", "STATIC", "Hits", "Scene"]

STATIC, OWN = -1, -2  # `Hits.object` of what stands still (or of no hit), and of the own vehicle
NOTHING = 255  # `Hits.material` where a ray hits nothing
BATCH = 2**17  # rays per call of Open3D: its answers then stay in the processor's cache
ROWS, SECTORS = 256, 512  # directions from the sensor in which moving things are looked for
CLOSE = 12.0  # [m] of things farther away the box around them says well enough where to look
PASSES = 3  # panes of glass that a ray goes through at most
SMALL = 4096  # rays that are not worth waking another thread for
SKIN = np.float32(1e-3)  # [m] a ray goes on this far behind the glass it has passed
_ZERO = np.zeros(1, np.float32)
_DTYPES = [np.dtype(name) for name in ("float32", "uint8", "int32", "float32")]  # of Hits


class Hits(NamedTuple):
    """What each ray hits first.

    Attributes
    ----------
    distance : (N,) float32
        [m]; inf for nothing.
    material : (N,) uint8
        `Material`; 255 for nothing.
    object : (N,) int32
        Number of the moving thing in the list given to `Scene.place`; -1 for static things or nothing, -2
        for the own vehicle.
    cosine : (N,) float32
        Of the angle between ray and surface normal, [0, 1]; 0 for nothing.
    """

    distance: NDArray[np.float32]
    material: NDArray[np.uint8]
    object: NDArray[np.int32]
    cosine: NDArray[np.float32]

    @classmethod
    def room(cls, count: int) -> "Hits":
        """Return arrays with arbitrary content, for `Scene.cast` to fill."""
        return cls(
            np.empty(count, np.float32),
            np.empty(count, np.uint8),
            np.empty(count, np.int32),
            np.empty(count, np.float32),
        )


class Scene:
    """Triangles that rays are cast at; one caller at a time.

    Parameters
    ----------
    static : Mesh
        What stands still, in the world frame. May be empty.
    threads : int
        Processor cores to use; 0 for all. The results do not depend on it. Open3D holds Python's lock while
        it casts, so two scenes in two threads of one process gain nothing: use processes, or `threads`.
    """

    def __init__(self, static: Mesh, *, threads: int = 0) -> None:
        if threads < 0:
            raise ValueError(f"threads must be 0 (all cores) or a number of cores, got {threads}")
        self.threads = threads or len(os.sched_getaffinity(0))
        self._static = _Shape(static, np.full(len(static.triangles), STATIC, np.int32), self.threads)
        self._moving = _Shape(empty(), np.zeros(0, np.int32), self.threads)
        self._things = 0
        self._parts: list[Mesh] = []
        self._boxes: list[Mesh] = []
        self._nearest = np.empty((ROWS, SECTORS), np.float32)
        self._nearest_origin: tuple[float, ...] | None = None
        self._transmission = np.ascontiguousarray(table()[:, 4])
        self._rays = np.empty((BATCH, 6), np.float32)
        self._picked = np.empty((BATCH, 6), np.float32)
        self._index = np.empty(BATCH, np.int32)
        self._every = np.arange(BATCH, dtype=np.int32)
        self._pool = ThreadPoolExecutor(self.threads) if self.threads > 1 else None

    def place(self, meshes: Sequence[Mesh], own: Mesh | None = None) -> None:
        """Put this frame's moving things where they are, instead of the last frame's.

        Parameters
        ----------
        meshes : sequence of Mesh
            In the world frame; `Hits.object` counts in their order.
        own : Mesh, optional
            The vehicle that carries the sensor, in the world frame.
        """
        self._things = len(meshes)
        parts = [*meshes] if own is None else [*meshes, own]
        numbers = [*range(len(meshes))] if own is None else [*range(len(meshes)), OWN]
        counts = [len(part.triangles) for part in parts]
        things = np.repeat(np.array(numbers, np.int32), counts)
        self._moving = _Shape(merge(parts), things, self.threads)
        self._parts = [part for part in parts if len(part.triangles)]
        self._boxes = [_box_around(part) for part in self._parts]
        self._nearest_origin = None

    @property
    def things(self) -> int:
        """Moving things that are in place, the own vehicle not counted."""
        return self._things

    def cast(
        self,
        origin: ArrayLike,
        directions: NDArray[np.float32],
        *,
        salt: int = 0,
        number: int = 0,
        out: Hits | None = None,
    ) -> Hits:
        """Find what rays hit first.

        Glass lets a share of the rays through, three panes at most: which ones, depends on `salt`, the ray's
        number and nothing else.

        Parameters
        ----------
        origin : (3,), (N, 3) or (4, 4) array
            Where all rays or each of them starts, in the world frame [m]; or the sensor's pose
            ``T_world_sensor``, and then `directions` are in the sensor frame.
        directions : (N, 3) float32
            Unit vectors.
        salt : int
            Changes which rays pass through glass, for instance from frame to frame; 0 or more.
        number : int
            Of the first ray, where one set of rays is cast in several calls.
        out : Hits, optional
            Filled and returned instead of new arrays: (N,) each, as from `Hits.room`.

        Raises
        ------
        TypeError
            If `directions` are not float32, or `out` has other types than `Hits.room` gives.
        ValueError
            If shapes do not fit.
        """
        aim = _aim(origin, directions)
        count = len(directions)
        hits = Hits.room(count) if out is None else out
        if any(column.shape != (count,) for column in hits):
            raise ValueError(f"out must hold {count} rays, got {[column.shape for column in hits]}")
        if [column.dtype for column in hits] != _DTYPES:
            raise TypeError(f"out must be of the types of Hits.room, got {[str(c.dtype) for c in hits]}")
        nearest = self._look_around(aim[0])
        for start in range(0, count, BATCH):
            job = _Batch(start, min(BATCH, count - start), aim)
            self._cast_batch(job, nearest, hits)
            self._pass_glass(job, salt, number, hits)
        return hits

    def _look_around(self, origins: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return where moving things are around the origin that all rays share; None if they share none."""
        if self._moving.empty or len(origins) != 1:
            return None
        place = tuple(origins[0].tolist())
        if place != self._nearest_origin:
            mesh = merge(
                part if _distance(around, origins[0]) < CLOSE else around
                for part, around in zip(self._parts, self._boxes, strict=True)
            )
            kernels.look_around(mesh.vertices, mesh.triangles, origins[0].astype(np.float64), self._nearest)
            self._nearest_origin = place
        return self._nearest

    def _cast_batch(self, job: "_Batch", nearest: NDArray[np.float32] | None, hits: Hits) -> None:
        """Cast `job.size` rays, at what stands still and, if they may meet it, at what moves."""
        rays, index = self._rays[: job.size], self._index
        self._share(lambda a, b: kernels.aim(*job.aim, job.start, rays, a, b), job.size)
        t, primitive, normals = self._static.cast(rays)
        lookup = (rays, t, primitive, normals, self._static.materials, job.start, *hits)
        self._share(lambda a, b: kernels.look_up(*lookup, a, b), job.size)
        if self._moving.empty:
            return
        if nearest is None:
            self._improve(self._moving, rays, self._every[: job.size], _ZERO, job.start, hits)
            return
        search = (rays, nearest, job.start, hits.distance, index, self._picked)
        chosen = 0
        for first, many in self._share(lambda a, b: (a, kernels.collect(*search, a, b)), job.size):
            if chosen != first:  # close the gap between two threads' shares
                index[chosen : chosen + many] = index[first : first + many]
                self._picked[chosen : chosen + many] = self._picked[first : first + many]
            chosen += many
        self._improve(self._moving, self._picked[:chosen], index[:chosen], _ZERO, job.start, hits)

    def _pass_glass(self, job: "_Batch", salt: int, number: int, hits: Hits) -> None:
        """Cast those rays again, from behind it, that glass lets through."""
        candidates = self._every[: job.size]
        for turn in range(PASSES):
            key = PASSES * salt + turn
            chosen = kernels.through_glass(
                hits.material, self._transmission, job.start, number + job.start, key, candidates, self._index
            )
            if not chosen:
                return
            candidates, onward = self._index[:chosen], self._picked[:chosen]
            base = np.empty(chosen, np.float32)
            kernels.restart(candidates, self._rays, SKIN, job.start, *hits, base, onward, 0, chosen)
            for shape in (self._static, self._moving):
                self._improve(shape, onward, candidates, base, job.start, hits)

    def _improve(
        self,
        shape: "_Shape",
        rays: NDArray[np.float32],
        index: NDArray[np.int32],
        base: NDArray[np.float32],
        start: int,
        hits: Hits,
    ) -> None:
        if shape.empty or not len(rays):
            return
        t, primitive, normals = shape.cast(rays)
        answer = (index, rays, t, primitive, normals, shape.materials, shape.things, base, start, *hits)
        self._share(lambda a, b: kernels.improve(*answer, a, b), len(rays))

    def _share(self, work: Callable[[int, int], Any], count: int) -> list[Any]:
        """Do the work on rays 0 to `count` in equal shares, one per thread."""
        if self._pool is None or count < SMALL:
            return [work(0, count)]
        edges = [count * k // self.threads for k in range(self.threads + 1)]
        return list(self._pool.map(work, edges[:-1], edges[1:]))


class _Batch(NamedTuple):
    """Rays cast in one go: their number, the first one's place, and what aims them."""

    start: int
    size: int
    aim: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


class _Shape:
    """One Open3D scene and what its triangles are."""

    def __init__(self, mesh: Mesh, things: NDArray[np.int32], threads: int) -> None:
        _check(mesh)
        self.mesh = mesh
        self.materials = np.ascontiguousarray(mesh.material)
        self.things = things
        self.threads = threads
        self.empty = not len(mesh.triangles)
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
        if not self.empty:
            self._scene.add_triangles(_tensor(mesh.vertices), _tensor(mesh.triangles))

    def cast(
        self, rays: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32]]:
        """Return distance, triangle and its unit normal for each ray (n, 6)."""
        if self.empty:
            count = len(rays)
            return (
                np.full(count, np.inf, np.float32),
                np.zeros(count, np.uint32),
                np.zeros((count, 3), np.float32),
            )
        answer = self._scene.cast_rays(_tensor(rays), nthreads=self.threads)
        return tuple(answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_normals"))


def _box_around(mesh: Mesh) -> Mesh:
    """Return the smallest of a few upright boxes around a mesh."""
    cosine, sine, *bounds = kernels.upright_box(mesh.vertices)
    turn = np.eye(4)
    turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
    return box(bounds[:3], bounds[3:], 0).moved(turn)


def _distance(around: Mesh, origin: NDArray[np.float32]) -> float:
    """Return how far away the box surely is, horizontally [m]."""
    middle = around.vertices.mean(axis=0)
    radius = np.hypot(*(around.vertices - middle)[:, :2].T).max()
    return float(np.hypot(*(middle - origin)[:2]) - radius)


def _tensor(array: NDArray) -> "open3d.core.Tensor":
    return open3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


def _check(mesh: Mesh) -> None:
    """Refuse a mesh that Open3D would crash on."""
    for name, columns, dtype in (
        ("vertices", 3, "float32"),
        ("triangles", 3, "uint32"),
        ("material", 0, "uint8"),
    ):
        array = getattr(mesh, name)
        if array.dtype != dtype or array.shape[1:] != (columns,) * (columns > 0):
            shape = f"(N, {columns})" if columns else "(N,)"
            raise TypeError(
                f"the mesh's {name} must be {dtype} of shape {shape}, got {array.dtype} of shape {array.shape}"
            )
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("the mesh has vertices that are NaN or inf")
    if len(mesh.triangles) and mesh.triangles.max() >= len(mesh.vertices):
        raise ValueError(f"triangle corner {mesh.triangles.max()} but only {len(mesh.vertices)} vertices")
    if len(mesh.material) != len(mesh.triangles):
        raise ValueError(
            f"{len(mesh.triangles)} triangles but {len(mesh.material)} materials; each needs one"
        )


def _aim(
    origin: ArrayLike, directions: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return origins (1 or N, 3), directions and the rotation that takes them to the world."""
    if not isinstance(directions, np.ndarray) or directions.dtype != np.float32:
        got = getattr(directions, "dtype", type(directions).__name__)
        raise TypeError(f"directions must be a float32 array of shape (N, 3), got {got}")
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions must have shape (N, 3), got {directions.shape}")
    place = np.asarray(origin, np.float64)
    rotation = np.eye(3, dtype=np.float32)
    if place.shape == (4, 4):
        T = check_pose(place, "origin")
        place, rotation = T[:3, 3], T[:3, :3].astype(np.float32)
    if place.shape not in ((3,), directions.shape):
        raise ValueError(
            f"origin must be (3,), one per direction {directions.shape} or a (4, 4) pose, got {place.shape}"
        )
    if not np.isfinite(place).all():
        raise ValueError("origin holds NaN or inf")
    return np.ascontiguousarray(place.reshape(-1, 3), np.float32), directions, rotation
