"""A grid with its pose in the frame of a file, as stored by map files."""

import math
import re
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.io.messages.grids import AnyGrid, bands_of, check_grid, check_names, evidential, grid_from_bands, split_corner
from ogm.pose import check_pose, check_stamp, pose

_MAX_TILT = 1e-3  # [rad] within which a frame counts as level: at 100 m the projected cells are off by 0.05 mm
_NO_TURN = 1e-9  # [rad]
MODEL_LAYER = re.compile(r"(model[0-9]+|plane|rest)_\w+")  # of one map of `ogm.fusion.EvidentialMapper.layers`


class Corner(NamedTuple):
    """Pose of a grid on the plane: the outer corner of cell (0, 0), and the direction of x.

    Attributes
    ----------
    x, y : float
        [m]
    yaw : float
        [rad]
    """

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, eq=False)
class PlacedGrid:
    """A grid in a frame, as stored by map files.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid or LayeredGrid
        Velocities are along the grid's own axes, also for a rotated grid.
    T_frame_grid : (4, 4) array
        Transform from the coordinates of ``grid.spec`` to the frame [m]. Default: identity.
    frame_id : str
        Name of the frame, for messages.
    stamp : float, optional
        Time of the grid [s].
    crs : str, optional
        Coordinate reference system of the frame, for GeoTIFF, NetCDF and Zarr: ``"EPSG:25832"``, or WKT. Projected, in
        metres.
    layers : LayeredGrid, optional
        Further layers on the cells of `grid`, such as conflict.

    Raises
    ------
    TypeError
        If `grid` is no grid.
    ValueError
        If its numbers are no masses, the transform is not rigid, the stamp not finite, or the layers have other cells
        or names used by the grid.
    """

    grid: AnyGrid
    T_frame_grid: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    frame_id: str = "map"
    stamp: float | None = None
    crs: str | None = None
    layers: LayeredGrid | None = None

    def __post_init__(self) -> None:
        check_grid(self.grid)
        check_names(self.grid, self.layers)
        object.__setattr__(self, "T_frame_grid", check_pose(self.T_frame_grid, "T_frame_grid"))
        if self.stamp is not None:
            object.__setattr__(self, "stamp", check_stamp(self.stamp))

    @property
    def corner(self) -> Corner:
        """Outer corner of cell (0, 0) and direction of x in the frame; the height is ignored.

        Raises
        ------
        ValueError
            If the grid is tilted in its frame, which no map file can store.
        """
        T, (x, y) = self.T_frame_grid, self.grid.spec.origin
        if math.hypot(T[2, 0], T[2, 1]) > _MAX_TILT or T[2, 2] < 0:
            tilt = math.degrees(math.acos(min(max(T[2, 2], -1), 1)))
            got = f"the grid is tilted by {tilt:.3g} degrees in frame {self.frame_id!r}"
            wanted = "a rotation about the vertical: give a T_frame_grid without roll and pitch"
            raise ValueError(f"{got}; a map file stores only {wanted}")
        yaw = math.atan2(T[1, 0], T[0, 0])
        corner = T[:2, :2] @ (x, y) + T[:2, 3]
        return Corner(float(corner[0]), float(corner[1]), 0.0 if abs(yaw) < _NO_TURN else yaw)

    @classmethod
    def of(cls, grid: "AnyGrid | PlacedGrid") -> "PlacedGrid":
        """Return a placed grid unchanged, and any other grid with its own coordinates as the frame."""
        return grid if isinstance(grid, PlacedGrid) else cls(grid)

    @classmethod
    def of_bands(cls, bands: LayeredGrid, *place: Any, **facts: Any) -> Self:
        """Return the grid and further layers of named bands, see `grid_from_bands`, with further attributes."""
        grid, layers = grid_from_bands(bands)
        return cls(grid, *place, **facts | {"layers": layers})

    def without_models(self) -> "PlacedGrid":
        """Return the grid without the layers of single models of a map."""
        named = {} if self.layers is None else self.layers.layers
        rest = {name: layer for name, layer in named.items() if not MODEL_LAYER.fullmatch(name)}
        return replace(self, layers=LayeredGrid(self.grid.spec, rest) if rest else None)

    @property
    def bands(self) -> LayeredGrid:
        """All cell values as named bands, see `ogm.io.messages.grids.bands_of`."""
        return bands_of(self.grid, self.layers)

    @property
    def evidential(self) -> EvidentialGrid:
        """The masses of free and occupied, in the grid's own coordinates; ValueError without masses."""
        return evidential(self.grid)

    @property
    def upright(self) -> "PlacedGrid":
        """The grid in the frame's own coordinates: origins are moved, and `T_frame_grid` keeps only the height.

        Raises
        ------
        ValueError
            If it is rotated or tilted in the frame.
        """
        corner = self.corner
        if corner.yaw:
            raise ValueError(
                f"the grid is rotated by {math.degrees(corner.yaw):.6g} degrees in frame {self.frame_id!r}, which "
                "cells along x and y cannot hold: write .yaml, .tif or .nc and read it by ogm.io.read_placed_grid, or "
                "resample it (ogm.fusion.warp)"
            )
        if not self.T_frame_grid[:2, 3].any():
            return self
        spec = replace(self.grid.spec, origin=(corner.x, corner.y))
        grid, layers = self.grid, self.layers and replace(self.layers, spec=spec)
        moved = (
            EvidentialGrid.trusted(spec, grid.mass).with_meta(grid.meta)
            if isinstance(grid, EvidentialGrid)
            else replace(grid, spec=spec)
        )
        return replace(self, grid=moved, layers=layers, T_frame_grid=pose(z=float(self.T_frame_grid[2, 3])))


def placed_at(bands: LayeredGrid, yaw: float, **facts: Any) -> PlacedGrid:
    """Return the grid of a file with cells rotated around their corner.

    Parameters
    ----------
    bands : LayeredGrid
        Bands; the origin is the position of the corner in the frame [m].
    yaw : float
        Direction of x in the frame [rad].
    **facts
        Further attributes of `PlacedGrid`.
    """
    if not math.isfinite(yaw):
        raise ValueError(f"origin must be finite numbers (x, y, yaw) [m, rad], got {yaw}")
    origin, T = split_corner(pose(*bands.spec.origin, yaw=yaw))
    return PlacedGrid.of_bands(replace(bands, spec=replace(bands.spec, origin=origin)), T, **facts)


def nanometres(metres: float) -> float:
    """Round a computed length, so that 0.30000000000000004 m becomes 0.3 m."""
    return round(metres, 9)
