"""``radar_msgs/RadarScan`` and Continental's detections."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from ogm.geometric import moving_detections, sensor_velocity
from ogm.io.messages import scan_from_continental, scan_from_radar_scan
from ogm.storage.files import OgmError


def test_radar_scan(sent):
    way = np.radians(30)
    rows = [(10.0, way, 0.0, -3.0, 4.0), (20.0, 0.0, way, 2.5, 1.0), (0.0, 0.0, 0.0, 9.0, 9.0)]
    names = ("range", "azimuth", "elevation", "doppler_velocity", "amplitude")
    header = SimpleNamespace(seq=0, stamp=SimpleNamespace(sec=4, nanosec=500_000_000), frame_id="radar")
    plain = SimpleNamespace(
        header=header, returns=[SimpleNamespace(**dict(zip(names, row, strict=True))) for row in rows]
    )
    for ros in (1, 2):
        scan = scan_from_radar_scan(sent(plain, "radar_msgs/msg/RadarScan", ros))
        left, up = [10 * np.cos(way), 5, 0, 0], [20 * np.cos(way), 0, 10, 0]
        np.testing.assert_allclose(scan.points, [left, up], atol=1e-5)  # a range of 0 is no return
        np.testing.assert_array_equal(scan.doppler, [-3, 2.5])
        assert scan.stamp == 4.5
    plain.returns = []
    assert len(scan_from_radar_scan(sent(plain, "radar_msgs/msg/RadarScan"))) == 0


def test_continental_detections():
    def row(azimuth: float, elevation: float, **more: object) -> dict[str, object]:
        angles = {"azimuth_angle": azimuth, "elevation_angle": elevation}
        return {"range": 10.0, **angles, "range_rate": -3.0, "rcs": 7, **more}

    message = {
        "header": {"stamp": {"sec": 4, "nanosec": 500_000_000}, "frame_id": "radar"},
        "detections": [row(np.pi / 6, 0.0), row(0.0, np.pi / 6), row(0.1, 0.0, invalid_azimuth=True)],
    }
    scan = scan_from_continental(message)
    left, up = [10 * np.cos(np.pi / 6), 5, 0, 0], [10 * np.cos(np.pi / 6), 0, 5, 0]
    np.testing.assert_allclose(scan.points, [left, up], atol=1e-5)
    np.testing.assert_array_equal(scan.doppler, [-3, -3])
    np.testing.assert_array_equal(scan.rcs, [7, 7])
    assert scan.stamp == 4.5
    for wrong in ({}, {"header": message["header"]}, message | {"detections": [{"range": 1.0}]}):
        with pytest.raises(OgmError):
            scan_from_continental(wrong)


def test_the_recorded_frame_of_an_ars548(real: Callable[[str], Path]):
    text = real("nebula_apache2/ars548/*_detection.yaml").read_text()
    scan = scan_from_continental(yaml.safe_load(text))
    assert len(scan) == 308
    assert np.linalg.norm(scan.points[:, :3], axis=1).max() == pytest.approx(292.7, abs=0.1)
    velocity = sensor_velocity(scan, doppler_noise=0.25)
    assert velocity is not None
    assert 4 < velocity[0] < 8  # the README: about 6 m/s
    moving = moving_detections(scan, 0.25, 0.0087)
    assert 0.02 < moving.mean() < 0.4
