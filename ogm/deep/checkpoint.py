"""Trained networks on disk: weights in NAME.safetensors, network, grid and provenance in NAME.json.

Nothing is unpickled. Names, shapes and types of the weights must match the description. Both files must match the
checksums under ``sha256`` in the description, if it has them; files of older versions have no checksums.
"""

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from ogm.deep.description import FORMAT, description_checksum, grid_of, read_description
from ogm.deep.network import NetworkConfig, PillarNetwork
from ogm.io.reading import read_bytes
from ogm.storage.files import OgmError, atomic_write


def save_network(path: str | os.PathLike[str], network: PillarNetwork, facts: Mapping[str, Any]) -> Path:
    """Write weights and description of a network, each atomically.

    Parameters
    ----------
    path : path
        File name of the weights, ending in ``.safetensors``. The description has the same name, ending in ``.json``.
    network : PillarNetwork
    facts : mapping
        Further entries of the description that JSON can hold: provenance, recipe, results.

    Returns
    -------
    Path
        File of the weights.
    """
    path = _checked_path(path)
    weights = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    description = {
        **facts,
        "format": FORMAT,
        "network": asdict(network.config),
        "spec": asdict(network.spec),
        "parameters": sum(value.numel() for value in network.parameters()),
    }
    data = save(weights, {"format": FORMAT})
    description |= {"sha256": {"weights": hashlib.sha256(data).hexdigest()}}
    description["sha256"]["description"] = description_checksum(description)
    text = json.dumps(description, indent=1)  # before any file is written, as facts may not be JSON
    with atomic_write(path) as file:
        file.write(data)
    with atomic_write(path.with_suffix(".json"), "w") as file:
        file.write(text + "\n")
    return path


def load_network(path: str | os.PathLike[str]) -> tuple[PillarNetwork, dict[str, Any]]:
    """Read a network that `save_network` wrote.

    Returns
    -------
    network : PillarNetwork
        Network in evaluation mode, on the CPU.
    description : dict
        Content of the JSON file.

    Raises
    ------
    FileNotFoundError
        If one of the two files is missing.
    OgmError
        If a file is damaged, of another kind, or does not fit the other file.
    """
    path = _checked_path(path)
    beside = path.with_suffix(".json")
    for file in (path, beside):
        if not file.is_file():
            raise FileNotFoundError(f"there is no {file}: `ogm train` writes two files, {path.name} and {beside.name}")
    description = read_description(beside)
    try:
        with torch.device("meta"):  # names and shapes without memory
            wanted = _network(description).state_dict()
    except (ValueError, KeyError, TypeError, AttributeError, RuntimeError, OverflowError, MemoryError) as error:
        raise OgmError(f"{beside} describes no valid network: {error}; restore both files") from error
    weights = _read_weights(path, wanted)
    _check_sums(path, beside, description)
    network = _network(description)
    network.load_state_dict(weights)
    return network.eval(), description


def _network(description: dict[str, Any]) -> PillarNetwork:
    """Return the network of a description, with random weights."""
    config = NetworkConfig.from_dict(description["network"])
    _check_config(config)
    return PillarNetwork(config, grid_of(description))


def _read_weights(path: Path, wanted: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Read weights and check their names, shapes, types and values."""
    try:
        weights = load(read_bytes(path)[0])  # not memory-mapped: truncation of a mapped file would end the process
    except OgmError:
        raise
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise OgmError(f"{path} is no complete file of weights (.safetensors): {error}; restore it") from error
    if odd := sorted(set(weights) ^ set(wanted)):
        differing = f"{len(odd)} names differ, such as {odd[0]}"
        raise OgmError(f"{path} has other weights than its description: {differing}; restore both files")
    for name, value in weights.items():
        if value.shape != wanted[name].shape:
            raise OgmError(f"{path} has {name} of shape {list(value.shape)}, wanted {list(wanted[name].shape)}")
        if value.dtype != wanted[name].dtype:
            raise OgmError(f"{path} has {name} as {value.dtype}, wanted {wanted[name].dtype}")
        if not torch.isfinite(value).all() or (name.endswith("running_var") and (value < 0).any()):
            raise OgmError(f"{path} has variances below 0, or NaN or infinite weights, in {name}: restore it")
    return weights


def _check_sums(path: Path, beside: Path, description: Mapping[str, Any]) -> None:
    """Compare both files with the checksums in the description, if it has checksums."""
    if "sha256" not in description:
        return
    for file, part, found in (
        (beside, "description", description_checksum(description)),
        (path, "weights", hashlib.sha256(path.read_bytes()).hexdigest()),
    ):
        wanted = description["sha256"]
        if not isinstance(wanted, dict) or wanted.get(part) != found:
            raise OgmError(f"{file} is damaged: its SHA-256 differs from sha256, {part} in {beside}; restore both")


def _check_config(config: NetworkConfig) -> None:
    """Raise ValueError for sizes that would exhaust the memory, before the weights are read."""
    low, high = config.z_range
    good = (
        _are_sizes([config.pillar, config.up], config.blocks)
        and config.join in ("add", "concatenate")
        and config.evidence in ("softplus", "relu")
        and len(config.scale) == 9
        and all(0 < s < math.inf for s in config.scale)
        and -math.inf < low < high < math.inf
        and 0 <= config.dropout < 1
    )
    if not good:
        raise ValueError(f"a size, a range or a choice is invalid in {config}")


def _are_sizes(others: list[int], blocks: tuple[tuple[int, int], ...]) -> bool:
    sizes = [*others, *(n for block in blocks for n in block)]
    small = 0 < len(blocks) <= 8 and all(count <= 64 for _, count in blocks)
    return small and all(type(n) is int and 0 < n <= 4096 for n in sizes)


def _checked_path(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if path.suffix != ".safetensors":
        raise OgmError(f"weights must be named .safetensors, got {path}: rename the file")
    return path
