"""Deep inverse sensor models: pillars, network, losses, training, and the model that goes through the common door."""

from ogm.deep.ism import DeepISM
from ogm.deep.network import LITE, PAPER, Network, NetworkConfig

__all__ = ["LITE", "PAPER", "DeepISM", "Network", "NetworkConfig"]
