"""One of the processes of a training on several nodes: python train_node.py FOLDER EPOCHS [KILLED]."""

import json
import os
import signal
import sys
from pathlib import Path

import torch
from walls import frame

from ogm.deep.network import NetworkConfig
from ogm.deep.recipe import Recipe
from ogm.deep.training import train
from ogm.grid import GridSpec

TRAINING = 18
SCALE = (15.0, 10.0, 2.0, 0.5, 0.2, 0.2, 0.3, 0.3, 0.3)


class Noted(list):
    """Frames that write down which of them are read, and kill the process of the second node at the n-th."""

    def __init__(self, frames, killed):
        super().__init__(frames)
        self.numbers, self.killed = [], killed

    def __getitem__(self, i):
        self.numbers.append(i)
        if len(self.numbers) == self.killed and os.environ["NODE_RANK"] == "1":
            os.kill(os.getpid(), signal.SIGKILL)
        return super().__getitem__(i)


def main(folder, epochs, killed=0):
    torch.set_num_threads(1)
    network = NetworkConfig(pillar=8, blocks=((8, 1), (8, 1), (8, 1)), join="add", bearings=True, scale=SCALE)
    recipe = Recipe(network, epochs=int(epochs), batch=4, warmup=2, learning_rate=1e-2, average=0.5)
    frames = Noted([frame(k) for k in range(TRAINING)], int(killed))
    fixed = [frame(k) for k in range(100, 102)]
    small = GridSpec.centered(length=30.72, width=20.48, resolution=0.64)
    options = {"accelerator": "cpu", "precision": "32-true", "nodes": 2, "workers": 0}
    try:
        train(frames, fixed, small, Path(folder), recipe, resume=True, picture_every=0, progress=False, **options)
    except OSError as error:
        sys.exit(str(error))
    rank = os.environ["NODE_RANK"]
    Path(f"{folder}-{rank}.json").write_text(json.dumps(frames.numbers[TRAINING:]))


if __name__ == "__main__":
    main(*sys.argv[1:])
