"""The network: pillar features, a 2-D convolutional backbone, and a head that gives evidence for every cell.

Two sizes. `PAPER` is PointPillars as van Kempen et al. 2021 describe it (Sec. III): three blocks of
convolutions at 1/2, 1/4 and 1/8 of the resolution, each brought back to 1/2 and concatenated. `LITE` is made for
processors without an accelerator: fewer channels, one block more for context, and a pyramid whose scales are
added. In both, the last convolution gives the four cells of each 2 x 2 square at once, so that the result has the
full resolution of the grid.
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
    """Sizes and choices of a network, kept as JSON with the weights.

    Parameters
    ----------
    pillar : int
        Features of a pillar.
    blocks : tuple of (channels, convolutions)
        One per scale 1/2, 1/4, 1/8, ...; the first convolution of each halves the resolution.
    join : "concatenate" or "add"
        How the scales are joined at 1/2: each enlarged by a transposed convolution and concatenated (PointPillars),
        or from the coarsest down, each added to the next finer one.
    up : int
        Channels of each scale when they are concatenated.
    bearings : bool
        Give the network, at every cell, the distance and the direction of the sensor.
    rays : bool
        Give the network, at every cell, the masses of `ogm.geometric.RayISM`: where the scan measured at all.
    evidence : "softplus" or "relu"
        Activation of the head. ReLU is the paper's; it leaves cells without gradient.
    dropout : float
        Share of the blocks' activations left out in training.
    scale : tuple of 9 floats
        The pillars' features are divided by these [the features' units].
    z_range : (float, float)
        Heights above the ground that are kept [m].
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
        """Make a configuration from JSON, where tuples are lists."""
        return cls(**{name: _tuple(value) for name, value in numbers.items()})  # type: ignore[arg-type]

    @property
    def stride(self) -> int:
        """Both sides of the grid must be whole multiples of this many cells."""
        return 1 << len(self.blocks)

    def build(self, spec: GridSpec) -> "PillarNetwork":
        """Return a network of these sizes for a grid, with random weights."""
        return PillarNetwork(self, spec)


# PointPillars as van Kempen et al. 2021 describe it, for accelerators
PAPER = NetworkConfig(64, ((64, 4), (128, 6), (256, 6)), join="concatenate", dropout=0.1, z_range=(-1.2, 2.8))
_SCALE = (40.0, 28.0, 2.0, 0.5, 0.05, 0.05, 0.3, 0.08, 0.08)
# For processors without an accelerator: that of the shipped weights, but for the inputs of rays
LITE = NetworkConfig(16, ((32, 2), (48, 3), (80, 3), (112, 4)), join="add", bearings=True, scale=_SCALE)


class PillarNetwork(nn.Module):
    """Pillars in, evidence for free and occupied out.

    Parameters
    ----------
    config : NetworkConfig
        `LITE`, `PAPER`, or your own.
    spec : GridSpec
        The grid it is trained on. The weights do not depend on its size.

    Raises
    ------
    ValueError
        If the spec's cells cannot be halved as often as the network does.
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
            raise ValueError(f"bearings join at the second block, got {len(config.blocks)} block")
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
        if config.evidence == "softplus":  # begin near the usual: much free, little occupied
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
            If the resolution differs, or the cells cannot be halved as often as the network does.
        """
        check_resolution(spec, self.spec)
        network = PillarNetwork(self.config, spec)
        network.load_state_dict(self.state_dict())
        return network.train(self.training)

    def forward(self, pillars: Pillars) -> torch.Tensor:
        """Return evidence, (batch, nx, ny, 2) float32, at least 0; states last, free before occupied."""
        return self.evidence(self.feature_map(pillars))

    def feature_map(self, pillars: Pillars) -> torch.Tensor:
        """Return the pillars' features on the grid, (batch, channels, nx, ny); 0 where no point is.

        The masses of rays, if the network takes them, are the last two channels.
        """
        nx, ny = self.spec.shape
        features: torch.Tensor = self.pillar(pillars.features, pillars.lengths)
        width = self.config.pillar
        x = features.new_zeros(pillars.batch * nx * ny, width + 2 * self.config.rays)
        x[:, :width].index_copy_(0, pillars.cells, features)
        if self.config.rays:
            if pillars.rays is None:
                raise ValueError("this network takes the masses of rays too: give Pillars with rays")
            x[:, width:] = pillars.rays.reshape(-1, 2)
        return x.view(pillars.batch, nx, ny, -1).permute(0, 3, 1, 2)  # in memory: channels last

    def evidence(self, feature_map: torch.Tensor) -> torch.Tensor:
        """Return evidence (batch, nx, ny, 2) from the feature map."""
        x = pixel_shuffle(self.quarters(feature_map), 2)
        x = x.permute(0, 2, 3, 1).float()  # the one change from channels first to states last
        return softplus(x) if self.config.evidence == "softplus" else relu(x)

    def quarters(self, feature_map: torch.Tensor, sensor_coords: torch.Tensor | None = None) -> torch.Tensor:
        """Return the head's values before their activation, (batch, 2 * 4, nx / 2, ny / 2).

        Its channels are the states, and of each the four cells of a 2 x 2 square. The coordinates of the sensor are
        those of the network's grid unless others are given.
        """
        return self._head(self.joined(feature_map, sensor_coords))

    def joined(self, feature_map: torch.Tensor, sensor_coords: torch.Tensor | None = None) -> list[torch.Tensor]:
        """Return what the head takes: one part or several, (batch, channels, nx / 2, ny / 2)."""
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
        """Apply the head to concatenated parts: convolved one by one and added, they need not be copied together."""
        weights = torch.split(self.head.weight, [part.shape[1] for part in parts], dim=1)
        x = conv2d(parts[0], weights[0], self.head.bias, padding=1)
        for part, weight in zip(parts[1:], weights[1:], strict=True):
            x += conv2d(part, weight, padding=1)
        return x


class PillarFeatures(nn.Module):
    """The paper's pillar feature net: a linear layer for each point, and the largest of each pillar's."""

    scale: torch.Tensor | None

    def __init__(self, channels: int, scale: tuple[float, ...]) -> None:
        super().__init__()
        self.linear: nn.Linear = nn.Linear(FEATURES, channels, bias=False)
        self.norm: nn.Module = nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)
        inverse = np.float32(1) / np.array(scale, np.float32)  # torch would load its compiler on the device meta
        self.register_buffer("scale", torch.from_numpy(inverse), persistent=False)

    def forward(self, features: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        """Return (P, channels) from (N, 9) features of points sorted by pillar, and the pillars' lengths."""
        norm: Any = self.norm
        x: torch.Tensor = self.linear(features if self.scale is None else features * self.scale)
        if len(features) < 2 and self.training:  # no statistics of one point
            x = batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias, eps=norm.eps)
        else:
            x = norm(x)
        if len(features) == 0:
            return x
        return torch.segment_reduce(relu(x, inplace=True), "max", lengths=lengths, unsafe=True)


class ConcatenateNeck(nn.Module):
    """PointPillars' neck: every scale to 1/2 by a transposed convolution, then concatenated."""

    def __init__(self, channels: list[int], up: int) -> None:
        super().__init__()
        self.ups: nn.ModuleList = nn.ModuleList(
            nn.Sequential(nn.ConvTranspose2d(size, up, 2**k, 2**k, bias=False), _norm(up), nn.ReLU(inplace=True))
            for k, size in enumerate(channels)
        )

    def forward(self, scales: list[torch.Tensor]) -> list[torch.Tensor]:
        """Return one (batch, up, nx / 2, ny / 2) per scale; the head concatenates them."""
        return [up(x) for up, x in zip(self.ups, scales, strict=True)]


class AddNeck(nn.Module):
    """A pyramid from the coarsest scale down: enlarge, add to the next finer scale, convolve."""

    def __init__(self, channels: list[int]) -> None:
        super().__init__()
        pairs = list(zip(channels[:-1], channels[1:], strict=True))
        self.lateral: nn.ModuleList = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.merge: nn.ModuleList = nn.ModuleList(_layer(fine, fine) for fine, _ in pairs)

    def forward(self, scales: list[torch.Tensor]) -> list[torch.Tensor]:
        """Return a single (batch, channels of the finest scale, nx / 2, ny / 2)."""
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
    """Return a block of convolutions from `before` to `after` channels, the first of which halves the resolution."""
    layers = (_layer(after if k else before, after, 1 if k else 2, dropout) for k in range(count))
    return nn.Sequential(*layers)


@torch.no_grad()
def copy_weights(source: nn.Module, target: nn.Module) -> None:
    """Give a network the weights of another of the same layers; channels that only the target has get weights of 0.

    Raises
    ------
    ValueError
        If the layers differ in more than the number of their inputs.
    """
    weights = source.state_dict()
    for name, value in target.state_dict().items():
        given = weights.get(name)
        if given is None or given.dim() != value.dim():
            raise ValueError(f"the networks have other layers: {name} is missing or of another kind")
        grown = [k for k, (a, b) in enumerate(zip(given.shape, value.shape, strict=True)) if a != b]
        if grown not in ([], [1]) or any(given.shape[k] > value.shape[k] for k in grown):
            raise ValueError(f"the networks have other layers: {name} is {tuple(given.shape)}, {tuple(value.shape)}")
        value.zero_()
        value[(slice(None), slice(given.shape[1])) if grown else ...] = given


def _tuple(value: object) -> object:
    return tuple(_tuple(one) for one in value) if isinstance(value, list) else value
