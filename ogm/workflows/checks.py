"""Checks for problems that would spoil a map: `check_drive` for a dataset, `check_log` for a log or a folder."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ogm.datasets import Dataset, SensorSetup, open_dataset
from ogm.datasets.frames import EGO
from ogm.datasets.log_scans import scan_topics
from ogm.datasets.logs import is_log
from ogm.io.logs import open_log
from ogm.io.notices import one_notice_per_kind
from ogm.pose import rotate
from ogm.storage.files import OgmError, error_text
from ogm.workflows.drive_checks import check_direction, check_frames, check_tilt_of_poses, check_topics
from ogm.workflows.ego_checks import EgoChecks
from ogm.workflows.findings import Finding, by_severity
from ogm.workflows.scan_checks import ScanChecks

_GROUND_SCANS = 10  # scans to check ground and ego vehicle in
_MIN_POINTS = 40_000  # per scan, after thinning
_QUICK_SCANS = 5  # scans checked before mapping: the same as for the estimate of the sensor's height
_UNREADABLE = (ValueError, TypeError, OSError)

Progress = Callable[[Sequence[int]], Iterable[int]]


class DriveCheck(NamedTuple):
    """Findings about a drive, the worst first, and the estimated setup of its sensor."""

    name: str
    findings: list[Finding]
    setup: SensorSetup


def check_log(
    path: str | Path, *, topic: Sequence[str] = (), progress: Progress = iter, **reading: Any
) -> list[DriveCheck]:
    """Check all scans of a log, a folder of scans or a capture.

    Parameters
    ----------
    path : path
    topic : sequence of str
        Topics of a log; by default all topics with scans.
    progress : function
        Iterates over the numbers of the scans, and may draw a progress bar.
    **reading
        Further options of `ogm.datasets.open_dataset`.

    Returns
    -------
    list of DriveCheck
        One check for each topic of a log, or for each drive of other inputs.

    Raises
    ------
    OgmError
        If the path contains no scans.
    """
    path = Path(path)
    if not (path.exists() and is_log([path])):
        dataset = open_dataset(path, **reading)
        drives = [dataset.select(numbers) for numbers in dataset.sequences.values()] or [dataset]
        return [check_drive(drive, progress=progress) for drive in drives]
    with open_log(path) as log:
        topics = tuple(topic) or tuple(scan_topics(log))
        left_out = list(check_topics(log, topics))
        if not topics:
            open_dataset(path, **reading)  # raises an error that lists the topics
    checks = []
    for name in topics:
        try:
            check = check_drive(open_dataset(path, topic=name, **reading), progress=progress)
        except OgmError as error:
            check = DriveCheck(name, [Finding("wrong map", "frames", str(error))], SensorSetup())
        checks.append(check._replace(name=name, setup=replace(check.setup, topic=name)))
    return [checks[0]._replace(findings=by_severity([*checks[0].findings, *left_out])), *checks[1:]]


def check_drive(dataset: Dataset, scans: int | None = None, progress: Progress = iter) -> DriveCheck:
    """Check a drive for problems that would spoil its map.

    Parameters
    ----------
    dataset : Dataset
        One drive.
    scans : int, optional
        Number of scans to read, evenly spaced; by default all.
    progress : function
        Iterates over the numbers of the scans, and may draw a progress bar.

    Returns
    -------
    DriveCheck
    """
    every = np.arange(len(dataset))
    numbers = every if scans is None else np.unique(np.linspace(0, len(dataset) - 1, scans).round().astype(int))
    examined = {int(numbers[k]) for k in np.linspace(0, len(numbers) - 1, _GROUND_SCANS).round().astype(int)}
    recording, rows = dataset.recording, dataset.numbers
    stamps = np.unique([ref.stamp for ref in dataset.refs if ref.stamp is not None])
    found = ScanChecks(float(np.median(np.diff(stamps))) if len(stamps) > 1 else math.nan)
    ego, readable = EgoChecks(), list[int]()
    read = recording.raw if recording.ego_footprint is None else recording.read  # keeps returns of the vehicle
    for n in progress(numbers.tolist()):
        try:
            with one_notice_per_kind(recording.notices):
                scan = read(rows[n]).scan
        except _UNREADABLE as error:
            found.failed[error_text(error)] += 1
            continue
        if scan.rcs is not None:
            continue  # a radar
        found.add(scan)
        if n in examined and len(scan):
            readable.append(n)
            if scan.kind in ("planar", "cone"):
                continue  # shows neither ground nor ego vehicle
            thin = scan.points[:: max(1, len(scan) // _MIN_POINTS)]
            points = rotate(recording.levelling(rows[n]), thin[:, :3].T).T
            plane, T = found.add_ground(points, recording.square(rows[n])), recording.frames[rows[n]].T_map_sensor
            if plane is not None and recording.sensor_position is None:
                level = rotate(plane.levelling, points.T).T
                ego.add(level, plane.distance, None if T is None else T[:2, 3])
    findings = [
        *check_frames(dataset),
        *found.findings(recording.notices),
        *_sensor_findings(dataset, readable, found, ego),
    ]
    name = dataset.refs[0].sequence or dataset.name
    return DriveCheck(name, by_severity(findings), _estimated(findings, found, ego))


def gravest(dataset: Dataset, model: str = "") -> list[str]:
    """Return the problems that make the map of a drive wrong, found in up to five of its scans, as texts.

    Parameters
    ----------
    dataset : Dataset
        One drive. Public datasets with known axes are not checked.
    model : str
        Name of the sensor model; planar scans suit ``height-band``.
    """
    if dataset.recording.known_axes or not len(dataset):
        return []
    wrong = [finding for finding in check_drive(dataset, _QUICK_SCANS).findings if finding.severity == "wrong map"]
    return [str(finding) for finding in wrong if not (model.startswith("height-band") and finding.kind == "ground")]


def _sensor_findings(dataset: Dataset, numbers: list[int], found: ScanChecks, ego: EgoChecks) -> Iterator[Finding]:
    """Yield findings about mount, height and ego vehicle in the readable scans `numbers`."""
    if not numbers:
        return
    recording, first = dataset.recording, numbers[0]
    try:
        mount = dataset[first].mount
    except _UNREADABLE as error:
        reasons = list(found.ground_findings(None, "", recording.axes))
        yield from reasons
        if not any(finding.severity == "wrong map" for finding in reasons):
            yield Finding("wrong map", "height", error_text(error))
        yield from ego.findings(recording.setup(dataset.numbers[first]).ego_footprint or EGO, recording.ego_footprint)
        return
    given = recording.sensor_height is not None or recording.setup(dataset.numbers[first]).sensor_height is not None
    stated = "--sensor-height is" if given else "the recording states" if recording.known_height else ""
    height = mount.sensor_height - (recording.sensor_position or (0.0, 0.0, 0.0))[2]
    yield from found.ground_findings(height, stated, recording.axes)
    yield from check_tilt_of_poses(dataset, numbers)
    yield from check_direction(dataset)
    x, y = mount.origin[:2] if mount.points_in == "sensor" else (0.0, 0.0)
    x0, x1, y0, y1 = mount.ego_footprint
    yield from ego.findings((x0 - x, x1 - x, y0 - y, y1 - y), recording.ego_footprint)


def _estimated(findings: Sequence[Finding], found: ScanChecks, ego: EgoChecks) -> SensorSetup:
    """Return the setup of a sensor estimated from its scans; without a footprint if the used footprint is right."""
    kinds = {finding.kind for finding in findings if finding.severity == "wrong map"}
    planes = [plane for plane in found.planes if plane is not None]
    roll, pitch = found.tilt()
    tilted = math.acos(math.cos(roll) * math.cos(pitch)) > math.radians(3)
    height = float(np.median([plane.distance for plane in planes])) if planes else None
    farthest = found.saturated()
    return SensorSetup(
        sensor_height=height,
        mount=(0.0, 0.0, 0.0, roll, pitch, 0.0) if tilted else None,
        ego_footprint=ego.footprint() if kinds & {"ego returns", "ego footprint"} else None,
        max_range=math.inf if farthest is None else farthest,
        max_range_no_echo=farthest is not None,
    )
