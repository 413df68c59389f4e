"""The network: shapes, batches, empty scans, fusion, sizes, and gradients."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from cases import each, refused
from networks import SPEC, trained

from ogm.deep.network import LITE, PAPER, NetworkConfig, PillarNetwork, copy_weights
from ogm.deep.pillars import Pillars, collate, pillarize
from ogm.deep.torch_engine import fused
from ogm.grid import GridSpec

CELLS = SPEC.shape[0] * SPEC.shape[1]
SMALL = [
    replace(LITE, blocks=((8, 1), (12, 2), (16, 1))),
    replace(PAPER, pillar=16, blocks=((8, 1), (16, 2), (16, 1)), up=8),
]
both = each("config", SMALL)


def scan(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform((-5, -2.5, 0, 0), (5, 2.5, 2, 1), (n, 4)).astype(np.float32)


def pillars(n: int, seed: int = 0, spec: GridSpec = SPEC) -> Pillars:
    return pillarize(scan(n, seed), spec)


def count(config: NetworkConfig) -> int:
    return sum(value.numel() for value in PillarNetwork(config, SPEC).parameters())


@both
@each("evidence", ["softplus", "relu"])
@torch.inference_mode()
def test_evidence_is_a_batch_of_grids_with_the_states_last(config: NetworkConfig, evidence: str) -> None:
    network = trained(replace(config, evidence=evidence))
    found = network(collate([pillars(500, 0), pillars(300, 1), pillars(0)], CELLS))
    assert found.shape == (3, 64, 32, 2)
    assert found.dtype == torch.float32
    assert found.isfinite().all()
    assert found.min() >= 0
    assert found.max() > 0.1


@torch.inference_mode()
def test_a_new_network_expects_free_before_occupied() -> None:
    evidence = PillarNetwork(SMALL[0], SPEC).eval()(pillars(0))
    assert evidence[..., 0].min() > evidence[..., 1].max()


@both
@torch.inference_mode()
def test_a_batch_gives_what_its_scans_give_alone(config: NetworkConfig) -> None:
    network = trained(config)
    scans = [pillars(n, n) for n in (400, 0, 1, 700)]
    together = network(collate(scans, CELLS))
    for number, one in enumerate(scans):
        np.testing.assert_allclose(network(one)[0], together[number], atol=1e-5)


@both
@torch.inference_mode()
def test_the_order_of_points_does_not_matter(config: NetworkConfig) -> None:
    network, points = trained(config), scan(800)
    shuffled = np.random.default_rng(0).permutation(points)
    one, other = (network(pillarize(these, SPEC)) for these in (points, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-4)
    assert one.std() > 0.01


@each("join", ["concatenate", "add"])
@torch.inference_mode()
def test_a_point_changes_the_evidence_where_it_stands(join: str) -> None:
    config = NetworkConfig(pillar=8, blocks=((8, 1),), join=join, up=8)
    network = trained(config)
    point = np.float32([[2.3, -1.5, 0.4, 0.5]])
    ix, iy = SPEC.index(2.3, -1.5)
    changed = (network(pillarize(point, SPEC)) - network(pillars(0)))[0].abs().sum(-1) > 1e-6
    where = changed.nonzero()
    assert changed[ix, iy]
    assert (where - torch.tensor([int(ix), int(iy)])).abs().max() <= 5  # what the convolutions can reach


@both
@torch.inference_mode()
def test_the_fused_network_is_the_network(config: NetworkConfig) -> None:
    network = trained(config)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    quick = fused(network)
    for n in (500, 0, 1):
        np.testing.assert_allclose(quick(pillars(n)), network(pillars(n)), atol=1e-4)
    assert not any("BatchNorm" in type(module).__name__ for module in quick.modules())
    for name, value in network.state_dict().items():  # the original is left alone
        assert torch.equal(value, before[name])


def test_lite_is_small_and_paper_as_large_as_the_documentation_states() -> None:
    assert count(LITE) <= 1_500_000
    assert count(PAPER) == 4_834_760


@each("shape, better", [((60, 32), "(64, 32)"), ((64, 33), "(64, 40)")])
def test_a_grid_that_cannot_be_halved_is_refused(shape: tuple[int, int], better: str) -> None:
    with pytest.raises(ValueError, match="multiples of 8 cells") as caught:
        PillarNetwork(SMALL[0], GridSpec(0.16, shape, (0, 0)))
    assert f"got {shape}" in str(caught.value)
    assert f"use {better} cells" in str(caught.value)


def test_bearings_need_two_scales() -> None:
    refused("bearings", PillarNetwork, NetworkConfig(pillar=8, blocks=((8, 1),), join="add", bearings=True), SPEC)


@pytest.mark.slow
@both
@each("n", [0, 1, 2])
def test_empty_and_one_point_scans_can_be_learned_from(config: NetworkConfig, n: int) -> None:
    network = trained(config).train()
    before = network.pillar.norm.running_mean.clone()
    evidence = network(pillars(n))
    evidence.sum().backward()
    assert evidence.isfinite().all()
    for name, value in network.named_parameters():
        assert value.grad is None or value.grad.isfinite().all(), name
    assert network.head.weight.grad is not None
    assert torch.equal(network.pillar.norm.running_mean, before) == (n < 2)  # no statistics of one point
    network.eval()
    with torch.inference_mode():
        assert network(pillars(n)).isfinite().all()


@both
def test_the_gradient_reaches_every_parameter(config: NetworkConfig) -> None:
    network = trained(config).train()
    evidence = network(collate([pillars(800, 0), pillars(600, 1)], CELLS))
    (evidence * torch.randn(evidence.shape, generator=torch.Generator().manual_seed(0))).sum().backward()
    for name, value in network.named_parameters():
        assert value.grad is not None, name
        assert value.grad.isfinite().all(), name
        assert value.grad.abs().max() > 0, name


def test_sensor_coords_are_polar_coordinates() -> None:
    coords = PillarNetwork(SMALL[0], SPEC).sensor_coords[0]
    assert coords.shape == (4, 16, 8)
    x, y = np.meshgrid(np.arange(-4.8, 5, 0.64), np.arange(-2.24, 2.5, 0.64), indexing="ij")  # [m], 4 x 4 cells
    r = np.hypot(x, y)
    np.testing.assert_allclose(coords, [r / 40, np.log(r / 10), x / r, y / r], atol=1e-5)


@each("config", [LITE, PAPER, *SMALL])
def test_a_config_survives_json(config: NetworkConfig) -> None:
    assert NetworkConfig.from_dict(json.loads(json.dumps(asdict(config)))) == config


def test_a_network_that_takes_rays_begins_as_the_one_without():
    torch.manual_seed(1)
    config = NetworkConfig(4, ((8, 1), (8, 1)), join="add")
    before = PillarNetwork(config, SPEC).eval()
    after = PillarNetwork(replace(config, rays=True), SPEC).eval()
    copy_weights(before, after)
    points = np.random.default_rng(0).uniform(-4, 4, (200, 4)).astype(np.float32)
    plain = pillarize(np.abs(points), SPEC)
    rays = torch.rand(1, *SPEC.shape, 2)
    with torch.no_grad():
        torch.testing.assert_close(after(plain._replace(rays=rays)), before(plain))
        after.blocks[0][0][0].weight[:, -2:] = 0.1
        assert not torch.allclose(after(plain._replace(rays=rays)), before(plain))
    refused("Pillars without rays", after, plain)
    refused("other layers", copy_weights, after, before)
