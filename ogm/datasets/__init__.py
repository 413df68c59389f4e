"""Datasets as sequences of frames: public datasets, logs, files of scans and the simulator's output.

>>> from ogm.datasets import open_dataset
>>> dataset = open_dataset("2011_09_26_drive_0005")             # doctest: +SKIP
>>> frame = dataset[3]                                          # doctest: +SKIP
>>> frame.scan, frame.mount, frame.truth, frame.T_map_sensor    # doctest: +SKIP
"""

from ogm.datasets.dataset import Dataset
from ogm.datasets.neighbours import truth_from_neighbours
from ogm.datasets.opening import open_dataset
from ogm.datasets.poses import with_matching, with_odometry, with_poses
from ogm.datasets.sensor_setup import SensorSetup, read_setups, write_setups
from ogm.datasets.truth import SOURCES
from ogm.io.poses import frame_numbers

__all__ = [
    "SOURCES", "Dataset", "SensorSetup", "frame_numbers", "open_dataset", "read_setups", "truth_from_neighbours",
    "with_matching", "with_odometry", "with_poses", "write_setups",
]  # fmt: skip
