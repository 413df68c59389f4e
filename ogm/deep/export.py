"""A network as one ONNX file, for use without torch: from a scan's features to belief masses or evidence.

`ogm.deep.onnx_engine.OnnxEngine` and `ogm.deep.radar_onnx.RadarOnnxEngine` run it, and so does whatever else runs ONNX.
The file holds the network with its normalisation folded in, for one scan at a time. Its metadata describe every array:
``format``, ``description`` (JSON of the weights: spec, network, recipe, ...), ``weights`` (their SHA-256), and an entry
for each input and output; the last entry, ``sha256``, is the checksum of all bytes before it.

A network of lidars takes any grid whose sides are multiples of ``multiple`` cells. The step before it, a linear layer
and a maximum over the points of a pillar, is in the entry ``input`` (JSON: weight, bias, rays, z_range, multiple)::

    feature_map[0, ix, iy, c] = max over the points of the cell of max(0, features @ weight[:, c] + bias[c])

A network of radars takes the features of `ogm.deep.polar.polar_features`, whose names are in the entry ``channels``.

>>> from ogm.deep.checkpoint import load_network
>>> from ogm.deep.export import export_onnx
>>> network, description = load_network("runs/lite/best.safetensors")       # doctest: +SKIP
>>> export_onnx(network, "lite.onnx", description=description)              # doctest: +SKIP
"""

import importlib
import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from ogm.deep.description import FORMAT as DESCRIPTION_FORMAT
from ogm.deep.export_parts import ExportParts, lidar_parts, radar_parts
from ogm.deep.network import PillarNetwork
from ogm.deep.onnx_file import OPERATIONS, sealed, weights_sum
from ogm.deep.radar_network import RadarNetwork
from ogm.extras import install_line
from ogm.storage.files import atomic_write

__all__ = ["export_onnx"]

_OPSET = 18


def export_onnx(
    network: PillarNetwork | RadarNetwork,
    path: str | os.PathLike[str],
    *,
    description: Mapping[str, Any] | None = None,
    weights: str | os.PathLike[str] | None = None,
) -> dict[str, str]:
    """Write a network as ONNX.

    Parameters
    ----------
    network : PillarNetwork or RadarNetwork
        See `ogm.deep.checkpoint.load_any_network`.
    path : path
        Name of the file, ending in ``.onnx``. The file appears when it is whole.
    description : mapping, optional
        Description of the weights. `ogm.deep.DeepISM` needs its entry ``seen`` to notice scans unlike the training
        data.
    weights : path, optional
        File that the network was loaded from. Its checksum is noted, by which old exports of a run are recognised.

    Returns
    -------
    dict
        Names and values that describe the file, to be printed.

    Raises
    ------
    ValueError
        If `path` does not end in ``.onnx``, or the network went through `ogm.deep.torch_engine.fused` before.
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
    given = {"description": json.dumps(facts), "weights": weights_sum(weights) if weights is not None else ""}
    _package("onnxscript")  # torch needs it
    onnx = _package("onnx")
    parts = radar_parts(network, given) if isinstance(network, RadarNetwork) else lidar_parts(network, given)
    with atomic_write(path) as file:
        model = _model(parts)
        onnx.checker.check_model(model, full_check=True)
        if odd := {node.op_type for node in model.graph.node} - OPERATIONS:
            raise RuntimeError(f"this version of torch wrote operations that ogm does not run: {sorted(odd)}")
        size = file.write(sealed(model.SerializeToString(deterministic=True)))
    return {**parts.facts, "size": f"{size / 1e6:.1f} MB, opset {_OPSET}"}


def _model(parts: ExportParts) -> Any:
    """Return the ONNX model with its metadata, without torch's notes of the machine."""
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning
        )  # torch's own
        warnings.filterwarnings("ignore", "# The axis name: .* will not be used", UserWarning)
        program = torch.onnx.export(
            parts.module,
            tuple(parts.inputs.values()),
            dynamo=True,
            verbose=False,
            opset_version=_OPSET,
            input_names=[*parts.inputs],
            output_names=[parts.output],
            dynamic_shapes=parts.shapes,
        )
    assert program is not None  # as dynamo is given
    model = program.model_proto
    graph = model.graph
    del model.metadata_props[:], graph.metadata_props[:]
    for part in (*graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del part.metadata_props[:]  # paths of the machine, among others
        part.doc_string = parts.metadata.get(part.name, "")
    graph.name, model.doc_string = "ogm", parts.about
    _package("onnx.helper").set_model_props(model, parts.metadata)
    return model


def _package(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"ONNX needs the package {name}, which is missing ({error}): {install_line('train')}"
        ) from error
