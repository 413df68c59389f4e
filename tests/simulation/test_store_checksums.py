"""Damaged data sets: every flipped bit and every exchanged file is found, and the sample named."""

import json
import shutil
import struct
from collections import Counter
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import google_crc32c
import pytest
from cases import each, refused
from damage import check_flips
from stand_in import BEAMS, stand_in

from ogm.simulation.mounts import LidarMount
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.sample import SimulatedSample
from ogm.simulation.store import Damaged, Store
from ogm.simulation.workers import begin, missing_shards

PLAN = DatasetPlan(samples=13, validation=4, test=1, mounts=(LidarMount("small"), LidarMount("tall")))


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards of training samples, the second of three."""
    path = tmp_path_factory.mktemp("checksums") / "data"
    store = begin(path, PLAN, BEAMS, {"ogm": "0"})
    for shard, numbers in enumerate((range(10), range(10, 13))):
        store.write("training", shard, [stand_in(None, "training", i) for i in numbers])
    return path


@pytest.fixture
def store(written: Path, tmp_path: Path) -> Store:
    """A copy of `written`."""
    return Store.open(shutil.copytree(written, tmp_path / "data"))


def content(sample: SimulatedSample) -> list[Any]:
    arrays = (sample.steps, sample.intensities, sample.objects, sample.truth.state, sample.truth.height_cm)
    poses = (sample.T_world_sensor, sample.T_vehicle_sensor, sample.velocity)
    facts = [getattr(sample, name) for name in ("beams", "yaw_rate", "stamp", "split", "index", "scenario", "weather")]
    return [*(one.tobytes() for one in (*arrays, *poses)), *facts]


@pytest.mark.slow
def test_flipped_bits_are_found(store: Store) -> None:
    """In chunks of the second shard, which is read in a third of the first one's time, and in metadata."""

    def read(*numbers: int) -> list[Any]:
        split = Store.open(store.path)["training"]
        return [content(split[i]) for i in numbers]

    found = Counter[str]()
    for file in sorted(one for one in store.path.rglob("*") if one.is_file()):
        place = file.relative_to(store.path).parts  # training/steps/c/SHARD/...
        chunk = len(place) > 3 and place[2] == "c"
        if not chunk or place[3] == "1":
            found += check_flips(file, partial(read, 12), 3, str(store.path))
    assert found["refused"] > 20


@each("at, size", [(4, 2**31), (8, 0), (8, 2**30), (12, 2**31), (12, 1), (0, 0)])
def test_blosc_never_unpacks_a_chunk_whose_sizes_are_wrong(written: Path, tmp_path: Path, at: int, size: int) -> None:
    """Checksums are right; ``at`` 0 stands for a chunk that ends within its header."""
    store = Store.open(shutil.copytree(written, tmp_path / "data"))
    file = next(one for one in (store.path / "training/steps/c").rglob("0") if one.is_file())
    data = bytearray(file.read_bytes())
    assert data[-4:] == sum_of(data[-164:-4])  # of the index of ten chunks
    offset, length = struct.unpack_from("<QQ", data, len(data) - 164)
    if at:
        struct.pack_into("<I", data, offset + at, size)
    else:
        length = 15
        struct.pack_into("<QQ", data, len(data) - 164, offset, length)
    data[offset + length - 4 : offset + length] = sum_of(data[offset : offset + length - 4])
    data[-4:] = sum_of(data[-164:-4])
    file.write_bytes(data)
    with pytest.raises(Damaged, match=r"steps is damaged on disk .*of Blosc data do not contain a chunk of"):
        Store.open(store.path)["training"][0]


def sum_of(data: bytes | bytearray) -> bytes:
    return struct.pack("<I", google_crc32c.value(bytes(data)))


@each("array", ["steps", "intensities", "truth", "heights", "objects", "facts"])
def test_an_exchanged_file_is_found_by_reading_and_by_resuming(written: Path, array: str, tmp_path: Path) -> None:
    """Its chunks are whole, but of other samples."""
    store = Store.open(shutil.copytree(written, tmp_path / "data"))
    other = begin(tmp_path / "other", PLAN, BEAMS, {"ogm": "0"})
    other.write("training", 0, [replace(stand_in(None, "training", i + 40), index=i) for i in range(10)])
    shutil.copytree(
        other.path / "training" / array / "c" / "0", store.path / "training" / array / "c" / "0", dirs_exist_ok=True
    )
    split = Store.open(store.path)["training"]
    with pytest.raises(
        Damaged, match=rf"sample 3 of training in .*data: the array {array} is damaged on disk .the checksum differs"
    ):
        split[3]
    assert content(split[12]) == content(stand_in(None, "training", 12))
    with pytest.raises(
        Damaged, match=rf"sample . of training .*{array} is damaged .*; . more are damaged: sample . of tr"
    ):
        missing_shards(Store.open(store.path))


def test_a_finished_data_set_without_damage_resumes(store: Store) -> None:
    assert {(job.split, job.shard) for job in missing_shards(store)} == {("validation", 0), ("test", 0)}
    assert not [*store["training"].damage()]


def test_a_changed_plan_is_found(store: Store) -> None:
    file = store.path / "zarr.json"
    text = file.read_text()
    for old, new in (("0.0,", "0.5,"), ('"ogm": "0"', '"ogm": "1"'), ('"rate": 10.0', '"rate": 11.0')):
        assert old in text
        file.write_text(text.replace(old, new, 1))
        refused("the SHA-256 differs.*restore the file", Store.open, store.path, error=Damaged)


def test_data_sets_of_older_versions_are_read_and_grow(store: Store) -> None:
    """They have no checksums; samples that are added have."""
    shutil.rmtree(store.path / "training" / "checksums")
    text = json.loads((store.path / "zarr.json").read_text())
    del text["attributes"]["sha256"]
    (store.path / "zarr.json").write_text(json.dumps(text))
    old = Store.open(store.path)
    assert [content(one) for one in old["training"]] == [content(stand_in(None, "training", i)) for i in range(13)]
    counts = PLAN.counts | {"training": 21}
    grown = Store.create(store.path, asdict(PLAN), counts, BEAMS, {"ogm": "0"})
    grown.write("training", 2, [stand_in(None, "training", 20)])
    assert not [*grown["training"].damage()]
    file = grown.path / "training" / "truth" / "c" / "0"
    shutil.copytree(file, file.with_name("2"), dirs_exist_ok=True)
    assert [i for i, _ in Store.open(store.path)["training"].damage()] == [20]
