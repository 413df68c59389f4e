"""Engines that run networks by torch, for weights that are not exported, accelerators and comparison."""

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn.functional import relu
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from ogm.deep.network import PillarNetwork
from ogm.deep.pillars import Pillars, collate, pillarize, pillarize_torch
from ogm.deep.points import Rectangle
from ogm.grid import GridSpec


class TorchEngine:
    """Lidar network on a grid, run by torch.

    Parameters
    ----------
    network : PillarNetwork
        Network, see `ogm.deep.checkpoint.load_network`.
    device : str or torch.device
        Device of torch: ``"cpu"`` or ``"cuda"``.
    compile : bool
        Whether to use ``torch.compile``. The first call takes half a minute and needs a C++ compiler.
    precision : "float32" or "bfloat16"
        Number format of the convolutions.
    description : mapping, optional
        Description of the weights.

    Attributes
    ----------
    spec : GridSpec
        Grid around the sensor, initially the network's grid.
    rays : bool
        Whether the network takes the masses of `ogm.geometric.RayISM` as input.
    network : PillarNetwork
        Network with folded normalisation.
    description : dict
        Description of the weights.

    Raises
    ------
    ValueError
        If the device or the precision does not exist.
    """

    description: dict[str, Any]
    rays: bool
    spec: GridSpec
    network: PillarNetwork

    def __init__(
        self,
        network: PillarNetwork,
        *,
        device: str | torch.device = "cpu",
        compile: bool = False,
        precision: str = "float32",
        description: Mapping[str, Any] | None = None,
    ) -> None:
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision must be float32 or bfloat16, got {precision!r}")
        self.device, self.description = _device(device), dict(description or {})
        self._dtype, self._compile = getattr(torch, precision), compile
        self._given, self.rays = network, bool(getattr(network.config, "rays", False))
        self._prepare(network)

    def _prepare(self, network: PillarNetwork) -> None:
        self.spec, self.network = network.spec, fused(network).to(self.device)
        backbone = copy.deepcopy(self.network).to(self._dtype) if self._dtype != torch.float32 else self.network
        self._evidence: Callable[[torch.Tensor], torch.Tensor] = backbone.evidence
        if self._compile:
            self._evidence = torch.compile(backbone.evidence)

    def on(self, spec: GridSpec) -> Self:
        """Return the same network for another grid; for errors see `PillarNetwork.on`."""
        other = copy.copy(self)
        other._prepare(self._given.on(spec))
        return other

    def pillars(self, points: NDArray[np.float32], ego_footprint: Rectangle, T: NDArray[np.floating[Any]]) -> Pillars:
        """Sort the points of a scan into the pillars of the grid, on the device."""
        options = self.spec, self.network.config.z_range, ego_footprint
        if self.device.type == "cpu":
            return pillarize(points, *options, T)
        on_device = torch.from_numpy(T).float().to(self.device)
        return pillarize_torch(torch.tensor(points, device=self.device), *options, on_device)

    @torch.inference_mode()
    def masses(
        self, scans: Sequence[Pillars], rays: Sequence[NDArray[np.float32]] | None = None
    ) -> NDArray[np.float32]:
        """Return belief masses for free and occupied, (scans, nx, ny, 2); see `OnnxEngine.masses`."""
        nx, ny = self.spec.shape
        pillars: Any = collate(scans, nx * ny)
        if rays is not None:
            pillars = pillars._replace(rays=torch.from_numpy(np.stack(rays)).to(self.device))
        feature_map = self.network.feature_map(pillars)
        evidence = self._evidence(feature_map.to(self._dtype))
        mass = evidence / (evidence[..., :1] + evidence[..., 1:] + 2)  # Sec. II: b = e / S
        return mass.cpu().numpy()


def _device(name: str | torch.device) -> torch.device:
    try:
        device = torch.empty(0, device=name).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(f"there is no device {str(name)!r} on this machine ({error}): use cpu") from error
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {str(name)!r}")
    return device


class ConvReLU(nn.Module):
    """Convolution with ReLU, a single operation with oneDNN."""

    def __init__(self, conv: nn.Conv2d) -> None:
        super().__init__()
        self.conv = conv

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the output of the convolution after the ReLU."""
        conv = self.conv
        plain = x.device.type != "cpu" or x.dtype != torch.float32 or torch.is_grad_enabled() or not _ONEDNN
        if plain or torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export():
            return relu(conv(x), inplace=True)
        numbers: Any = conv.padding, conv.stride, conv.dilation, conv.groups, "relu", [], None
        result: torch.Tensor = torch.ops.mkldnn._convolution_pointwise(x, conv.weight, conv.bias, *numbers)
        return result


_onednn: Any = torch.backends.mkldnn
_ONEDNN = _onednn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")


def fused(network: PillarNetwork) -> PillarNetwork:
    """Return a network for inference: all normalisation folded into layers, channels last in memory."""
    result = copy.deepcopy(network).eval()
    for module in result.modules():
        if isinstance(module, nn.Sequential) and len(module) > 1 and isinstance(module[1], nn.BatchNorm2d):
            conv: Any = module[0]
            transposed = isinstance(conv, nn.ConvTranspose2d)
            conv = fuse_conv_bn_eval(conv, module[1], transpose=transposed)
            module[0], module[1] = conv, nn.Identity()
            if not transposed:
                module[0], module[2] = ConvReLU(conv), nn.Identity()
    pillar: Any = result.pillar
    pillar.linear = fuse_linear_bn_eval(pillar.linear, pillar.norm)
    pillar.linear.weight.data *= pillar.scale
    pillar.scale, pillar.norm = None, nn.Identity()
    convert: Any = result.to  # torch declares no memory_format
    converted: PillarNetwork = convert(memory_format=torch.channels_last)
    return converted
