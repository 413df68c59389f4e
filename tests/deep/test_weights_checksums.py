"""Damaged weights: every flipped bit is found, in the weights, their description and the exported network."""

import hashlib
import json
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import pytest
import torch
from damage import check_flips

from ogm.deep.checkpoint import load_network, save_network
from ogm.deep.network import LITE, PillarNetwork
from ogm.deep.onnx_file import read_onnx, sealed
from ogm.grid import GridSpec
from ogm.storage.files import OgmError

SPEC = GridSpec(0.16, (64, 32), (-5.12, -2.4))
SMALL = replace(LITE, blocks=((8, 1), (8, 1)))


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    return save_network(tmp_path / "net.safetensors", PillarNetwork(SMALL, SPEC), {"seen": {"height": [1.7, 2.1]}})


def test_flipped_bits_of_weights_are_found(saved: Path) -> None:
    def read() -> Any:
        network, description = load_network(saved)
        state = {name: value.numpy().tobytes() for name, value in network.state_dict().items()}
        return network.config, network.spec, state, description["seen"]

    assert check_flips(saved, read, 40)["harmless"] == 0
    found = check_flips(saved.with_suffix(".json"), read, 60)
    assert found["refused"] > found["harmless"]


def test_weights_of_another_training_are_refused(saved: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    torch.manual_seed(1)
    save_network(tmp_path / "other" / "net.safetensors", PillarNetwork(SMALL, SPEC), {})
    for name in ("net.safetensors", "net.json"):
        before = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes((tmp_path / "other" / name).read_bytes())
        with pytest.raises(OgmError, match=r"net\.safetensors is damaged: its SHA-256"):
            load_network(saved)
        (tmp_path / name).write_bytes(before)


def test_weights_without_checksums_are_read(saved: Path) -> None:
    beside = saved.with_suffix(".json")
    description = json.loads(beside.read_text())
    assert description.pop("sha256")["weights"] == hashlib.sha256(saved.read_bytes()).hexdigest()
    beside.write_text(json.dumps(description))
    assert load_network(saved)[1] == description


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """The network that comes with the package."""
    with as_file(files("ogm") / "data" / "lite.onnx") as path:
        (tmp_path / "net.onnx").write_bytes(path.read_bytes())
    return tmp_path / "net.onnx"


def test_flipped_bits_of_an_exported_network_are_found(exported: Path) -> None:
    def read() -> Any:
        file = read_onnx(exported)
        return file.description, file.weight.tobytes(), file.data[:-76]

    found = check_flips(exported, read, 60)
    assert found["harmless"] <= 1


def test_flipped_bits_of_the_checksum_itself_change_nothing(exported: Path) -> None:
    whole, refused = exported.read_bytes(), 0
    for at in range(len(whole) - 76, len(whole)):
        exported.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        try:
            assert read_onnx(exported).data[:-76] == whole[:-76], at
        except OgmError:
            refused += 1
    assert refused >= 64


def test_an_exported_network_without_a_checksum_is_read(exported: Path) -> None:
    whole = exported.read_bytes()
    exported.write_bytes(whole[:-76])
    assert read_onnx(exported).description
    assert sealed(whole[:-76]) == whole


def test_the_files_that_come_with_the_package_have_checksums() -> None:
    with as_file(files("ogm") / "data") as data:
        description = json.loads((data / "lite.json").read_text())
        assert description["sha256"]["weights"] == hashlib.sha256((data / "lite.safetensors").read_bytes()).hexdigest()
        assert read_onnx(data / "lite.onnx").weights_sum == description["sha256"]["weights"]
        load_network(data / "lite.safetensors")
