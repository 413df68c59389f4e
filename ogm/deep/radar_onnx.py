"""Exported radar networks, run without torch."""

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
    """Exported radar network, ready to run; for parameters see `ogm.deep.exported.ExportedNetwork`.

    Attributes
    ----------
    polar : RadarGrid
        Polar grid of the network.
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
                raise ValueError("its channels differ from the channels of this version")
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise OgmError(f"{path} describes no valid radar network: {error!r}; export the weights again") from error
        return data

    def evidence(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return evidence for free and occupied (2, ranges, azimuths) from features (channels, ranges, azimuths)."""
        return self._run({"features": features[None]}, (2, *self.polar.shape))
