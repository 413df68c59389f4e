"""Exported lidar networks, run without torch."""

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.exported import ExportedNetwork
from ogm.deep.network_grid import check_resolution, check_sides, sensor_coords
from ogm.deep.onnx_file import read_onnx
from ogm.deep.points import Rectangle, SortedPoints, pillar_maxima, sort_points
from ogm.grid import GridSpec


class OnnxEngine(ExportedNetwork):
    """Exported lidar network on a grid, ready to run; for parameters see `ogm.deep.exported.ExportedNetwork`.

    Attributes
    ----------
    spec : GridSpec
        Grid around the sensor, initially the grid of the training.
    rays : bool
        Whether the network takes the masses of `ogm.geometric.RayISM` as input.
    precision : "float32" or "int8"
        Number format in which the network was exported.
    """

    inputs = ({"feature_map"}, {"feature_map", "sensor_coords"})
    output = "mass"
    rays: bool
    spec: GridSpec

    def _read(self, path: str | os.PathLike[str]) -> bytes:
        self._file = file = read_onnx(path)
        self.description, self.rays, self.spec, self.precision = file.description, file.rays, file.spec, file.precision
        check_sides(self.spec, file.multiple)
        return file.data

    def on(self, spec: GridSpec) -> Self:
        """Return the same network for another grid of the same resolution.

        Raises
        ------
        ValueError
            If the resolution differs, or a side of the grid is no multiple of the network's stride.
        """
        check_resolution(spec, self.spec)
        check_sides(spec, self._file.multiple)
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)  # shares the session
        other.spec = spec
        return other

    def __reduce__(self) -> tuple[Any, ...]:
        return _on_grid, (super().__reduce__(), self.spec)

    def pillars(
        self, points: NDArray[np.float32], ego_footprint: Rectangle, T: NDArray[np.floating[Any]]
    ) -> SortedPoints:
        """Sort the points of a scan into the pillars of the grid; see `ogm.deep.points.sort_points`."""
        return sort_points(points, self.spec, self._file.z_range, ego_footprint, T)

    def masses(
        self, scans: Sequence[SortedPoints], rays: Sequence[NDArray[np.float32]] | None = None
    ) -> NDArray[np.float32]:
        """Return belief masses for free and occupied, (scans, nx, ny, 2).

        Parameters
        ----------
        scans : sequence of SortedPoints
            Results of `pillars`.
        rays : sequence of (nx, ny, 2) float32 arrays, optional
            Masses of `ogm.geometric.RayISM` for each scan, if the network takes them.

        Raises
        ------
        OgmError
            If the network in the file has an output of another shape or type.
        """
        return np.stack([self._one(scan, None if rays is None else rays[k]) for k, scan in enumerate(scans)])

    def _one(self, scan: SortedPoints, rays: NDArray[np.float32] | None) -> NDArray[np.float32]:
        file = self._file
        channels = len(file.bias) + 2 * file.rays
        feature_map = pillar_maxima(scan, file.weight, file.bias, self.spec.shape, channels)
        if file.rays:
            feature_map[0, ..., -2:] = rays
        inputs = {"feature_map": feature_map}
        if "sensor_coords" in self._names:
            inputs["sensor_coords"] = _coords(self.spec)
        return self._run(inputs, (*self.spec.shape, 2))


@lru_cache(8)
def _coords(spec: GridSpec) -> NDArray[np.float32]:
    return np.ascontiguousarray(sensor_coords(spec))


def _on_grid(reopen: tuple[Any, ...], spec: GridSpec) -> OnnxEngine:
    """Return an unpickled engine."""
    function, arguments = reopen
    engine: OnnxEngine = function(*arguments)
    return engine.on(spec)
