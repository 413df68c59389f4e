"""Parts of an exported network: module of ONNX operations, example inputs and metadata."""

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.nn.functional import pixel_shuffle

from ogm.deep.network import PillarNetwork
from ogm.deep.onnx_file import FORMAT
from ogm.deep.points import FEATURES
from ogm.deep.torch_engine import fused


class ExportParts(NamedTuple):
    """Parts of a network for the export.

    Attributes
    ----------
    module : Module
        Module that computes belief masses from the inputs.
    inputs : dict of str to Tensor
        Example inputs by name.
    shapes : dict
        Axes of variable length, the ``dynamic_shapes`` of `torch.onnx.export`.
    metadata : dict of str to str
        Metadata of the file. An entry with the name of an input or output is also its documentation.
    facts : dict of str to str
        Names and values that describe the file, to print.
    """

    module: nn.Module
    inputs: dict[str, torch.Tensor]
    shapes: dict[str, Any]
    metadata: dict[str, str]
    facts: dict[str, str]


def network_parts(network: PillarNetwork, given: Mapping[str, str]) -> ExportParts:
    """Return the parts of a network, from the feature map to belief masses.

    Parameters
    ----------
    network : PillarNetwork
    given : mapping
        Further metadata: description and checksum of the weights.
    """
    module = _Masses(network).eval()
    config, spec = network.config, network.spec
    channels = config.pillar + 2 * config.rays
    kx, ky = torch.export.Dim("nx"), torch.export.Dim("ny")  # in units of the multiple
    multiple = config.stride
    nx, ny = 4 * multiple, 2 * multiple
    inputs = {"feature_map": torch.zeros(1, nx, ny, channels)}
    shapes: dict[str, dict[int, Any]] = {"feature_map": {1: multiple * kx, 2: multiple * ky}}
    facts = {"feature_map": f"(1, {spec.shape[0]}, {spec.shape[1]}, {channels}) float32, from (points, {FEATURES})"}
    if config.bearings:
        inputs["sensor_coords"] = torch.zeros(1, 4, nx // 4, ny // 4)
        shapes["sensor_coords"] = {2: multiple // 4 * kx, 3: multiple // 4 * ky}
        facts["sensor_coords"] = f"(1, 4, {spec.shape[0] // 4}, {spec.shape[1] // 4}) float32"
    facts |= {
        "mass": f"({spec.shape[0]}, {spec.shape[1]}, 2) float32: free, occupied",
        "grid": f"{spec.length:g} x {spec.width:g} m, cells of {spec.resolution:g} m",
    }
    metadata = _documentation(network) | _input(module.network) | dict(given)
    return ExportParts(module, inputs, shapes, metadata, facts)


class _Masses(nn.Module):
    """Module from the feature map to belief masses, built of ONNX operations."""

    def __init__(self, network: PillarNetwork) -> None:
        super().__init__()
        if isinstance(network.pillar.norm, nn.Identity):
            raise ValueError("the network is already fused, wanted the network of load_network")
        self.network = fused(network).cpu()

    def forward(self, feature_map: torch.Tensor, sensor_coords: torch.Tensor | None = None) -> torch.Tensor:
        x = self.network.quarters(feature_map.permute(0, 3, 1, 2), sensor_coords)
        e = _softplus(x) if self.network.config.evidence == "softplus" else torch.relu(x)
        e = pixel_shuffle(e, 2)
        free, occupied = torch.split(e, 1, dim=1)
        return (e / (free + occupied + 2))[0].permute(1, 2, 0)  # Sec. II: b = e / S


def _softplus(x: torch.Tensor) -> torch.Tensor:
    """Return ln(1 + exp(x)), built of operations that runtimes vectorise."""
    return torch.relu(torch.relu(x) + torch.log(1 + torch.exp(-torch.abs(x))))  # outer relu: OpenVINO's ln(1) is -1e-6


def _input(network: PillarNetwork) -> dict[str, str]:
    """Return the metadata to compute the feature map, from a fused network."""
    linear = network.pillar.linear
    numbers = {
        "weight": [[float(f"{value:.9g}") for value in row] for row in linear.weight.detach().T.tolist()],
        "bias": [float(f"{value:.9g}") for value in linear.bias.detach().tolist()],
        "rays": network.config.rays,
        "z_range": list(network.config.z_range),
        "multiple": network.config.stride,
    }
    return {"input": json.dumps(numbers)}


def _documentation(network: PillarNetwork) -> dict[str, str]:
    """Return the metadata that document the arrays."""
    spec, (nx, ny), (low, high) = network.spec, network.spec.shape, network.config.z_range
    return {
        "format": FORMAT,
        "features": (
            "For each point: x, y, z [m], intensity [0, 1]; x, y, z minus the mean of all points in the point's cell "
            "[m]; x, y minus the center of the cell [m]. x is forward, y left, z up; x = y = 0 at the sensor, z = 0 "
            f"on the ground below it. Only finite points on the grid with {low} <= z < {high} that are not on the ego "
            f"vehicle. Cell: ix = floor((x - ({spec.origin[0]})) / {spec.resolution}) in 0 ... {nx - 1}, "
            f"iy = floor((y - ({spec.origin[1]})) / {spec.resolution}) in 0 ... {ny - 1}; other grids of the same "
            f"resolution are allowed, with sides of multiples of {network.config.stride} cells."
        ),
        "feature_map": (
            "[0, ix, iy, c]: maximum over the points in the cell of max(0, features @ weight[:, c] + bias[c]), with "
            "weight and bias from the metadata 'input'; 0 in cells without points. If its 'rays' is true, two more "
            "channels: the masses free and occupied of ogm.geometric.RayISM."
        ),
        "sensor_coords": (
            "[0, k, ix // 4, iy // 4]: for each block of 4 x 4 cells r / 40 m, ln(r / 10 m), x / r and y / r, with the "
            "center (x, y) of the block and r = sqrt(x**2 + y**2), at least one cell. For networks with bearings."
        ),
        "mass": (
            "Belief masses of each cell, [ix, iy, state]: free, then occupied. Unknown is 1 minus their sum. "
            "Evidence is 2 * mass / unknown."
        ),
    }
