"""Geometry and data of grids: `GridSpec`, `EvidentialGrid` and `LayeredGrid`.

>>> import numpy as np
>>> from ogm import EvidentialGrid, GridSpec
>>> spec = GridSpec.centered(length=20.0, width=10.0, resolution=0.5)
>>> spec.shape, spec.origin
((40, 20), (-10.0, -5.0))
>>> EvidentialGrid(spec, np.full((*spec.shape, 2), (0.6, 0.1), np.float32)).at(3.0, 1.0)
Opinion(free=0.60, occupied=0.10, unknown=0.30)
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import Opinion, check_mass, mass_to_evidence, mass_to_probability, unknown
from ogm.evidence.arrays import refuse_masked
from ogm.storage.archive import open_archive, write_archive
from ogm.storage.limits import current_limits, too_large

__all__ = ["CombinedGrid", "EvidentialGrid", "GridSpec", "LayeredGrid", "PartialGrid"]

Sampling = Literal["nearest", "bilinear"]

_LENGTH, _WIDTH = 81.92, 56.32  # [m] default extent (van Kempen et al. 2021, Sec. V)
_MAX_CELLS = 2**28  # 2 GiB of masses; files that announce more are refused before they are unpacked
_MIN_CELL, _MAX_CELL = 1e-6, 1e6  # [m] side of a cell: beyond, products of lengths leave the range of float32
_MAX_META = 65_536  # characters
_MAX_XY = 1e10  # [m], at which float64 resolves 2 micrometres


@dataclass(frozen=True)
class GridSpec:
    """Geometry of a grid: resolution, number of cells and corner. Holds no arrays.

    Axes follow REP 103: x forward, y left. Cell ``(ix, iy)`` covers
    ``origin + resolution * [ix, ix + 1) x [iy, iy + 1)``.

    Parameters
    ----------
    resolution : float
        Side of a cell [m], 1e-6 to 1e6.
    shape : (int, int)
        Number of cells along x and along y.
    origin : (float, float)
        x, y of the *outer corner* of cell (0, 0) [m], as in ROS.

    Raises
    ------
    ValueError
        If the resolution is out of range, a count is not a positive whole number, the grid has more than 2**28
        cells, or it reaches beyond 1e10 m.
    """

    resolution: float
    shape: tuple[int, int]
    origin: tuple[float, float]

    def __post_init__(self) -> None:
        try:
            resolution, shape, origin = float(self.resolution), tuple(self.shape), tuple(map(float, self.origin))
        except OverflowError as error:
            raise ValueError("resolution and origin must be numbers within the range of float64 [m]") from error
        if not (resolution > 0 and np.isfinite(resolution)):
            raise ValueError(f"resolution must be positive and finite [m], got {self.resolution}")
        if not _MIN_CELL <= resolution <= _MAX_CELL:
            raise ValueError(f"resolution must be {_MIN_CELL:g} to {_MAX_CELL:g} m, got {self.resolution}")
        if len(shape) != 2 or not all(0 < n < np.inf and n == int(n) for n in shape):
            raise ValueError(f"shape must be two positive whole numbers (nx, ny), got {self.shape}")
        if shape[0] * shape[1] > _MAX_CELLS:
            raise ValueError(f"shape {self.shape} has more than {_MAX_CELLS} cells; use larger or fewer cells")
        if len(origin) != 2 or not np.isfinite(origin).all():
            raise ValueError(f"origin must be two finite numbers (x, y) [m], got {self.origin}")
        if max(abs(corner) + n * resolution for corner, n in zip(origin, shape, strict=True)) > _MAX_XY:
            raise ValueError(f"grids must lie within {_MAX_XY:g} m, got origin {origin} m, cells of {resolution} m")
        self.__dict__.update(resolution=resolution, shape=(int(shape[0]), int(shape[1])), origin=origin)

    @classmethod
    def centered(
        cls,
        length: float | None = None,
        width: float | None = None,
        resolution: float = 0.16,
        center: tuple[float, float] = (0.0, 0.0),
    ) -> Self:
        """Make a grid of a given size around a point.

        Parameters
        ----------
        length, width : float, optional
            Extent along x and along y [m]; each must be a whole number of cells. By default the paper's 81.92 m
            and 56.32 m, rounded to whole cells.
        resolution : float
            Side of a cell [m].
        center : (float, float)
            x, y of the grid's centre [m].

        Raises
        ------
        ValueError
            If an extent is no whole number of cells; the message names the nearest possible extents.

        Examples
        --------
        The paper's grid (van Kempen et al. 2021, Sec. V):

        >>> GridSpec.centered(length=81.92, width=56.32, resolution=0.16).shape
        (512, 352)
        >>> GridSpec.centered(resolution=0.1).shape
        (819, 563)
        """
        if not (resolution > 0 and np.isfinite(resolution)):
            raise ValueError(f"resolution must be positive and finite [m], got {resolution}")
        counts = []
        for name, size, default in (("length", length, _LENGTH), ("width", width, _WIDTH)):
            if size is None:
                counts.append(max(round(default / resolution), 1))
                continue
            cells = size / resolution
            if not (np.isfinite(cells) and cells > 0):
                raise ValueError(f"{name} must be positive and finite [m], got {size}")
            if abs(cells - round(cells)) > 1e-6 * max(1.0, cells):
                low, high = np.floor(cells) * resolution, np.ceil(cells) * resolution
                raise ValueError(
                    f"{name} {size} m is {cells:.4g} cells of {resolution} m, not a whole number; "
                    f"use {low:.6g} m or {high:.6g} m"
                )
            counts.append(round(cells))
        nx, ny = counts
        origin = (center[0] - nx * resolution / 2, center[1] - ny * resolution / 2)
        return cls(resolution=resolution, shape=(nx, ny), origin=origin)

    def __str__(self) -> str:
        (nx, ny), (x0, x1, y0, y1) = self.shape, self.extent
        return f"{nx} x {ny} cells of {self.resolution:g} m, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m"

    @property
    def length(self) -> float:
        """Extent along x [m]."""
        return self.shape[0] * self.resolution

    @property
    def width(self) -> float:
        """Extent along y [m]."""
        return self.shape[1] * self.resolution

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The outer edges x_min, x_max, y_min, y_max [m]."""
        x, y = self.origin
        return x, x + self.length, y, y + self.width

    @property
    def cell_centers(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Coordinates of cell centres [m]: x as (nx, 1) and y as (1, ny), ready to broadcast."""
        x = self.origin[0] + (np.arange(self.shape[0]) + 0.5) * self.resolution
        y = self.origin[1] + (np.arange(self.shape[1]) + 0.5) * self.resolution
        return x[:, None], y[None, :]

    def index(
        self, x: ArrayLike, y: ArrayLike, *, unbounded: bool = False
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the cell of each point.

        Parameters
        ----------
        x, y : float or array
            Coordinates [m].
        unbounded : bool
            Whether points may lie outside the grid. Their indices are below 0 or at least ``shape``; do not index an
            array with them.

        Returns
        -------
        ix, iy : int64 arrays of the inputs' shapes

        Raises
        ------
        ValueError
            If a point is not finite, or lies outside the grid without `unbounded`; see `contains`.
        """
        ix, iy = self._floored(x, y)
        bad = ~(np.isfinite(ix) & np.isfinite(iy)) if unbounded else ~self._are_cells(ix, iy)
        if bad.any():
            px, py = (np.broadcast_to(coordinates, bad.shape)[bad].flat[0] for coordinates in (x, y))
            x0, x1, y0, y1 = self.extent
            raise ValueError(
                f"{np.count_nonzero(bad)} of {bad.size} points lie outside the grid, the first at ({px}, {py}) m: "
                f"x in [{x0}, {x1}), y in [{y0}, {y1}) m; keep the points for which `contains` is true"
            )
        return ix.astype(np.int64), iy.astype(np.int64)

    def contains(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """Return whether each point lies in a cell of the grid (the far edges are outside)."""
        return self._are_cells(*self._floored(x, y))

    def _floored(self, x: ArrayLike, y: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        ix = np.floor((np.asarray(x, np.float64) - self.origin[0]) / self.resolution)
        iy = np.floor((np.asarray(y, np.float64) - self.origin[1]) / self.resolution)
        return ix, iy

    def _are_cells(self, ix: NDArray[np.float64], iy: NDArray[np.float64]) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = (ix >= 0) & (ix < self.shape[0]) & (iy >= 0) & (iy < self.shape[1])
        return inside

    def refined(self, factor: int) -> "GridSpec":
        """Return the spec of the same area with `factor` times as many cells along each axis."""
        if not (np.isfinite(factor) and factor == int(factor) and factor >= 1):
            raise ValueError(f"factor must be a positive whole number, got {factor}")
        nx, ny = self.shape
        return GridSpec(self.resolution / factor, (nx * int(factor), ny * int(factor)), self.origin)


def sampled_opinions(
    points: ArrayLike,
    origin: tuple[float, float],
    resolution: float,
    masses: Callable[[NDArray[np.float64]], NDArray[np.float32]],
    method: Sampling,
) -> Opinion | NDArray[np.float32]:
    """Return opinions at points of a map given as a function of its cells; see `EvidentialGrid.opinion_at`.

    Parameters
    ----------
    points : (..., 2) array
        x, y [m].
    origin : (float, float)
        x, y of the corner of cell (0, 0) [m].
    resolution : float
        Side of a cell [m].
    masses : function
        Takes indices of cells, (..., 2), to masses of free and occupied, (..., 2): 0 beyond the map.
    method : {"nearest", "bilinear"}
    """
    xy = np.asarray(points, np.float64)
    if xy.shape[-1:] != (2,):
        raise ValueError(f"points must have x and y on their last axis, got shape {xy.shape}")
    if not np.isfinite(xy).all():
        raise ValueError(f"points must be finite [m], got {xy[~np.isfinite(xy).all(axis=-1)].reshape(-1, 2)[0]}")
    cell = (xy - origin) / resolution
    if method == "nearest":
        mass = masses(np.floor(cell))
    elif method == "bilinear":
        low = np.floor(cell - 0.5)
        share = cell - 0.5 - low
        corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        weights = (np.where(corner, share, 1 - share).prod(axis=-1, keepdims=True) for corner in corners)
        mass = sum(w * masses(low + corner) for w, corner in zip(weights, corners, strict=True)).astype(np.float32)
    else:
        raise ValueError(f"method must be nearest or bilinear, got {method!r}")
    return Opinion(*mass.tolist()) if mass.ndim == 1 else np.concatenate([mass, unknown(mass)[..., None]], axis=-1)


class ShownInNotebooks:
    """Mixin: notebooks show the value as a small picture and a table of facts."""

    def _repr_png_(self) -> bytes | None:
        from ogm.plot.notebook import png

        return png(self) or None

    def _repr_html_(self) -> str:
        from ogm.plot.notebook import html

        return html(self)


class SavedGrid(ShownInNotebooks):
    """Mixin: lossless, self-describing ``.npz`` files, read without unpickling."""

    FORMAT: ClassVar[str]
    spec: GridSpec

    def arrays(self) -> dict[str, ArrayLike]:
        """Return the checked arrays of the file: ``resolution`` and ``origin`` [m], ``axes``, and the cells."""
        raise NotImplementedError

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Return the grid stored in the arrays of a file."""
        raise NotImplementedError

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the grid to an ``.npz`` file, lossless and in one step: see `docs/formats.md`.

        `ogm.io.write_grid` also writes a stamp, a pose and further layers.

        Raises
        ------
        ValueError
            If the path has another ending, or the numbers are no masses.
        OSError
            If the file cannot be written; an existing file is replaced only by a complete new file.
        """
        write_archive(path, self.FORMAT, **self.arrays())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a grid written by `save`.

        Raises
        ------
        FileNotFoundError
            If the file does not exist.
        OgmError
            If the file is damaged, of another kind or version, or has masses outside [0, 1].
        """
        with open_archive(path, cls.FORMAT) as arrays:
            return cls.of_arrays(arrays)

    def _place(self) -> dict[str, ArrayLike]:
        return {"resolution": self.spec.resolution, "origin": self.spec.origin}


def spec_of_arrays(arrays: Mapping[str, NDArray[Any]], shape: tuple[int, ...]) -> GridSpec:
    """Return the spec of a file with arrays ``resolution`` and ``origin``."""
    return GridSpec(float(arrays["resolution"]), (shape[0], shape[1]), tuple(arrays["origin"].tolist()))


@dataclass(frozen=True, eq=False)
class EvidentialGrid(SavedGrid):
    """Belief masses of free and occupied for every cell of a grid.

    Parameters
    ----------
    spec : GridSpec
    mass : (nx, ny, 2) float array
        Masses of free and occupied in [0, 1]. Their sum is at most 1; unknown is 1 minus the sum. Kept as float32;
        a float32 array is not copied.

    Raises
    ------
    TypeError
        If `mass` is not a float array, or a masked array.
    ValueError
        If the shape does not fit `spec`, a mass is NaN or negative, or a sum of masses exceeds 1 by more than
        1e-6. Nothing is repaired: see `ogm.evidence.renormalize`.
    """

    FORMAT: ClassVar[str] = "ogm.EvidentialGrid/1"
    spec: GridSpec
    mass: NDArray[np.float32]

    def __post_init__(self) -> None:
        refuse_masked(self.mass, "mass")
        mass = np.asarray(self.mass)
        if mass.dtype.kind != "f":
            raise TypeError(f"mass must be a float array, got dtype {mass.dtype}; convert it with .astype('float32')")
        if mass.ndim != 3 or mass.shape[-1] != 2:
            raise ValueError(f"mass must have shape (nx, ny, 2) with the states free and occupied, got {mass.shape}")
        if mass.shape[:2] != self.spec.shape:
            raise ValueError(f"mass has {mass.shape[:2]} cells, but the spec has {self.spec.shape}")
        mass = mass.astype(np.float32, copy=False)
        check_mass(mass)
        object.__setattr__(self, "mass", mass)

    @classmethod
    def trusted(cls, spec: GridSpec, mass: NDArray[np.float32]) -> Self:
        """Make a grid without checks, for results of kernels that are masses by construction.

        Parameters as in the constructor; `mass` must be float32 of shape ``(*spec.shape, 2)`` and is not
        copied.
        """
        grid = object.__new__(cls)
        grid.__dict__.update(spec=spec, mass=mass)
        return grid

    def check(self) -> None:
        """Check the masses as the constructor does: for grids of `trusted` or with changed masses, before writing."""
        EvidentialGrid(self.spec, self.mass)

    @classmethod
    def vacuous(cls, spec: GridSpec) -> Self:
        """Return a grid without evidence: unknown = 1 everywhere."""
        return cls(spec, np.zeros((*spec.shape, 2), np.float32))

    @property
    def known(self) -> tuple[tuple[int, int], NDArray[np.float32]]:
        """First cell and masses, (mx, my, 2), of a rectangle that includes all known cells."""
        return (0, 0), self.mass

    @property
    def in_plane(self) -> bool:
        """Whether free is valid only in the plane of a laser: maps keep obstacles that other sensors detect outside."""
        return False

    @property
    def cause(self) -> NDArray[np.uint8] | None:
        """Codes of `ogm.UnknownCause`, (nx, ny), in grids of `ogm.models.ExplainedISM`, else None."""
        return self.__dict__.get("_cause")

    def with_cause(self, cause: NDArray[np.uint8]) -> Self:
        """Return the grid with codes of `ogm.UnknownCause`, (nx, ny)."""
        return self._with(_cause=cause)

    @property
    def meta(self) -> dict[str, str]:
        """Facts about the grid, such as the ``guarantee`` of its sensor model; kept in ``.npz`` files."""
        return dict(self.__dict__.get("_meta", {}))

    def with_meta(self, meta: Mapping[str, str]) -> Self:
        """Return the grid with facts, see `meta`."""
        return self._with(_meta=dict(meta))

    def _with(self, **attributes: Any) -> Self:
        grid = object.__new__(type(self))
        grid.__dict__.update(self.__dict__, **attributes)
        return grid

    @property
    def free(self) -> NDArray[np.float32]:
        """Mass of free, (nx, ny) in [0, 1]."""
        return self.mass[..., 0]

    @property
    def occupied(self) -> NDArray[np.float32]:
        """Mass of occupied, (nx, ny) in [0, 1]."""
        return self.mass[..., 1]

    @property
    def unknown(self) -> NDArray[np.float32]:
        """Mass of unknown, (nx, ny) in [0, 1]: 1 - free - occupied, at least 0."""
        return unknown(self.mass)

    @property
    def probability(self) -> NDArray[np.float32]:
        """Expected probability of occupied, (nx, ny) in [0, 1]: occupied + unknown / 2 (base rate 1/2)."""
        return mass_to_probability(self.mass)

    @property
    def evidence(self) -> NDArray[np.float32]:
        """Dirichlet evidence for free and occupied, (nx, ny, 2), >= 0 (prior weight 2); inf where unknown = 0."""
        return mass_to_evidence(self.mass)

    @overload
    def at(self, x: float, y: float) -> Opinion: ...
    @overload
    def at(self, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float32]: ...
    def at(self, x: ArrayLike, y: ArrayLike) -> Opinion | NDArray[np.float32]:
        """Return the opinion or masses of the cells at the given points.

        Parameters
        ----------
        x, y : float or array
            Coordinates [m], of equal shapes.

        Returns
        -------
        Opinion or (..., 2) float32
            The opinion for one point, the masses of free and occupied for an array of points.

        Raises
        ------
        ValueError
            If a point lies outside the grid.
        """
        mass = self.mass[self.spec.index(x, y)]
        return mass if mass.ndim > 1 else Opinion(*mass.tolist())

    @overload
    def opinion_at(self, points: tuple[float, float], method: Sampling = "nearest") -> Opinion: ...
    @overload
    def opinion_at(self, points: NDArray[Any], method: Sampling = "nearest") -> NDArray[np.float32]: ...
    def opinion_at(self, points: ArrayLike, method: Sampling = "nearest") -> Opinion | NDArray[np.float32]:
        """Return the opinion at any points; points outside the grid are unknown (an error in `at`).

        Parameters
        ----------
        points : (..., 2) array
            x, y [m].
        method : {"nearest", "bilinear"}
            "nearest": the masses of the cell at the point. "bilinear": bilinear interpolation between the centres of
            the four nearest cells.

        Returns
        -------
        Opinion or (..., 3) float32
            The opinion at one point (2,), the masses of free, occupied and unknown at each point of an array.

        Raises
        ------
        ValueError
            If `points` has another shape, a coordinate is not finite, or `method` is unknown.
        """

        def masses(cell: NDArray[np.float64]) -> NDArray[np.float32]:
            inside = ((cell >= 0) & (cell < self.spec.shape)).all(axis=-1, keepdims=True)
            i, j = np.moveaxis(np.where(inside, cell, 0).astype(np.intp), -1, 0)
            return np.where(inside, self.mass[i, j], np.float32(0))

        return sampled_opinions(points, self.spec.origin, self.spec.resolution, masses, method)

    def __repr__(self) -> str:
        free, occupied, unknown = (float(mass.mean()) for mass in (self.free, self.occupied, self.unknown))
        return f"EvidentialGrid({self.spec}: free {free:.1%}, occupied {occupied:.1%}, unknown {unknown:.1%})"

    def __eq__(self, other: object) -> bool:
        """Return whether both grids have the same cells and masses."""
        if not isinstance(other, EvidentialGrid):
            return NotImplemented
        return self.spec == other.spec and np.array_equal(self.mass, other.mass)

    __hash__: ClassVar[None] = None  # type: ignore[assignment]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the masses for numpy, (nx, ny, 2); copied only if `copy` or `dtype` requires it."""
        return np.array(self.mass, dtype, copy=copy)

    def arrays(self) -> dict[str, ArrayLike]:
        """Return the arrays of the file: ``mass`` (nx, ny, 2), ``states``, ``axes``, ``resolution``, ``origin`` [m]."""
        self.check()
        axes = "[ix (x forward), iy (y left), state]; origin is the corner of cell (0, 0)"
        meta = {"meta": json.dumps(dict(self.meta))} if self.meta else {}
        return {"states": ["free", "occupied"], "axes": axes, **self._place(), **meta, "mass": self.mass}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """See `SavedGrid.of_arrays`."""
        grid = cls(spec_of_arrays(arrays, arrays["mass"].shape), arrays["mass"])
        return grid.with_meta(_meta_of(arrays["meta"])) if "meta" in arrays else grid


def _meta_of(stored: NDArray[Any]) -> dict[str, str]:
    """Return the facts in a file; they are shown only, so damaged facts are left out."""
    try:
        found = json.loads(str(stored)[:_MAX_META])
    except (ValueError, RecursionError):
        return {}
    return {str(name): str(fact) for name, fact in found.items()} if isinstance(found, dict) else {}


class PartialGrid(EvidentialGrid):
    """A grid known within a rectangle only; its full array of masses is made at the first access, read-only.

    A scan of short range thus costs a map only the cells within its reach. Made by `of`.
    """

    @classmethod
    def of(cls, spec: GridSpec, corner: tuple[int, int], mass: NDArray[np.float32], *, in_plane: bool = False) -> Self:
        """Return a grid with the masses of a rectangle.

        Parameters
        ----------
        spec : GridSpec
            Cells of the whole grid.
        corner : (int, int)
            First cell of the rectangle.
        mass : (mx, my, 2) float32
            Masses of the rectangle, not checked; all other cells are unknown.
        in_plane : bool
            See `EvidentialGrid.in_plane`.
        """
        (i, j), (mx, my) = corner, mass.shape[:2]
        if not (0 <= i <= spec.shape[0] - mx and 0 <= j <= spec.shape[1] - my):
            raise ValueError(f"the rectangle of {mx} x {my} cells from {corner} on exceeds the grid {spec.shape}")
        grid = object.__new__(cls)
        grid.__dict__.update(spec=spec, _known=((i, j), mass), _in_plane=in_plane)
        return grid

    @property
    def in_plane(self) -> bool:
        """See `EvidentialGrid.in_plane`."""
        return bool(self.__dict__["_in_plane"])

    @property
    def known(self) -> tuple[tuple[int, int], NDArray[np.float32]]:
        """First cell and masses of the rectangle."""
        rectangle: tuple[tuple[int, int], NDArray[np.float32]] = self.__dict__["_known"]
        return rectangle

    @cached_property
    def mass(self) -> NDArray[np.float32]:
        """Masses of all cells, (nx, ny, 2) float32."""
        mass, ((i, j), part) = np.zeros((*self.spec.shape, 2), np.float32), self.known
        mass[i : i + part.shape[0], j : j + part.shape[1]] = part
        mass.flags.writeable = False
        return mass


Combine = Callable[[Sequence[NDArray[np.float32]]], NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class CombinedGrid(EvidentialGrid):
    """A grid combined from the masses of several models, which it keeps: maps fuse each model separately.

    Parameters
    ----------
    spec, mass
        See `EvidentialGrid`.
    parts : tuple of (nx, ny, 2) float32
        Masses of each model.
    combine : function
        Takes the masses of each model, (..., 2), to combined masses: ``combine(parts)`` is `mass`.
    """

    parts: tuple[NDArray[np.float32], ...]
    combine: Combine

    def check(self) -> None:
        """Check the combined masses and the masses of each model; see `EvidentialGrid.check`."""
        for mass in (self.mass, *self.parts):
            EvidentialGrid(self.spec, mass)

    @classmethod
    def of_parts(cls, spec: GridSpec, parts: Sequence[NDArray[np.float32]], combine: Combine) -> Self:
        """Return the grid combined from `parts`, which are not checked."""
        grid = cls.trusted(spec, combine(parts))
        grid.__dict__.update(parts=tuple(parts), combine=combine)
        return grid


@dataclass(frozen=True, eq=False)
class LayeredGrid(SavedGrid):
    """Named layers of numbers on the cells of a grid, such as conflict, velocity and height.

    Parameters
    ----------
    spec : GridSpec
    layers : mapping of str to (nx, ny) float32
        NaN in cells without a value; masked values become NaN. Converted to float32.

    Raises
    ------
    ValueError
        If a layer has another shape than `spec`.
    """

    FORMAT: ClassVar[str] = "ogm.LayeredGrid/1"
    spec: GridSpec
    layers: Mapping[str, NDArray[np.float32]]

    def __post_init__(self) -> None:
        layers = {
            name: np.ma.filled(np.ma.asarray(layer, np.float32), np.nan)
            if isinstance(layer, np.ma.MaskedArray)
            else np.asarray(layer, np.float32)
            for name, layer in self.layers.items()
        }
        for name, layer in layers.items():
            if layer.shape != self.spec.shape:
                raise ValueError(f"layer {name!r} has shape {layer.shape}, but the spec has {self.spec.shape}")
        object.__setattr__(self, "layers", layers)

    def __getitem__(self, name: str) -> NDArray[np.float32]:
        """Return a layer, (nx, ny)."""
        if name not in self.layers:
            raise KeyError(f"there is no layer {name!r}, only {', '.join(self.layers) or 'none'}")
        return self.layers[name]

    def arrays(self) -> dict[str, ArrayLike]:
        """Return the arrays of the file: ``layers`` (L, nx, ny), ``names``, ``axes``, ``resolution`` and ``origin``."""
        layers = np.array([*self.layers.values()], np.float32).reshape(len(self.layers), *self.spec.shape)
        if layers.nbytes > current_limits().grid:  # readers would refuse the file
            raise too_large("the layers", layers.nbytes, "grid")
        axes = "[layer, ix (x forward), iy (y left)]; origin is the corner of cell (0, 0)"
        return {"names": np.array([*self.layers], np.str_), "axes": axes, **self._place(), "layers": layers}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """See `SavedGrid.of_arrays`."""
        spec = spec_of_arrays(arrays, arrays["layers"].shape[1:])
        return cls(spec, dict(zip(arrays["names"].tolist(), arrays["layers"], strict=True)))

    def __eq__(self, other: object) -> bool:
        """Return whether both have the same cells and layers; NaN equals NaN."""
        if not isinstance(other, LayeredGrid):
            return NotImplemented
        same = self.spec == other.spec and self.layers.keys() == other.layers.keys()
        return same and all(np.array_equal(layer, other[name], equal_nan=True) for name, layer in self.layers.items())

    __hash__: ClassVar[None] = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"LayeredGrid({self.spec}: {', '.join(self.layers)})"
