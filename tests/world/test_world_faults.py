"""World maps of which something is lost, damaged, or changed by two at once; builders and schedulers killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from test_build import DRIVES, OPTIONS, built
from world_frames import RandomGrids

from ogm.pose import pose
from ogm.storage.files import OgmError
from ogm.world import Progress, WorldMap, build_world, rebuild_world, writer
from ogm.world.drives import load_drive, lost_tiles, submap_key

TWO = {name: DRIVES[name] for name in "ac"}


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of two drives, which tests copy."""
    folder = tmp_path_factory.mktemp("town") / "map"
    with built({"url": folder}, TWO) as world:
        world.build_overviews()
    return folder


@pytest.fixture
def copy(town: Path, tmp_path: Path) -> Path:
    shutil.copytree(town, tmp_path / "map")
    return tmp_path / "map"


def build(world: WorldMap, **options: Any) -> list[Progress]:
    """Build the two drives; return the events."""
    events: list[Progress] = []
    build_world(world, TWO, RandomGrids(), length=15.0, progress=events.append, **options)
    return events


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---- lost and damaged


@pytest.mark.slow
def test_a_lost_sub_map_is_made_anew_or_named(town: Path, copy: Path) -> None:
    with WorldMap.open(copy, "r+") as world:
        index = world.tiles()[4]
        part = next(one for one in (copy / "drives" / "a" / "c").rglob(f"{index[0] + 2**21}/{index[1] + 2**21}"))
        part.unlink()
        os.unlink(copy / world.store.key(index))  # so that the sub-map is needed
        message = r"tiles of sub-maps of drive a .* are missing, such as drives/a/c/"
        refused(message, rebuild_world, world, error=OgmError)
        assert sum(map(len, lost_tiles(world.store, load_drive(world.store, "a")).values())) == 1
        events = build(world)
        assert [event for event in events if event.stage == "sub-maps"][-1].total == 1
        world.build_overviews()
    assert bytes_of(copy) == bytes_of(town)


def test_a_damaged_tile_is_named_and_made_anew(town: Path, copy: Path) -> None:
    with WorldMap.open(copy, "r+") as world:
        index = world.tiles()[3]
        path = copy / world.store.key(index)
        data = bytearray(path.read_bytes())
        for at in range(len(data)):
            data[at] ^= 4 * (at % 40 == 0)  # some byte of every layer
        path.write_bytes(data)
        message = rf"tile \({index[0]}, {index[1]}\).*`ogm world rebuild` makes it again"
        refused(message, world.window, world.layout.spec(world.layout.box_of(index)), error=OgmError)
        events: list[Progress] = []
        rebuild_world(world, progress=events.append)
        assert events[-1] == Progress("tiles", 1, 1)
        world.build_overviews()
    assert bytes_of(copy) == bytes_of(town)


def test_a_drive_without_its_description_is_not_left_out_silently(town: Path, copy: Path) -> None:
    (copy / "drives" / "a" / "zarr.json").unlink()
    with WorldMap.open(copy, "r+") as world:
        refused(r"drive a .* has lost its zarr.json", rebuild_world, world, error=OgmError)
        build(world)
        world.build_overviews()
    assert bytes_of(copy) == bytes_of(town)


@each("change", [('"fill_value": 0', '"fill_value": 1'), ("little", "big"), ('"crc32c"', '"none"')])
def test_a_damaged_description_of_an_array_is_refused(copy: Path, change: tuple[str, str]) -> None:
    paths = [copy / name / "zarr.json" for name in ("0", "drives/a")]
    whole = [path.read_text() for path in paths]
    for path, text in zip(paths, whole, strict=True):
        assert change[0] in text
        path.write_text(text.replace(*change))
    with WorldMap.open(copy) as world:
        refused("cannot be read", world.window, world.cells(), error=OgmError)
        refused("", load_drive, world.store, "a", error=OgmError)
    for path, text in zip(paths, whole, strict=True):
        path.write_text(text)


def test_masses_above_one_are_no_masses(copy: Path) -> None:
    with WorldMap.open(copy, "r+") as world:
        index = world.tiles()[0]
        tile = world.tile(index)
        tile[:2, 3, 3] = 4000
        world.store.write_tile(index, tile)
        refused("negative or above 1", world.window, world.cells(), error=OgmError)


def test_a_rebuild_that_was_stopped_and_taken_back_leaves_nothing(town: Path, copy: Path) -> None:
    """A tile that was written, but whose number was not, must not pass for the one of the earlier poses."""

    class Stop(Exception):
        pass

    def stops(event: Progress) -> None:
        if event.done == 5:
            raise Stop

    moved = {k: pose(4.0, -2.5) @ TWO["a"].pose(k) for k in range(24)}
    back = {k: TWO["a"].pose(k) for k in range(24)}
    with WorldMap.open(copy, "r+") as world:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("ogm.world.rendered.Rendered.__exit__", lambda self, *error: None)  # as a kill would
            with pytest.raises(Stop):
                rebuild_world(world, {"a": moved}, progress=stops)
        rebuild_world(world, {"a": back})
        world.build_overviews()
    assert bytes_of(copy) == bytes_of(town)


@pytest.mark.slow
def test_a_map_whose_making_was_stopped_is_begun_or_goes_on(tmp_path: Path, town: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / writer.WRITER).write_text("{}")
    (tmp_path / "a" / "zarr.0123.partial").write_text("{")
    with built({"url": tmp_path / "a"}, TWO) as world:
        world.build_overviews()
    assert bytes_of(tmp_path / "a") == bytes_of(town)
    WorldMap.create(tmp_path / "b", **OPTIONS).close()  # its array comes with the first tile
    assert sorted(bytes_of(tmp_path / "b")) == ["zarr.json"]
    with WorldMap.open(tmp_path / "b", "r+") as world:
        build(world)
        world.build_overviews()
    assert bytes_of(tmp_path / "b") == bytes_of(town)


# ---- two at once


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let leases be renewed, and end, within moments."""
    monkeypatch.setattr(writer, "RENEWAL_INTERVAL", 0.2)
    monkeypatch.setattr(writer, "LEASE_TIMEOUT", 3.0)


def test_a_bucket_has_one_writer(s3: dict[str, str], quick: None, make_grid: Callable) -> None:
    where = {"url": "s3://maps/one-writer", "storage": s3}
    with WorldMap.create(**where, **OPTIONS) as world:
        for another in (lambda: WorldMap.open(**where, mode="r+"), lambda: WorldMap.create(**where, **OPTIONS)):
            with pytest.raises(BlockingIOError, match=f"another process is writing to this map: process {os.getpid()}"):
                another()
        world.integrate(make_grid(), np.eye(4))
        world.flush()
        with WorldMap.open(**where) as reader:
            assert reader.tiles() == world.tiles()
    before = time.monotonic()
    WorldMap.open(**where, mode="r+").close()  # at once
    assert time.monotonic() - before < 2.5


@pytest.mark.slow
def test_the_lease_of_a_killed_writer_is_taken_over_and_it_writes_no_more(
    s3: dict[str, str], quick: None, make_grid: Callable
) -> None:
    where = {"url": "s3://maps/taken-over", "storage": s3}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "_renew", lambda *given: None)  # as if it were killed
        killed = WorldMap.create(**where, **OPTIONS)
    killed.integrate(make_grid(), np.eye(4))
    with WorldMap.open(**where, mode="r+") as world:
        with pytest.raises(BlockingIOError, match="another process has become the writer"):
            killed.flush()
        assert world.tiles() == []
        killed.forget_tiles()
        killed.close()  # does not free the lease of the other one
        with pytest.raises(BlockingIOError):
            WorldMap.open(**where, mode="r+")


@pytest.mark.slow
def test_of_many_who_want_a_bucket_one_gets_it(s3: dict[str, str], quick: None) -> None:
    WorldMap.create("s3://maps/many", storage=s3, **OPTIONS).close()
    got: list[WorldMap] = []
    refused: list[BaseException] = []

    def want() -> None:
        try:
            got.append(WorldMap.open("s3://maps/many", "r+", storage=s3))
        except BlockingIOError as error:
            refused.append(error)

    threads = [threading.Thread(target=want) for _ in range(4)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert (len(got), len(refused)) == (1, 3)
    got[0].close()


# ---- kills, with a Dask cluster of processes of its own

CLIENT = """
import sys
from test_world_faults import TWO, RandomGrids
from test_build import OPTIONS
from ogm.world import WorldMap, build_world
if __name__ == "__main__":
    try:
        world = WorldMap.open(sys.argv[1], "r+")
    except FileNotFoundError:
        world = WorldMap.create(sys.argv[1], **OPTIONS)
    with world:
        tell = lambda one: print(one, flush=True)
        build_world(world, TWO, RandomGrids(), length=15.0, scheduler=sys.argv[2], progress=tell)
        world.build_overviews()
"""


@contextmanager
def dask_cluster(folder: Path, environment: dict[str, str]) -> Iterator[tuple[str, subprocess.Popen]]:
    """Start a scheduler and two workers; yield its address and its process."""
    with ExitStack() as stack:

        def start(*words: str) -> subprocess.Popen:
            silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            process = subprocess.Popen(words, env=environment, **silent)  # type: ignore[call-overload]
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        file = folder / "scheduler.json"
        file.unlink(missing_ok=True)
        run = "import sys; from distributed.cli.dask_{0} import main; sys.exit(main())"
        words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
        scheduler = start(sys.executable, "-c", run.format("scheduler"), *words)
        while not (file.exists() and file.read_text().endswith("}")):
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        for _ in range(2):
            few = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "30"]
            start(sys.executable, "-c", run.format("worker"), address, *few)
        yield address, scheduler


@pytest.mark.slow
@pytest.mark.parametrize("who", ["client", "scheduler"])
def test_client_or_scheduler_of_a_cluster_may_be_killed(tmp_path: Path, town: Path, who: str) -> None:
    (tmp_path / "client.py").write_text(CLIENT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    url = tmp_path / "map"
    with dask_cluster(tmp_path, environment) as (address, scheduler):
        command = [sys.executable, str(tmp_path / "client.py"), str(url), address]
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        with subprocess.Popen(command, env=environment, **pipes) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if "stage='sub-maps', done=3" in line:
                    (process if who == "client" else scheduler).send_signal(signal.SIGKILL)
                    break
            _, errors = process.communicate(timeout=120)
        if who == "scheduler":
            assert process.returncode == 1
            assert "run the same command again" in errors
        else:
            subprocess.run(command, env=environment, check=True, capture_output=True, timeout=300)
    if who == "scheduler":
        with dask_cluster(tmp_path, environment) as (address, _):
            subprocess.run([*command[:-1], address], env=environment, check=True, capture_output=True, timeout=300)
    assert bytes_of(url) == bytes_of(town)


def test_keys_of_sub_maps_are_those_of_zarr(town: Path) -> None:
    with WorldMap.open(town) as world:
        for number, one in enumerate(load_drive(world.store, "a").submaps):
            for index in one.tiles:
                assert (town / submap_key(world.store, "a", number, index)).is_file()
