"""An exported network of lidars, ready to run without torch."""

import os
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.network_grid import check_resolution, check_sides, sensor_coords
from ogm.deep.onnx_file import read_onnx
from ogm.deep.onnx_session import OnnxSession, reopened
from ogm.deep.points import Rectangle, SortedPoints, pillar_maxima, sort_points
from ogm.grid import GridSpec
from ogm.storage.files import OgmError

__all__ = ["OnnxEngine"]


class OnnxEngine:
    """An exported network that is ready to run, on one grid.

    Parameters
    ----------
    path : path
        Of a file that `ogm.deep.export.export_onnx` wrote.
    runtime, precision, threads
        See `ogm.deep.onnx_session.OnnxSession`.

    Attributes
    ----------
    spec : GridSpec
        The grid around the sensor; at first that of the training.
    rays : bool
        Whether the network takes the masses of `ogm.geometric.RayISM` too.
    description : dict
        Of the weights.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged or of another kind.
    ValueError
        If the runtime lacks the precision.
    ImportError
        If the runtime is not installed; the message holds the pip command that adds it.

    Notes
    -----
    Threads may share an engine. The same scan gives the same masses, bit by bit, on the same machine with the same
    number of threads.
    """

    description: dict[str, Any]
    rays: bool
    spec: GridSpec

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        runtime: str = "onnxruntime",
        precision: str = "float32",
        threads: int | None = None,
    ) -> None:
        self._file = file = read_onnx(path)
        session = OnnxSession(path, file.data, "mass", runtime=runtime, precision=precision, threads=threads)
        if session.inputs not in ({"feature_map"}, {"feature_map", "sensor_coords"}):
            names = sorted(session.inputs)
            raise OgmError(f"{path} takes {names}, wanted feature_map and, for some networks, sensor_coords")
        self._session = session
        self.description, self.rays = file.description, file.rays
        self.spec = file.spec
        check_sides(self.spec, file.multiple)
        self._coords = self._fixed_inputs()

    def on(self, spec: GridSpec) -> Self:
        """Return the same network for another grid of the same resolution.

        Raises
        ------
        ValueError
            If the resolution differs, or the cells cannot be halved as often as the network does.
        """
        check_resolution(spec, self.spec)
        check_sides(spec, self._file.multiple)
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)  # shares the session
        other.spec = spec
        other._coords = other._fixed_inputs()
        return other

    def __repr__(self) -> str:
        return f"OnnxEngine({self._session.sha256[:16]}, {', '.join(self._session.arguments[1:3])})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopened_on, (self._session.arguments, self.spec)

    def pillars(
        self, points: NDArray[np.float32], ego_footprint: Rectangle, T: NDArray[np.floating[Any]]
    ) -> SortedPoints:
        """Sort the points of a scan into the pillars of the grid; see `ogm.deep.points.sort_points`."""
        return sort_points(points, self.spec, self._file.z_range, ego_footprint, T)

    def masses(
        self, scans: Sequence[SortedPoints], rays: Sequence[NDArray[np.float32]] | None = None
    ) -> NDArray[np.float32]:
        """Return belief masses (scans, nx, ny, 2): free, occupied.

        Parameters
        ----------
        scans : sequence of SortedPoints
        rays : sequence of (nx, ny, 2) float32 arrays, optional
            Of each scan the masses of `ogm.geometric.RayISM`, if the network takes them.

        Raises
        ------
        OgmError
            If the network in the file gives something else.
        """
        return np.stack([self._one(scan, None if rays is None else rays[k]) for k, scan in enumerate(scans)])

    def _one(self, scan: SortedPoints, rays: NDArray[np.float32] | None) -> NDArray[np.float32]:
        file = self._file
        channels = len(file.bias) + 2 * file.rays
        feature_map = pillar_maxima(scan, file.weight, file.bias, self.spec.shape, channels)
        if file.rays:
            feature_map[0, ..., -2:] = rays
        return self._session.run({"feature_map": feature_map, **self._coords}, (*self.spec.shape, 2))

    def _fixed_inputs(self) -> dict[str, NDArray[np.float32]]:
        if "sensor_coords" not in self._session.inputs:
            return {}
        return {"sensor_coords": np.ascontiguousarray(sensor_coords(self.spec))}


def _reopened_on(arguments: tuple[str, str, str, int], spec: GridSpec) -> OnnxEngine:
    engine: OnnxEngine = reopened(OnnxEngine, *arguments)
    return engine.on(spec)
