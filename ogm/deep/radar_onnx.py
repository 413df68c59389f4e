"""An exported network of radars, ready to run without torch."""

import json
import os

import numpy as np
from numpy.typing import NDArray

from ogm.deep.exported import ExportedNetwork
from ogm.deep.onnx_file import read_metadata
from ogm.deep.polar import CHANNELS, RadarGrid
from ogm.storage.files import OgmError

FORMAT = "ogm.radar.onnx/1"


class RadarOnnxEngine(ExportedNetwork):
    """An exported network of radars that is ready to run; see `ogm.deep.exported.ExportedNetwork`.

    Attributes
    ----------
    polar : RadarGrid
    """

    inputs = ({"features"},)
    output = "evidence"
    polar: RadarGrid

    def _read(self, path: str | os.PathLike[str]) -> bytes:
        data, metadata = read_metadata(path, FORMAT)
        try:
            self.description = json.loads(metadata["description"])
            place = self.description["spec"]
            self.polar = RadarGrid(tuple(place["shape"]), float(place["range_step"]), float(place["azimuth_step"]))
            if json.loads(metadata["channels"]) != list(CHANNELS):
                raise ValueError("its channels are others than those of this version")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise OgmError(f"{path} describes no network of radar that can be run: {error!r}") from error
        return data

    def evidence(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return evidence (2, ranges, azimuths) of free and occupied from features (channels, ranges, azimuths)."""
        return self._run({"features": features[None]}, (2, *self.polar.shape))
