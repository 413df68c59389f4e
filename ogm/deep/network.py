"""Lidar network: pillar features, a 2-D convolutional backbone, and a head that outputs evidence for every cell.

There are two sizes. `PAPER` is PointPillars as described by van Kempen et al. 2021 (Sec. III): three blocks of
convolutions at 1/2, 1/4 and 1/8 of the resolution, each upsampled to 1/2 and concatenated. `LITE` is for processors
without an accelerator: fewer channels, a fourth block for context, and a feature pyramid with added scales. In both,
the last convolution outputs the four cells of each 2 x 2 square, so the output has the full resolution of the grid.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import nn
from torch.nn.functional import batch_norm, conv2d, interpolate, pixel_shuffle, relu, softplus

from ogm.deep.network_grid import check_resolution, check_sides, sensor_coords
from ogm.deep.pillars import Pillars
from ogm.deep.points import FEATURES
from ogm.grid import GridSpec


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes and options of a lidar network, stored as JSON with the weights.

    Parameters
    ----------
    pillar : int
        Number of features of a pillar.
    blocks : tuple of (channels, convolutions)
        One entry per scale 1/2, 1/4, 1/8, ...; the first convolution of each block halves the resolution.
    join : "concatenate" or "add"
        Join of the scales at 1/2. "concatenate": each scale is upsampled by a transposed convolution and concatenated
        (PointPillars). "add": from the coarsest scale on, each scale is upsampled and added to the next finer scale.
    up : int
        Channels of each scale for "concatenate".
    bearings : bool
        Whether the network gets the distance and direction of the sensor at every cell.
    rays : bool
        Whether the network gets the masses of `ogm.geometric.RayISM` at every cell, which show the measured area.
    evidence : "softplus" or "relu"
        Activation of the head. ReLU is the paper's, but leaves cells without gradient.
    dropout : float
        Dropout rate of the blocks' activations in training.
    scale : tuple of 9 floats
        Divisors of the points' features, in the features' units.
    z_range : (float, float)
        Heights above the ground of the points to keep [m].
    """

    pillar: int
    blocks: tuple[tuple[int, int], ...]
    join: Literal["concatenate", "add"]
    up: int = 128
    bearings: bool = False
    rays: bool = False
    evidence: Literal["softplus", "relu"] = "softplus"
    dropout: float = 0.0
    scale: tuple[float, ...] = (1.0,) * FEATURES
    z_range: tuple[float, float] = (-3.0, 8.0)

    @classmethod
    def from_dict(cls, numbers: dict[str, object]) -> "NetworkConfig":
        """Return a configuration from JSON, with lists converted to tuples."""
        return cls(**{name: _tuple(value) for name, value in numbers.items()})  # type: ignore[arg-type]

    @property
    def stride(self) -> int:
        """Number of cells of which both sides of the grid must be multiples."""
        return 1 << len(self.blocks)

    def build(self, spec: GridSpec) -> "PillarNetwork":
        """Return a network for a grid, with random weights."""
        return PillarNetwork(self, spec)


# PointPillars of van Kempen et al. 2021, for accelerators
PAPER = NetworkConfig(64, ((64, 4), (128, 6), (256, 6)), join="concatenate", dropout=0.1, z_range=(-1.2, 2.8))
_SCALE = (40.0, 28.0, 2.0, 0.5, 0.05, 0.05, 0.3, 0.08, 0.08)
# For processors without an accelerator: the network of the shipped weights, except for the input of rays
LITE = NetworkConfig(16, ((32, 2), (48, 3), (80, 3), (112, 4)), join="add", bearings=True, scale=_SCALE)


class PillarNetwork(nn.Module):
    """Network from pillars of lidar scans to evidence for free and occupied.

    Parameters
    ----------
    config : NetworkConfig
        `LITE`, `PAPER`, or another configuration.
    spec : GridSpec
        Grid of the training. The weights do not depend on its size.

    Raises
    ------
    ValueError
        If a side of the grid is no multiple of `NetworkConfig.stride`.
    """

    config: NetworkConfig
    spec: GridSpec
    pillar: "PillarFeatures"
    bearings: nn.Conv2d | None
    blocks: nn.ModuleList
    join: "AddNeck | ConcatenateNeck"
    head: nn.Conv2d
    sensor_coords: torch.Tensor  # if config.bearings

    def __init__(self, config: NetworkConfig, spec: GridSpec) -> None:
        super().__init__()
        check_sides(spec, config.stride)
        if config.bearings and len(config.blocks) < 2:
            raise ValueError(f"bearings are added in the second block, got {len(config.blocks)} block: add a block")
        self.config, self.spec = config, spec
        channels = [size for size, _ in config.blocks]
        self.pillar = PillarFeatures(config.pillar, config.scale)
        self.bearings = nn.Conv2d(4, channels[1], 1) if config.bearings else None
        pairs = zip([config.pillar + 2 * config.rays, *channels], config.blocks, strict=False)
        self.blocks = nn.ModuleList(down_block(before, *block, config.dropout) for before, block in pairs)
        added = config.join == "add"
        self.join = AddNeck(channels) if added else ConcatenateNeck(channels, config.up)
        last = channels[0] if added else config.up * len(channels)
        self.head = nn.Conv2d(last, 2 * 4, 3, padding=1)
        if config.evidence == "softplus":  # start near the usual output: much free, little occupied
            bias: Any = self.head.bias
            bias.data[:] = torch.tensor([2.0] * 4 + [-1.0] * 4)
        if config.bearings:
            coords = torch.from_numpy(sensor_coords(spec)).contiguous(memory_format=torch.channels_last)
            self.register_buffer("sensor_coords", coords, persistent=False)

    def on(self, spec: GridSpec) -> "PillarNetwork":
        """Return the same network for another grid of the same resolution.

        Raises
        ------
        ValueError
            If the resolution differs, or a side of the grid is no multiple of `NetworkConfig.stride`.
        """
        check_resolution(spec, self.spec)
        network = PillarNetwork(self.config, spec)
        network.load_state_dict(self.state_dict())
        return network.train(self.training)

    def forward(self, pillars: Pillars) -> torch.Tensor:
        """Return evidence for free and occupied, (batch, nx, ny, 2) float32, at least 0."""
        return self.evidence(self.feature_map(pillars))

    def feature_map(self, pillars: Pillars) -> torch.Tensor:
        """Return the features of pillars on the grid, (batch, channels, nx, ny); 0 in cells without points.

        The last two channels are the masses of rays, if the network takes them.
        """
        nx, ny = self.spec.shape
        features: torch.Tensor = self.pillar(pillars.features, pillars.lengths)
        width = self.config.pillar
        x = features.new_zeros(pillars.batch * nx * ny, width + 2 * self.config.rays)
        if self.config.rays:
            if pillars.rays is None:
                raise ValueError("this network takes masses of rays, got Pillars without rays: add `Pillars.rays`")
            x[:, width:] = pillars.rays.reshape(-1, 2)
            features = torch.cat([features, x[pillars.cells, width:]], dim=1)  # whole rows: cheap to differentiate
        x.index_copy_(0, pillars.cells, features)
        return x.view(pillars.batch, nx, ny, -1).permute(0, 3, 1, 2)  # channels last in memory

    def evidence(self, feature_map: torch.Tensor) -> torch.Tensor:
        """Return evidence from the feature map, (batch, nx, ny, 2)."""
        x = pixel_shuffle(self.quarters(feature_map), 2)
        x = x.permute(0, 2, 3, 1).float()  # from channels first to states last
        return softplus(x) if self.config.evidence == "softplus" else relu(x)

    def quarters(self, feature_map: torch.Tensor, sensor_coords: torch.Tensor | None = None) -> torch.Tensor:
        """Return the output of the head before its activation, (batch, 2 * 4, nx / 2, ny / 2).

        The channels are the four cells of a 2 x 2 square for each state. `sensor_coords` are coordinates for another
        grid than the network's.
        """
        return self._head(self.joined(feature_map, sensor_coords))

    def joined(self, feature_map: torch.Tensor, sensor_coords: torch.Tensor | None = None) -> list[torch.Tensor]:
        """Return the inputs of the head, each (batch, channels, nx / 2, ny / 2)."""
        scales = []
        x = feature_map
        for k, block in enumerate(cast("Iterable[nn.Sequential]", self.blocks)):
            x = block[0](x)
            if k == 1 and self.bearings is not None:
                x = x + self.bearings(self.sensor_coords if sensor_coords is None else sensor_coords)
            x = block[1:](x)
            scales.append(x)
        parts: list[torch.Tensor] = self.join(scales)
        return parts

    def _head(self, parts: list[torch.Tensor]) -> torch.Tensor:
        """Apply the head to concatenated parts; they are convolved separately and added, which saves a copy."""
        weights = torch.split(self.head.weight, [part.shape[1] for part in parts], dim=1)
        x = conv2d(parts[0], weights[0], self.head.bias, padding=1)
        for part, weight in zip(parts[1:], weights[1:], strict=True):
            x += conv2d(part, weight, padding=1)
        return x


class PillarFeatures(nn.Module):
    """Pillar feature net of the paper: a linear layer for each point and the maximum over each pillar."""

    scale: torch.Tensor | None

    def __init__(self, channels: int, scale: tuple[float, ...]) -> None:
        super().__init__()
        self.linear: nn.Linear = nn.Linear(FEATURES, channels, bias=False)
        self.norm: nn.Module = nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)
        inverse = np.float32(1) / np.array(scale, np.float32)  # in torch, this would load its compiler for device meta
        self.register_buffer("scale", torch.from_numpy(inverse), persistent=False)

    def forward(self, features: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        """Return the features of pillars, (P, channels), from sorted points (N, 9) and the pillars' lengths."""
        norm: Any = self.norm
        x: torch.Tensor = self.linear(features if self.scale is None else features * self.scale)
        if len(features) < 2 and self.training:  # a single point has no statistics
            x = batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)
        else:
            x = norm(x)
        if len(features) == 0:
            return x
        return torch.segment_reduce(relu(x, inplace=True), "max", lengths=lengths, unsafe=True)


class ConcatenateNeck(nn.Module):
    """Neck of PointPillars: each scale is upsampled to 1/2 by a transposed convolution."""

    def __init__(self, channels: list[int], up: int) -> None:
        super().__init__()
        self.ups: nn.ModuleList = nn.ModuleList(
            nn.Sequential(nn.ConvTranspose2d(size, up, 2**k, 2**k, bias=False), _norm(up), nn.ReLU(inplace=True))
            for k, size in enumerate(channels)
        )

    def forward(self, scales: list[torch.Tensor]) -> list[torch.Tensor]:
        """Return a part (batch, up, nx / 2, ny / 2) per scale; the head concatenates them."""
        return [up(x) for up, x in zip(self.ups, scales, strict=True)]


class AddNeck(nn.Module):
    """Feature pyramid: from the coarsest scale on, upsample, add to the next finer scale, convolve."""

    def __init__(self, channels: list[int]) -> None:
        super().__init__()
        pairs = list(zip(channels[:-1], channels[1:], strict=True))
        self.lateral: nn.ModuleList = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.merge: nn.ModuleList = nn.ModuleList(_layer(fine, fine) for fine, _ in pairs)

    def forward(self, scales: list[torch.Tensor]) -> list[torch.Tensor]:
        """Return a list of a single part, (batch, channels of the finest scale, nx / 2, ny / 2)."""
        x = scales[-1]
        for k in reversed(range(len(scales) - 1)):
            x = interpolate(self.lateral[k](x), scale_factor=2.0, mode="bilinear", align_corners=False)
            x += scales[k]
            x = self.merge[k](x)
        return [x]


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


def _layer(before: int, after: int, stride: int = 1, dropout: float = 0.0) -> nn.Sequential:
    layers = [nn.Conv2d(before, after, 3, stride, 1, bias=False), _norm(after), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, *([nn.Dropout(dropout)] if dropout else []))


def down_block(before: int, after: int, count: int, dropout: float) -> nn.Sequential:
    """Return a block of convolutions from `before` to `after` channels; the first halves the resolution."""
    layers = (_layer(after if k else before, after, 1 if k else 2, dropout) for k in range(count))
    return nn.Sequential(*layers)


@torch.no_grad()
def copy_weights(source: nn.Module, target: nn.Module) -> None:
    """Copy weights to a network with the same layers; additional input channels get the weight 0.

    Raises
    ------
    ValueError
        If the layers differ in more than the number of input channels.
    """
    weights = source.state_dict()
    for name, value in target.state_dict().items():
        given = weights.get(name)
        if given is None or given.dim() != value.dim():
            raise ValueError(f"the networks have other layers: {name} is missing or of another kind; give others")
        grown = [k for k, (a, b) in enumerate(zip(given.shape, value.shape, strict=True)) if a != b]
        if grown not in ([], [1]) or any(given.shape[k] > value.shape[k] for k in grown):
            shapes = f"{tuple(given.shape)}, wanted {tuple(value.shape)}"
            raise ValueError(f"the networks have other layers: {name} is {shapes}; give others")
        value.zero_()
        value[(slice(None), slice(given.shape[1])) if grown else ...] = given


def _tuple(value: object) -> object:
    return tuple(_tuple(item) for item in value) if isinstance(value, list) else value
