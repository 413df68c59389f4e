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


def save(folder: Path) -> Path:
    return save_network(folder / "net.safetensors", PillarNetwork(ADD, SPEC), FACTS)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    return save(tmp_path)


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


def test_one_file_of_the_two_is_not_enough(saved: Path) -> None:
    for path in (saved.with_suffix(".json"), saved):
        path.unlink()
        with pytest.raises(FileNotFoundError, match=rf"there is no .*net\{path.suffix}: .*two files"):
            load_network(saved)
        save(saved.parent)


def test_weights_that_are_cut_off_are_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    for size in (0, 4, 8, 100, len(whole) // 2, len(whole) - 1):
        saved.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="no complete|holds 0 bytes"):
            load_network(saved)


def test_a_header_or_a_weight_that_claims_to_be_huge_is_refused(saved: Path) -> None:
    weight = json.dumps({"head.weight": {"dtype": "F32", "shape": [2**40, 4], "data_offsets": [0, 2**44]}}).encode()
    claims = [(size, b'{"a": 1}') for size in (2**63, 2**40, 2**31)]
    for size, header in (*claims, (len(weight), weight + b"\0" * 64)):
        saved.write_bytes(struct.pack("<Q", size) + header)
        with pytest.raises(ValueError, match="no complete file of weights"):
            load_network(saved)


def test_nothing_is_unpickled(saved: Path, tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    pickled = pickle.dumps(Trap(sprung))
    torch.save(Trap(sprung), saved)
    with pytest.raises(ValueError, match="no complete file of weights"):
        load_network(saved)
    saved.write_bytes(pickled)
    with pytest.raises(ValueError, match="no complete file of weights"):
        load_network(saved)
    saved.with_suffix(".json").write_bytes(pickled)
    with pytest.raises(ValueError, match="no description"):
        load_network(saved)
    assert not sprung.exists()
    pickle.loads(pickled)
    assert sprung.exists()  # the trap works


def test_a_description_that_is_none_is_refused(saved: Path) -> None:
    long = (b"[" * 100_000, b"[" + b"0," * 2**19 + b"0]", b"9" * 5000)
    for text in (b"", b"{", b"\xff\xfe\x00", b"[]", b"3", b"null", b'"ogm.network/1"', b"{}", *long):
        saved.with_suffix(".json").write_bytes(text)
        with pytest.raises(ValueError, match=r"net\.json is no description of a network"):
            load_network(saved)


IMPOSSIBLE = {
    "pillar": [10**9, 0, -8, "8", None, True],
    "up": [10**12],
    "blocks": [
        [[10**6, 2], [8, 1]], [[8, 10**9], [8, 1]], [[4096, 4096], [4096, 4096]], [[8, 1]] * 40, [[8, 1]],
        [[8, 1, 1], [8, 1, 1]], [8, 8], [], 4, None,
    ],
    "join": ["stack"],
    "evidence": [["relu"]],
    "dropout": [3.0, "much", float("nan")],
    "scale": [[1.0], ["a"] * 9, [0.0] * 9, [float("nan")] * 9, 1.0],
    "z_range": [[0.0], ["low", "high"], [float("nan"), 2.0], [3.0, -3.0]],
    "unheard_of": [1],
}  # fmt: skip
BAD_SPEC = {
    "resolution": [0, float("nan"), "fine"],
    "shape": [[2**20, 2**20], [66, 32], [-64, 32], [64, 32, 1], 64],
    "origin": [[float("inf"), 0], None],
}


def refused(tmp_path: Path, how: Callable[[dict[str, Any]], Any], message: str) -> None:
    saved = save(tmp_path)
    change(saved, how)
    with pytest.raises(ValueError, match=message):
        load_network(saved)


@each("name, value", [(name, value) for name, values in IMPOSSIBLE.items() for value in values])
def test_a_network_that_cannot_be_is_refused_before_it_is_made(
    tmp_path: Path, name: str, value: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.deep.checkpoint.PillarNetwork", guarded)
    message = "describes no valid network"
    refused(tmp_path, lambda description: description["network"].update({name: value}), message)


@each("name, value", [(name, value) for name, values in BAD_SPEC.items() for value in values])
def test_a_grid_that_cannot_be_is_refused(tmp_path: Path, name: str, value: Any) -> None:
    refused(tmp_path, lambda d: d["spec"].update({name: value}), "describes no valid network")


@each("part", ["network", "spec"])
def test_parts_of_another_kind_or_none_are_refused(tmp_path: Path, part: str) -> None:
    refused(tmp_path, lambda description: description.pop(part), "describes no valid network")
    for value in (None, [], ["pillar", 8], "lite", {}, [0.16, 64, 32]):
        refused(tmp_path, lambda description, v=value: description.update({part: v}), "no valid network")


@each("found", ["ogm.network/2", None, 1, ["ogm.network/1"]])
def test_another_format_is_refused(tmp_path: Path, found: Any) -> None:
    refused(tmp_path, lambda description: description.update(format=found), "has the format .* reads ogm.network/1")


@each("join", ["add", "concatenate"])
def test_a_huge_network_is_refused_before_it_fills_the_memory(
    tmp_path: Path, join: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.deep.checkpoint.PillarNetwork", guarded)
    huge = {"blocks": [[4096, 30], [4096, 30]], "up": 4096, "pillar": 4096, "join": join}
    message = "describes no valid network|has other weights"
    refused(tmp_path, lambda description: description["network"].update(huge), message)


def test_weights_of_another_network_are_refused(saved: Path, tmp_path: Path) -> None:
    other = save_network(tmp_path / "other.safetensors", PillarNetwork(CONCATENATE, SPEC), {})
    other.replace(saved)
    with pytest.raises(ValueError, match="has other weights .* names differ, such as"):
        load_network(saved)


@each("name, value, message", [
        ("head.bias", None, r"1 names differ, such as head\."),
        ("head.more", torch.zeros(3), r"1 names differ, such as head\."),
        *[("head.weight", one, "NaN or infinite weights, in head.weight") for one in (np.nan, np.inf, -np.inf)],
        *[("head.weight", one, r"head\.weight") for one in (torch.int8, torch.bool)],
        ("pillar.norm.running_var", -1.0, r"pillar\.norm\.running_var"),
    ])  # fmt: skip
def test_weights_that_do_not_fit_are_refused(tmp_path: Path, name: str, value: Any, message: str) -> None:
    saved = save(tmp_path)
    weights = load_file(saved)
    if isinstance(value, float):
        weights[name].view(-1)[-1] = value
    else:
        weights[name] = weights[name].to(value) if isinstance(value, torch.dtype) else value
    save_file({key: one for key, one in weights.items() if one is not None}, saved)
    with pytest.raises(ValueError, match=message):
        load_network(saved)


def test_weights_of_other_shapes_are_refused(tmp_path: Path) -> None:
    how = r"has .* of shape \[.*\], wanted \[.*32"
    refused(tmp_path, lambda description: description["network"].update(pillar=32), how)
