"""A map that is read while it is updated: every reader gets a whole state, in threads and in other processes."""

import contextlib
import copy
import math
import multiprocessing
import os
import pickle
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from cases import each, refused

from ogm.fusion import BinaryBayesMapper, DynamicMapper, EvidentialMapper
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose

SPEC = GridSpec.centered(length=51.2, width=38.4, resolution=0.2)  # 256 x 192
STEPS = 12
MAPPERS = {
    "evidential": lambda: EvidentialMapper(SPEC),
    "any rule": lambda: EvidentialMapper(SPEC, lambda a, b: np.maximum(a, b) / 2),
    "bayes": lambda: BinaryBayesMapper(SPEC),
    "dynamic": lambda: DynamicMapper(SPEC, 5_000),
}
READERS: dict[str, Callable[[Any], Any]] = {
    "grid": lambda mapper: mapper.grid,
    "view": lambda mapper: mapper.view(),
    "conflict": lambda mapper: mapper.conflict,
    "conflict_view": lambda mapper: mapper.conflict_view(),
    "dynamic_grid": lambda mapper: mapper.dynamic_grid,
    "dynamic_view": lambda mapper: mapper.dynamic_view(),
    "objects": lambda mapper: mapper.objects(),
    "predicted": lambda mapper: mapper.predicted(0.1),
}
READ = {"evidential": [*READERS][:4], "any rule": [*READERS][:4], "bayes": [*READERS][:2], "dynamic": [*READERS]}
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")


def scan(step: int) -> EvidentialGrid:
    """Return free before an obstacle that moves on with the steps."""
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[..., 0] = 0.3
    mass[4 * step : 4 * step + 20, 60:100] = 0, 0.7
    return EvidentialGrid(SPEC, mass)


def drive(mapper: Any, step: int) -> None:
    """Update with the scan of a step: the vehicle moves by 1.3 m, so that the window scrolls."""
    mapper.update(scan(step), pose(x=1.3 * step, y=0.6 * step, yaw=0.02 * step), stamp=0.1 * step)


def content(found: Any) -> bytes:
    """Return all that a reader returned, so that two can be compared."""
    if hasattr(found, "boxes"):
        return repr(found.boxes.center.tolist()).encode()
    spec = repr(found.spec).encode()
    if hasattr(found, "layers"):
        return spec + b"".join(layer.tobytes() for layer in found.layers.values())
    velocity = found.velocity.tobytes() if hasattr(found, "velocity") else b""
    return spec + np.ascontiguousarray(found.mass).tobytes() + velocity


@contextlib.contextmanager
def threads_that_change_often() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


class Watched:
    """What a thread read of a map while another one updated it: (stamp, content), in turn."""

    def __init__(self, mapper: Any, reader: Callable[[Any], Any]) -> None:
        self.seen: list[tuple[float, bytes]] = []
        self.error: BaseException | None = None
        self._go_on, self._mapper, self._reader = True, mapper, reader
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> "Watched":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._go_on = False
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _watch(self) -> None:
        try:
            while self._go_on:
                with self._mapper.lock:
                    self.seen.append((self._mapper.stamp, content(self._reader(self._mapper))))
                time.sleep(0)  # a reader that never rests would keep the writer out for long
        except BaseException as error:  # noqa: BLE001 (raised in the thread of the test)
            self.error = error


@each(("name", "reader"), [(name, reader) for name in MAPPERS for reader in READ[name]])
def test_a_reader_gets_the_state_before_or_after_an_update_with_its_stamp(name, reader):
    read = READERS[reader]
    alone, states = MAPPERS[name](), {}
    for step in range(STEPS):
        drive(alone, step)
        states[alone.stamp] = content(read(alone))
    mapper = MAPPERS[name]()
    drive(mapper, 0)
    read(mapper)  # objects are followed from the first call on
    with threads_that_change_often(), Watched(mapper, read) as watched:
        for step in range(1, STEPS):
            drive(mapper, step)
    assert len(watched.seen) > 1
    assert {stamp for stamp, _ in watched.seen} <= set(states)
    torn = [stamp for stamp, found in watched.seen if found != states[stamp]]
    assert not torn, f"{len(torn)} of {len(watched.seen)} reads are of no state"


@each("name", MAPPERS)
def test_every_property_waits_for_the_end_of_an_update(name):
    mapper = MAPPERS[name]()
    drive(mapper, 0)
    inside, finish, order = threading.Event(), threading.Event(), []
    fuse = mapper._fuse

    def slowly(*args: Any) -> None:
        inside.set()
        assert finish.wait(30)
        fuse(*args)
        order.append("updated")

    readers = [READERS[reader] for reader in READ[name]]
    readers += [lambda m: m.spec, lambda m: m.stamp, lambda m: m.T_map_vehicle, lambda m: m.scans, lambda m: m.reset()]
    mapper._fuse = slowly
    writer = threading.Thread(target=drive, args=(mapper, 1))
    writer.start()
    assert inside.wait(30)
    waiting = [threading.Thread(target=one, args=(mapper,)) for one in readers]
    for thread in waiting:
        thread.start()
    for thread in waiting:
        thread.join(0.02)
    alive = [thread.is_alive() for thread in waiting]
    finish.set()
    for thread in (writer, *waiting):
        thread.join(30)
    assert all(alive)
    assert order == ["updated"]


@each("name", MAPPERS)
def test_an_error_leaves_the_lock_free(name):
    mapper = MAPPERS[name]()
    drive(mapper, 0)
    refused("stamp", mapper.update, scan(1), np.eye(4), stamp=math.nan)
    thread = threading.Thread(target=drive, args=(mapper, 1))
    thread.start()
    thread.join(30)
    assert mapper.scans == 2


@each("duplicate", [copy.deepcopy, lambda mapper: pickle.loads(pickle.dumps(mapper))])
@each("name", ["evidential", "bayes", "dynamic"])
def test_a_copy_has_a_lock_of_its_own(name, duplicate):
    mapper = MAPPERS[name]()
    drive(mapper, 0)
    with mapper.lock:
        other = duplicate(mapper)
        thread = threading.Thread(target=drive, args=(other, 1))
        thread.start()
        thread.join(30)
    assert (mapper.scans, other.scans) == (1, 2)
    drive(mapper, 1)
    assert content(mapper.grid) == content(other.grid)


def _grid_after(mapper: Any, step: int, connection: Any) -> None:
    drive(mapper, step)
    connection.send_bytes(content(mapper.grid))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_process_goes_on_with_a_map(method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system does not {method}")
    context = multiprocessing.get_context(method)
    mapper = EvidentialMapper(SPEC)
    drive(mapper, 0)
    ours, theirs = context.Pipe()
    with warnings.catch_warnings(action="ignore"):  # Python 3.12 warns of a fork beside other threads
        process = context.Process(target=_grid_after, args=(mapper, 1, theirs))
        process.start()
    assert ours.poll(60)
    found = ours.recv_bytes()
    process.join(30)
    drive(mapper, 1)
    assert process.exitcode == 0
    assert found == content(mapper.grid)


@forks
def test_a_process_forks_when_the_update_of_another_thread_is_done():
    mapper, inside = EvidentialMapper(SPEC), threading.Event()
    drive(mapper, 0)
    fuse = mapper._fuse

    def slowly(*args: Any) -> None:
        fuse(*args)
        inside.set()
        time.sleep(0.3)  # the masses are new, stamp and pose are not yet

    mapper._fuse = slowly
    writer = threading.Thread(target=drive, args=(mapper, 1))
    writer.start()
    assert inside.wait(30)
    with warnings.catch_warnings(action="ignore"):
        child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            os._exit(0 if mapper.scans == 2 and mapper.stamp == 0.1 and content(mapper.grid) else 1)
        os._exit(2)
    code = _exit_code(child)
    writer.join(30)
    assert code == 0


def _exit_code(child: int) -> int | str:
    """Return the exit code of a child process; one that hangs is ended."""
    for _ in range(1000):
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return "hangs"
