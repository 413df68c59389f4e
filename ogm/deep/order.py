"""Order of frames in a training: shuffled, disjoint between processes, and reproducible when resumed."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, zip_longest

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch.utils.data import Sampler

STREAMS = 8  # streams of batches in a process; up to this number of loading processes share no shard
BLOCK = 8  # shards of which the frames are shuffled together


@dataclass(eq=False)
class EpochSampler(Sampler[tuple[int, int]]):
    """Sampler of an epoch: this process's share of all frames, each once, from a position on."""

    count: int
    seed: int
    rank: int = 0
    processes: int = 1
    epoch: int = 0
    skip: int = 0  # frames of this process that are already done

    def __len__(self) -> int:
        return self.count // self.processes - self.skip

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = np.random.default_rng((self.seed, self.epoch)).permutation(self.count)
        order = order[: self.count // self.processes * self.processes][self.rank :: self.processes]
        return iter([(self.epoch, int(i)) for i in order[self.skip :]])


class ShardSampler(EpochSampler):
    """Sampler that keeps the frames of a shard close together, for datasets in object stores.

    Shards are shuffled and distributed to the processes, and within a process to streams. In each stream, the frames
    of `BLOCK` shards are shuffled together. Batches are taken from the streams in turn. If the number of loading
    processes is a divisor of `STREAMS`, each shard is read once by a single process. The order does not depend on that
    number.

    Parameters
    ----------
    shards : (count,) int array
        Shard of every frame.
    seed, rank, processes
        See `EpochSampler`.
    batch : int
        Frames per step in each process.
    """

    batch: int

    def __init__(self, shards: ArrayLike, seed: int, rank: int = 0, processes: int = 1, *, batch: int = 1) -> None:
        _, first, counts = np.unique(np.sort(np.asarray(shards)), return_index=True, return_counts=True)
        by_shard = np.argsort(shards, kind="stable")
        self._shards = [by_shard[start : start + count] for start, count in zip(first, counts, strict=True)]
        self.batch = batch
        super().__init__(len(by_shard), seed, rank, processes)

    def __len__(self) -> int:
        return self._share - self.skip

    @property
    def _share(self) -> int:
        """Number of frames of each process, a multiple of the batch size."""
        return self.count // self.processes // self.batch * self.batch

    def __iter__(self) -> Iterator[tuple[int, int]]:
        rng = np.random.default_rng((self.seed, self.epoch))
        shards = [self._shards[k] for k in rng.permutation(len(self._shards))]
        orders = [self._of_process(shards[rank :: self.processes], rng) for rank in range(self.processes)]
        spare = np.concatenate([order[self._share :] for order in orders])
        for rank, order in enumerate(orders):  # processes with fewer frames take the spare frames of others
            need = max(0, self._share - len(order))
            orders[rank], spare = np.concatenate([order[: self._share], spare[:need]]), spare[need:]
        return iter([(self.epoch, int(i)) for i in orders[self.rank][self.skip :]])

    def _of_process(self, shards: list[NDArray[np.intp]], rng: np.random.Generator) -> NDArray[np.intp]:
        """Return the frames of shards: batches of the streams in turn, then the rest of each stream."""
        streams = [_shuffled(shards[k::STREAMS], k % BLOCK + 1, rng) for k in range(STREAMS)]
        whole = [len(stream) // self.batch * self.batch for stream in streams]
        batches = [stream[:size].reshape(-1, self.batch) for stream, size in zip(streams, whole, strict=True)]
        turns = chain.from_iterable(zip_longest(*batches))
        rests = [stream[size:] for stream, size in zip(streams, whole, strict=True)]
        return np.concatenate([np.zeros(0, np.intp), *(batch for batch in turns if batch is not None), *rests])


def _shuffled(shards: list[NDArray[np.intp]], first: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the frames of a stream, shuffled in blocks of shards; `first` is the size of the first block."""
    starts = [0, *range(first, len(shards), BLOCK), len(shards)]
    blocks = [shards[start:stop] for start, stop in zip(starts, starts[1:], strict=False) if start < stop]
    return np.concatenate([np.zeros(0, np.intp), *(rng.permutation(np.concatenate(block)) for block in blocks)])
