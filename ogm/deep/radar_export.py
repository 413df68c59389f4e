"""A network of radar as one ONNX file, from polar features to evidence, for use without torch.

`ogm.deep.radar_onnx.RadarOnnxEngine` runs it. Its metadata hold ``format``, ``channels`` (JSON: names of the features,
see `ogm.deep.polar.polar_features`), ``description`` (JSON of the weights: spec, network, recipe, data), ``weights``
(their SHA-256), ``features`` and ``evidence`` (what the arrays are), and ``sha256`` of all bytes before it.
"""

import copy
import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.functional import pixel_shuffle

from ogm.deep.description import FORMAT as DESCRIPTION_FORMAT
from ogm.deep.export import softplus_of_parts, traced, write_model
from ogm.deep.folding import fold_norms
from ogm.deep.onnx_file import weights_sum
from ogm.deep.polar import CHANNELS, RadarGrid
from ogm.deep.radar_network import RadarNetwork
from ogm.deep.radar_onnx import FORMAT

__all__ = ["TorchRadarEngine", "export_radar_onnx"]


class TorchRadarEngine:
    """A network of radar run by torch: for weights that were not exported, and for comparison.

    Parameters
    ----------
    network : RadarNetwork
    description : mapping, optional
        Of the weights.

    Attributes
    ----------
    polar : RadarGrid
    description : dict
    """

    polar: RadarGrid
    description: dict[str, Any]
    network: RadarNetwork

    def __init__(self, network: RadarNetwork, description: Mapping[str, Any] | None = None) -> None:
        self.polar, self.description, self.network = network.spec, dict(description or {}), folded(network)

    @torch.inference_mode()
    def evidence(self, features: Any) -> Any:
        """Return evidence (2, ranges, azimuths) of free and occupied from features (channels, ranges, azimuths)."""
        return self.network.evidence(torch.from_numpy(features)[None])[0].contiguous().numpy()


def folded(network: RadarNetwork) -> RadarNetwork:
    """Return a copy for inference: normalisation folded into the convolutions before it."""
    result = copy.deepcopy(network).eval().cpu()
    fold_norms(result)
    return result


def export_radar_onnx(
    network: RadarNetwork,
    path: str | os.PathLike[str],
    *,
    description: Mapping[str, Any] | None = None,
    weights: str | os.PathLike[str] | None = None,
) -> int:
    """Write a network of radar as ONNX, and return the size of the file [bytes].

    Parameters
    ----------
    network : RadarNetwork
        As `ogm.deep.checkpoint.load_radar_network` returns it.
    path : path
        Of the file, ending in ``.onnx``; it appears when it is whole.
    description : mapping, optional
        Of the weights.
    weights : path, optional
        The file that the network was loaded from, whose checksum is noted.

    Raises
    ------
    ValueError
        If `path` does not end in ``.onnx``.
    ImportError
        If the packages for the export are absent.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"an ONNX file is named .onnx, got {path}")
    facts = {"format": DESCRIPTION_FORMAT, **(description or {})}
    facts |= {"network": asdict(network.config), "spec": asdict(network.spec)}
    facts.pop("sha256", None)  # of the files of weights
    metadata = {
        "format": FORMAT,
        "channels": json.dumps(CHANNELS),
        "description": json.dumps(facts),
        "weights": weights_sum(weights) if weights is not None else "",
        "features": "[0, channel, range, azimuth]: see ogm.deep.polar.polar_features.",
        "evidence": "[state, range, azimuth]: free, then occupied. Mass is evidence / (free + occupied + 2).",
    }
    inputs = {"features": torch.zeros(1, len(CHANNELS), *network.spec.shape)}
    about = "One sweep of a radar to evidence on its polar grid."
    return write_model(path, lambda: traced(_Evidence(network).eval(), inputs, "evidence", None, metadata, about))


class _Evidence(nn.Module):
    """From features to evidence, of operations that ONNX has."""

    def __init__(self, network: RadarNetwork) -> None:
        super().__init__()
        self.network = folded(network)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return pixel_shuffle(softplus_of_parts(self.network.quarters(features)), 2)[0]
