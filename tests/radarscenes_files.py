"""A sequence of RadarScenes as its documentation and its authors' tools describe it; nothing of it is recorded."""

import json
from pathlib import Path
from typing import Any

import numpy as np

MOUNTS = {1: (3.663, -0.873, -1.484), 2: (3.86, -0.70, -0.436), 3: (3.86, 0.70, 0.436), 4: (3.663, 0.873, 1.484)}
START, SPEED = 1_508_759_214_000_000, 5.0  # [us, m/s]
_NUMBERS = ("range_sc", "azimuth_sc", "rcs", "vr", "vr_compensated", "x_cc", "y_cc", "x_seq", "y_seq")
DETECTION = np.dtype([
    ("timestamp", "<i8"), ("sensor_id", "u1"), *((name, "<f4") for name in _NUMBERS),
    ("uuid", "S32"), ("track_id", "S32"), ("label_id", "u1"),
])  # fmt: skip
ODOMETRY = np.dtype(
    [("timestamp", "<i8"), *((name, "<f4") for name in ("x_seq", "y_seq", "yaw_seq", "vx", "yaw_rate"))]
)


def odometry(count: int = 60) -> np.ndarray:
    """Return poses of a vehicle that turns left, every 10 ms from 20 ms before the first sweep on."""
    rows = np.zeros(count, ODOMETRY)
    t = (np.arange(count) - 2) * 0.01
    rows["timestamp"], rows["vx"], rows["yaw_rate"] = START + np.round(t * 1e6), SPEED, 0.2
    rows["yaw_seq"] = np.angle(np.exp(1j * (3.1 + 0.2 * t)))  # passes from pi to -pi
    rows["x_seq"], rows["y_seq"] = -142.77 + SPEED * np.cos(3.1) * t, -213.88 + SPEED * np.sin(3.1) * t
    return rows


def detections(sweeps: int = 8, each: int = 6) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the detections of standing things, and the scenes that refer to them."""
    rng = np.random.default_rng(4)
    rows, scenes = np.zeros(sweeps * each, DETECTION), {}
    path = odometry()
    for n in range(sweeps):
        stamp, sensor = START + 17_000 * n, 1 + n % 4
        part = rows[n * each : (n + 1) * each]
        x, y, yaw = MOUNTS[sensor]
        part["timestamp"], part["sensor_id"], part["label_id"] = stamp, sensor, 11
        part["range_sc"], part["azimuth_sc"] = rng.uniform(5, 90, each), rng.uniform(-1, 1, each)
        part["rcs"], angle = rng.uniform(-10, 20, each), part["azimuth_sc"] + yaw
        part["x_cc"], part["y_cc"] = x + part["range_sc"] * np.cos(angle), y + part["range_sc"] * np.sin(angle)
        part["vr"] = -((SPEED - 0.2 * y) * np.cos(angle) + 0.2 * x * np.sin(angle))
        at = [np.interp(stamp, path["timestamp"], path[name]) for name in ("x_seq", "y_seq")]
        turn = 3.1 + 0.2 * (stamp - START) * 1e-6
        part["x_seq"] = at[0] + part["x_cc"] * np.cos(turn) - part["y_cc"] * np.sin(turn)
        part["y_seq"] = at[1] + part["x_cc"] * np.sin(turn) + part["y_cc"] * np.cos(turn)
        near = int(np.abs(path["timestamp"] - stamp).argmin())
        scenes[str(stamp)] = {"sensor_id": sensor, "prev_timestamp": None, "next_timestamp": None,
                              "prev_timestamp_same_sensor": None, "next_timestamp_same_sensor": None,
                              "odometry_timestamp": int(path["timestamp"][near]), "odometry_index": near,
                              "image_name": "a.jpg", "radar_indices": [n * each, (n + 1) * each]}  # fmt: skip
    return rows, scenes


def write_sequence(
    folder: Path, sweeps: int = 8, each: int = 6, path: np.ndarray | None = None, **storage: Any
) -> Path:
    """Write ``sequence_1`` and ``sensors.json`` into a folder; return the sequence."""
    import h5py

    made = folder / "sequence_1"
    made.mkdir(parents=True)
    rows, scenes = detections(sweeps, each)
    with h5py.File(made / "radar_data.h5", "w") as file:
        file.create_dataset("radar_data", data=rows, **storage)
        file.create_dataset("odometry", data=odometry() if path is None else path, **storage)
    content = {"sequence_name": "sequence_1", "category": "train", "first_timestamp": START, "scenes": scenes}
    (made / "scenes.json").write_text(json.dumps(content))
    sensors = {f"radar_{k}": {"id": k, "x": x, "y": y, "yaw": yaw} for k, (x, y, yaw) in MOUNTS.items()}
    (folder / "sensors.json").write_text(json.dumps(sensors))
    return made
