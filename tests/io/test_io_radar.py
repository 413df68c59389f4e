"""nuScenes' radar files, made here by its documentation."""

from pathlib import Path

import numpy as np
import pytest

from ogm.io import read_nuscenes_radar
from ogm.storage.files import OgmError

FIELDS = "x y z dyn_prop id rcs vx vy vx_comp vy_comp is_quality_valid ambig_state "
FIELDS += "x_rms y_rms invalid_state pdh0 vx_rms vy_rms"
SIZES = "4 4 4 1 2 4 4 4 4 4 1 1 1 1 1 1 1 1"
TYPES = "F F F I I F F F F F I I I I I I I I"
ROW = np.dtype(
    [
        (name, f"<{kind.lower()}{size}")
        for name, kind, size in zip(FIELDS.split(), TYPES.split(), SIZES.split(), strict=True)
    ]
)


def write(path: Path, rows: np.ndarray) -> Path:
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {FIELDS}\nSIZE {SIZES}\nTYPE {TYPES}\n"
        f"COUNT {' '.join('1' * 18)}\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(rows)}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + rows.tobytes())
    return path


def sweep() -> np.ndarray:
    rows = np.zeros(5, ROW)
    rows["x"], rows["y"], rows["rcs"] = [10, 30, 20, 20, 20], [0, 40, 1, 2, 3], [5, -2.5, 1, 1, 1]
    rows["vx"], rows["vy"], rows["ambig_state"] = [-4, 3, 0, 0, 0], [0, 4, 0, 0, 0], 3
    rows["invalid_state"][2], rows["ambig_state"][3], rows["dyn_prop"][4] = 4, 1, 7
    return rows


def test_detections_with_doppler_and_cross_section(tmp_path: Path) -> None:
    scan = read_nuscenes_radar(write(tmp_path / "radar.pcd", sweep()))
    np.testing.assert_allclose(scan.points, [[10, 0, 0, 0], [30, 40, 0, 0]])
    np.testing.assert_allclose(scan.doppler, [-4, 5], atol=1e-6)
    np.testing.assert_allclose(scan.rcs, [5, -2.5])
    assert len(read_nuscenes_radar(tmp_path / "radar.pcd", unfiltered=True)) == 5


def test_a_sweep_without_detections(tmp_path: Path) -> None:
    assert len(read_nuscenes_radar(write(tmp_path / "radar.pcd", sweep()[:0]))) == 0


def test_a_cloud_that_is_no_radar_is_refused(tmp_path: Path) -> None:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    (tmp_path / "lidar.pcd").write_text(f"{head}POINTS 1\nDATA ascii\n1 2 3\n")
    with pytest.raises(OgmError, match=r"has no rcs, vx, vy, .*no radar file of nuScenes"):
        read_nuscenes_radar(tmp_path / "lidar.pcd")
    cut = write(tmp_path / "cut.pcd", sweep())
    cut.write_bytes(cut.read_bytes()[:-20])
    with pytest.raises(OgmError):
        read_nuscenes_radar(cut)
