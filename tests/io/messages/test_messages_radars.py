"""``radar_msgs/RadarScan``."""

from types import SimpleNamespace

import numpy as np

from ogm.io.messages import scan_from_radar_scan


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
