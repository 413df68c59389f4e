"""Every format, written by another library and read back."""

import gzip
import lzma
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ogm.io import read_points, read_scan, read_scan_file
from ogm.io.formats.feather import parse_feather

CLOUDS = hnp.arrays(
    np.float32, st.tuples(st.integers(1, 30), st.just(4)), elements=st.floats(0.0009765625, 1.0, width=32)
).map(lambda unit: unit * np.float32([900, -900, 30, 1]))


def write_kitti(path: Path, cloud: np.ndarray) -> Path:
    path = path / "cloud.bin"
    path.write_bytes(cloud.tobytes())
    return path


def write_nuscenes(path: Path, cloud: np.ndarray) -> Path:
    path = path / "cloud.pcd.bin"
    rows = np.column_stack([cloud[:, :3], cloud[:, 3] * 255, np.arange(len(cloud)) % 32])
    path.write_bytes(rows.astype(np.float32).tobytes())
    return path


def write_npy(path: Path, cloud: np.ndarray) -> Path:
    path = path / "cloud.npy"
    np.save(path, cloud)
    return path


def write_pcd(path: Path, cloud: np.ndarray, encoding: str) -> Path:
    pypcd4 = pytest.importorskip("pypcd4")
    path = path / "cloud.pcd"
    pypcd4.PointCloud.from_xyzi_points(cloud).save(path, encoding=pypcd4.Encoding(encoding))
    return path


def write_pcd_ascii(path: Path, cloud: np.ndarray) -> Path:
    return write_pcd(path, cloud, "ascii")


def write_pcd_binary(path: Path, cloud: np.ndarray) -> Path:
    return write_pcd(path, cloud, "binary")


def write_pcd_compressed(path: Path, cloud: np.ndarray) -> Path:
    return write_pcd(path, cloud, "binary_compressed")


def write_ply(path: Path, cloud: np.ndarray, byte_order: str, text: bool) -> Path:
    plyfile = pytest.importorskip("plyfile")
    path = path / "cloud.ply"
    names = ("x", "y", "z", "intensity")
    vertex = np.array([tuple(row) for row in cloud], dtype=[(name, "f4") for name in names])
    camera = np.array([(1.0, 7)], dtype=[("focal", "f8"), ("id", "u1")])
    face = np.array([([0, 1, 2],)], dtype=[("vertex_indices", "i4", (3,))])
    elements = [
        plyfile.PlyElement.describe(array, name)
        for array, name in ((camera, "camera"), (vertex, "vertex"), (face, "face"))
    ]
    plyfile.PlyData(elements, text=text, byte_order=byte_order).write(str(path))
    return path


def write_ply_ascii(path: Path, cloud: np.ndarray) -> Path:
    return write_ply(path, cloud, "=", True)


def write_ply_little(path: Path, cloud: np.ndarray) -> Path:
    return write_ply(path, cloud, "<", False)


def write_ply_big(path: Path, cloud: np.ndarray) -> Path:
    return write_ply(path, cloud, ">", False)


def write_feather(path: Path, cloud: np.ndarray) -> Path:
    pyarrow = pytest.importorskip("pyarrow")
    feather = pytest.importorskip("pyarrow.feather")
    path = path / "cloud.feather"
    names = ("x", "y", "z", "intensity")
    feather.write_feather(pyarrow.table(dict(zip(names, cloud.T, strict=True))), path, compression="lz4")
    return path


def write_las(path: Path, cloud: np.ndarray, suffix: str = ".las") -> Path:
    laspy = pytest.importorskip("laspy")
    path = path / f"cloud{suffix}"
    las = laspy.create(point_format=3)
    las.header.scales = [1e-5] * 3
    las.x, las.y, las.z = cloud[:, :3].T.astype(np.float64)
    las.intensity = np.round(cloud[:, 3] * 65535).astype(np.uint16)
    las.gps_time = 400_000.0 + 0.001 * np.arange(len(cloud))
    las.write(path)
    return path


def write_laz(path: Path, cloud: np.ndarray) -> Path:
    pytest.importorskip("lazrs")
    return write_las(path, cloud, ".laz")


def test_a_laz_file_without_its_decoder_is_refused_with_the_way_to_install_it(cloud, tmp_path, monkeypatch):
    path = write_laz(tmp_path, cloud)
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(ImportError, match=r"cloud\.laz cannot be read: lazrs is not installed: .*pip install .*\[io\]"):
        read_scan(path)


WRITERS = [
    write_kitti, write_nuscenes, write_npy, write_pcd_ascii, write_pcd_binary, write_pcd_compressed,
    write_ply_ascii, write_ply_little, write_ply_big, write_feather, write_las, write_laz,
]  # fmt: skip


@pytest.mark.parametrize("write", WRITERS)
@settings(max_examples=20, deadline=None)
@given(cloud=CLOUDS)
def test_what_is_written_is_read(write, cloud):
    with tempfile.TemporaryDirectory() as folder:
        points = read_points(write(Path(folder), cloud), ("+x", "+y", "+z"))
    assert points.dtype == np.float32
    assert points.shape == cloud.shape
    np.testing.assert_allclose(points, cloud, rtol=1e-6, atol=1e-5)


@each("write", [write_npy, write_pcd_ascii, write_pcd_binary, write_ply_ascii, write_ply_big, write_feather, write_las])
def test_formats_with_a_header_can_hold_no_points(write, cloud, tmp_path):
    assert read_points(write(tmp_path, cloud[:0])).shape == (0, 4)


@each("write", [write_kitti, write_npy, write_pcd_binary, write_pcd_compressed, write_ply_big])
def test_formats_of_float32_lose_nothing(write, cloud, tmp_path):
    np.testing.assert_array_equal(read_points(write(tmp_path, cloud)), cloud)


@each("suffix, pack", [(".xz", lzma.compress), (".gz", gzip.compress)])
@each("write", WRITERS)
def test_packing_changes_nothing(write, suffix, pack, cloud, tmp_path):
    plain = write(tmp_path, cloud)
    packed = tmp_path / (plain.name + suffix)
    packed.write_bytes(pack(plain.read_bytes()))
    np.testing.assert_array_equal(read_points(packed), read_points(plain))


@each("write", [write_kitti, write_npy])
def test_suffixes_may_be_in_capitals(write, cloud, tmp_path):
    plain = write(tmp_path, cloud)
    np.testing.assert_array_equal(read_points(plain.rename(tmp_path / plain.name.upper())), cloud)


def test_nuscenes_has_rings(cloud, tmp_path):
    scan = read_scan(write_nuscenes(tmp_path, cloud), "nuscenes")
    assert scan.ring.dtype == np.uint16
    np.testing.assert_array_equal(scan.ring, np.arange(60) % 32)


def test_las_has_times(cloud, tmp_path):
    scan = read_scan(write_las(tmp_path, cloud))
    assert scan.stamp == pytest.approx(400_000.0)
    np.testing.assert_allclose(scan.time, 0.001 * np.arange(60), atol=1e-9)


# ---- numpy arrays


BODY = np.float32([[1, 2, 3], [4, 5, 6]])


@each("head", [
        "COLUMNS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n",
        "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nPOINTS 2\n",
        "columns x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\n",
    ])  # fmt: skip
def test_pcd_headers_as_pcl_takes_them(head, tmp_path):
    (tmp_path / "a.pcd").write_bytes(f"{head}DATA binary\n".encode() + BODY.tobytes())
    np.testing.assert_array_equal(read_points(tmp_path / "a.pcd")[:, :3], BODY)


@each("value", ["nan", "12.0", "-nan", "4294967296", "-1", "1e3"])
def test_a_whole_number_of_a_pcd_that_is_none_costs_no_scan(value, tmp_path):
    head = "FIELDS x y z ring id\nSIZE 4 4 4 2 4\nTYPE F F F U U\nWIDTH 2\nHEIGHT 1\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(f"{head}1 2 3 0 7\n4 5 6 1 {value}\n")
    scan = read_scan(tmp_path / "a.pcd")
    np.testing.assert_array_equal(scan.points[:, :3], BODY)
    assert scan.ring.tolist() == [0, 1]


@each("kind", ["int64", "uint64"])
@each("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_properties_of_64_bits(kind, encoding, tmp_path):
    properties = "".join(f"property float {name}\n" for name in "xyz") + f"property {kind} t\n"
    head = f"ply\nformat {encoding} 1.0\nelement vertex 2\n{properties}end_header\n"
    order = ">" if "big" in encoding else "<"
    rows = np.zeros(2, [(name, f"{order}f4") for name in "xyz"] + [("t", f"{order}{'iu'[kind[0] == 'u']}8")])
    rows["x"], rows["y"], rows["z"], rows["t"] = *BODY.T, [17 * 10**17, 17 * 10**17 + 10**8]
    text = "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode()
    (tmp_path / "a.ply").write_bytes(head.encode() + (text if encoding == "ascii" else rows.tobytes()))
    scan = read_scan(tmp_path / "a.ply")
    np.testing.assert_array_equal(scan.points[:, :3], BODY)
    np.testing.assert_allclose(scan.time, [0, 0.1])


def test_npy_of_three_values_has_no_intensity(cloud, tmp_path):
    np.save(tmp_path / "a.npy", cloud[:, :3].astype(np.float64))
    scan, facts = read_scan_file(tmp_path / "a.npy")
    assert facts.intensity_max is None
    np.testing.assert_array_equal(scan.points[:, :3], cloud[:, :3])
    assert not scan.points[:, 3].any()


def test_npy_of_five_values_ends_in_the_ring(cloud, tmp_path):
    np.save(tmp_path / "a.npy", np.column_stack([cloud, np.arange(60)]))
    np.testing.assert_array_equal(read_scan(tmp_path / "a.npy").ring, np.arange(60))


def test_npy_may_lie_column_by_column_and_in_any_byte_order(cloud, tmp_path):
    np.save(tmp_path / "a.npy", np.asfortranarray(cloud).astype(">f8"))
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), cloud)


@each("version", [(1, 0), (2, 0), (3, 0)])
def test_npy_of_any_version_is_read(version, cloud, tmp_path):
    with open(tmp_path / "a.npy", "wb") as file:
        np.lib.format.write_array(file, cloud, version)
    np.testing.assert_array_equal(read_points(tmp_path / "a.npy"), cloud)


def test_npy_of_an_image_is_an_organised_cloud(cloud, tmp_path):
    image = np.concatenate([cloud, np.full((60, 2), 99.0, np.float32)], axis=1).reshape(6, 10, 6)
    np.save(tmp_path / "a.npy", image)
    scan, facts = read_scan_file(tmp_path / "a.npy")
    assert facts.shape == (6, 10)
    assert facts.fields == ("x", "y", "z", "intensity")
    np.testing.assert_array_equal(scan.points, cloud)


# ---- PCD, as real writers write it


def pcd(path: Path, header: str, body: bytes) -> Path:
    path = path / "a.pcd"
    path.write_bytes(b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n" + header.encode() + body)
    return path


HEADER = """FIELDS {fields}
SIZE {sizes}
TYPE {types}
COUNT {counts}
WIDTH {width}
HEIGHT {height}
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA {encoding}
"""
STRUCT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "timestamp", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f8", "<u2"],
        "offsets": [0, 4, 8, 16, 24, 32],
        "itemsize": 48,
    }
)


@pytest.fixture
def records(cloud) -> np.ndarray:
    records = np.frombuffer(np.full(60 * 48, 0x7F, np.uint8).tobytes(), STRUCT).copy()  # padding is not zero
    for name, column in zip(("x", "y", "z", "intensity"), cloud.T, strict=True):
        records[name] = column
    records["timestamp"] = 1_600_000_000.25 + 0.001 * np.arange(60)
    records["ring"] = np.arange(60)
    return records


@each("counts", ["1 1 1 4 1 4 1 1 14", "1 1 1 4 1 0 1 6 1 12"])
def test_pcd_padding_is_stepped_over(counts, records, cloud, tmp_path):
    with_gap = len(counts.split()) == 10
    header = HEADER.format(
        fields="x y z _ intensity _ timestamp _ ring _" if with_gap else "x y z _ intensity _ timestamp ring _",
        sizes="4 4 4 1 4 1 8 1 2 1" if with_gap else "4 4 4 1 4 1 8 2 1",
        types="F F F U F U F U U U" if with_gap else "F F F U F U F U U",
        counts=counts,
        width=60,
        height=1,
        points=60,
        encoding="binary",
    )
    scan, facts = read_scan_file(pcd(tmp_path, header, records.tobytes()))
    np.testing.assert_array_equal(scan.points, cloud)
    np.testing.assert_array_equal(scan.ring, np.arange(60))
    assert scan.stamp == 1_600_000_000.25
    np.testing.assert_allclose(scan.time, 0.001 * np.arange(60), atol=1e-6)
    assert facts.fields == ("x", "y", "z", "intensity", "timestamp", "ring")


def xyzi(points: int, width: int, height: int, encoding: str = "binary") -> str:
    return HEADER.format(
        fields="x y z intensity", sizes="4 4 4 4", types="F F F F", counts="1 1 1 1",
        width=width, height=height, points=points, encoding=encoding,
    )  # fmt: skip


@each("padding", [b"\0" * 3900, b"\0", b"anything"])
def test_pcd_bytes_behind_the_last_point_are_no_points(padding, cloud, tmp_path):
    path = pcd(tmp_path, xyzi(60, 60, 1), cloud.tobytes() + padding)
    scan, facts = read_scan_file(path)
    np.testing.assert_array_equal(scan.points, cloud)
    assert facts.shape is None


def test_pcd_lines_behind_the_last_point_are_no_points(tmp_path):
    path = pcd(tmp_path, xyzi(2, 2, 1, "ascii"), b"1 2 3 0.5\n4 5 6 1\n7 8 9 1\n")
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3, 0.5], [4, 5, 6, 1]])


def test_pcd_text_may_end_without_a_newline_and_have_those_of_windows(tmp_path):
    path = pcd(tmp_path, xyzi(2, 2, 1, "ascii").replace("\n", "\r\n"), b"1 2 3 0.5\r\n4 5 6 1")
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3, 0.5], [4, 5, 6, 1]])


def test_pcd_text_may_say_nan(tmp_path):
    path = pcd(tmp_path, xyzi(4, 4, 1, "ascii"), b"nan nan nan 0\n4 5 6 1\n-nan 1 1 0\n1 inf 2 0\n")
    scan, facts = read_scan_file(path)
    np.testing.assert_array_equal(scan.points, [[4, 5, 6, 1]])
    assert facts.dropped == 3


def test_pcd_of_several_rows_is_organised(cloud, tmp_path):
    scan, facts = read_scan_file(pcd(tmp_path, xyzi(60, 10, 6), cloud.tobytes()))
    assert facts.shape == (6, 10)
    np.testing.assert_array_equal(scan.points, cloud)


@each("encoding", ["ascii", "binary"])
def test_pcd_fields_of_several_values_are_stepped_over(encoding, cloud, tmp_path):
    rows = np.column_stack([np.zeros((60, 3)), cloud]).astype(np.float32)
    header = HEADER.format(
        fields="normal x y z intensity", sizes="4 4 4 4 4", types="F F F F F", counts="3 1 1 1 1",
        width=60, height=1, points=60, encoding=encoding,
    )  # fmt: skip
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows)
    np.testing.assert_array_equal(
        read_points(pcd(tmp_path, header, rows.tobytes() if encoding == "binary" else text.encode())), cloud
    )


def test_pcd_without_count_and_points_is_read(cloud, tmp_path):
    lines = xyzi(60, 60, 1).splitlines(keepends=True)
    header = "".join(line for line in lines if not line.startswith(("COUNT", "POINTS", "VIEWPOINT")))
    np.testing.assert_array_equal(read_points(pcd(tmp_path, header, cloud.tobytes())), cloud)


@each("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_of_no_points_gives_none(encoding, tmp_path):
    scan = read_scan(pcd(tmp_path, xyzi(0, 0, 1, encoding), b""))
    assert scan.points.shape == (0, 4)


# ---- PLY


def test_ply_types_are_read_by_either_name(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment made by hand\nobj_info none\nelement vertex 2\nproperty double x\n"
        "property float32 y\nproperty int16 z\nproperty uchar intensity\nproperty ushort ring\nend_header\n"
        "1.5 2.5 3 255 7\n-1 -2 -3 0 8\n"
    )
    scan = read_scan(tmp_path / "a.ply")
    np.testing.assert_array_equal(scan.points, [[1.5, 2.5, 3, 1], [-1, -2, -3, 0]])
    np.testing.assert_array_equal(scan.ring, [7, 8])


@each("newline", ["\n", "\r\n"])
def test_a_ply_comment_may_speak_of_end_header(newline, tmp_path):
    text = (
        "ply\nformat ascii 1.0\ncomment the end_header line comes below\ncomment end_header\n"
        "element vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n4 5 6\n"
    )
    (tmp_path / "a.ply").write_bytes(text.replace("\n", newline).encode())
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply")[:, :3], [[1, 2, 3], [4, 5, 6]])


def test_feather_reads_only_what_it_needs(cloud, tmp_path):
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    columns = dict(zip(("x", "y", "z", "intensity"), cloud.T, strict=True))
    words = pyarrow.array(["a word"] * 60)
    table = pyarrow.table({"label": words, **columns, "kind": words.dictionary_encode(), "rgb": cloud[:, 0]})
    feather.write_feather(table, tmp_path / "a.feather", chunksize=7)
    scan, facts = read_scan_file(tmp_path / "a.feather")
    np.testing.assert_array_equal(scan.points, cloud)
    assert facts.fields == ("x", "y", "z", "intensity", "rgb")
    path = tmp_path / "a.feather"
    assert set(parse_feather(path.read_bytes(), path).columns) == {"x", "y", "z", "intensity"}
