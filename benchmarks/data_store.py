"""How fast does a training read its samples from a folder and from an object store? Measured.

    python benchmarks/data_store.py DATA [--samples N ...] [--seconds S]

DATA is a data set that `ogm simulate` made. Its training samples are repeated, as files with checksums of their own, to
N: the work of reading is that of N different samples. The object store is an S3 server (moto) on this machine, a
process of its own that shares the processors. Writes benchmarks/results/data_store.json.
"""

import os

os.environ["OGM_CORES"] = str(len(os.sched_getaffinity(0)))
import _run as run  # first: it sets the number of threads

# isort: split
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import obstore
import torch
from _object_store import s3_server

from ogm.datasets import open_dataset
from ogm.deep.data import Batch, PillarDataset
from ogm.deep.order import EpochSampler, ShardSampler
from ogm.deep.recipe import LITE_RECIPE, mean_loss
from ogm.deep.training_loop import make_loader
from ogm.grid import GridSpec
from ogm.simulation.split import open_array, sample_checksums, shard_file
from ogm.simulation.store import SHARD, Store
from ogm.storage.remote import as_path, object_store

SPEC = GridSpec.centered()
BATCH = 8


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, nargs="+", default=[1000, 10_000])
    parser.add_argument("--seconds", type=float, default=6.0, help="of each row, once it runs (6)")
    options = parser.parse_args()
    record: dict[str, Any] = run.environment() | {"batch": BATCH}
    with tempfile.TemporaryDirectory(dir=options.data.parent) as folder, s3_server("samples") as storage:
        rows = []
        for count in options.samples:
            path = Path(folder) / str(count)
            in_process(repeat, options.data, path, count)
            place = f"s3://samples/{count}"
            size, seconds = in_process(upload, path, place, storage)
            rows.append({"samples": count, "bytes": size, "upload_s": seconds})
            rows[-1]["source"] = len(in_process(whole_shards, options.data)) * SHARD
            large = count == max(options.samples)
            rows[-1]["folder"] = measured(large, str(path), {}, count, options.seconds)
            rows[-1]["s3"] = measured(large, place, storage, count, options.seconds)
            run.write_record(options.out, record | {"sets": rows})


def whole_shards(path: Path) -> list[int]:
    numbers = Store.open(path)["training"].finished
    return [int(k) for k in np.unique(numbers // SHARD) if np.isin(range(k * SHARD, (k + 1) * SHARD), numbers).all()]


def repeat(source: Path, path: Path, count: int) -> None:
    """Make a data set of the whole shards of another, again and again: links to its files, and new checksums."""
    old, whole = Store.open(source), whole_shards(source)
    new = Store.create(path, old.plan, {"training": count}, old.beams, old.versions)
    checked = old.contents.checked
    arrays = {name: open_array(source / "training" / name) for name in checked}
    samples = {k: {name: one[k * SHARD : (k + 1) * SHARD] for name, one in arrays.items()} for k in whole}
    sums = open_array(path / "training" / "checksums", "r+")
    for shard in range(count // SHARD):
        at = whole[shard % len(whole)]
        first = shard * SHARD
        columns = [sample_checksums("training", first, samples[at][name]) for name in checked]
        sums[first : first + SHARD] = np.stack(columns, axis=-1)
        for name in checked:
            link = shard_file(path / "training", name, shard)
            link.parent.mkdir(parents=True, exist_ok=True)
            os.link(shard_file(source / "training", name, at), link)
    assert new.counts["training"] == count


def upload(path: Path, url: str, storage: dict[str, str]) -> tuple[int, float]:
    """Copy a data set; return its bytes and the seconds."""
    store, start, size = object_store(url, storage), time.perf_counter(), 0
    for file in path.rglob("*"):
        if file.is_file():
            data = file.read_bytes()
            obstore.put(store, str(file.relative_to(path)), data)
            size += len(data)
    return size, time.perf_counter() - start


def measured(large: bool, *words: Any) -> dict[str, Any]:
    """Return the rows of one place, each measured in a process of its own; of the largest set more."""
    found = {
        f"{order}, {loaders} loading": in_process(row, *words, order, loaders)
        for order, loaders in (("all", 0), ("shards", 0), ("shards", 1))
    }
    if large:
        found["training"] = in_process(row, *words, "training", 1)
        found["two ranks"] = two_ranks(*words)
        if words[1]:
            found |= {f"requests, {order}": in_process(row, *words, order, -1) for order in ("shards", "all")}
    return found


def two_ranks(*words: Any) -> list[float]:
    """Return the samples/s of two training processes at the same time, each with one that loads."""
    with ProcessPoolExecutor(2, mp_context=get_context("fork")) as pool:
        both = [pool.submit(row, *words, f"rank {rank} of 2", 1) for rank in range(2)]
        return [waiting.result()["samples_per_s"] for waiting in both]


def in_process(function: Callable[..., Any], *words: Any) -> Any:
    """Call a function in a process of its own, which has all modules but no connections, threads or data."""
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as pool:
        return pool.submit(function, *words).result()


def row(place: str, storage: dict[str, str], count: int, seconds: float, order: str, loaders: int) -> dict[str, Any]:
    """Open a data set and take batches for some seconds; nothing is done with them."""
    path = as_path(place, storage)
    start = time.perf_counter()
    frames = open_dataset(path, split="training")
    opening = time.perf_counter() - start
    where = np.array(frames.facts["samples"]) // SHARD
    rank = (int(order.split()[1]), 2) if order.startswith("rank") else (0, 1)
    sampler = EpochSampler(len(frames), 1) if order == "all" else ShardSampler(where, 1, *rank, batch=BATCH)
    recipe = LITE_RECIPE
    dataset = PillarDataset(frames, SPEC, recipe.augmentation, recipe.network.z_range, rays=True)
    if loaders < 0:
        return requests(path, [int(where[i]) for _, i in sampler], 640 if order == "shards" else 100, seconds)
    dataset[0]  # compiles kernels
    torch.set_num_threads(1)
    batches = iter(make_loader(dataset, sampler, BATCH, loaders, torch.device("cpu")))
    next(batches)  # the loading processes have started
    step = training_step() if order == "training" else lambda batch: None
    step(next(batches))
    taken, waited, start = 0, 0.0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        before = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - before
        step(batch)
        taken += len(batch.numbers)
    rate, share = (value / (time.perf_counter() - start) for value in (taken, waited))
    found = {"samples_per_s": rate, "waiting": share, "opening_s": opening, "samples": taken}
    del batches  # ends the loading processes
    found["loading_mb"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3 if loaders else 0.0
    found["resident_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return found


def requests(path: Any, shards: list[int], begun: int, seconds: float) -> dict[str, Any]:
    """Return requests and bytes per sample when so many samples have been read, by reading the objects alone."""
    names, part, objects = Store.open(path).contents.layout, path / "training", path.objects
    before, start, taken = (0, 0), 0.0, 0
    for k, shard in enumerate(shards):
        if k == begun:
            before, start = (objects.requests, objects.bytes), time.perf_counter()
        if start and time.perf_counter() - start > seconds and taken >= 100:
            break
        path.fetch(shard_file(part, name, shard).key for name in names)
        taken = k + 1 - begun
    counts = (objects.requests - before[0]) / taken, (objects.bytes - before[1]) / taken / 1e6
    return {"requests_per_sample": counts[0], "mb_per_sample": counts[1], "samples": taken}


def training_step() -> Callable[[Batch], None]:
    """Return a training step of `lite` on one core."""
    network = LITE_RECIPE.network.build(SPEC)
    optimizer = torch.optim.AdamW(network.parameters())

    def step(batch: Batch) -> None:
        loss = mean_loss(network(batch.pillars), batch.state, LITE_RECIPE, 1.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


if __name__ == "__main__":
    main()
