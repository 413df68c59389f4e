"""The order in which a training takes its frames: shuffled, disjoint between processes, the same when it is resumed."""

from collections.abc import Iterator
from itertools import chain, zip_longest

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch.utils.data import Sampler

STREAMS = 8  # of batches that a process takes in turn, so that up to so many loading processes share no shard
BLOCK = 8  # shards whose frames are shuffled together


class EpochSampler(Sampler[tuple[int, int]]):
    """The order of an epoch: every frame once, the share of this process, from a position on."""

    count: int
    seed: int
    rank: int
    processes: int
    epoch: int
    skip: int

    def __init__(self, count: int, seed: int, rank: int = 0, processes: int = 1) -> None:
        self.count, self.seed, self.rank, self.processes = count, seed, rank, processes
        self.epoch, self.skip = 0, 0

    def __len__(self) -> int:
        return self.count // self.processes - self.skip

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = np.random.default_rng((self.seed, self.epoch)).permutation(self.count)
        order = order[: self.count // self.processes * self.processes][self.rank :: self.processes]
        return iter([(self.epoch, int(i)) for i in order[self.skip :]])


class ShardSampler(EpochSampler):
    """An order in which frames that lie together are taken soon after each other: for data sets in object stores.

    Shards are shuffled and dealt to the processes, and there to some streams. In each stream, the frames of `BLOCK`
    shards are shuffled together. Batches come from the streams in turn: where the processes that load frames are a
    divisor of `STREAMS`, each shard is read by one of them, once. The order does not depend on their number.

    Parameters
    ----------
    shards : (count,) int array
        The shard of every frame.
    seed, rank, processes
        As of `EpochSampler`.
    batch : int
        Frames of a step in each process.
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
        """Frames of each process: whole batches."""
        return self.count // self.processes // self.batch * self.batch

    def __iter__(self) -> Iterator[tuple[int, int]]:
        rng = np.random.default_rng((self.seed, self.epoch))
        shards = [self._shards[k] for k in rng.permutation(len(self._shards))]
        orders = [self._of_process(shards[rank :: self.processes], rng) for rank in range(self.processes)]
        spare = np.concatenate([order[self._share :] for order in orders])
        for rank, order in enumerate(orders):  # those with fewer frames take what others have over
            need = max(0, self._share - len(order))
            orders[rank], spare = np.concatenate([order[: self._share], spare[:need]]), spare[need:]
        return iter([(self.epoch, int(i)) for i in orders[self.rank][self.skip :]])

    def _of_process(self, shards: list[NDArray[np.intp]], rng: np.random.Generator) -> NDArray[np.intp]:
        """Return the frames of some shards: batches of the streams in turn, then what is left of each."""
        streams = [_shuffled(shards[k::STREAMS], k % BLOCK + 1, rng) for k in range(STREAMS)]
        whole = [len(one) // self.batch * self.batch for one in streams]
        batches = [one[:size].reshape(-1, self.batch) for one, size in zip(streams, whole, strict=True)]
        turns = chain.from_iterable(zip_longest(*batches))
        rests = [one[size:] for one, size in zip(streams, whole, strict=True)]
        return np.concatenate([np.zeros(0, np.intp), *(one for one in turns if one is not None), *rests])


def _shuffled(shards: list[NDArray[np.intp]], first: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the frames of a stream, shuffled in blocks of shards; blocks of streams end at different times."""
    starts = [0, *range(first, len(shards), BLOCK), len(shards)]
    blocks = [shards[start:stop] for start, stop in zip(starts, starts[1:], strict=False) if start < stop]
    return np.concatenate([np.zeros(0, np.intp), *(rng.permutation(np.concatenate(block)) for block in blocks)])
