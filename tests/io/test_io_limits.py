"""What a file may become in memory: bounds that are checked while it is decoded, and peaks near what is returned."""

import contextlib
import gzip
import io
import json
import lzma
import os
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, OgmError
from ogm.io import read_grid, read_poses, read_scan
from ogm.io.formats.feather import unpacked_sizes
from ogm.io.logs.chunks import unpack_zstd
from ogm.io.reading import decode_json, read_bytes, text_lines
from ogm.io.sustech import read_sustech
from ogm.simulation.exchange import read_label
from ogm.storage.limits import MemoryLimits, _from_environment, current_limits, set_limits

MB = 2**20
SLACK = 20 * MB  # of the test: the readers' bound has 100 MB, so that small arrays suffice here
CLEAR, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


@pytest.fixture(autouse=True)
def _limits() -> Iterator[None]:
    before = current_limits()
    yield
    set_limits(before)


def resident(field: str) -> int:
    """Return VmRSS (now) or VmHWM (the peak) of this process [byte]."""
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(field))
    return int(line.split()[1]) * 1024


def peak_of(call: Callable[[], Any], bound: Callable[[Any], float]) -> tuple[Any, int]:
    """Return what a call returned, and how much more memory of the system it had at its peak [byte].

    If that is above the bound, which may depend on the result, the least of three calls: what the allocator gives back
    meanwhile, or another thread takes, is not the reader's.
    """
    if not STATUS.exists() or not os.access(CLEAR, os.W_OK):
        pytest.skip("the peak of a process is known and reset on Linux alone")
    peaks: list[int] = []
    for _ in range(3):
        CLEAR.write_text("5")  # the peak begins anew
        before = resident("VmRSS")
        result = call()
        peaks.append(resident("VmHWM") - before)
        if peaks[-1] <= bound(result):
            return result, peaks[-1]
        last, result = result, None  # the next call begins without it
    return last, min(peaks)


# ---- peaks


def points(count: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    some = np.column_stack([rng.uniform(-50, 50, (5000, 3)), rng.random(5000)]).astype(np.float32)
    return np.tile(some, (-(-count // len(some)), 1))[:count]  # which is packed fast


def pcd(cloud: np.ndarray, rows: int = 1) -> bytes:
    head = f"FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH {len(cloud) // rows}\nHEIGHT {rows}\n"
    return head.encode() + b"DATA binary\n" + cloud.tobytes()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def las(cloud: np.ndarray, suffix: str) -> bytes:
    laspy = pytest.importorskip("laspy")
    if suffix == ".laz":
        pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = [1e-3] * 3, [0.0] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = cloud[:, :3].T.astype(np.float64)
    stream = io.BytesIO()
    data.write(stream, do_compress=suffix == ".laz")
    return stream.getvalue()


def feather(cloud: np.ndarray, packing: str = "zstd") -> bytes:
    pyarrow, writer = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    stream = io.BytesIO()
    writer.write_feather(pyarrow.table(dict(zip("xyz", cloud.T[:3], strict=True))), stream, compression=packing)
    return stream.getvalue()


SCANS: dict[str, Callable[[np.ndarray], bytes]] = {
    "a.bin": lambda cloud: cloud.tobytes(), "a.bin.gz": lambda cloud: gzip.compress(cloud.tobytes(), 1),
    "a.bin.xz": lambda cloud: lzma.compress(cloud.tobytes(), preset=0), "a.pcd": pcd,
    "organised.pcd": lambda cloud: pcd(cloud, 1000), "a.npy": npy, "a.las": lambda cloud: las(cloud, ".las"),
    "a.laz": lambda cloud: las(cloud, ".laz"), "a.feather": feather,
}  # fmt: skip


def every_run(names, nightly):
    """Return parameters of which some are left to the nightly run."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in nightly)) for name in names]


@pytest.mark.parametrize("axes", every_run(["nuscenes", "flu"], {"flu"}))
@pytest.mark.parametrize("name", every_run(SCANS, {"a.bin", "a.bin.gz", "organised.pcd", "a.npy", "a.las"}))
def test_a_scan_takes_three_times_its_size_at_most(name, axes, tmp_path):
    cloud = points(1_500_000)  # 24 MB
    path = tmp_path / name
    path.write_bytes(SCANS[name](cloud))
    read_scan(path, axes)  # packages are imported
    decoded = max(cloud.nbytes, 28 * len(cloud) if ".la" in name else 0)  # LAS has 28 bytes per point
    scan, peak = peak_of(lambda: read_scan(path, axes), lambda _: 3 * decoded + SLACK)
    assert len(scan) == len(cloud)
    assert peak <= 3 * decoded + SLACK, f"{peak / decoded:.2f} times"


SPEC = GridSpec.centered(200.0, 200.0, 0.1)  # 4 M cells


def _written(grid: Any, suffix: str, folder: Path) -> Path:
    path = folder / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, grid.mass)
    elif suffix == ".npz":
        grid.save(path)
    else:
        from ogm.io import write_grid

        write_grid(path, grid)
    return path


GRIDS = [".npz", ".npy", ".png", ".tif", ".nc", ".zarr", ".yaml"]


@pytest.mark.parametrize("suffix", every_run(GRIDS, {".npy", ".png", ".nc", ".yaml"}))
def test_a_grid_takes_three_times_its_size_at_most(suffix, tmp_path):
    for package in {".tif": ["rasterio"], ".nc": ["netCDF4", "xarray"], ".zarr": ["zarr", "xarray"]}.get(suffix, []):
        pytest.importorskip(package)
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[::3, :, 0], mass[1::3, :, 1] = 1, 1
    path, area = _written(EvidentialGrid(SPEC, mass), suffix, tmp_path), SPEC if suffix in (".npy", ".png") else None
    read_grid(path, area)
    grid, peak = peak_of(lambda: read_grid(path, area), lambda _: 3 * mass.nbytes + SLACK)
    assert grid.mass.shape == mass.shape
    assert peak <= 3 * mass.nbytes + SLACK, f"{peak / mass.nbytes:.2f} times"


@pytest.mark.parametrize("kind", every_run(["dynamic", "layered"], {"layered"}))
def test_other_grids_take_three_times_their_size_at_most(kind, tmp_path):
    spec = GridSpec.centered(120.0, 120.0, 0.1)
    cells = spec.shape
    grid: Any = LayeredGrid(spec, {"a": np.zeros(cells, np.float32), "b": np.ones(cells, np.float32)})
    if kind == "dynamic":
        nothing = (np.zeros((*cells, 3), np.float32), np.zeros((*cells, 2), np.float32))
        grid = DynamicGrid(spec, *nothing, np.zeros((*cells, 2, 2), np.float32))
    grid.save(tmp_path / "a.npz")
    arrays = [*grid.layers.values()] if kind == "layered" else [grid.mass, grid.velocity, grid.covariance]
    decoded = sum(array.nbytes for array in arrays)
    read, peak = peak_of(lambda: type(grid).load(tmp_path / "a.npz"), lambda _: 3 * decoded + SLACK)
    assert read == grid
    assert peak <= 3 * decoded + SLACK, f"{peak / decoded:.2f} times"


# ---- bounds


def test_limits_are_stated_and_refuse_what_is_none():
    assert asdict(current_limits()) == asdict(MemoryLimits())
    before = set_limits(file=1e3)
    assert (before, current_limits().file) == (MemoryLimits(), 1000)
    for bad in (0, -1, 1.5, float("inf"), float("nan"), "1"):
        refused("limit file must be", set_limits, file=bad)
    with pytest.raises(TypeError):
        set_limits(files=1)
    assert current_limits().file == 1000
    set_limits(before)
    assert current_limits() == MemoryLimits()


def test_the_environment_sets_limits():
    code = "from ogm.storage.limits import current_limits as c; print(c().file, c().json)"
    environment = os.environ | {"OGM_LIMITS": "file=4e9 json=10"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True)
    assert done.stdout.decode().split() == ["4000000000", "10"]
    assert (_from_environment("file=5,json=6").file, _from_environment("file=5,json=6").json) == (5, 6)


@each("text", ["file", "files=3", "file=many", "file=0", "file=1e400"])
def test_an_environment_that_sets_no_limits_is_refused(text):
    refused("OGM_LIMITS must be pairs such as file=4e9", _from_environment, text)


@each("suffix, pack", [(".xz", lzma.compress), (".gz", gzip.compress)])
def test_unpacking_stops_at_the_limit(suffix, pack, tmp_path):
    path = tmp_path / f"a.bin{suffix}"
    path.write_bytes(pack(bytes(64 * MB)))
    set_limits(file=4 * MB)
    tracemalloc.start()
    try:
        refused(rf"more than {4 * MB} bytes when decoded.*set_limits\(file=\.\.\.\)", read_bytes, path, error=OgmError)
        assert tracemalloc.get_traced_memory()[1] < 20 * MB  # the decoder of xz has 9
    finally:
        tracemalloc.stop()


@each("check", [lzma.CHECK_CRC32, lzma.CHECK_NONE])
def test_streams_of_xz_that_follow_each_other_are_one_file(check, tmp_path):
    one, other = (lzma.compress(text, check=check) for text in (b"abc" * 9999, b"defg" * 99_999))
    path = tmp_path / "a.bin.xz"
    path.write_bytes(one + bytes(8) + other + bytes(4))
    assert read_bytes(path)[0] == b"abc" * 9999 + b"defg" * 99_999
    path.write_bytes(one + other[:-5])
    refused("no complete .xz", read_bytes, path, error=OgmError)
    path.write_bytes(one + b"what else")
    refused("no complete .xz", read_bytes, path, error=OgmError)


def test_xz_whose_decoder_takes_much_memory_is_refused(tmp_path):
    data = bytearray(lzma.compress(bytes(1000), preset=0))
    at = data.index(b"\x21\x01") + 2  # LZMA2, one byte of properties: the size of the dictionary
    data[at] = 39  # 3 GiB
    header = data[12 : 12 + 4 * (data[12] + 1)]
    data[12 + len(header) - 4 : 12 + len(header)] = struct.pack("<I", zlib.crc32(bytes(header[:-4])))
    (tmp_path / "a.bin.xz").write_bytes(bytes(data))
    refused("[Mm]emory", read_bytes, tmp_path / "a.bin.xz", error=OgmError)


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats(allow_nan=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=9), inner, max_size=9),
    max_leaves=200,
)


@pytest.mark.slow
@settings(max_examples=25)
@given(values, st.booleans())
def test_the_estimate_for_json_is_from_above(value, ascii_only):
    data = json.dumps([value] * 20, ensure_ascii=ascii_only).encode("utf-8", "surrogatepass")
    tracemalloc.start()
    try:
        try:
            decoded = json.loads(data)
        except UnicodeDecodeError:
            return
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    set_limits(json=max(held - 2000, 1))  # the list itself and the memo of keys
    assert decoded is not None
    if held > 3000:
        refused("bytes when decoded", decode_json, data, Path("a.json"), error=OgmError)


@each("unit", [b"[],", b"{},", b'{"a":1},', b'"",', b"1e9,", b"[[[1]]],", b'"\xc3\xa4",'])
def test_a_small_json_cannot_fill_the_memory(unit, tmp_path):
    path = tmp_path / "a.json.xz"
    path.write_bytes(lzma.compress(b"[" + unit * 2_000_000 + b"0]", preset=0))
    assert path.stat().st_size < 100_000
    set_limits(json=64 * MB)
    tracemalloc.start()
    try:
        refused(r"bytes when decoded, wanted at most .*set_limits\(json=\.\.\.\)", read_sustech, path, error=OgmError)
        assert tracemalloc.get_traced_memory()[1] < 40 * MB
    finally:
        tracemalloc.stop()


def test_a_small_file_of_poses_cannot_fill_the_memory(tmp_path):
    path = tmp_path / "a.txt.xz"
    path.write_bytes(lzma.compress(b"1 0 0 0 0 1 0 0 0 0 1 0\n" * 200_000, preset=0))
    set_limits(lines=MB)
    refused(r"set_limits\(lines=\.\.\.\)", read_poses, path, error=OgmError)
    set_limits(lines=8 * MB)
    poses, peak = peak_of(lambda: read_poses(path), lambda poses: 3 * poses.poses.nbytes + 100e6)
    assert len(poses) == 200_000
    assert peak <= 3 * poses.poses.nbytes + 100e6


@given(st.text(st.sampled_from("a b#\n\r\x0b\x0c\x1c\x85\u2028"), max_size=30))
def test_lines_are_those_of_python(text):
    assert [line for _, line in text_lines(text)] == text.splitlines()


# ---- Feather: what its buffers claim


@each("packing", ["zstd", "lz4", "uncompressed"])
def test_the_claims_of_a_feather_file_are_the_sizes_of_its_columns(packing):
    sizes = unpacked_sizes(feather(points(70_000), packing))  # batches of 65,536
    assert [max(batch) for batch in sizes] == [4 * 65_536, 4 * (70_000 - 65_536)]


def test_a_feather_buffer_that_claims_much_is_refused_before_memory_is_taken(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    data = bytearray(feather(points(1000)))
    at = data.index(struct.pack("<q", 4000))
    data[at : at + 8] = struct.pack("<q", 3 * 2**40)
    (tmp_path / "a.feather").write_bytes(bytes(data))
    taken = pyarrow.total_allocated_bytes()
    refused(f"holds {3 * 2**40 + 8000} bytes when decoded", read_scan, tmp_path / "a.feather", error=OgmError)
    assert pyarrow.total_allocated_bytes() == taken


@given(st.data())
def test_the_sizes_of_a_damaged_feather_file_are_refused_or_numbers(data):
    whole = bytearray(feather(points(50)))
    for _ in range(data.draw(st.integers(1, 5))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(ValueError, struct.error):
        assert all(size >= 0 for batch in unpacked_sizes(bytes(whole)) for size in batch)


# ---- LAZ: the sizes that its layers state


@each("form", [6, 7, 8])
def test_layers_of_laz_must_end_where_the_table_of_chunks_begins(form, tmp_path):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    data = laspy.create(point_format=form, file_version="1.4")
    data.x, data.y, data.z = points(60_000)[:, :3].T.astype(np.float64)  # more than a chunk
    stream = io.BytesIO()
    data.write(stream, do_compress=True)
    whole, path = bytearray(stream.getvalue()), tmp_path / "a.laz"
    path.write_bytes(whole)
    assert len(read_scan(path)) == 60_000
    start = struct.unpack_from("<I", whole, 96)[0] + 8  # the first chunk: a point, its number of points, sizes
    at = start + {6: 30, 7: 36, 8: 38}[form] + 4
    assert struct.unpack_from("<I", whole, at - 4)[0] == 50_000
    for claim in (2**32 - 1, struct.unpack_from("<I", whole, at)[0] + 1):
        struct.pack_into("<I", whole, at, claim)
        path.write_bytes(whole)
        refused("no complete LAS cloud", read_scan, path, error=OgmError)


# ---- logs


def test_zstd_that_claims_much_takes_what_it_holds():
    zstandard = pytest.importorskip("zstandard")
    packed = zstandard.ZstdCompressor().compress(bytes(1000))
    tracemalloc.start()
    try:
        assert unpack_zstd(packed, 2**30) == bytes(1000)
        assert tracemalloc.get_traced_memory()[1] < 16 * MB
    finally:
        tracemalloc.stop()


# ---- images


@each("form", ["EPS", "BMP", "JPEG", "TIFF", "WEBP", "PPM", "TGA", "GIF"])
def test_only_a_png_is_read_under_its_name(form, tmp_path, monkeypatch):
    spec = GridSpec(1.0, (8, 6), (0.0, 0.0))
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((8, 6, 3), np.uint8)).save(path, form)

    def start(*_: object, **__: object) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(subprocess, "check_call", start)
    for read in (read_label, read_grid):
        refused("damaged or no image.*wanted PNG", read, path, spec, error=OgmError)


def test_a_label_of_another_size_is_refused_before_it_is_decoded(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((5000, 5000, 3), np.uint8)).save(path)
    with pytest.raises(OgmError, match="RGB of 5000 x 5000, wanted RGB of 512"):
        read_label(path)  # what is imported
    _, peak = peak_of(lambda: pytest.raises(OgmError, read_label, path), lambda _: 20 * MB)
    assert peak < 20 * MB
    set_limits(image=10_000)
    refused(r"set_limits\(image=\.\.\.\)", read_label, path, error=OgmError)


# ---- arrays


@each("content", [b"\x93NUMPY\x01\x00\x06\x00{'a':\n", b"\x93NUMPY\x01\x00\x02\x00((", b"PK\x03\x04"])
def test_a_damaged_array_is_an_error_of_the_file(content, tmp_path):
    (tmp_path / "a.npy").write_bytes(content)
    refused(r"a\.npy has no readable numpy header", read_grid, tmp_path / "a.npy", SPEC, error=OgmError)
