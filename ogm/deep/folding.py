"""A network for inference: its normalisation folded into the layers before it."""

import copy
from typing import Any, TypeVar

import torch
from torch import nn
from torch.nn.functional import relu
from torch.nn.utils.fusion import fuse_conv_bn_eval, fuse_linear_bn_eval

from ogm.deep.network import PillarNetwork

Network = TypeVar("Network", bound=nn.Module)


class ConvReLU(nn.Module):
    """A convolution and its ReLU: one operation where oneDNN computes, else two."""

    def __init__(self, conv: nn.Conv2d) -> None:
        super().__init__()
        self.conv = conv

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return an array of the convolution's shape."""
        conv = self.conv
        plain = x.device.type != "cpu" or x.dtype != torch.float32 or torch.is_grad_enabled() or not _ONEDNN
        if plain or torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export():
            return relu(conv(x), inplace=True)
        numbers = conv.padding, conv.stride, conv.dilation, conv.groups
        whole: torch.Tensor = torch.ops.mkldnn._convolution_pointwise(
            x, conv.weight, conv.bias, *numbers, "relu", [], None
        )
        return whole


_onednn: Any = torch.backends.mkldnn
_ONEDNN = _onednn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")


def fused(network: PillarNetwork) -> PillarNetwork:
    """Return a copy for inference: normalisation folded into the layers before it, channels last in memory."""
    result = folded(network)
    pillar: Any = result.pillar
    pillar.linear = fuse_linear_bn_eval(pillar.linear, pillar.norm)
    pillar.linear.weight.data *= pillar.scale
    pillar.scale, pillar.norm = None, nn.Identity()
    convert: Any = result.to  # torch declares no memory_format
    converted: PillarNetwork = convert(memory_format=torch.channels_last)
    return converted


def folded(network: Network) -> Network:
    """Return a copy for inference: normalisation folded into the convolutions before it."""
    result = copy.deepcopy(network).eval()
    for module in result.modules():
        if isinstance(module, nn.Sequential) and len(module) > 1 and isinstance(module[1], nn.BatchNorm2d):
            conv: Any = module[0]
            transposed = isinstance(conv, nn.ConvTranspose2d)
            conv = fuse_conv_bn_eval(conv, module[1], transpose=transposed)
            module[0], module[1] = conv, nn.Identity()
            if not transposed:
                module[0], module[2] = ConvReLU(conv), nn.Identity()
    return result
