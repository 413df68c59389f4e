"""A network as one ONNX file, from the feature map to belief masses, for use without torch.

`ogm.deep.onnx_engine.OnnxEngine` runs it, and so does whatever else runs ONNX. The file holds the network with its
normalisation folded in, for one scan at a time and any grid whose sides are multiples of ``multiple`` cells. What comes
before it, a linear layer and a maximum over the points of a pillar, is in its metadata::

    feature_map[0, ix, iy, c] = max over the points of the cell of max(0, features @ weight[:, c] + bias[c])

The metadata describes every array: ``format``, ``input`` (JSON: weight, bias, rays, z_range, multiple),
``description`` (JSON of the weights: spec, network, recipe, ...), ``weights`` (their SHA-256), ``features``,
``feature_map``, ``sensor_coords`` and ``mass``; the last entry, ``sha256``, is that of all bytes before it.

>>> from ogm.deep.checkpoint import load_network
>>> from ogm.deep.export import export_onnx
>>> network, description = load_network("runs/lite/best.safetensors")       # doctest: +SKIP
>>> export_onnx(network, "lite.onnx", description=description)              # doctest: +SKIP
"""

import importlib
import json
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import nn
from torch.nn.functional import pixel_shuffle

from ogm.deep.description import FORMAT as DESCRIPTION_FORMAT
from ogm.deep.folding import fused
from ogm.deep.network import PillarNetwork
from ogm.deep.onnx_file import FORMAT, OPERATIONS, sealed, weights_sum
from ogm.deep.points import FEATURES
from ogm.storage.files import atomic_write

__all__ = ["export_onnx", "softplus_of_parts", "traced", "write_model"]

_OPSET = 18
_PIP = 'pip install "ogm-toolkit[train]"'


def export_onnx(
    network: PillarNetwork,
    path: str | os.PathLike[str],
    *,
    description: Mapping[str, Any] | None = None,
    weights: str | os.PathLike[str] | None = None,
) -> dict[str, str]:
    """Write a network as ONNX.

    Parameters
    ----------
    network : PillarNetwork
        As `ogm.deep.checkpoint.load_network` returns it.
    path : path
        Of the file, ending in ``.onnx``; it appears when it is whole.
    description : mapping, optional
        Of the weights; `ogm.deep.DeepISM` needs its entry ``seen`` to notice scans unlike the training data.
    weights : path, optional
        The file that the network was loaded from. Its checksum is noted, by which old exports of a run are recognised.

    Returns
    -------
    dict
        Names and values that describe the file, to be printed.

    Raises
    ------
    ValueError
        If `path` does not end in ``.onnx``, or the network went through `ogm.deep.folding.fused` before.
    ImportError
        If the packages for the export are absent; the message holds the pip command that adds them.

    Notes
    -----
    The same weights give the same bytes with the same versions of torch, onnx and onnxscript. The softplus of the head
    is written as ``max(x, 0) + ln(1 + exp(-|x|))``, whose parts the runtimes have vectorised.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"an ONNX file is named .onnx, got {path}")
    facts = {"format": DESCRIPTION_FORMAT, **(description or {})}
    facts |= {"network": asdict(network.config), "spec": asdict(network.spec)}
    facts.pop("sha256", None)  # of the files of weights
    metadata = {"description": json.dumps(facts), "weights": weights_sum(weights) if weights is not None else ""}
    size = write_model(path, partial(_model, network, metadata))
    nx, ny = network.spec.shape
    coords = {"sensor_coords": f"(1, 4, {nx // 4}, {ny // 4}) float32"} if network.config.bearings else {}
    return {
        "feature_map": f"(1, {nx}, {ny}, {_channels(network)}) float32, from (points, {FEATURES})",
        **coords,
        "mass": f"({nx}, {ny}, 2) float32: free, occupied",
        "grid": f"{network.spec.length:g} x {network.spec.width:g} m, cells of {network.spec.resolution:g} m",
        "size": f"{size / 1e6:.1f} MB, opset {_OPSET}",
    }


def write_model(path: Path, make: Callable[[], Any]) -> int:
    """Check and write the ONNX model that `make` makes, in one step; return its size [bytes]."""
    _package("onnxscript")  # torch needs it
    onnx = _package("onnx")
    with atomic_write(path) as file:
        model = make()
        onnx.checker.check_model(model, full_check=True)
        if odd := {node.op_type for node in model.graph.node} - OPERATIONS:
            raise RuntimeError(f"this version of torch wrote operations that ogm does not run: {sorted(odd)}")
        return int(file.write(sealed(model.SerializeToString(deterministic=True))))


class _Masses(nn.Module):
    """From the feature map to belief masses, of operations that ONNX has."""

    def __init__(self, network: PillarNetwork) -> None:
        super().__init__()
        if isinstance(network.pillar.norm, nn.Identity):
            raise ValueError("the network is fused already: give the one that load_network returns")
        self.network = fused(network).cpu()

    def forward(self, feature_map: torch.Tensor, sensor_coords: torch.Tensor | None = None) -> torch.Tensor:
        x = self.network.quarters(feature_map.permute(0, 3, 1, 2), sensor_coords)
        e = softplus_of_parts(x) if self.network.config.evidence == "softplus" else torch.relu(x)
        e = pixel_shuffle(e, 2)
        free, occupied = torch.split(e, 1, dim=1)
        return (e / (free + occupied + 2))[0].permute(1, 2, 0)  # Sec. II: b = e / S


def softplus_of_parts(x: torch.Tensor) -> torch.Tensor:
    """Return ln(1 + exp(x)), of operations that the runtimes have vectorised."""
    return torch.relu(torch.relu(x) + torch.log(1 + torch.exp(-torch.abs(x))))  # OpenVINO's ln(1) is -1e-6


def _model(network: PillarNetwork, metadata: dict[str, str]) -> Any:
    """Return the ONNX model, with its documentation and without what torch notes of the machine."""
    masses = _Masses(network).eval()
    kx, ky = torch.export.Dim("nx"), torch.export.Dim("ny")  # in units of the multiple
    multiple, channels = network.config.stride, _channels(network)
    nx, ny = 4 * multiple, 2 * multiple
    inputs: dict[str, torch.Tensor] = {"feature_map": torch.zeros(1, nx, ny, channels)}
    shapes: dict[str, dict[int, Any]] = {"feature_map": {1: multiple * kx, 2: multiple * ky}}
    if network.config.bearings:
        inputs["sensor_coords"] = torch.zeros(1, 4, nx // 4, ny // 4)
        shapes["sensor_coords"] = {2: multiple // 4 * kx, 3: multiple // 4 * ky}
    metadata = _documentation(network) | _input(masses.network) | metadata
    return traced(masses, inputs, "mass", shapes, metadata, "One lidar scan to an evidential grid map.")


def traced(
    module: nn.Module,
    inputs: Mapping[str, torch.Tensor],
    output: str,
    shapes: dict[str, Any] | None,
    metadata: Mapping[str, str],
    about: str,
) -> Any:
    """Return a module as an ONNX model with metadata, without what torch notes of the machine.

    Parameters
    ----------
    module : Module
    inputs : mapping
        Examples by their names.
    output : str
        Its name.
    shapes : mapping, optional
        Axes that are not fixed, as `torch.onnx.export` takes them.
    metadata : mapping
        Entries that have the name of an input or output become its documentation, too.
    about : str
        Documentation of the model.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning
        )  # torch's own
        warnings.filterwarnings("ignore", "# The axis name: .* will not be used", UserWarning)
        program = torch.onnx.export(
            module,
            tuple(inputs.values()),
            dynamo=True,
            verbose=False,
            opset_version=_OPSET,
            input_names=[*inputs],
            output_names=[output],
            dynamic_shapes=shapes,
        )
    assert program is not None  # as dynamo is given
    model = program.model_proto
    graph = model.graph
    del model.metadata_props[:], graph.metadata_props[:]
    for part in (*graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del part.metadata_props[:]  # paths of the machine, among others
        part.doc_string = metadata.get(part.name, "")
    graph.name, model.doc_string = "ogm", about
    _package("onnx.helper").set_model_props(model, metadata)
    return model


def _input(network: PillarNetwork) -> dict[str, str]:
    """Return the metadata from which the feature map is made; of a fused network."""
    linear = network.pillar.linear
    numbers = {
        "weight": [[float(f"{value:.9g}") for value in row] for row in linear.weight.detach().T.tolist()],
        "bias": [float(f"{value:.9g}") for value in linear.bias.detach().tolist()],
        "rays": _has_rays(network),
        "z_range": list(network.config.z_range),
        "multiple": network.config.stride,
    }
    return {"input": json.dumps(numbers)}


def _channels(network: PillarNetwork) -> int:
    """Return the channels of the feature map: the inputs of the first convolution."""
    block: Any = network.blocks[0]
    first = block[0][0]
    return int(getattr(first, "conv", first).in_channels)


def _has_rays(network: PillarNetwork) -> bool:
    return _channels(network) == network.config.pillar + 2


def _documentation(network: PillarNetwork) -> dict[str, str]:
    """Return the metadata that explain the arrays."""
    spec, (nx, ny), (low, high) = network.spec, network.spec.shape, network.config.z_range
    return {
        "format": FORMAT,
        "features": (
            "Of each point: x, y, z [m], intensity [0, 1]; x, y, z less the mean of all points in the point's cell "
            "[m]; x, y less the center of the cell [m]. x is forward, y left, z up; x = y = 0 at the sensor, z = 0 "
            f"on the ground below it. Only points with {low} <= z < {high}, on the grid, finite, and not of the ego "
            f"vehicle. The cell: ix = floor((x - ({spec.origin[0]})) / {spec.resolution}) in 0 ... {nx - 1}, "
            f"iy = floor((y - ({spec.origin[1]})) / {spec.resolution}) in 0 ... {ny - 1}; other grids of the same "
            f"resolution may be given, of whole multiples of {network.config.stride} cells."
        ),
        "feature_map": (
            "[0, ix, iy, c]: of the points in the cell the largest max(0, features @ weight[:, c] + bias[c]), with "
            "weight and bias from the metadata 'input'; 0 where no point is. If its 'rays' is true, two more channels: "
            "the masses free and occupied of ogm.geometric.RayISM."
        ),
        "sensor_coords": (
            "[0, k, ix // 4, iy // 4]: of each 4 x 4 cells r / 40 m, ln(r / 10 m), x / r and y / r, with x, y and "
            "r = sqrt(x**2 + y**2), at least one cell's side, of their middle. Wanted by networks with bearings."
        ),
        "mass": (
            "Belief masses of each cell, [ix, iy, state]: free, then occupied. Unknown is 1 less both. "
            "Evidence is 2 * mass / unknown."
        ),
    }


def _package(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"ONNX needs the package {name}, which is missing ({error}): {_PIP}") from error
