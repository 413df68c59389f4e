"""An exported network of radars, ready to run without torch."""

import json
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.deep.onnx_file import read_metadata
from ogm.deep.onnx_session import OnnxSession, reopened
from ogm.deep.polar import CHANNELS, RadarGrid
from ogm.storage.files import OgmError

__all__ = ["FORMAT", "RadarOnnxEngine"]

FORMAT = "ogm.radar.onnx/1"


class RadarOnnxEngine:
    """An exported network of radars that is ready to run.

    Parameters
    ----------
    path : path
        File that `ogm.deep.export.export_onnx` wrote.
    runtime, precision, threads
        See `ogm.deep.onnx_session.OnnxSession`.

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

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        runtime: str = "onnxruntime",
        precision: str = "float32",
        threads: int | None = None,
    ) -> None:
        data, metadata = read_metadata(path, FORMAT)
        try:
            self.description: dict[str, Any] = json.loads(metadata["description"])
            place = self.description["spec"]
            self.polar = RadarGrid(tuple(place["shape"]), float(place["range_step"]), float(place["azimuth_step"]))
            if json.loads(metadata["channels"]) != list(CHANNELS):
                raise ValueError("its channels are others than those of this version")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise OgmError(f"{path} describes no network of radar that can be run: {error!r}") from error
        session = OnnxSession(path, data, "evidence", runtime=runtime, precision=precision, threads=threads)
        if session.inputs != {"features"}:
            raise OgmError(f"{path} takes {sorted(session.inputs)}, wanted features")
        self._session = session

    def __repr__(self) -> str:
        return f"RadarOnnxEngine({self._session.sha256[:16]})"

    def __reduce__(self) -> tuple[Any, ...]:
        return reopened, (RadarOnnxEngine, *self._session.arguments)

    def evidence(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return evidence (2, ranges, azimuths) of free and occupied from features (channels, ranges, azimuths)."""
        return self._session.run({"features": features[None]}, (2, *self.polar.shape))
