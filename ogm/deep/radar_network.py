"""Radar network: from features of a sweep on a polar grid to evidence for the polar cells."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn.functional import grid_sample, pixel_shuffle, softplus

from ogm.deep.network import AddNeck, down_block
from ogm.deep.polar import CHANNELS, RadarGrid


@dataclass(frozen=True)
class RadarConfig:
    """Sizes of a radar network, stored as JSON with the weights.

    Parameters
    ----------
    blocks : tuple of (channels, convolutions)
        One entry per scale 1/2, 1/4, ...; see `ogm.deep.network.NetworkConfig`.
    dropout : float
        Dropout rate of the blocks' activations in training.
    """

    blocks: tuple[tuple[int, int], ...]
    dropout: float = 0.0

    @classmethod
    def from_dict(cls, numbers: dict[str, object]) -> "RadarConfig":
        """Return a configuration from JSON, with lists converted to tuples."""
        blocks = numbers["blocks"]
        return cls(**{**numbers, "blocks": tuple(tuple(block) for block in blocks)})  # type: ignore[arg-type,attr-defined]

    @property
    def stride(self) -> int:
        """Number of cells of which both sides of the polar grid must be multiples."""
        return 1 << len(self.blocks)

    def build(self, spec: RadarGrid) -> "RadarNetwork":
        """Return a network for a polar grid, with random weights."""
        return RadarNetwork(self, spec)


RADAR = RadarConfig(((24, 2), (32, 2), (48, 3), (64, 3)))


class RadarNetwork(nn.Module):
    """U-Net on a polar grid, with the kinds of blocks of `ogm.deep.network.LITE`.

    Parameters
    ----------
    config : RadarConfig
        Sizes.
    spec : RadarGrid
        Polar grid of the training.

    Raises
    ------
    ValueError
        If a side of the polar grid is no multiple of `RadarConfig.stride`.
    """

    config: RadarConfig
    spec: RadarGrid
    join: AddNeck

    def __init__(self, config: RadarConfig, spec: RadarGrid) -> None:
        super().__init__()
        if any(n % config.stride for n in spec.shape):
            raise ValueError(f"both sides of the polar grid must be multiples of {config.stride}, got {spec.shape}")
        self.config, self.spec = config, spec
        channels = [size for size, _ in config.blocks]
        pairs = zip([len(CHANNELS), *channels], config.blocks, strict=False)
        blocks = (down_block(before, *block, config.dropout) for before, block in pairs)
        self.blocks: nn.ModuleList = nn.ModuleList(blocks)
        self.join = AddNeck(channels)
        self.head: nn.Conv2d = nn.Conv2d(channels[0], 2 * 4, 3, padding=1)
        bias: Any = self.head.bias
        bias.data[:] = torch.tensor([1.0] * 4 + [-1.0] * 4)  # start near the usual output

    def forward(self, inputs: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the evidence at given positions, (batch, N, 2).

        Parameters
        ----------
        inputs : (batch, channels, ranges, azimuths), (batch, N, 2)
            Features, and positions as azimuth and range from -1 to 1 across the polar grid.
        """
        features, places = inputs
        evidence = self.evidence(features)
        options: Any = {"mode": "bilinear", "padding_mode": "border", "align_corners": False}
        return grid_sample(evidence, places[:, :, None], **options)[..., 0].permute(0, 2, 1)

    def evidence(self, features: torch.Tensor) -> torch.Tensor:
        """Return evidence from features, (batch, 2, ranges, azimuths), at least 0."""
        return softplus(pixel_shuffle(self.quarters(features), 2).float())

    def quarters(self, features: torch.Tensor) -> torch.Tensor:
        """Return the output of the head before its activation, (batch, 2 * 4, ranges / 2, azimuths / 2)."""
        scales, x = [], features
        for block in self.blocks:
            x = block(x)
            scales.append(x)
        result: torch.Tensor = self.head(self.join(scales)[0])
        return result
