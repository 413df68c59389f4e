"""An exported network of radar, run by ONNX Runtime: inference without torch."""

import hashlib
import json
import os
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.deep.onnx_engine import default_threads, onnxruntime_session
from ogm.deep.onnx_file import read_metadata
from ogm.deep.polar import CHANNELS, RadarGrid
from ogm.storage.files import OgmError

__all__ = ["FORMAT", "RadarOnnxEngine"]

FORMAT = "ogm.radar.onnx/1"


class RadarOnnxEngine:
    """An exported network of radar that is ready to run.

    Parameters
    ----------
    path : path
        Of a file that `ogm.deep.radar_export.export_radar_onnx` wrote.
    threads : int, optional
        By default `ogm.deep.onnx_engine.default_threads`.

    Attributes
    ----------
    polar : RadarGrid
    description : dict
        Of the weights.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged or of another kind.
    ImportError
        If ONNX Runtime is not installed; the message holds the pip command that adds it.
    """

    polar: RadarGrid

    def __init__(self, path: str | os.PathLike[str], *, threads: int | None = None) -> None:
        threads = default_threads() if threads is None else threads
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._path, self._threads = os.path.abspath(path), threads
        data, metadata = read_metadata(path, FORMAT)
        self.sha256 = hashlib.sha256(data).hexdigest()
        try:
            self.description: dict[str, Any] = json.loads(metadata["description"])
            place = self.description["spec"]
            self.polar = RadarGrid(tuple(place["shape"]), float(place["range_step"]), float(place["azimuth_step"]))
            if json.loads(metadata["channels"]) != list(CHANNELS):
                raise ValueError("its channels are others than those of this version")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise OgmError(f"{path} describes no network of radar that can be run: {error!r}") from error
        try:
            self._session, names = onnxruntime_session(data, threads, "evidence")
        except ImportError:
            raise
        except Exception as error:  # those of the runtime have no other parent
            raise OgmError(f"{path} cannot be run by onnxruntime: {error}") from error
        if names != {"features"}:
            raise OgmError(f"{path} takes {sorted(names)}, wanted features")

    def __repr__(self) -> str:
        return f"RadarOnnxEngine({self.sha256[:16]})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _opened, (self._path, self._threads)

    def evidence(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return evidence (2, ranges, azimuths) of free and occupied from features (channels, ranges, azimuths)."""
        try:
            result = self._session({"features": features[None]})
        except Exception as error:  # those of the runtime have no other parent
            raise OgmError(f"{self._path} does not fit the input that it describes: {error}") from error
        if result.shape != (2, *self.polar.shape) or result.dtype != np.float32:
            raise OgmError(f"{self._path} gives {result.dtype} {result.shape} on a polar grid of {self.polar.shape}")
        return result


@lru_cache(2)
def _opened(path: str, threads: int) -> RadarOnnxEngine:
    return RadarOnnxEngine(path, threads=threads)
