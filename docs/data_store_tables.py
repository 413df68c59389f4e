"""Tables of docs/simulation.md on datasets in object stores, from the record data_store.json."""

from collections.abc import Mapping
from typing import Any

from record_tables import table

__all__ = ["data_store_tables"]

ROWS = {
    "all, 0 loading": "one process, all frames shuffled",
    "shards, 0 loading": "one process, shard by shard",
    "shards, 1 loading": "one process and one that loads, shard by shard",
}


def data_store_tables(record: Mapping[str, Any]) -> list[str]:
    """Return the table of samples a second, with requests, memory and time to open."""
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
    count, per_sample = large["samples"], large["bytes"] / large["samples"]
    facts = [
        f"{large['source']} simulated samples of {per_sample / 1e3:.0f} kB, repeated, in batches of {record['batch']}. "
        "Augmentation and the inputs of `lite` take most of the time. The S3 server (moto) shares the processors. No "
        "GPU was tried.",
        f"From S3, shard by shard: {read['requests_per_sample']:.2f} requests and {read['mb_per_sample']:.2f} MB a "
        f"sample; all frames shuffled: {many['requests_per_sample']:.1f} and {many['mb_per_sample']:.2f} MB. A loading "
        f"process has {one['loading_mb']:.0f} MB, the process that opened the dataset {one['resident_mb']:.0f} MB "
        f"({few['resident_mb']:.0f} MB with {small['samples']:,} samples). Opening {count:,} samples takes "
        f"{one['opening_s']:.1f} s ({small['samples']:,}: {few['opening_s']:.1f} s), a request per shard.",
    ]
    return [table(["samples/s", *heads], rows), *facts]
