"""What is no whole point cloud is refused: one OgmError that names the file once."""

import gzip
import lzma
import struct
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import each

import ogm.io.formats.feather
import ogm.io.formats.table
import ogm.io.reading
import ogm.storage.limits
from ogm.io import read_scan, read_scan_file
from ogm.scan import Scan
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits

SUFFIXES = [".bin", ".pcd.bin", ".pcd", ".ply", ".feather", ".las", ".laz", ".npy"]
ALL = SUFFIXES + [suffix + packing for suffix in SUFFIXES for packing in (".xz", ".gz")]
PCD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 10
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 10
DATA binary
"""
PLY = """ply
format binary_little_endian 1.0
element vertex 10
property float x
property float y
property float z
end_header
"""


def refused(path: Path, message: str = ".") -> str:
    """Read the file, take its OgmError, and check that it names the file once and asks for little memory."""
    import pyarrow.dataset  # noqa: F401  its first import is not memory that a file takes

    tracemalloc.start()
    try:
        with pytest.raises(OgmError, match=message) as caught:
            read_scan(path, "nuscenes")
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    assert str(caught.value).count(str(path).removesuffix(".xz").removesuffix(".gz")) == 1
    return str(caught.value)


def read_or_refuse(path: Path) -> tuple[Scan | None, str]:
    try:
        return read_scan(path, "nuscenes"), ""
    except OgmError as error:
        return None, str(error)


def limited(monkeypatch: pytest.MonkeyPatch, **changes: int) -> None:
    monkeypatch.setattr(ogm.storage.limits, "_now", [replace(current_limits(), **changes)])


def put(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@each("suffix", ALL)
def test_no_file_a_folder_and_zero_bytes(suffix, tmp_path):
    path = tmp_path / f"cloud{suffix}"
    with pytest.raises(FileNotFoundError, match="there is no file .*cloud"):
        read_scan(path)
    refused(put(tmp_path, path.name, b""), "0 bytes|cut short")
    packing = {".xz": lzma.compress, ".gz": gzip.compress}.get(path.suffix, bytes)
    refused(put(tmp_path, path.name, packing(b"")), "0 bytes|cut short")
    path.unlink()
    path.mkdir()
    refused(path, "is a folder")


@each("suffix", SUFFIXES)
def test_bytes_of_another_kind(suffix, tmp_path):
    refused(put(tmp_path, f"a{suffix}", b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 4), "is a PNG picture")
    refused(put(tmp_path, f"a{suffix}", b"x y z intensity\n" + b"1.25 -7.50 0.75 0.10\n" * 100))
    refused(put(tmp_path, f"a{suffix}", np.random.default_rng(0).bytes(400)))


@each("name, content, message", [
        ("a.bin", b"# .PCD v0.7\n", "PCD cloud.*name it .pcd"),
        ("a.pcd.bin", PCD.encode(), "PCD cloud.*name it .pcd"),
        ("a.pcd", PLY.encode(), "PLY cloud.*name it .ply"),
        ("a.pcd", gzip.compress(PCD.encode(), mtime=0), "packed by gzip"),
        ("a.pcd", lzma.compress(PCD.encode()), "packed by xz"),
        ("a.bin", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        ("a.npy", b"PK\x03\x04" + bytes(40), "zip archive"),
    ])  # fmt: skip
def test_a_known_format_under_a_wrong_name(name, content, message, tmp_path):
    refused(put(tmp_path, name, content), message)


@each("name", ["cloud", "cloud.txt", "cloud.png", "cloud.xz", "cloud.txt.gz", "bin"])
def test_an_unknown_name(name, tmp_path):
    packed = {"xz": lzma.compress, "gz": gzip.compress}.get(name.rpartition(".")[2], bytes)
    way_out = "ogm view. shows maps" if name.endswith(".png") else "name the file after its format"
    refused(put(tmp_path, name, packed(b"1234")), f"wanted .pcd.bin, .bin.*{way_out}")


@each("name, number", [("a.bin", 15), ("a.bin", 33), ("a.pcd.bin", 16), ("a.pcd.bin", 41)])
def test_a_size_that_is_no_number_of_points(name, number, tmp_path):
    refused(put(tmp_path, name, b"\x01" * number), "no multiple of")


def test_nuscenes_points_under_the_name_of_kitti(tmp_path):
    rows = np.float32([[4, 5, 6, 100, 7]] * 4)
    refused(put(tmp_path, "a.bin", rows.tobytes()), "intensities up to 100")


def test_kitti_points_under_the_name_of_nuscenes(tmp_path):
    rows = np.float32([[4.5, 5.25, -1.75, 0.3]] * 5)
    refused(put(tmp_path, "a.pcd.bin", rows.tobytes()))


# ---- Headers


FACES = "element face 10\nproperty list uchar int v\n"
CAMERAS = "element camera 99999999999\nproperty float f\n"


@each("header, line, damaged", [
        (PCD, "POINTS 10", ["POINTS " + text for text in ("11", "-10", "ten", "10 10", "99999999999999999999", "²")]),
        (PCD, "WIDTH 10", ["WIDTH 5", "WIDTH"]),
        (PCD, "HEIGHT 1", ["HEIGHT 0"]),
        (PCD, "COUNT 1 1 1", ["COUNT 1 1", "COUNT 1 1 0", "COUNT 1 1 -1", "COUNT 1 1 999999999999"]),
        (PCD, "SIZE 4 4 4", ["SIZE 4 4 3", "SIZE 4 4", "SIZE 4 4 999999999999"]),
        (PCD, "TYPE F F F", ["TYPE F F X", "TYPE F F F F"]),
        (PCD, "FIELDS x y z", ["FIELDS x y", "FIELDS x y range", "FIELDS _ _ _", ""]),
        (PCD, "DATA binary\n", ["DATA\n", "DATA binary_squeezed\n", "DATA binary", ""]),
        (PLY, " 10", [" 11", " 99999999999", " 99999999999999999999", " -1", ""]),
        (PLY, "vertex", ["point"]),
        (PLY, "float z", ["float32 w", "quad z", "float z\nproperty float z", "list uchar float z", "list uchar"]),
        (PLY, "element vertex 10\n", [FACES + "element vertex 10\n", CAMERAS + "element vertex 10\n", ""]),
        (PLY, "format binary_little_endian 1.0\n", ["format binary_middle_endian 1.0\n", ""]),
        (PLY, "end_header\n", ["comment end_header\n", "end_header of it\n", "end_header", ""]),
    ])  # fmt: skip
def test_a_header_that_cannot_be(header, line, damaged, tmp_path):
    name = "a.pcd" if header == PCD else "a.ply"
    for instead in damaged:
        assert line in header
        refused(put(tmp_path, name, header.replace(line, instead).encode() + bytes(120)))


# ---- PCD headers


@each("encoding", ["ascii", "binary", "binary_compressed"])
@each("points", [11, 10**6, 10**12, 10**17])
def test_a_pcd_header_that_promises_more_than_there_is(encoding, points, tmp_path):
    header = PCD.replace("10", str(points)).replace("DATA binary", f"DATA {encoding}")
    body = {"ascii": b"1 2 3\n" * 10, "binary": bytes(120), "binary_compressed": struct.pack("<II", 112, 2**32 - 1)}
    refused(put(tmp_path, "a.pcd", header.encode() + body[encoding]), "cut short|damaged")


@each("gap", ["0 1 -9 1", "0 1 999999999999 1", "-99999 1 1 1"])
def test_pcd_padding_that_cannot_be(gap, tmp_path):
    header = PCD.replace("x y z", "x y z _ intensity _ ring").replace("4 4 4", "4 4 4 1 4 1 2")
    header = header.replace("F F F", "F F F U F U U").replace("1 1 1", f"1 1 1 {gap}", 1)
    refused(put(tmp_path, "a.pcd", header.encode() + bytes(400)))


@each("lines", [b"1 2 3\n1 2\n", b"1 2 3\n1 2 x\n", b"1.00 2.00 3.00\n\n", b"1,2,3\n1,2,3\n", b"1 2 3\n\xff\n"])
def test_pcd_lines_that_cannot_be(lines, tmp_path):
    header = PCD.replace("10", "2").replace("binary", "ascii")
    refused(put(tmp_path, "a.pcd", header.encode() + lines))


@each("body", [b"", b"\0" * 7, struct.pack("<II", 5, 120) + b"\xff" * 5, struct.pack("<II", 500, 120) + b"\0" * 50])
def test_pcd_points_that_do_not_unpack(body, tmp_path):
    header = PCD.replace("DATA binary", "DATA binary_compressed")
    refused(put(tmp_path, "a.pcd", header.encode() + body))


@each("points", [59, 61])
def test_pcd_points_that_unpack_to_another_number(points, cloud, tmp_path):
    pypcd4 = pytest.importorskip("pypcd4")
    compressed = pypcd4.Encoding.BINARY_COMPRESSED
    pypcd4.PointCloud.from_xyzi_points(cloud).save(tmp_path / "a.pcd", encoding=compressed)
    content = (tmp_path / "a.pcd").read_bytes()
    for key in (b"WIDTH", b"POINTS"):
        content = content.replace(key + b" 60", key + b" %d" % points)
    refused(put(tmp_path, "b.pcd", content), "damaged")


def test_pcd_points_that_would_fill_the_memory(tmp_path):
    header = PCD.replace("10", "5000000").replace("DATA binary", "DATA binary_compressed")
    body = struct.pack("<II", 100, 60_000_000) + bytes(100)
    refused(put(tmp_path, "a.pcd", header.encode() + body), "for 60000000 unpacked")


def test_a_pcd_field_of_no_values(tmp_path):
    header = PCD.replace("x y z", "x y z intensity").replace("4 4 4", "4 4 4 4").replace("F F F", "F F F F")
    refused(put(tmp_path, "a.pcd", header.replace("1 1 1", "1 1 1 0").encode() + bytes(160)), "wanted 1 or more")


@each("names", [("x",), ("x", "Y"), ("w", "scalar_Z")])
@each("encoding", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_field_that_is_there_twice(names, encoding, tmp_path):
    header = PCD.replace("DATA binary", f"DATA {encoding}")
    for line, more in (("x y z", names), ("4 4 4", "44"), ("F F F", "FF"), ("1 1 1", "11")):
        header = header.replace(line, " ".join([line, *more[: len(names)]]), 1)
    refused(
        put(tmp_path, "a.pcd", header.encode() + bytes(200)),
        f"{names[-1]}, which differ only in case or scalar_, wanted one of each",
    )


# ---- PLY headers


@each("name, double", [("x", "x"), ("z", "Z"), ("x", "scalar_X")])
def test_a_ply_property_that_is_there_twice(name, double, tmp_path):
    header = PLY.replace("end_header", f"property float {double}\nend_header")
    refused(
        put(tmp_path, "a.ply", header.encode() + bytes(200)),
        f"fields {name}, {double}, which differ only in case or scalar_, wanted one of each",
    )


@each("number", [11, 99999999999])
def test_a_ply_text_that_is_too_short(number, tmp_path):
    header = PLY.replace("binary_little_endian", "ascii").replace("10", str(number))
    refused(put(tmp_path, "a.ply", header.encode() + b"1 2 3\n" * 10), "cut short")
    header = header.replace("element vertex", f"element camera {number}\nproperty float f\nelement vertex")
    refused(put(tmp_path, "a.ply", header.encode() + b"1\n"), "cut short")


@each("name", ["a.pcd", "a.ply"])
def test_text_without_end(name, tmp_path, monkeypatch):
    limited(monkeypatch, text=30)
    header = PCD.replace("binary", "ascii") if name == "a.pcd" else PLY.replace("binary_little_endian", "ascii")
    refused(put(tmp_path, name, header.encode() + b"1 2 3\n" * 10), "60 bytes when decoded, wanted at most 30")


@pytest.mark.slow
def test_lines_before_the_vertices_take_little_memory(tmp_path, monkeypatch):
    header = PLY.replace("binary_little_endian", "ascii").replace("vertex 10", "vertex 1")
    header = header.replace("element", "element camera 1000000\nproperty float f\nelement", 1)
    path = put(tmp_path, "a.ply", header.encode() + b"\n" * 1_000_000 + b"1 2 x\n")
    refused(path, "not 3 numbers")
    limited(monkeypatch, text=30)
    refused(path, "bytes when decoded, wanted at most 30")


def test_text_takes_little_more_memory_than_its_numbers():
    body = memoryview(b"1 2 3\n" * 200_000)
    fields = [ogm.io.formats.table.Field(name, np.dtype("<f4")) for name in "xyz"]
    tracemalloc.start()
    try:
        columns = ogm.io.formats.table.text_columns(fields, 200_000, body, Path("a"))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(columns["z"], np.full(200_000, 3))
    assert peak < 7e6  # 2.4 MB of numbers, twice, and 1.2 MB of text; one str per line would be 11 MB more


# ---- Feather


@each("compression", ["zstd", "lz4", "uncompressed"])
@each("batch", [5_000, 50_000])
def test_a_small_feather_file_cannot_fill_the_memory(compression, batch, tmp_path, monkeypatch):
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    table = pyarrow.table({name: np.zeros(50_000, np.float32) for name in "xyzw"})
    feather.write_feather(table, tmp_path / "a.feather", compression=compression, chunksize=batch)
    size = (tmp_path / "a.feather").stat().st_size
    limited(monkeypatch, file=max(50_000 * 12 + 2**12, size))  # w is not unpacked
    assert read_scan_file(tmp_path / "a.feather")[1].dropped == 50_000
    limited(monkeypatch, file=50_000 * 12 - 1)
    unpacked = pyarrow.total_allocated_bytes()
    refused(tmp_path / "a.feather", "holds [68]0.* bytes when decoded, wanted at most 599999")
    assert pyarrow.total_allocated_bytes() == unpacked


def test_a_feather_table_without_points_names_its_fields(tmp_path):
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    feather.write_feather(pyarrow.table({"a": [1.0], "b": ["c"]}), tmp_path / "a.feather")
    refused(tmp_path / "a.feather", "has the fields a, wanted x, y, z")


def test_feather_of_version_1(tmp_path):
    pytest.importorskip("pyarrow")
    refused(put(tmp_path, "a.feather", b"FEA1" + bytes(100) + b"FEA1"), "version 1, wanted version 2")


def test_a_feather_column_that_is_there_twice(tmp_path):
    pyarrow, ipc = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.ipc")
    batch = pyarrow.RecordBatch.from_arrays([pyarrow.array([1.0])] * 4, ["x", "y", "z", "z"])
    with ipc.new_file(str(tmp_path / "a.feather"), batch.schema) as writer:
        writer.write_batch(batch)
    refused(tmp_path / "a.feather", "fields z, z, which differ only in case or scalar_, wanted one of each")


# ---- numpy arrays


@each("shape", [4, (4, 2), (4, 6), (4, 4, 2), (2, 2, 2, 3), ()])
def test_an_array_of_another_shape_is_no_cloud(shape, tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    refused(tmp_path / "a.npy", "wanted numbers of shape")


@each("dtype", [complex, bool, "U1", [("x", "f4")]])
def test_an_array_of_no_numbers_is_no_cloud(dtype, tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((4, 3), dtype))
    refused(tmp_path / "a.npy", "wanted numbers of shape")


def test_an_array_of_an_unknown_version(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((2, 3)))
    content = bytearray((tmp_path / "a.npy").read_bytes())
    content[6] = 4
    refused(put(tmp_path, "b.npy", bytes(content)), "version|format")


def test_a_pickle_is_never_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return sys.exit, ("the pickle was opened",)

    np.save(tmp_path / "a.npy", np.array([[Trap()] * 3]), allow_pickle=True)
    refused(tmp_path / "a.npy", "array of object")


@each("rows", [11, 10**9, 10**15, 10**40, -5])
def test_an_array_header_that_promises_more_than_there_is(rows, tmp_path):
    np.save(tmp_path / "a.npy", np.ones((10, 3), np.float32))
    content = (tmp_path / "a.npy").read_bytes()
    claim = content[:128].replace(b"(10, 3), }" + b" " * 45, f"({rows}, 3), }}".ljust(55).encode())
    assert len(claim) == 128
    assert claim != content[:128]
    refused(put(tmp_path, "b.npy", claim + content[128:]))


# ---- LAS headers


POINTS_AT, RECORDS, POINTS, POINT_BYTES = 96, 100, 107, 105  # places in the header


def las_bytes(cloud, path):
    las = pytest.importorskip("laspy").create(point_format=3)
    las.x = cloud[:, 0].astype(np.float64)
    las.write(path)
    return bytearray(path.read_bytes())


@each("at", [POINTS_AT, RECORDS, POINTS, POINT_BYTES])
@each("claim", [2**16 - 1, 2**32 - 1])
def test_a_las_header_that_promises_more_than_there_is(at, claim, cloud, tmp_path):
    content, size = las_bytes(cloud, tmp_path / "a.las"), 2 if at == POINT_BYTES else 4
    content[at : at + size] = min(claim, 2 ** (8 * size) - 1).to_bytes(size, "little")
    refused(put(tmp_path, "b.las", bytes(content)))


def test_a_las_header_that_promises_one_point_more(cloud, tmp_path):
    content = las_bytes(cloud, tmp_path / "a.las")
    content[POINTS : POINTS + 4] = (61).to_bytes(4, "little")
    refused(put(tmp_path, "b.las", bytes(content)))


def test_a_laz_file_that_promises_more_chunks_than_there_are(cloud, tmp_path):
    content = las_bytes(cloud, tmp_path / "a.laz")
    start = int.from_bytes(content[96:100], "little")
    table = int.from_bytes(content[start : start + 8], "little")
    assert int.from_bytes(content[table + 4 : table + 8], "little") == 1
    content[table + 4 : table + 8] = b"\xff" * 4
    refused(put(tmp_path, "b.laz", bytes(content)), "no complete LAS cloud")


# ---- packed files


@each("suffix, pack", [(".xz", lzma.compress), (".gz", gzip.compress)])
def test_packed_files_that_are_damaged(suffix, pack, cloud, tmp_path):
    content = pack(cloud.tobytes())
    for end in range(0, len(content), 9):
        refused(put(tmp_path, f"a.bin{suffix}", content[:end]))
    refused(put(tmp_path, f"a.bin{suffix}", cloud.tobytes()), "wrongly named")
    damaged = bytearray(content)
    damaged[len(content) // 2] ^= 0xFF
    refused(put(tmp_path, f"a.bin{suffix}", bytes(damaged)))


# ---- any byte missing or wrong


NAMES = [
    "a.bin", "a.pcd.bin", "a.npy", "image.npy", "ascii.pcd", "binary.pcd", "binary_compressed.pcd",
    "text.ply", "binary.ply", "a.feather", "a.las",
]  # fmt: skip


def whole(path: Path, cloud: np.ndarray) -> Path:
    """Write a small file of a format."""
    match path.suffixes:
        case [".bin"]:
            path.write_bytes(cloud.tobytes())
        case [".pcd", ".bin"]:
            path.write_bytes(np.column_stack([cloud, np.arange(60)]).astype(np.float32).tobytes())
        case [".npy"]:
            np.save(path, cloud.reshape(6, 10, 4) if path.stem == "image" else cloud)
        case [".pcd"]:
            pypcd4 = pytest.importorskip("pypcd4")
            pypcd4.PointCloud.from_xyzi_points(cloud).save(path, encoding=pypcd4.Encoding(path.stem))
        case [".ply"]:
            plyfile = pytest.importorskip("plyfile")
            vertex = np.array([tuple(row) for row in cloud], dtype=[(name, "f4") for name in ("x", "y", "z", "i")])
            plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")], text=path.stem == "text").write(str(path))
        case [".feather"]:
            pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
            feather.write_feather(pyarrow.table(dict(zip(["x", "y", "z", "intensity"], cloud.T, strict=True))), path)
        case _:
            laspy = pytest.importorskip("laspy")
            las = laspy.create(point_format=3)
            las.x, las.y, las.z = cloud[:, :3].T.astype(np.float64)
            las.write(path)
    assert len(read_scan(path, "nuscenes").points) == 60
    return path


@each("name", [*NAMES, "a.laz"])
def test_a_file_cut_short_anywhere_is_refused_or_shorter(name, cloud, tmp_path):
    path = whole(tmp_path / name, cloud)
    content = path.read_bytes()
    for end in range(0, len(content), max(1, len(content) // 70)):
        path.write_bytes(content[:end])
        scan, message = read_or_refuse(path)
        if scan is None:
            assert name in message
        else:  # KITTI and nuScenes files do not hold their length; a text may lack its last digits
            assert len(scan.points) < 60 or (name in ("ascii.pcd", "text.ply") and end > len(content) - 20)


@each("name", NAMES)  # lazrs takes the sizes in a LAZ file on trust
def test_a_file_with_wrong_bytes_is_refused_or_read(name, cloud, tmp_path):
    path = whole(tmp_path / name, cloud)
    content, rng = path.read_bytes(), np.random.default_rng(12)
    for _ in range(60):
        damaged = np.frombuffer(content, np.uint8).copy()
        at = rng.integers(0, min(len(content), 500), 3)
        damaged[at] = rng.integers(0, 256, 3)
        path.write_bytes(damaged.tobytes())
        scan, message = read_or_refuse(path)
        assert name in message if scan is None else np.isfinite(scan.points).all()


# ---- packages that are not there


@each("name, module, content", [
        ("a.las", "laspy", b"LASF"),
        ("a.feather", "pyarrow", b"ARROW1"),
        ("a.pcd", "lzf", PCD.replace("binary", "binary_compressed").encode() + struct.pack("<II", 8, 120) + bytes(8)),
    ])  # fmt: skip
def test_a_missing_package_is_named_with_its_cure(name, module, content, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf'{name}.*{module}.*pip install .*\[io\]"'):
        read_scan(put(tmp_path, name, content))


def test_reading_needs_no_package_but_numpy():
    code = "import sys, ogm.io; print({'lzf', 'laspy', 'pyarrow', 'scipy', 'numba'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout == b"set()\n"
