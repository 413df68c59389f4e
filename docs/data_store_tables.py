"""Tables of docs/simulation.md on data sets in object stores, from the record data_store.json."""

from collections.abc import Mapping
from typing import Any

from record_tables import table

__all__ = ["data_store_tables"]

ROWS = {
    "all, 0 loading": "one process, all frames shuffled",
    "shards, 0 loading": "one process, shard by shard",
    "shards, 1 loading": "one process that loads beside it, shard by shard",
}
LARGE = 100_000  # samples, to which is extrapolated


def data_store_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the table of samples a second, and what follows for more samples."""
    sets = record["sets"]
    heads = [f"{where}, {one['samples']:,}" for one in sets for where in ("folder", "S3")]
    places = [one[where] for one in sets for where in ("folder", "s3")]
    rows = [[title, *(f"{one[name]['samples_per_s']:.1f}" for one in places)] for name, title in ROWS.items()]
    parts = [("two training processes, one each that loads", "two ranks", lambda both: f"{sum(both):.1f}")]
    parts += [("training of `lite` on one core", "training", lambda one: f"{one['samples_per_s']:.1f}")]
    parts += [("of its time it waits", "training", lambda one: f"{100 * one['waiting']:.1f} %")]
    rows += [[title, *(show(one[name]) if name in one else "" for one in places)] for title, name, show in parts]
    small, large = sets[0], sets[-1]
    few, one = (each["s3"]["shards, 1 loading"] for each in (small, large))
    read, many = (large["s3"][f"requests, {order}"] for order in ("shards", "all"))
    count, per_sample, opening = large["samples"], large["bytes"] / large["samples"], one["opening_s"]
    requests, factor = read["requests_per_sample"], LARGE / large["samples"]
    growth = (one["resident_mb"] - few["resident_mb"]) / (count - small["samples"])  # [MB] per sample
    facts = [
        f"{large['source']} simulated samples of {per_sample / 1e3:.0f} kB, repeated, in batches of {record['batch']} "
        "for some seconds. Most of the time are augmentation and the inputs of `lite`. The S3 server (moto, in Python) "
        "shares the processors. No GPU was tried.",
        f"From S3, shard by shard: {requests:.2f} requests and {read['mb_per_sample']:.2f} MB a sample; all frames "
        f"shuffled: {many['requests_per_sample']:.1f} and {many['mb_per_sample']:.2f} MB. A process that loads has "
        f"{one['loading_mb']:.0f} MB, that which opened the data set {one['resident_mb']:.0f} MB "
        f"({few['resident_mb']:.0f} MB with {small['samples']:,} samples). Opening {count:,} samples takes "
        f"{opening:.1f} s ({small['samples']:,}: {few['opening_s']:.1f} s), a request per shard.",
        f"Extrapolated to {LARGE:,} samples of such a store, not measured: {LARGE * per_sample / 1e9:.1f} GB and "
        f"{LARGE * requests:,.0f} requests per epoch, {opening * factor:.0f} s to open, "
        f"{growth * (LARGE - count):.0f} MB more in each process that opens it. Answers after 30 ms, for the seven "
        "requests of a shard at once, would cost 3 ms per sample and process, beside some 55 ms of preparation.",
    ]
    return [table(["samples/s", *heads], rows), *facts]
