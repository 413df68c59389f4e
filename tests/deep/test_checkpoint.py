"""Networks on disk: what was saved comes back, and files that are damaged, foreign or hostile are refused unrun."""

import json
import pickle
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cases import each
from safetensors.torch import load_file, save_file

from ogm.deep.checkpoint import FORMAT, load_network, save_network
from ogm.deep.network import LITE, PAPER, PillarNetwork
from ogm.deep.pillars import pillarize
from ogm.grid import GridSpec

SPEC = GridSpec(0.16, (64, 32), (-5.12, -2.4))
ADD = replace(LITE, blocks=((8, 1), (8, 1)))
CONCATENATE = replace(PAPER, pillar=8, blocks=((8, 1), (8, 2)), up=8)
FACTS = {"seed": 3, "seen": {"height": [1.7, 2.1]}}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return save_network(tmp_path / "net.safetensors", PillarNetwork(ADD, SPEC), FACTS)


def change(path: Path, how: Callable[[dict[str, Any]], Any]) -> None:
    """Change the description of saved weights."""
    beside = path.with_suffix(".json")
    description = json.loads(beside.read_text())
    how(description)
    beside.write_text(json.dumps(description))


def guarded(config: Any, spec: GridSpec) -> PillarNetwork:
    """Make a network, but none that would fill the memory."""
    size = max(config.pillar, config.up, *(n for n, _ in config.blocks))
    count = sum(n for _, n in config.blocks)
    weightless = torch.empty(0).device.type == "meta"
    assert count <= 1000, "too many layers would have been made"
    assert size <= 256 or weightless, "a huge network would have been made"
    return PillarNetwork(config, spec)


class Trap:
    """Makes a file when it is unpickled."""

    def __init__(self, sprung: Path) -> None:
        self.sprung = sprung

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.sprung,)


@each("config", [ADD, CONCATENATE])
def test_what_was_saved_comes_back(config: Any, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = PillarNetwork(config, SPEC).train()
    rng = np.random.default_rng(0)
    points = rng.uniform((-5, -2.3, 0, 0), (5, 2.5, 2, 1), (500, 4)).astype(np.float32)
    pillars = pillarize(points, SPEC)
    network(pillars)  # moves the normalisation's statistics
    path = save_network(tmp_path / "net.safetensors", network, FACTS)
    found, description = load_network(path)
    assert found.config == config
    assert found.spec == SPEC
    assert not found.training
    with torch.inference_mode():
        assert torch.equal(found(pillars), network.eval()(pillars))
    assert description["format"] == FORMAT
    assert description["parameters"] == sum(value.numel() for value in network.parameters())
    assert {name: description[name] for name in FACTS} == FACTS
    assert sorted(p.name for p in tmp_path.iterdir()) == ["net.json", "net.safetensors"]


def test_saving_again_replaces(saved: Path) -> None:
    save_network(saved, PillarNetwork(CONCATENATE, SPEC), {})
    network, description = load_network(saved)
    assert network.config == CONCATENATE
    assert "seed" not in description


def test_facts_that_json_cannot_hold_leave_what_was_there(saved: Path) -> None:
    before = {path: path.read_bytes() for path in saved.parent.iterdir()}
    with pytest.raises(TypeError, match="JSON"):
        save_network(saved, PillarNetwork(CONCATENATE, SPEC), {"odd": object()})
    assert {path: path.read_bytes() for path in saved.parent.iterdir()} == before


@each("name", ["net.pt", "net", "net.safetensors.gz"])
def test_other_names_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.safetensors"):
        save_network(tmp_path / name, PillarNetwork(ADD, SPEC), {})
    with pytest.raises(ValueError, match=r"\.safetensors"):
        load_network(tmp_path / name)
    assert not list(tmp_path.iterdir())


@each("suffix", [".json", ".safetensors"])
def test_one_file_of_the_two_is_not_enough(saved: Path, suffix: str) -> None:
    saved.with_suffix(suffix).unlink()
    with pytest.raises(FileNotFoundError, match=rf"net\{suffix} is not there.*two files"):
        load_network(saved)


def test_weights_that_are_cut_off_are_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for size in (0, 4, 8, 100, len(whole) // 2, len(whole) - 1):
        saved.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="no whole|not a whole|holds 0 bytes"):
            load_network(saved)


def test_nothing_is_unpickled(saved: Path, tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    pickled = pickle.dumps(Trap(sprung))
    torch.save(Trap(sprung), saved)
    with pytest.raises(ValueError, match="not a whole file of weights"):
        load_network(saved)
    saved.write_bytes(pickled)
    with pytest.raises(ValueError, match="not a whole file of weights"):
        load_network(saved)
    saved.with_suffix(".json").write_bytes(pickled)
    with pytest.raises(ValueError, match="no description"):
        load_network(saved)
    assert not sprung.exists()
    pickle.loads(pickled)
    assert sprung.exists()  # the trap works


@each("header", [2**63, 2**40, 2**31])
def test_a_header_that_claims_to_be_huge_is_refused(saved: Path, header: int) -> None:
    saved.write_bytes(struct.pack("<Q", header) + b'{"a": 1}')
    with pytest.raises(ValueError, match="not a whole file of weights"):
        load_network(saved)


def test_a_weight_that_claims_to_be_huge_is_refused(saved: Path) -> None:
    head = {"head.weight": {"dtype": "F32", "shape": [2**40, 4], "data_offsets": [0, 2**44]}}
    text = json.dumps(head).encode()
    saved.write_bytes(struct.pack("<Q", len(text)) + text + b"\0" * 64)
    with pytest.raises(ValueError, match="not a whole file of weights"):
        load_network(saved)


@each(
    "text",
    [
        b"",
        b"{",
        b"\xff\xfe\x00",
        b"[]",
        b"3",
        b"null",
        b'"ogm.network/1"',
        b"{}",
        b"[" * 100_000,
        b"[" + b"0," * 2**19 + b"0]",
        b"9" * 5000,
    ],
)
def test_a_description_that_is_none_is_refused(saved: Path, text: bytes) -> None:
    saved.with_suffix(".json").write_bytes(text)
    with pytest.raises(ValueError, match=r"net\.json is no description of a network"):
        load_network(saved)


@each("found", ["ogm.network/2", None, 1, ["ogm.network/1"]])
def test_another_format_is_refused(saved: Path, found: Any) -> None:
    change(saved, lambda description: description.update(format=found))
    with pytest.raises(ValueError, match="has the format .* reads ogm.network/1"):
        load_network(saved)


@each(
    "part, value",
    [
        ("pillar", 10**9),
        ("pillar", 0),
        ("pillar", -8),
        ("pillar", "8"),
        ("pillar", None),
        ("pillar", True),
        ("up", 10**12),
        ("blocks", [[10**6, 2], [8, 1]]),
        ("blocks", [[8, 10**9], [8, 1]]),
        ("blocks", [[4096, 4096], [4096, 4096]]),
        ("blocks", [[8, 1]] * 40),
        ("blocks", [[8, 1]]),  # with bearings
        ("blocks", [[8, 1, 1], [8, 1, 1]]),
        ("blocks", [8, 8]),
        ("blocks", []),
        ("blocks", 4),
        ("blocks", None),
        ("join", "stack"),
        ("evidence", ["relu"]),
        ("dropout", 3.0),
        ("dropout", "much"),
        ("dropout", float("nan")),
        ("scale", [1.0]),
        ("scale", ["a"] * 9),
        ("scale", [0.0] * 9),
        ("scale", [float("nan")] * 9),
        ("scale", 1.0),
        ("z_range", [0.0]),
        ("z_range", ["low", "high"]),
        ("z_range", [float("nan"), 2.0]),
        ("z_range", [3.0, -3.0]),
        ("unheard_of", 1),
    ],
)
def test_a_network_that_cannot_be_is_refused_before_it_is_made(
    saved: Path, part: str, value: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.deep.checkpoint.PillarNetwork", guarded)
    change(saved, lambda description: description["network"].update({part: value}))
    with pytest.raises(ValueError, match="describes no network that can be made"):
        load_network(saved)


@each("join", ["add", "concatenate"])
def test_a_huge_network_is_refused_before_it_fills_the_memory(
    saved: Path, join: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.deep.checkpoint.PillarNetwork", guarded)
    huge = {"blocks": [[4096, 30], [4096, 30]], "up": 4096, "pillar": 4096, "join": join}
    change(saved, lambda description: description["network"].update(huge))
    with pytest.raises(ValueError, match="describes no network|does not hold the weights"):
        load_network(saved)


@each(
    "spec",
    [
        {"resolution": 0.16, "shape": [2**20, 2**20], "origin": [0, 0]},
        {"resolution": 0.16, "shape": [66, 32], "origin": [0, 0]},
        {"resolution": 0.16, "shape": [-64, 32], "origin": [0, 0]},
        {"resolution": 0.16, "shape": [64, 32, 1], "origin": [0, 0]},
        {"resolution": 0.16, "shape": 64, "origin": [0, 0]},
        {"resolution": 0, "shape": [64, 32], "origin": [0, 0]},
        {"resolution": float("nan"), "shape": [64, 32], "origin": [0, 0]},
        {"resolution": "fine", "shape": [64, 32], "origin": [0, 0]},
        {"resolution": 0.16, "shape": [64, 32], "origin": [float("inf"), 0]},
        {"resolution": 0.16, "shape": [64, 32]},
        [0.16, 64, 32],
        None,
    ],
)
def test_a_grid_that_cannot_be_is_refused(saved: Path, spec: Any) -> None:
    change(saved, lambda description: description.update(spec=spec))
    with pytest.raises(ValueError, match="describes no network that can be made"):
        load_network(saved)


@each("network", [None, [], ["pillar", 8], "lite", {}])
def test_a_config_that_is_none_is_refused(saved: Path, network: Any) -> None:
    change(saved, lambda description: description.update(network=network))
    with pytest.raises(ValueError, match="describes no network that can be made"):
        load_network(saved)


@each("part", ["network", "spec"])
def test_a_description_that_lacks_a_part_is_refused(saved: Path, part: str) -> None:
    change(saved, lambda description: description.pop(part))
    with pytest.raises(ValueError, match="describes no network that can be made"):
        load_network(saved)


def test_weights_of_another_network_are_refused(saved: Path, tmp_path: Path) -> None:
    other = save_network(tmp_path / "other.safetensors", PillarNetwork(CONCATENATE, SPEC), {})
    other.replace(saved)
    with pytest.raises(ValueError, match="does not hold the weights .* names differ, such as"):
        load_network(saved)


@each("change_names", ["missing", "more"])
def test_weights_with_other_names_are_refused(saved: Path, change_names: str) -> None:
    weights = load_file(saved)
    if change_names == "missing":
        del weights["head.bias"]
    else:
        weights["head.more"] = torch.zeros(3)
    save_file(weights, saved)
    with pytest.raises(ValueError, match=r"1 names differ, such as head\."):
        load_network(saved)


def test_weights_of_other_shapes_are_refused(saved: Path) -> None:
    change(saved, lambda description: description["network"].update(pillar=32))
    with pytest.raises(ValueError, match=r"has .* of shape \[.*\], wanted \[.*32"):
        load_network(saved)


@each("value", [float("nan"), float("inf"), -float("inf")])
def test_weights_that_are_no_numbers_are_refused(saved: Path, value: float) -> None:
    weights = load_file(saved)
    weights["head.weight"][1, 2, 0, 1] = value
    save_file(weights, saved)
    with pytest.raises(ValueError, match="NaN or infinite, in head.weight"):
        load_network(saved)


@each("dtype", [torch.complex64, torch.int8, torch.bool])
def test_weights_of_another_kind_are_refused(saved: Path, dtype: torch.dtype) -> None:
    weights = load_file(saved)
    weights["head.weight"] = torch.zeros(weights["head.weight"].shape, dtype=dtype)
    try:
        save_file(weights, saved)
    except KeyError:
        pytest.skip(f"this version of safetensors writes no {dtype}")
    with pytest.raises(ValueError, match=r"head\.weight"):
        load_network(saved)


def test_a_variance_below_zero_is_refused(saved: Path) -> None:
    weights = load_file(saved)
    weights["pillar.norm.running_var"][0] = -1
    save_file(weights, saved)
    with pytest.raises(ValueError, match=r"pillar\.norm\.running_var"):
        load_network(saved)
