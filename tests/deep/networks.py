"""Networks as after training."""

import torch

from ogm.deep.network import NetworkConfig, PillarNetwork
from ogm.grid import GridSpec

SPEC = GridSpec.centered(length=10.24, width=5.12, resolution=0.16)  # 64 x 32 cells


def trained(config: NetworkConfig, spec: GridSpec = SPEC) -> PillarNetwork:
    """Make a network whose normalisation is not the identity, as after training."""
    torch.manual_seed(1)
    network = PillarNetwork(config, spec).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
            torch.nn.init.normal_(module.running_mean, 0, 0.1)
            torch.nn.init.uniform_(module.running_var, 0.5, 2)
            torch.nn.init.uniform_(module.weight, 0.5, 2)
            torch.nn.init.normal_(module.bias, 0, 0.3)
    return network
