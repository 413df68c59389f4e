"""A grid and its place in the frame of a file: what map files hold besides the cells."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.messages.grids import AnyGrid, check_grid, evidential, grid_from_layers, split_corner
from ogm.pose import check_pose, check_stamp, pose

_MAX_TILT = 1e-3  # [rad] within which a frame counts as level: at 100 m the projected cells are off by 0.05 mm
_NO_TURN = 1e-9  # [rad]


class Corner(NamedTuple):
    """Place of a grid on the plane: the outer corner of cell (0, 0), and the direction of x.

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
    """A grid in a frame, as map files hold it.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
        Velocities are along the grid's own axes, also where it is turned in the frame.
    T_frame_grid : (4, 4) array
        Takes the coordinates of ``grid.spec`` to the frame [m]. By default they are those of the frame.
    frame_id : str
        Name of the frame, for messages.
    stamp : float, optional
        Time of the grid [s].
    crs : str, optional
        Coordinate reference system of the frame, for GeoTIFF, NetCDF and Zarr: ``"EPSG:25832"``, or WKT. Projected, in
        metres.

    Raises
    ------
    TypeError
        If the grid holds no masses.
    ValueError
        If its numbers are no masses, the transform is not rigid, or the stamp not finite.
    """

    grid: AnyGrid
    T_frame_grid: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    frame_id: str = "map"
    stamp: float | None = None
    crs: str | None = None

    def __post_init__(self) -> None:
        check_grid(self.grid)
        object.__setattr__(self, "T_frame_grid", check_pose(self.T_frame_grid, "T_frame_grid"))
        if self.stamp is not None:
            object.__setattr__(self, "stamp", check_stamp(self.stamp))

    @property
    def corner(self) -> Corner:
        """Where the outer corner of cell (0, 0) lies, and where x points; height is left out.

        Raises
        ------
        ValueError
            If the grid is tilted in its frame, which no map file can hold.
        """
        T, (x, y) = self.T_frame_grid, self.grid.spec.origin
        if math.hypot(T[2, 0], T[2, 1]) > _MAX_TILT or T[2, 2] < 0:
            tilt = math.degrees(math.acos(min(max(T[2, 2], -1), 1)))
            raise ValueError(
                f"the grid is tilted by {tilt:.3g} degrees in frame {self.frame_id!r}; a map file holds a turn about "
                "the vertical alone: give a T_frame_grid without roll and pitch"
            )
        yaw = math.atan2(T[1, 0], T[0, 0])
        corner = T[:2, :2] @ (x, y) + T[:2, 3]
        return Corner(float(corner[0]), float(corner[1]), 0.0 if abs(yaw) < _NO_TURN else yaw)

    @property
    def evidential(self) -> EvidentialGrid:
        """The masses of free and occupied alone, in the grid's own coordinates."""
        return evidential(self.grid)

    @property
    def upright(self) -> AnyGrid:
        """The grid with the frame's own coordinates: its origin is moved.

        Raises
        ------
        ValueError
            If it is turned or tilted in the frame.
        """
        corner = self.corner
        if corner.yaw:
            raise ValueError(
                f"the grid is turned by {math.degrees(corner.yaw):.6g} degrees in frame {self.frame_id!r}, which cells "
                "along x and y cannot hold: write .yaml, .tif or .nc and read it by ogm.io.read_placed_grid, or "
                "resample it (ogm.fusion.warp)"
            )
        if not self.T_frame_grid[:2, 3].any():
            return self.grid
        spec = replace(self.grid.spec, origin=(corner.x, corner.y))
        if isinstance(self.grid, DynamicGrid):
            return replace(self.grid, spec=spec)
        return EvidentialGrid.trusted(spec, self.grid.mass)


def placed_at(layers: Mapping[str, NDArray[np.float32]], resolution: float, corner: Corner, **facts: Any) -> PlacedGrid:
    """Return the grid of a file.

    Parameters
    ----------
    layers : mapping of str to (nx, ny) float array
        See `ogm.io.messages.grids.grid_from_layers`.
    resolution : float
        [m]
    corner : Corner
        Its place becomes the origin of the grid, its yaw `T_frame_grid`.
    **facts
        Further attributes of `PlacedGrid`.
    """
    if not np.isfinite(corner).all():
        raise ValueError(f"origin must be finite numbers (x, y, yaw) [m, rad], got {tuple(corner)}")
    origin, T = split_corner(pose(corner.x, corner.y, yaw=corner.yaw))
    spec = GridSpec(resolution, next(iter(layers.values())).shape, origin)
    return PlacedGrid(grid_from_layers(LayeredGrid(spec, layers)), T, **facts)


def nanometres(metres: float) -> float:
    """Round a length that was computed from others, so that 0.30000000000000004 m is 0.3 m again."""
    return round(metres, 9)
