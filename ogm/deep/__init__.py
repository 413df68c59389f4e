"""Deep inverse sensor models: pillars, network, losses, training, and the trained model as `DeepISM`."""

try:
    from ogm.deep.ism import DeepISM
    from ogm.deep.network import LITE, PAPER, NetworkConfig, PillarNetwork
except ImportError as error:
    raise ImportError(
        f'the deep models lack a package ({error}): pip install "ogm-toolkit[deep]"; '
        "on a machine without an NVIDIA GPU install PyTorch's CPU build first"
    ) from error

__all__ = ["LITE", "PAPER", "DeepISM", "NetworkConfig", "PillarNetwork"]
