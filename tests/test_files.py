"""Files are whole or not there, also after a kill; errors name what the user gave; nothing steers a terminal."""

import asyncio
import errno
import logging
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from cases import each, fail_call
from test_faults import file_size_limit
from typer.testing import CliRunner

import ogm.storage.files
from ogm.cli import app, console
from ogm.cli.console import SafeFormatter, printable, report_errors
from ogm.storage.files import atomic_write, error_text, finish_zarr, temporary_folder
from ogm.storage.whole_path import whole_path

ESCAPE = "a\x1b[31m\x07\u202eb\x9bc"


def write_and_fail(path: Path, mode: str, content: str | bytes) -> None:
    with atomic_write(path, mode) as file:
        file.write(content)
        raise ZeroDivisionError


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("mode", ["wb", "w"])
def test_a_file_appears_whole_or_not_at_all(named, mode, tmp_path, monkeypatch):
    if named:
        monkeypatch.delattr(ogm.storage.files.os, "O_TMPFILE", raising=False)
    path = tmp_path / "a.txt"
    old, new = ("old", "ä") if mode == "w" else (b"old", b"\xff")
    for content in (old, new):
        with atomic_write(path, mode) as file:
            file.write(content)
            assert path.exists() == (content is new)
    with pytest.raises(ZeroDivisionError):
        write_and_fail(path, mode, old)
    assert path.read_bytes() == (new.encode() if isinstance(new, str) else new)
    assert os.listdir(tmp_path) == ["a.txt"]
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


@pytest.mark.parametrize("named", [False, True])
def test_links_permissions_pipes_and_removed_folders_are_respected(named, tmp_path, monkeypatch):
    if named:
        monkeypatch.delattr(ogm.storage.files.os, "O_TMPFILE", raising=False)
    real, link, dangling = (tmp_path / name for name in ("real/a", "link", "dangling"))
    real.parent.mkdir()
    real.write_text("old")
    real.chmod(0o640)
    link.symlink_to("real/a")
    dangling.symlink_to(real.parent / "new")
    for path in (link, dangling):
        with atomic_write(path) as file:
            file.write(b"x")
        assert path.read_bytes() == b"x"
        with whole_path(path) as temporary:
            temporary.write_bytes(b"y")
        assert path.is_symlink()
        assert path.read_bytes() == b"y"
    assert real.stat().st_mode & 0o777 == 0o640
    folder = tmp_path / "folder"
    folder.mkdir(mode=0o750)
    (tmp_path / "to").symlink_to(folder)
    with whole_path(tmp_path / "to") as path:
        path.mkdir()
        (path / "part").write_text("x")
    assert (tmp_path / "to").is_symlink()
    assert (folder / "part").read_text() == "x"
    assert folder.stat().st_mode & 0o777 == 0o750
    os.mkfifo(tmp_path / "pipe")
    for write in (atomic_write, whole_path):
        with pytest.raises(FileExistsError, match="pipe: it is a pipe or a device"), write(tmp_path / "pipe"):
            pass
    assert (tmp_path / "pipe").is_fifo()
    if not named:
        (tmp_path / "gone").mkdir()
        with atomic_write(tmp_path / "gone" / "a") as file:
            file.write(b"z")
            (tmp_path / "gone").rmdir()
        assert (tmp_path / "gone" / "a").read_bytes() == b"z"
    assert not [one for one in os.listdir(tmp_path) if one.startswith(".ogm")]


@each("length", [241, 242, 250, 255])
def test_names_may_be_as_long_as_the_system_lets_them(length, tmp_path):
    path = tmp_path / ("n" * (length - 4) + ".tif")
    with atomic_write(path) as file:
        file.write(b"x")
    with whole_path(path) as temporary:
        temporary.write_bytes(b"y")
    assert path.read_bytes() == b"y"
    assert len(os.listdir(tmp_path)) == 1
    path.unlink()


@pytest.mark.skipif(not hasattr(os, "O_TMPFILE"), reason="this system has no files without a name")
def test_a_killed_process_leaves_nothing(tmp_path):
    code = (
        "import os, signal, sys; from ogm.storage.files import atomic_write\n"
        "with atomic_write(sys.argv[1]) as file:\n"
        "    file.write(bytes(9999)); file.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.bin")], check=False)
    assert done.returncode == -signal.SIGKILL
    left = os.listdir(tmp_path)
    if left:
        pytest.skip("the file system of the tests has no files without a name")


def test_the_error_of_a_full_disk_names_the_file(tmp_path):
    path = tmp_path / "a.bin"

    def write() -> None:
        with atomic_write(path) as file:
            file.write(bytes(100_000))

    with file_size_limit(10_000), pytest.raises(OSError, match="a.bin") as caught:
        write()
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert not os.listdir(tmp_path)
    for number in (errno.ENOSPC, errno.EDQUOT):
        with pytest.raises(OSError, match="a.bin") as caught, atomic_write(path):
            raise OSError(number, "full")
        assert error_text(caught.value) == f"{path}: full"


def test_an_error_with_a_name_of_its_own_keeps_it(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, atomic_write(tmp_path / "a.bin"):
        (tmp_path / "other").read_bytes()
    assert caught.value.filename == str(tmp_path / "other")


# ---- the terminal


def test_control_characters_are_written_out():
    assert printable(ESCAPE) == r"a\x1b[31m\x07\u202eb\x9bc"
    assert printable("ä\n\t\udcff") == "ä\n\t\\udcff"


def test_no_name_of_a_file_reaches_the_terminal_as_it_is(tmp_path):
    path = tmp_path / f"{ESCAPE}.pcd"
    missing = CliRunner().invoke(app, ["info", str(path)])
    path.write_bytes(b"no cloud")
    damaged = CliRunner().invoke(app, ["info", str(path)])
    for result in (missing, damaged):
        assert result.exit_code == 2
        assert r"\x1b[31m\x07\u202e" in result.output
        assert not set(result.output) & {"\x1b", "\x07", "\u202e", "\x9b"}


def test_tables_and_the_log_write_control_characters_out(capsys):
    console.print_facts({ESCAPE: ESCAPE})
    assert "\x1b" not in capsys.readouterr().out
    record = logging.LogRecord("ogm", logging.WARNING, "", 0, "%s is odd", (ESCAPE,), None)
    assert SafeFormatter("ogm: %(message)s").format(record) == r"ogm: a\x1b[31m\x07\u202eb\x9bc is odd"


# ---- interrupts


@each("chained", [False, True])
def test_an_import_that_was_interrupted_is_no_missing_package(chained, capsys):
    def command() -> None:
        if not chained:
            raise ImportError("KeyboardInterrupt: <EMPTY MESSAGE>")
        try:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as inner:
                raise ImportError("initialization failed") from inner
        except ImportError as error:
            raise ImportError("pip install open3d") from error

    with pytest.raises(console.typer.Exit) as caught:
        report_errors(command)()
    assert caught.value.exit_code == 130
    assert capsys.readouterr().err == "ogm: interrupted; nothing was written\n"


def test_an_interrupt_while_packages_load_is_one_line(tmp_path):
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt")
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    words = [sys.executable, "-m", "ogm.cli", "info"]
    done = subprocess.run(words, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "ogm: interrupted; nothing was written\n")


def test_what_zarr_writes_in_threads_of_its_own_is_waited_for(tmp_path: Path) -> None:
    sync = pytest.importorskip("zarr.core.sync")
    sync.sync(asyncio.sleep(0))  # its loop runs from now on

    async def slow() -> None:
        await asyncio.sleep(0.3)
        (tmp_path / "written").touch()

    asyncio.run_coroutine_threadsafe(slow(), sync.loop[0])
    finish_zarr()
    assert (tmp_path / "written").exists()


def test_an_interrupt_while_a_temporary_folder_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_call(monkeypatch, shutil, "rmtree", 1)
    with pytest.raises(KeyboardInterrupt), temporary_folder(tmp_path) as folder:
        (folder / "a").touch()
    assert list(tmp_path.iterdir()) == []
