"""The network of radar: a polar grid of one sweep's features in, evidence for its cells out."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn.functional import grid_sample, pixel_shuffle, softplus

from ogm.deep.network import AddNeck, down_block
from ogm.deep.polar import CHANNELS, RadarGrid


@dataclass(frozen=True)
class RadarConfig:
    """Sizes of the network, kept as JSON with the weights.

    Parameters
    ----------
    blocks : tuple of (channels, convolutions)
        One per scale 1/2, 1/4, ...; see `ogm.deep.network.NetworkConfig`.
    dropout : float
        Share of the blocks' activations left out in training.
    """

    blocks: tuple[tuple[int, int], ...]
    dropout: float = 0.0

    @classmethod
    def from_dict(cls, numbers: dict[str, object]) -> "RadarConfig":
        """Make a configuration from JSON, where tuples are lists."""
        blocks = numbers["blocks"]
        return cls(**{**numbers, "blocks": tuple(tuple(one) for one in blocks)})  # type: ignore[arg-type,attr-defined]

    @property
    def stride(self) -> int:
        """Both sides of the polar grid must be whole multiples of this many cells."""
        return 1 << len(self.blocks)

    def build(self, spec: RadarGrid) -> "RadarNetwork":
        """Return a network of these sizes, with random weights."""
        return RadarNetwork(self, spec)


RADAR = RadarConfig(((24, 2), (32, 2), (48, 3), (64, 3)))


class RadarNetwork(nn.Module):
    """A U-Net on a polar grid, of the blocks of `ogm.deep.network.LITE`.

    Parameters
    ----------
    config : RadarConfig
    spec : RadarGrid

    Raises
    ------
    ValueError
        If the polar grid's cells cannot be halved as often as the network does.
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
        self.blocks: nn.ModuleList = nn.ModuleList(
            down_block(before, *block, config.dropout) for before, block in pairs
        )
        self.join = AddNeck(channels)
        self.head: nn.Conv2d = nn.Conv2d(channels[0], 2 * 4, 3, padding=1)
        bias: Any = self.head.bias
        bias.data[:] = torch.tensor([1.0] * 4 + [-1.0] * 4)  # begin near the usual

    def forward(self, inputs: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Return the evidence of places, (batch, N, 2).

        Parameters
        ----------
        inputs : (batch, channels, ranges, azimuths), (batch, N, 2)
            Features, and places as azimuth and range from -1 to 1 across the polar grid.
        """
        features, places = inputs
        evidence = self.evidence(features)
        options: Any = {"mode": "bilinear", "padding_mode": "border", "align_corners": False}
        return grid_sample(evidence, places[:, :, None], **options)[..., 0].permute(0, 2, 1)

    def evidence(self, features: torch.Tensor) -> torch.Tensor:
        """Return evidence (batch, 2, ranges, azimuths), at least 0, from features."""
        return softplus(pixel_shuffle(self.quarters(features), 2).float())

    def quarters(self, features: torch.Tensor) -> torch.Tensor:
        """Return the head's values before their activation, (batch, 2 * 4, ranges / 2, azimuths / 2)."""
        scales, x = [], features
        for block in self.blocks:
            x = block(x)
            scales.append(x)
        result: torch.Tensor = self.head(self.join(scales)[0])
        return result
