"""Simulated data sets in an object store: what is read is what lies in the folder."""

import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from samples import flat_sample

from ogm.datasets import open_dataset
from ogm.pose import pose
from ogm.simulation.sample import OBJECT_DTYPE, Beams, SimulatedSample
from ogm.simulation.store import Damaged, Store
from ogm.storage import remote
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath, as_path, object_store
from ogm.truth import TRUTH_SPEC

BEAMS = Beams("small", (-0.3, -0.1), (0.0, 0.0), -2 * np.pi / 60, 60, 10.0, ((0.0, 0.0, 0.0),) * 2)
URL = "s3://maps/data"
S3 = Mapping[str, str]


def sample(index: int, split: str) -> SimulatedSample:
    rng, objects = np.random.default_rng((index, len(split))), np.zeros(2, OBJECT_DTYPE)
    for name in ("length", "width", "height", "x"):
        objects[name] = rng.uniform(1, 5, 2)
    steps, state = rng.integers(0, 5000, BEAMS.shape).astype(np.uint16), rng.integers(0, 3, TRUTH_SPEC.shape)
    facts = {"objects": objects, "stamp": 0.1 * index, "scenario": index // 10}
    return flat_sample(split, index, steps, state, beams=BEAMS, T_vehicle_sensor=pose(z=1.8), **facts)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of which a shard in the middle is not made."""
    path = tmp_path_factory.mktemp("remote") / "data"
    store = Store.create(path, {"seed": 1}, {"training": 30, "sequences": 5}, [BEAMS], {"ogm": "0"})
    for split, shard, numbers in (
        ("training", 0, range(10)),
        ("training", 2, range(20, 30)),
        ("sequences", 0, range(5)),
    ):
        store.write(split, shard, [sample(k, split) for k in numbers])
    return path


@pytest.fixture(scope="module")
def uploaded(folder: Path, s3: S3) -> S3:
    import obstore

    store = object_store(URL, s3)
    for path in folder.rglob("*"):
        if path.is_file():
            obstore.put(store, str(path.relative_to(folder)), path.read_bytes())
    return s3


@pytest.fixture(autouse=True)
def nothing_in_memory() -> None:
    remote._objects.cache_clear()


@each("split", ["training", "sequences"])
def test_frames_in_a_bucket_are_those_of_the_folder(folder: Path, uploaded: S3, split: str) -> None:
    here, there = open_dataset(folder, split=split), open_dataset(URL, storage=uploaded, split=split)
    assert (here.name, here.facts) == (there.name, there.facts)
    assert len(here) == len(there) == (20 if split == "training" else 5)
    again = pickle.loads(pickle.dumps(there))  # as in another process
    for one, other, third in zip(here, there, again, strict=True):
        assert one.name == other.name == third.name
        for it in (other, third):
            assert one.scan.points.tobytes() == it.scan.points.tobytes()
            assert one.truth.state.tobytes() == it.truth.state.tobytes()
            np.testing.assert_array_equal(one.boxes.center, it.boxes.center)
            np.testing.assert_array_equal(one.T_map_sensor, it.T_map_sensor)
    if split == "training":
        assert there.shards is not None
        assert there.shards.tolist() == [0] * 10 + [2] * 10
        assert there[8:12].shards is not None
        assert there[8:12].shards.tolist() == [0, 0, 2, 2]
    assert here.shards is None


def test_a_shard_is_one_request_for_each_array(uploaded: S3) -> None:
    place = as_path(URL, uploaded)
    split = Store.open(place)["training"]
    objects = place.objects
    split[0]
    before = objects.requests
    for k in range(1, 10):
        split[k]
    assert objects.requests == before
    split[20]
    assert objects.requests == before + len(split.contents.layout)
    with pytest.raises(ValueError, match="sample 12 of training is not made yet"):
        split[12]


def test_what_was_read_is_forgotten_beyond_the_limit(uploaded: S3, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ogm.storage.remote.CACHE", 1e4)
    place = as_path(URL, uploaded)
    split = Store.open(place)["training"]
    for k in (0, 20, 1, 21):
        split[k]
        kept = place.objects._kept
        assert sum(len(one) for one in kept.values() if one is not None) == place.objects._size
        assert len(kept) == 1 or place.objects._size <= 1e4


def test_damage_in_a_bucket_is_found(folder: Path, uploaded: S3) -> None:
    import obstore

    store, url = object_store(URL + "-damaged", uploaded), URL + "-damaged"
    for path in folder.rglob("*"):
        if path.is_file():
            data = path.read_bytes()
            if path.parts[-6:-4] == ("training", "truth") and path.parts[-3] == "2":
                data = data[:100] + bytes([data[100] ^ 1]) + data[101:]
            obstore.put(store, str(path.relative_to(folder)), data)
    obstore.delete(store, "training/heights/c/0/0/0")
    split = Store.open(as_path(url, uploaded))["training"]
    with pytest.raises(Damaged, match=r"sample \d+ of training in s3://maps/data-damaged: the array truth is damaged"):
        [split[k] for k in range(20, 30)]
    with pytest.raises(Damaged, match="heights is damaged .*a file is missing"):
        split[0]


def test_what_is_no_data_set_is_refused(uploaded: S3, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="s3://maps/nothing is no dataset"):
        open_dataset("s3://maps/nothing", storage=uploaded)
    refused("storage is for object stores", open_dataset, tmp_path, storage=uploaded)
    refused("has no split 'x'", open_dataset, URL, error=OgmError, storage=uploaded, split="x")
    nobody = ObjectPath(URL, {**uploaded, "endpoint": "http://127.0.0.1:9", "timeout": "1s"})
    assert "secret" not in repr(nobody)
