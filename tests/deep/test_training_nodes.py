"""A training on two nodes, here two processes of this machine that meet by gloo, as on two machines."""

import csv
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).parent


def on_two_nodes(*words: object) -> list[int]:
    """Start the training on both nodes, and return their exit codes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    known = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"}
    known["PYTHONPATH"] = os.pathsep.join([str(HERE), *sys.path])
    command = [sys.executable, str(HERE / "train_node.py"), *map(str, words)]
    nodes = [subprocess.Popen(command, env=known | {"NODE_RANK": str(rank)}) for rank in range(2)]
    try:
        return [node.wait(300) for node in nodes]
    finally:
        for node in nodes:
            node.kill()


def curve(folder: Path) -> list[float]:
    with open(folder / "log.csv") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


@pytest.mark.slow
def test_two_nodes_learn_from_frames_of_their_own_and_resume(tmp_path: Path) -> None:
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert on_two_nodes(whole, 12) == [0, 0]
    losses = curve(whole)
    assert len(losses) == 12
    assert losses[-1] < 0.5 * losses[0]
    read = [json.loads(Path(f"{whole}-{rank}.json").read_text()) for rank in range(2)]
    assert [len(one) for one in read] == [8 * 12, 8 * 12]  # two batches of four per epoch
    for epoch in range(12):
        seen = [one for node in read for one in node[8 * epoch : 8 * epoch + 8]]
        assert len(set(seen)) == 16
        assert set(seen) <= set(range(18))
    assert on_two_nodes(stopped, 12, 18 + 8 * 5 + 6) == [1, -9]  # within the sixth epoch
    assert len(curve(stopped)) == 5
    assert torch.load(stopped / "state.pt", weights_only=True)["step"] == 11  # the first has saved what was done
    assert on_two_nodes(stopped, 12) == [0, 0]
    states = [torch.load(one / "state.pt", weights_only=True) for one in (whole, stopped)]
    for name, value in states[0]["network"].items():
        assert value.equal(states[1]["network"][name]), name
    assert (whole / "best.safetensors").read_bytes() == (stopped / "best.safetensors").read_bytes()
