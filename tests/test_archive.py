"""Grids in ``.npz`` files: lossless, whole or as they were, and harmless whatever they hold."""

import contextlib
import hashlib
import io
import resource
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from damage import check_flips
from moving import street

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, OgmError
from ogm.io import GridLog, PlacedGrid, read_grid, read_placed_grid, write_grid
from ogm.pose import pose
from ogm.storage.archive import stated_format

SPEC = GridSpec(0.0625, (31, 17), (-1.03125, 2.2))
HOSTILE = ("file", "format", "../up", "a/b.npy", "", "ä \N{SNOWMAN}", "\ud800", "self", "x" * 300)
Grid = EvidentialGrid | DynamicGrid | LayeredGrid


def evidential() -> EvidentialGrid:
    return EvidentialGrid(SPEC, np.random.default_rng(0).dirichlet([1, 1, 1], SPEC.shape)[..., :2])


def layered() -> LayeredGrid:
    rng = np.random.default_rng(1)
    layers = {name: rng.normal(size=SPEC.shape) for name in HOSTILE}
    layers[""][3:, 5] = np.nan
    return LayeredGrid(SPEC, layers)


EVERY = each("make", [evidential, street, layered])
Make = Callable[[], Grid]


@contextlib.contextmanager
def little_memory(more: int = 2**30) -> Iterator[None]:
    """Let this process take that much more memory at most [bytes]."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def repacked(path: Path, **arrays: bytes | np.ndarray | None) -> None:
    """Write an archive anew with some of its members replaced, left out (None) or added."""
    with zipfile.ZipFile(path) as archive:
        members: dict[str, bytes | np.ndarray | None] = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (members | {f"{name}.npy": one for name, one in arrays.items()}).items():
            if isinstance(content, np.ndarray):
                buffer = io.BytesIO()
                np.save(buffer, content)
                content = buffer.getvalue()
            if content is not None:
                archive.writestr(name, content)


def header_of(shape: object, kind: str = "<f4") -> bytes:
    """Return the beginning of an array file."""
    text = str({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@each("make", [evidential, street, layered, lambda: LayeredGrid(SPEC, {})])
def test_save_and_load_lose_nothing(tmp_path: Path, make: Make) -> None:
    grid = make()
    grid.save(tmp_path / "a.npz")
    again = type(grid).load(tmp_path / "a.npz")
    assert again == grid
    assert again.spec == grid.spec
    assert stated_format(tmp_path / "a.npz") == f"ogm.{type(grid).__name__}/1"
    with np.load(tmp_path / "a.npz", allow_pickle=False) as data:
        assert data["resolution"] == grid.spec.resolution
        assert tuple(data["origin"]) == grid.spec.origin


def test_a_grid_is_not_taken_for_one_of_another_kind_or_version(tmp_path: Path) -> None:
    path, kinds = tmp_path / "a.npz", (evidential(), street(), layered())
    for grid in kinds:
        grid.save(path)
        for other in kinds:
            if other is not grid:
                message = f"not an ogm.{type(other).__name__}/1 file: found ogm.{type(grid).__name__}/1"
                refused(message, type(other).load, path, error=OgmError)
    for arrays, message in (
        ({"other": np.zeros(3)}, "found arrays"),
        ({"format": np.array("ogm.EvidentialGrid/9")}, r"EvidentialGrid/9"),
        ({"format": np.array([{}], dtype=object)}, "pickle"),
    ):
        np.savez(path, **arrays)
        refused(message, EvidentialGrid.load, path, error=OgmError)


@EVERY
def test_a_failed_save_leaves_the_old_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Make) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(b"old")

    def breaks(file: object, array: object, **options: object) -> None:
        file.write(b"half")  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(np.lib.format, "write_array", breaks)
        with pytest.raises(KeyboardInterrupt):
            make().save(path)
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["a.npz"]
    refused(r"saved as \.npz, got .*a\.zip", make().save, tmp_path / "a.zip")
    refused("no folder", make().save, tmp_path / "none" / "a.npz", error=FileNotFoundError)


@EVERY
def test_cut_files_are_refused_by_their_name(tmp_path: Path, make: Make) -> None:
    path = tmp_path / "a.npz"
    make().save(path)
    whole = path.read_bytes()
    for size in (0, 1, 20, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        assert refused("", type(make()).load, path, error=OgmError).count("a.npz") == 1
    path.unlink()
    refused("", type(make()).load, path, error=FileNotFoundError)
    path.mkdir()
    refused("", make().save, path, error=IsADirectoryError)
    path.rmdir()


LIES = {
    "more cells than bytes": header_of((2**20, 2**20, 2)),
    "a product beyond 64 bits": header_of((2**40, 2**40, 2)),
    "a negative count": header_of((-1, 31, 2)),
    "no counts": header_of(("a", "b")),
    "objects": header_of((31, 17, 2), "|O"),
    "rows of other things": header_of((31, 17), "<f4,<i4"),
    "nothing per cell": header_of((2**62,), "<U0"),
    "no header": b"masses",
    "a version that is none": b"\x93NUMPY\x09\x00" + bytes(200),
    "nested brackets": b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535,
    "nothing": b"",
}


@EVERY
@each("lie", LIES)
def test_headers_that_lie_take_no_memory(tmp_path: Path, make: Make, lie: str) -> None:
    path, grid = tmp_path / "a.npz", make()
    grid.save(path)
    repacked(path, **{"layers" if isinstance(grid, LayeredGrid) else "mass": LIES[lie]})
    with little_memory():
        refused(r"a\.npz: ", type(grid).load, path, error=OgmError)


@EVERY
@each("name", ["format", "resolution", "origin"])
def test_every_array_is_needed_and_checked(tmp_path: Path, make: Make, name: str) -> None:
    path, grid = tmp_path / "a.npz", make()
    for wrong in (None, np.array([{}], object), np.full(3, np.nan), np.array("text"), np.array([[np.inf, -1.0]])):
        grid.save(path)
        repacked(path, **{name: wrong})
        refused(r"a\.npz: ", type(grid).load, path, error=OgmError)


def test_numbers_that_are_no_grid_are_refused(tmp_path: Path) -> None:
    path, grid, layers = tmp_path / "a.npz", street(), layered()
    for whole, name, wrong in (
        (grid, "mass", grid.mass * 2),
        (grid, "mass", grid.mass[..., :2].copy()),
        (grid, "velocity", grid.mass),
        (grid, "covariance", None),
        (grid, "covariance", grid.velocity),
        (layers, "names", np.array(["one"])),
        (layers, "layers", layers["file"]),
        (layers, "names", None),
    ):
        whole.save(path)
        repacked(path, **{name: wrong})
        refused(r"a\.npz: ", type(whole).load, path, error=OgmError)


def announced(path: Path, size: int) -> bytearray:
    """Write an archive whose one array is said to have a size [bytes]; return what stands in it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mass.npy", b"x")
    data = bytearray(path.read_bytes())
    at = data.rfind(b"PK\x01\x02") + 24  # the uncompressed size in the archive's directory
    data[at : at + 4] = size.to_bytes(4, "little")
    path.write_bytes(bytes(data))
    return data


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    """The largest grid has 2**28 cells of 8 bytes; 1 MiB is left for the rest. 20 GB of zeros may be announced, too."""
    path = tmp_path / "bomb.npz"
    for size, message in (
        (2**32 - 2, "holds 42949"),
        (2**31 + 2**20 + 1, "holds 2148532225 bytes"),
        (2**31 + 2**20, "found arrays"),
    ):
        announced(path, size)
        refused(message, EvidentialGrid.load, path, error=OgmError)
    data = announced(path, 2**32 - 2)
    repeated = data[: data.rfind(b"PK\x01\x02")]
    entry = data[data.rfind(b"PK\x01\x02") : data.rfind(b"PK\x05\x06")]
    end = bytearray(data[data.rfind(b"PK\x05\x06") :])
    end[8:10] = end[10:12] = (5).to_bytes(2, "little")
    end[12:16] = (5 * len(entry)).to_bytes(4, "little")
    path.write_bytes(bytes(repeated + 5 * entry + end))
    with little_memory():
        for kind in (EvidentialGrid, DynamicGrid, LayeredGrid):
            refused("holds 21474836470 bytes when decoded", kind.load, path, error=OgmError)


def test_read_grid_names_the_file_once(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04")
    assert refused("", read_grid, tmp_path / "a.npz", error=OgmError).count("a.npz") == 1


# ---- checksums


@pytest.mark.slow
def test_flipped_bits_of_a_grid_are_found(tmp_path: Path) -> None:
    spec = GridSpec(0.5, (6, 5), (-1.5, 2.0))
    mass = evidential().mass[:6, :5]
    layers = LayeredGrid(spec, {"height": mass[..., 0], "": mass[..., 1]})
    for number, (grid, most) in enumerate(((EvidentialGrid(spec, mass), 600), (layers, 150), (street(), 150))):
        path = tmp_path / f"{number}.npz"
        grid.save(path)
        found = check_flips(path, partial(type(grid).load, path), most)
        assert found["refused"] > found["harmless"], grid


def test_removed_and_exchanged_arrays_of_a_grid_are_named(tmp_path: Path) -> None:
    """Each array has the CRC-32 that it should."""
    path, grid = tmp_path / "grid.npz", evidential()
    EvidentialGrid(SPEC, grid.mass[::-1]).save(path)
    with zipfile.ZipFile(path) as archive:
        other = {name: archive.read(f"{name}.npy") for name in ("mass", "checksums")}
    for name in ("states", "axes", "resolution", "origin", "mass"):
        grid.save(path)
        repacked(path, **{name: None})
        refused(rf"grid\.npz: its array {name} is missing", EvidentialGrid.load, path, error=OgmError)
    grid.save(path)
    repacked(path, mass=other["mass"])
    refused(r"grid\.npz: its array mass is damaged", EvidentialGrid.load, path, error=OgmError)
    repacked(path, **other)
    assert EvidentialGrid.load(path) == EvidentialGrid(SPEC, grid.mass[::-1])
    repacked(path, checksums=None)  # of an earlier version
    assert EvidentialGrid.load(path) == EvidentialGrid(SPEC, grid.mass[::-1])


def test_the_checksum_of_an_array_is_that_of_its_file(tmp_path: Path) -> None:
    """What ``unzip -p grid.npz mass.npy | sha256sum`` prints."""
    street().save(tmp_path / "grid.npz")
    with np.load(tmp_path / "grid.npz", allow_pickle=False) as data, zipfile.ZipFile(tmp_path / "grid.npz") as archive:
        sums = dict(data["checksums"].tolist())
        assert sums.keys() == {*data.files} - {"checksums"}
        assert all(hashlib.sha256(archive.read(f"{name}.npy")).hexdigest() == one for name, one in sums.items())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["map.nc", "map.zarr", "map.mcap"])
def test_flipped_bits_of_other_maps_are_found(tmp_path: Path, name: str) -> None:
    """Attributes, such as the stamp, have no checksum in NetCDF and Zarr; masses and coordinates do."""
    packages = {".nc": ("xarray", "netCDF4"), ".zarr": ("xarray", "zarr"), ".mcap": ("rosbags", "mcap")}
    spec, path = GridSpec(0.5, (6, 5), (-1.5, 2.0)), tmp_path / name
    grid = EvidentialGrid(spec, evidential().mass[:6, :5])
    for package in packages[path.suffix]:
        pytest.importorskip(package)
    if name == "map.mcap":
        with GridLog(path, "grid-map") as log:
            log.write(PlacedGrid(grid, pose(1.0, 2.0), stamp=1.0))
    else:
        write_grid(path, PlacedGrid(grid, pose(1.0, 2.0)))
    found = Counter[str]()
    for file in sorted(one for one in (path, *path.rglob("*")) if one.is_file()):
        found += check_flips(file, lambda: read_placed_grid(path).upright.grid, 150 if path.is_file() else 15, name)
    assert found["refused"] > 5
