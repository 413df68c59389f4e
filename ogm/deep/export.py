"""Export of a network to an ONNX file, to run it without torch.

`ogm.deep.onnx_engine.OnnxEngine` and other ONNX runtimes can run the file. It holds the network for one scan at a time,
with the normalisation folded into the layers. Its metadata are ``format``, ``description`` (JSON of the weights: spec,
network, recipe, ...), ``weights`` (their SHA-256), a documentation of each input and output, and as last entry
``sha256``, the checksum of all bytes before it.

The network accepts any grid with sides of multiples of ``multiple`` cells. The step before the network, a linear
layer and a maximum over the points of a pillar, is in the entry ``input`` (JSON: weight, bias, rays, z_range,
multiple)::

    feature_map[0, ix, iy, c] = max over the points of the cell of max(0, features @ weight[:, c] + bias[c])

>>> from ogm.deep.checkpoint import load_network
>>> from ogm.deep.export import export_onnx
>>> network, description = load_network("runs/lite/best.safetensors")       # doctest: +SKIP
>>> export_onnx(network, "lite.onnx", description=description)              # doctest: +SKIP
"""

import json
import os
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ogm.deep.description import FORMAT as DESCRIPTION_FORMAT
from ogm.deep.export_parts import ExportParts, network_parts
from ogm.deep.network import PillarNetwork
from ogm.deep.onnx_file import OPERATIONS, sealed, weights_sum
from ogm.extras import import_extra
from ogm.storage.files import atomic_write

__all__ = ["export_onnx"]

_OPSET = 18


def export_onnx(
    network: PillarNetwork,
    path: str | os.PathLike[str],
    *,
    description: Mapping[str, Any] | None = None,
    weights: str | os.PathLike[str] | None = None,
) -> dict[str, str]:
    """Write a network as an ONNX file.

    Parameters
    ----------
    network : PillarNetwork
        See `ogm.deep.checkpoint.load_network`.
    path : path
        File name, ending in ``.onnx``. The file is written atomically.
    description : mapping, optional
        Description of the weights. `ogm.deep.DeepISM` uses its entry ``seen`` to detect scans unlike the training
        data.
    weights : path, optional
        File that the network was loaded from. Its checksum is stored, to recognise exports of older weights.

    Returns
    -------
    dict
        Names and values that describe the file, to print.

    Raises
    ------
    ValueError
        If `path` does not end in ``.onnx``, or the network is a result of `ogm.deep.torch_engine.fused`.
    ImportError
        If a package for the export is missing; the message holds the pip command to install it.

    Notes
    -----
    The same weights give the same bytes with the same versions of torch, onnx and onnxscript. The softplus of the head
    is written as ``max(x, 0) + ln(1 + exp(-|x|))``, which consists of operations that runtimes vectorise.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"path must end in .onnx, got {path}")
    facts = {"format": DESCRIPTION_FORMAT, **(description or {})}
    facts |= {"network": asdict(network.config), "spec": asdict(network.spec)}
    facts.pop("sha256", None)  # checksums of the files of weights
    given = {"description": json.dumps(facts), "weights": weights_sum(weights) if weights is not None else ""}
    import_extra("onnxscript", "train")  # needed by torch
    onnx = import_extra("onnx", "train")
    parts = network_parts(network, given)
    with atomic_write(path) as file:
        model = _model(parts)
        onnx.checker.check_model(model, full_check=True)
        if odd := {node.op_type for node in model.graph.node} - OPERATIONS:
            raise RuntimeError(f"this torch wrote operations that ogm does not run, {sorted(odd)}: use an older torch")
        size = file.write(sealed(model.SerializeToString(deterministic=True)))
    return {**parts.facts, "size": f"{size / 1e6:.1f} MB, opset {_OPSET}"}


def _model(parts: ExportParts) -> Any:
    """Return the ONNX model with its metadata, without the machine's paths that torch adds."""
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
            output_names=["mass"],
            dynamic_shapes=parts.shapes,
        )
    assert program is not None  # with dynamo=True
    model = program.model_proto
    graph = model.graph
    del model.metadata_props[:], graph.metadata_props[:]
    for part in (*graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del part.metadata_props[:]  # contains paths of the machine
        part.doc_string = parts.metadata.get(part.name, "")
    graph.name, model.doc_string = "ogm", "One lidar scan to an evidential grid map."
    import_extra("onnx.helper", "train").set_model_props(model, parts.metadata)
    return model
