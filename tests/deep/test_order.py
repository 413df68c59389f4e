"""The order of frames that lie in shards of an object store."""

import numpy as np
from cases import each
from hypothesis import given
from hypothesis import strategies as st

from ogm.deep.order import BLOCK, STREAMS, ShardSampler

SHARD = 10


def shards(count: int) -> np.ndarray:
    """As of frames that were shuffled before."""
    return np.random.default_rng(count).permutation(np.arange(count) // SHARD)


def taken(order: ShardSampler) -> list[int]:
    return [i for _, i in order]


@given(count=st.integers(1, 300), processes=st.integers(1, 4), batch=st.integers(1, 9), epoch=st.integers(0, 3))
def test_processes_take_whole_batches_of_frames_of_their_own(count, processes, batch, epoch):
    orders = [ShardSampler(shards(count), 7, rank, processes, batch=batch) for rank in range(processes)]
    for one in orders:
        one.epoch = epoch
    seen = [taken(one) for one in orders]
    steps = count // processes // batch
    assert [len(one) for one in seen] == [len(one) for one in orders] == [steps * batch] * processes
    every = [i for one in seen for i in one]
    assert len(set(every)) == len(every)
    assert set(every) <= set(range(count))


@each("loaders", [1, 2, 4, 8])
def test_a_shard_is_read_by_one_loading_process_of_one_node(loaders):
    where, batch, count = shards(6400), 8, 6400
    readers: dict[int, list[tuple[int, int]]] = {}
    for rank in range(2):
        order = taken(ShardSampler(where, 3, rank, 2, batch=batch))
        for k, i in enumerate(order):
            readers.setdefault(int(where[i]), []).append((rank, k // batch % loaders))
    several = sum(len(set(one)) > 1 for one in readers.values())
    assert several <= 2 * STREAMS + 2  # the last frames of each stream
    assert len(readers) == count // SHARD


def test_few_shards_are_begun_and_not_yet_read_to_their_end():
    where = shards(6400)
    order = taken(ShardSampler(where, 1, batch=8))
    first, last = {}, {}
    for k, i in enumerate(order):
        first.setdefault(where[i], k)
        last[where[i]] = k
    begun = np.zeros(len(order) + 1, int)
    for shard, start in first.items():
        begun[start] += 1
        begun[last[shard] + 1] -= 1
    open_at = np.cumsum(begun)
    assert open_at.max() <= STREAMS * (BLOCK + 1)  # those in which one block ends and the next begins
    assert np.median(open_at) > STREAMS * BLOCK / 4  # and yet many, so that batches mix drives
    mixed = [len({where[i] for i in order[k : k + 8]}) for k in range(0, len(order), 8)]
    assert np.mean(mixed) > 4


def test_an_order_is_that_of_seed_and_epoch_and_goes_on_where_it_stopped():
    order = ShardSampler(shards(200), 5, 1, 2, batch=4)
    whole = taken(order)
    order.skip = 24
    assert taken(order) == whole[24:]
    assert len(order) == len(whole) - 24
    order.skip, order.epoch = 0, 1
    assert {epoch for epoch, _ in order} == {1}
    assert taken(order) != whole
    assert taken(ShardSampler(shards(200), 6, 1, 2, batch=4)) != whole
    assert np.abs(np.corrcoef(whole, np.arange(len(whole)))[0, 1]) < 0.3
