"""Targets: CARMEN logs, plain and packed, read as a data set."""

import gzip
import logging
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from targets import Target, check_poses, check_scan

from ogm.datasets import open_dataset
from ogm.io.carmen import read_carmen
from ogm.storage.files import OgmError


def drive() -> bytes:
    """Return a log of three lasers."""
    lines = ["# CARMEN Logfile", "PARAM robot_front_laser_max 50 nohost 0", ""]
    ranges = np.random.default_rng(3).uniform(0.3, 9, (6, 12)).round(2)
    ranges[:, ::4] = 81.83
    for k, row in enumerate(ranges):
        numbers, time = " ".join(map(str, row.tolist())), f"{100 + k}.5 host {k}.25"
        lines.append(f"ODOM {k} 0 0.1 0.4 0 0 {time}")
        lines.append(f"FLASER 12 {numbers} {k} 0 0.1 {k} 0 0.1 {time}")
        lines.append(f"RLASER 12 {numbers} {k} 0 3.2 {k} 0 0.1 {time}")
        config = f"ROBOTLASER1 0 -1.57 3.14 0.28 50 0.01 0 12 {numbers} 12 {numbers}"
        lines.append(f"{config} {k} 0 0.1 {k} 0 0.1 0.4 0 0.2 0.2 0 {time}")
    return "\n".join(lines).encode() + b"\n"


def _frames(path: Path) -> None:
    logging.getLogger("ogm").setLevel(logging.ERROR)
    kinds = list(dict.fromkeys(line.kind for line in read_carmen(path).lines))
    dataset = open_dataset(path, topic=kinds)
    for n in range(min(len(dataset), 6)):
        with suppress(OgmError):
            frame = dataset[n]
            check_scan(frame.scan)
            if frame.T_map_sensor is not None:
                check_poses(frame.T_map_sensor)


def _carmen(name: str, folder: Path) -> Target:
    data = gzip.compress(drive()) if name.endswith(".gz") else drive()
    return Target({name: data}, lambda files: _frames(files / name))


TARGETS = {"carmen": partial(_carmen, "a.log"), "carmen-gz": partial(_carmen, "a.log.gz")}
