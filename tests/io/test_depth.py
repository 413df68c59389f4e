"""Depth images: pixels to points, mixtures at edges, encodings of messages, cameras."""

import struct
from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
from cases import each, refused
from PIL import Image
from rooms import CAMERA, MAN, TABLE, depths, looking, ranges

from ogm.io import Intrinsics, depth_scan
from ogm.io.depth import source_pixels
from ogm.io.messages import intrinsics_from_camera_info, scan_from_depth_image
from ogm.io.messages.plain import header
from ogm.pose import transform_points

SMALL = Intrinsics(8, 6, 100.0, 100.0, 3.5, 2.5)


ALL = slice(None)


def image(*changes: tuple[Any, Any, float]) -> np.ndarray:
    """Return depths [m] of a wall at 3 m, where the pixels of some rows and columns lie nearer or farther."""
    pixels = np.full((SMALL.height, SMALL.width), 3.0, np.float32)
    for rows, columns, value in changes:
        pixels[rows, columns] = value
    return pixels


def message(pixels: np.ndarray, encoding: str, *, big: bool = False, padding: int = 0, **changed: Any) -> Any:
    rows = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<")).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    sizes = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    given = {"encoding": encoding, "is_bigendian": int(big), "data": rows.reshape(-1), **sizes, **changed}
    return SimpleNamespace(header=header(12.5, "camera_optical_frame"), **given)


def test_pixels_become_the_points_that_the_rays_met() -> None:
    T = looking(1.2, pitch=15, yaw=20)
    scan = depth_scan(depths(T, (*TABLE, MAN)), CAMERA, 1.0, stride=1, stamp=3.0)
    x, y, z = transform_points(T, scan.points)[:, :3].T
    walls = np.minimum.reduce([abs(x - 5), abs(x + 3), abs(y - 3), abs(y + 3), abs(z), abs(z - 2.6)])
    on_box = np.zeros(len(x), bool)
    for x0, y0, z0, x1, y1, z1 in (*TABLE, MAN):
        low, high = np.array([x0, y0, z0]) - 1e-4, np.array([x1, y1, z1]) + 1e-4
        on_box |= ((np.column_stack([x, y, z]) > low) & (np.column_stack([x, y, z]) < high)).all(axis=1)
    assert (on_box | (walls < 1e-4)).all()
    assert (scan.kind, scan.stamp, scan.no_returns) == ("depth", 3.0, None)


@each(
    "changes, kept",
    [
        ([], 48),
        ([(ALL, 0, 0), (0, ALL, np.nan)], 35),  # without depth: no points
        ([(2, 2, np.inf), (3, 2, -1.0), (5, 5, 0.1), (5, 6, 11.0)], 44),  # nor too near or too far
        ([(ALL, slice(0, 4), 1.0)], 48),  # two surfaces side by side: both stay
        ([(ALL, slice(0, 3), 1.0), (ALL, 3, 2.0)], 42),  # a column between them
        ([(slice(0, 2), ALL, 1.0), (2, ALL, 2.0)], 40),  # a row
        ([(ALL, slice(0, 3), 1.0), (ALL, 3, 2.0), (ALL, slice(4, 8), 0)], 18),  # one beside no depth
        ([(ALL, 3, 1.0)], 48),  # a thin pole before the wall stays
        ([(2, 3, 1.0)], 47),  # a speck does not
    ],
)
def test_points_are_of_surfaces(changes: list[tuple[Any, Any, float]], kept: int) -> None:
    assert len(depth_scan(image(*changes), SMALL, 1.0, stride=1)) == kept


def test_of_every_square_of_pixels_the_nearest_point_stays() -> None:
    scan = depth_scan(image((ALL, 3, 1.0)), SMALL, 1.0, stride=4)
    assert scan.points[:, 0].tolist() == [1.0, 3.0, 1.0, 3.0]
    assert (
        len(depth_scan(depths(looking(1.0)), CAMERA, 1.0)) == CAMERA.width * CAMERA.height
    )  # points 0.4 degrees apart


@each(
    "match, pixels, scale",
    [
        ("median of 3e\\+03 m at scale 1.*--depth-scale", image() * 1000, 1.0),
        ("median of 0.003 m", image(), 1000.0),
        ("give the depth image, not the colour or grey image", np.zeros((6, 8, 3), np.uint8), 1000.0),
        ("give the depth image, not the colour or grey image", np.zeros((6, 8), np.uint8), 1000.0),
        ("8 x 5 pixels, its intrinsics have 8 x 6", image()[:5], 1.0),
        ("scale must be above 0", image(), 0.0),
    ],
)
def test_what_is_no_depth_image_is_refused(match: str, pixels: np.ndarray, scale: float) -> None:
    refused(match, depth_scan, pixels, SMALL, scale)


@each(
    "encoding, pixels, options",
    [
        ("16UC1", (image() * 1000).astype(np.uint16), {}),
        ("16UC1", (image() * 1000).astype(np.uint16), {"big": True, "padding": 6}),
        ("16UC1", (image() * 1000).astype(np.uint16), {"step": 0}),
        ("32FC1", image(), {"padding": 4}),
        ("32FC1", image(), {"big": True}),
        ("mono16", (image() * 5000).astype(np.uint16), {"scale": 5000.0}),
    ],
)
def test_messages_of_all_layouts_are_the_same_scan(encoding: str, pixels: np.ndarray, options: dict[str, Any]) -> None:
    scale = options.pop("scale", None)
    scan = scan_from_depth_image(message(pixels, encoding, **options), SMALL, scale=scale)
    np.testing.assert_allclose(scan.points, depth_scan(image(), SMALL, 1.0).points, atol=1e-6)
    assert scan.stamp == 12.5


@each(
    "match, encoding, changed",
    [
        ("encoding rgb8, wanted depths \\(16UC1, 32FC1\\): choose the topic of a depth camera", "rgb8", {}),
        ("encoding 8UC1", "8UC1", {}),
        ("encoding mono16, .*give --depth-scale, 1000 for mm", "mono16", {}),
        ("96 bytes, wanted 7 rows of 8 pixels", "16UC1", {"height": 7}),
        ("cut short or damaged", "16UC1", {"width": 2**31}),
        ("8 x 3 pixels, its intrinsics have 8 x 6", "16UC1", {"height": 3}),
    ],
)
def test_other_images_are_refused(match: str, encoding: str, changed: dict[str, Any]) -> None:
    pixels = np.full((6, 8), 3000, np.uint16)
    refused(match, scan_from_depth_image, message(pixels, encoding, **changed), SMALL)


def packed(pixels: np.ndarray, encoding: str, head: bytes, **changed: Any) -> Any:
    Image.fromarray(pixels).save(png := BytesIO(), "PNG")
    given = {"format": f"{encoding}; compressedDepth png", "data": head + png.getvalue(), **changed}
    return SimpleNamespace(header=header(12.5, "camera_optical_frame"), **given)


def test_compressed_depths_are_the_same_scan() -> None:
    """As compressed_depth_image_transport writes them: depth = A / (pixel - B), 0 for none."""
    wanted, millimetres = (
        depth_scan(image((0, 0, 0)), SMALL, 1.0, stride=1),
        (image((0, 0, 0)) * 1000).astype(np.uint16),
    )
    a, b = 1000.0, -1.0 + 1000 / 10
    quantised = np.where(millimetres > 0, 1000 / np.maximum(image(), 1e-3) + b, 0).round().astype(np.uint16)
    for pixels, encoding, head in (
        (millimetres, "16UC1", struct.pack("<iff", 0, 0, 0)),
        (millimetres, "16UC1", b""),  # of compressed_image_transport
        (quantised, "32FC1", struct.pack("<iff", 0, a, b)),
    ):
        scan = scan_from_depth_image(packed(pixels, encoding, head), SMALL)
        assert len(scan) == len(wanted) == 47
        np.testing.assert_allclose(scan.points, wanted.points, atol=0.01)


@each(
    "match, head, changed",
    [
        (
            "compressedDepth rvl', wanted depths as PNG",
            b"",
            {"format": "16UC1; compressedDepth rvl", "data": bytes(40)},
        ),
        ("encoding rgb8, wanted depths", b"", {"format": "rgb8; png compressed bgr8"}),
        ("quantised by nan and 0", struct.pack("<iff", 0, np.nan, 0), {"format": "32FC1; compressedDepth png"}),
        ("is damaged or no image", b"", {"data": b"\x89PNG and no more"}),
    ],
)
def test_other_compressed_images_are_refused(match: str, head: bytes, changed: dict[str, Any]) -> None:
    refused(match, scan_from_depth_image, packed(np.full((6, 8), 3000, np.uint16), "16UC1", head, **changed), SMALL)


@each("lens", [(-0.3, 0.1, 0.002, -0.001, -0.02), (0.4, 0.1, 0.001, 0.0, 0.02, 0.5, 0.2, 0.05)])
def test_distorted_images_become_the_points_that_the_rays_met(lens: tuple[float, ...]) -> None:
    """The image of a lens: every pixel sees along the ray whose distorted place it is (found by Newton's method)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(lens, (0, 8 - len(lens)))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].reshape(2, -1)
    seen = np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy])

    def distort(at: np.ndarray) -> np.ndarray:
        (x, y), r2 = at, (at**2).sum(axis=0)
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        turned = [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        return at * radial + np.array(turned)

    at = seen.copy()
    for _ in range(100):
        at -= distort(at) - seen
    np.testing.assert_allclose(distort(at), seen, atol=1e-9)
    T = looking(1.2, pitch=15, yaw=20)
    ways = np.column_stack([np.ones(u.size), -at[0], -at[1]])
    depth = ranges(T[:3, 3], ways @ T[:3, :3].T).reshape(CAMERA.height, CAMERA.width)

    def off(camera: Intrinsics) -> np.ndarray:
        """Return how far points lie from the walls, floor and ceiling [m]."""
        x, y, z = transform_points(T, depth_scan(depth, camera, 1.0, stride=1).points)[:, :3].T
        return np.minimum.reduce([abs(x - 5), abs(x + 3), abs(y - 3), abs(y + 3), abs(z), abs(z - 2.6)])

    right = off(CAMERA._replace(distortion=lens))
    assert len(right) > 0.7 * depth.size
    assert right.max() < 0.05  # half a pixel at the farthest
    assert off(CAMERA).max() > 0.1  # where distortion is neglected


def test_a_lens_whose_polynomial_turns_back_shows_nothing_beyond() -> None:
    source = source_pixels(CAMERA._replace(distortion=(-1.5, 0.0, 0.0, 0.0, 0.0)))
    v, u = np.nonzero(source < CAMERA.width * CAMERA.height)
    assert np.hypot((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy).max() < np.sqrt(1 / 4.5) + 0.01


def info(K: Any = (100, 0, 3.5, 0, 100, 2.5, 0, 0, 1), **changed: Any) -> Any:  # noqa: N803
    region = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    given = {"height": 6, "width": 8, "k": np.array(K, float), "d": np.zeros(5), "binning_x": 0, "binning_y": 0}
    given |= {"p": np.insert(np.array(K, float)[:9] * 2, [3, 6, 9], 0) if len(K) == 9 else K}
    given |= {"distortion_model": "plumb_bob"}
    return SimpleNamespace(header=header(1.0, "camera"), **{**given, "roi": region, **changed})


def test_a_camera_is_known_by_its_matrix_binning_and_region() -> None:
    assert intrinsics_from_camera_info(info()) == SMALL
    assert intrinsics_from_camera_info(info(binning_x=2, binning_y=2)) == Intrinsics(4, 3, 50.0, 50.0, 1.75, 1.25)
    region = SimpleNamespace(x_offset=2, y_offset=1, width=4, height=4)
    assert intrinsics_from_camera_info(info(roi=region)) == Intrinsics(4, 4, 100.0, 100.0, 1.5, 1.5)
    lens = info(d=np.array([0.1, -0.2, 0.0, 0.0, 0.05]))
    assert intrinsics_from_camera_info(lens).distortion == (0.1, -0.2, 0.0, 0.0, 0.05)
    assert intrinsics_from_camera_info(lens, rectified=True) == Intrinsics(8, 6, 200.0, 200.0, 7.0, 5.0)
    fisheye = info(d=np.full(4, 0.1), distortion_model="equidistant")
    refused("lens model 'equidistant' with 4 coefficients, wanted plumb_bob", intrinsics_from_camera_info, fisheye)
    refused("distortion .*nan.*calibrate the camera", intrinsics_from_camera_info, info(d=np.full(5, np.nan)))
    refused("calibrate the camera", intrinsics_from_camera_info, info(np.zeros(9)))
    refused("matrix that is not numeric", intrinsics_from_camera_info, info(np.ones(8)))
