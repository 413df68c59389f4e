"""A network as one ONNX file, from the points' features to belief masses, for use without torch.

The file holds the network with its normalisation folded in, for one scan at a time and any number of points::

    import onnxruntime
    session = onnxruntime.InferenceSession("ogm.onnx")
    (mass,) = session.run(["mass"], {"features": features, "cells": cells})

The file describes the three arrays itself, in the documentation of its inputs and outputs and in its metadata:
``format``, ``spec``, ``z_range``, ``network``, ``features``, ``cells`` and ``mass``.
"""

import importlib
import json
import os
import warnings
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from ogm.deep.network import PillarNetwork, fused
from ogm.deep.pillars import FEATURES, Pillars
from ogm.files import OgmError, atomic_write

__all__ = ["FORMAT", "export_onnx", "onnx_inputs", "run_onnx"]

FORMAT = "ogm.network.onnx/1"
_OPSET = 18  # the first whose scatter knows a maximum
_PIP = 'pip install "ogm-toolkit[onnx]"'


def export_onnx(network: PillarNetwork, path: str | os.PathLike[str]) -> dict[str, str]:
    """Write a network as ONNX.

    Parameters
    ----------
    network : PillarNetwork
        As `ogm.deep.checkpoint.load_network` returns it.
    path : path
        Of the file, ending in ``.onnx``; it appears when it is whole.

    Returns
    -------
    dict
        Names and values that describe the file, to be printed.

    Raises
    ------
    ValueError
        If `path` does not end in ``.onnx``, or the network went through `ogm.deep.network.fused` before.
    ImportError
        If the packages for the export are absent; the message holds the pip command that adds them.

    Notes
    -----
    The file's inputs are ``features`` (N, 9) float32 and ``cells`` (N,) int64, its output is ``mass`` (nx, ny, 2)
    float32. In place of the maximum over segments, which ONNX lacks, the points' features are scattered onto a
    feature map of zeros by their maximum. The features come from a ReLU, so this is the same, and needs no order of
    the points.
    """
    path = Path(path)
    if path.suffix != ".onnx":
        raise ValueError(f"an ONNX file is named .onnx, got {path}")
    _package("onnxscript")  # torch needs it
    onnx = _package("onnx")
    with atomic_write(path) as file:
        model = _model(network)
        onnx.checker.check_model(model, full_check=True)
        size = file.write(model.SerializeToString())
    spec = network.spec
    return {
        "features": f"(points, {FEATURES}) float32",
        "cells": "(points,) int64",
        "mass": f"({spec.shape[0]}, {spec.shape[1]}, 2) float32: free, occupied",
        "grid": f"{spec.length:g} x {spec.width:g} m, cells of {spec.resolution:g} m",
        "size": f"{size / 1e6:.1f} MB, opset {_OPSET}",
    }


def onnx_inputs(pillars: Pillars) -> dict[str, NDArray[Any]]:
    """Return what an exported network takes, from one scan's pillars.

    Parameters
    ----------
    pillars : Pillars
        Of one scan, from `ogm.deep.pillars.pillarize` with the spec and the heights of the network.

    Returns
    -------
    dict
        ``features`` (N, 9) float32 and ``cells`` (N,) int64.
    """
    if pillars.batch != 1:
        raise ValueError(f"an exported network takes one scan at a time, got a batch of {pillars.batch}")
    cells = torch.repeat_interleave(pillars.cells, pillars.lengths)
    return {"features": pillars.features.cpu().numpy(), "cells": cells.cpu().numpy()}


def run_onnx(path: str | os.PathLike[str], pillars: Pillars) -> NDArray[np.float32]:
    """Run an exported network once, by ONNX Runtime on the CPU.

    It opens the file at each call. For many scans keep a session, as in the docstring of this module.

    Parameters
    ----------
    path : path
        Of a file that `export_onnx` wrote.
    pillars : Pillars
        Of one scan.

    Returns
    -------
    (nx, ny, 2) float32 array
        Belief masses free, occupied.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged or of another kind.
    ValueError
        If the pillars are of more than one scan.
    ImportError
        If ONNX Runtime is absent; the message holds the pip command that adds it.
    """
    path = Path(path)
    runtime = _package("onnxruntime")
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there; `ogm export` writes such files")
    try:
        session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no other parent
        raise OgmError(f"{path} is no whole ONNX file: {error}") from error
    if (found := session.get_modelmeta().custom_metadata_map.get("format")) != FORMAT:
        raise OgmError(f"{path} has the format {found!r}, this version of ogm runs {FORMAT}")
    (mass,) = session.run(["mass"], onnx_inputs(pillars))
    return mass


class _Masses(nn.Module):
    """From the points to belief masses, of operations that ONNX has."""

    def __init__(self, network: PillarNetwork) -> None:
        super().__init__()
        if isinstance(network.pillar.norm, nn.Identity):
            raise ValueError("the network is fused already: give the one that load_network returns")
        self.network = fused(network).cpu()

    def forward(self, features: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
        nx, ny = self.network.spec.shape
        x = torch.relu(self.network.pillar.linear(features))  # the features' scale is in the fused weights
        feature_map = x.new_zeros(nx * ny, x.shape[1])
        feature_map = feature_map.scatter_reduce(0, cells[:, None].expand(-1, x.shape[1]), x, "amax")
        evidence = self.network.evidence(feature_map.view(1, nx, ny, -1).permute(0, 3, 1, 2))[0]
        return evidence / (evidence.sum(-1, keepdim=True) + 2)  # Sec. II: b = e / S


def _model(network: PillarNetwork) -> Any:
    """Return the ONNX model, with its documentation and without what torch notes of the machine."""
    points = torch.export.Dim("points")
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning
        )  # torch's own
        warnings.filterwarnings("ignore", "# The axis name: points will not be used", UserWarning)
        program = torch.onnx.export(
            _Masses(network).eval(),
            (torch.zeros(7, FEATURES), torch.arange(7)),  # any number but 0 and 1, which torch takes as fixed
            dynamo=True,
            verbose=False,
            opset_version=_OPSET,
            input_names=["features", "cells"],
            output_names=["mass"],
            dynamic_shapes={"features": {0: points}, "cells": {0: points}},
        )
    model = program.model_proto
    graph, metadata = model.graph, _metadata(network)
    del model.metadata_props[:], graph.metadata_props[:]
    for part in (*graph.node, *graph.value_info, *graph.initializer, *graph.input, *graph.output):
        del part.metadata_props[:]  # paths of the machine, among others
        part.doc_string = metadata.get(part.name, "")
    graph.name, model.doc_string = "ogm", "One lidar scan to an evidential grid map."
    _package("onnx.helper").set_model_props(model, metadata)
    return model


def _metadata(network: PillarNetwork) -> dict[str, str]:
    """Return the metadata of a file: what the network is, and what its inputs and outputs mean."""
    spec, (nx, ny), (low, high) = network.spec, network.spec.shape, network.config.z_range
    numbers = {"spec": asdict(spec), "z_range": [low, high], "network": asdict(network.config)}
    return {
        "format": FORMAT,
        **{name: json.dumps(value) for name, value in numbers.items()},
        "features": (
            "Of each point: x, y, z [m], intensity [0, 1]; x, y, z less the mean of all points in the point's cell "
            "[m]; x, y less the center of the cell [m]. x is forward, y left, z up; x = y = 0 at the sensor, z = 0 "
            f"on the ground below it. Only points with {low} <= z < {high}, on the grid, finite, and not of the ego "
            "vehicle; in any order."
        ),
        "cells": (
            f"The cell of each point: ix * {ny} + iy, where ix = floor((x - ({spec.origin[0]})) / {spec.resolution}) "
            f"in 0 ... {nx - 1} and iy = floor((y - ({spec.origin[1]})) / {spec.resolution}) in 0 ... {ny - 1}."
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
