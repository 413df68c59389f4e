"""Exported networks, run without torch."""

import hashlib
import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.network_grid import check_resolution, check_sides, sensor_coords
from ogm.deep.onnx_file import read_onnx
from ogm.deep.points import Rectangle, SortedPoints, pillar_maxima, sort_points
from ogm.deep.runtimes import Inputs, default_threads, open_onnxruntime, open_openvino
from ogm.grid import GridSpec
from ogm.storage.files import OgmError

_INPUTS = ({"feature_map"}, {"feature_map", "sensor_coords"})  # of a network without and with bearings


class OnnxEngine:
    """Exported network on a grid, run by ONNX Runtime or OpenVINO.

    Parameters
    ----------
    path : path
        File of `ogm.deep.export.export_onnx`.
    runtime : "onnxruntime" or "openvino"
        Package that runs the network.
    precision : "float32" or "bfloat16"
        Number format of the convolutions of a network that was exported in float32. bfloat16 needs OpenVINO.
    threads : int, optional
        Number of threads for one scan. By default `ogm.deep.runtimes.default_threads`.

    Attributes
    ----------
    spec : GridSpec
        Grid around the sensor, initially the grid of the training.
    rays : bool
        Whether the network takes the masses of `ogm.geometric.RayISM` as input.
    precision : "float32" or "int8"
        Number format in which the network was exported.
    description : dict
        Description of the weights.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged or of another kind.
    ValueError
        If the runtime does not support the precision.
    ImportError
        If the runtime is not installed; the message holds the pip command to install it.

    Notes
    -----
    Engines are thread-safe and pickled by path. The same scan gives the same result bit by bit, on the same machine
    with the same number of threads.
    """

    description: dict[str, Any]
    precision: str
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
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision must be float32 or bfloat16, got {precision!r}")
        if runtime == "onnxruntime" and precision != "float32":
            raise ValueError(f"ONNX Runtime computes in float32, got {precision!r}: use the engine openvino or torch")
        threads = default_threads() if threads is None else threads
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._file = file = read_onnx(path)
        self.description, self.rays, self.spec, self.precision = file.description, file.rays, file.spec, file.precision
        check_sides(self.spec, file.multiple)
        self._path, self._sha256 = os.fspath(path), hashlib.sha256(file.data).hexdigest()
        self._arguments = os.path.abspath(path), runtime, precision, threads
        try:
            if runtime == "openvino":
                self._session, self._names = open_openvino(file.data, precision, threads)
            else:
                self._session, self._names = open_onnxruntime(file.data, threads)
        except ImportError:
            raise
        except Exception as error:  # the runtimes' errors have no common class
            raise OgmError(f"{path} cannot be run by {runtime}: {error}") from error
        if self._names not in _INPUTS:
            wanted = ", or ".join(" and ".join(sorted(names)) for names in _INPUTS)
            raise OgmError(f"{path} takes {' and '.join(sorted(self._names))}, wanted {wanted}")

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
        return _reopened, (*self._arguments, self.spec)

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

    def _run(self, inputs: Inputs, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return the output of the network; raise OgmError if it has another shape or type."""
        try:
            result = self._session(inputs)
        except Exception as error:  # the runtimes' errors have no common class
            raise OgmError(f"{self._path} does not accept the input that it describes: {error}") from error
        if result.shape != shape or result.dtype != np.float32:
            raise OgmError(f"{self._path} gives {result.dtype} {result.shape}, wanted float32 {shape}")
        return result

    def __repr__(self) -> str:
        _, runtime, computed, _ = self._arguments
        precision = computed if self.precision == "float32" else self.precision
        return f"{type(self).__name__}({self._sha256[:16]}, {runtime}, {precision})"


@lru_cache(8)
def _coords(spec: GridSpec) -> NDArray[np.float32]:
    return np.ascontiguousarray(sensor_coords(spec))


def _reopened(path: str, runtime: str, precision: str, threads: int, spec: GridSpec) -> OnnxEngine:
    """Return an unpickled engine on a grid."""
    return _opened(path, runtime, precision, threads).on(spec)


@lru_cache(4)
def _opened(path: str, runtime: str, precision: str, threads: int) -> OnnxEngine:
    """Return the engine of a file; each process opens it once."""
    return OnnxEngine(path, runtime=runtime, precision=precision, threads=threads)
