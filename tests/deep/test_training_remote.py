"""Training on a data set in an object store: the same however many processes load it, and resumed."""

import pytest
from walls import BEAMS, sample

from ogm.datasets import open_dataset
from ogm.deep import order
from ogm.deep.recipe import Recipe
from ogm.simulation.store import Store
from ogm.storage.remote import object_store

URL = "s3://maps/walls"


@pytest.fixture(scope="module")
def data(tmp_path_factory, s3):
    """Three shards to train on, of which the last has four samples; give the two parts."""
    import obstore

    path = tmp_path_factory.mktemp("walls") / "data"
    made = Store.create(path, {"seed": 1}, {"training": 24, "validation": 2}, [BEAMS], {"ogm": "test"})
    for split, shard, count in (("training", 0, 10), ("training", 1, 10), ("training", 2, 4), ("validation", 0, 2)):
        made.write(split, shard, [sample(10 * shard + k, split) for k in range(count)])
    store = object_store(URL, s3)
    for file in path.rglob("*"):
        if file.is_file():
            obstore.put(store, str(file.relative_to(path)), file.read_bytes())
    return [open_dataset(URL, storage=s3, split=split) for split in ("training", "validation")]


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_a_run_is_the_same_with_loading_processes_and_resumed(data, small, tiny, tmp_path, monkeypatch):
    from ogm.deep.training import train
    from ogm.deep.training_run import TrainingRun

    monkeypatch.setattr(order, "STREAMS", 2)
    recipe = Recipe(tiny, epochs=2, batch=4, warmup=2, learning_rate=1e-2)
    options = {"accelerator": "cpu", "progress": False, "picture_every": 0}
    whole = train(*data, small, tmp_path / "whole", recipe, workers=0, **options)
    do_step, steps = TrainingRun.do_step, []

    def stops(run, batch):
        steps.append(batch.numbers)
        if len(steps) == 9:
            raise KeyboardInterrupt
        do_step(run, batch)

    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "do_step", stops)
        with pytest.raises(KeyboardInterrupt):
            train(*data, small, tmp_path / "stopped", recipe, workers=0, **options)
    stopped = train(*data, small, tmp_path / "stopped", recipe, workers=1, resume=True, **options)
    assert sorted(i for numbers in steps[:6] for i in numbers) == list(range(24))
    assert stopped.read_bytes() == whole.read_bytes()
