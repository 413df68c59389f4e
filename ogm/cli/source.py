"""What ``ogm evaluate`` judges on: frames with their truth, simulated, recorded, or as folders of grids."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.io.grids import GRID_ENDINGS, read_grid
from ogm.state import CellState, Truth, predict_state

__all__ = ["Frame", "Item", "Source", "grids_in", "shown_name", "source_of"]

HOW = {
    "aimed": "rays from the sensor's place, aimed at every cell,",
    "hd": "the rays of a lidar with thousands of layers at the sensor's place",
}


class Frame(NamedTuple):
    """What a frame is called.

    Attributes
    ----------
    name : str
        No other frame has the same.
    sequence : str
        Frames of one sequence follow each other in time; "" where a frame stands alone.
    stamp : float or None
        [s].
    """

    name: str
    sequence: str = ""
    stamp: float | None = None


@dataclass(frozen=True, eq=False)
class Item:
    """A frame, read.

    Parameters
    ----------
    truth : Truth
    points : (N, 4) float32 or None
        In the sensor's frame; None where there are grids only.
    T_vehicle_sensor, T_map_sensor : (4, 4) or None
        How the sensor is mounted above the ground below it; where it is on the map.
    """

    truth: Truth
    points: NDArray[np.float32] | None = None
    T_vehicle_sensor: NDArray[np.float64] | None = None
    T_map_sensor: NDArray[np.float64] | None = None


@dataclass(frozen=True, eq=False)
class Source:
    """Frames to judge on.

    Parameters
    ----------
    kind : str
        "simulated store", "real recording" or "folders of grids".
    name : str
    says : str
        One sentence: what the truth is made of.
    facts : dict
        What else there is to tell, as JSON can hold it.
    frames : tuple of Frame
    read : function of int
        Reads a frame.
    files : tuple of Path
        Files and folders that it reads from.
    """

    kind: str
    name: str
    description: str
    facts: dict[str, Any]
    frames: tuple[Frame, ...]
    read: Callable[[int], Item]
    files: tuple[Path, ...] = ()


def shown_name(folder: Path) -> str:
    """Return what a folder is called, also where it is given as ``.`` or ``..``."""
    return folder.name if folder.name not in ("", "..") else folder.resolve().name or str(folder)


def source_of(
    path: Path,
    spec: GridSpec,
    split: str | None = None,
    truth: tuple[str, ...] = (),
    judged: Literal["scans", "maps"] = "scans",
) -> Source:
    """Find the frames of a data set, a recording, or a folder of truth grids.

    Parameters
    ----------
    path : Path
    spec : GridSpec
        The cells that are judged: the area of pictures, which do not say it.
    split : str, optional
        Part of a simulated data set.
    truth : tuple of str
        Of a recording: what the truth is made from, see `ogm.recordings.open_recording`.
    judged : {"scans", "maps"}
        Whether single scans are judged, or also what was fused over time. A map may know from other frames what this
        one cannot see, so for maps what is unknown in a simulated frame's truth is ignored; and the aggregated truth
        of a recording is made from later scans only, which no map has seen.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    ValueError
        If it is none of the three, has no such part, or nothing in it is labelled.
    """
    if not path.exists():
        raise FileNotFoundError(
            f"there is no {path}; give a data set, a recording or a folder of truth grids"
        )
    if (path / "zarr.json").exists():
        if truth:
            raise ValueError("--truth is for recordings; a simulated data set knows its truth")
        return _store(path, split, judged)
    if split is not None:
        raise ValueError(f"--split is for data sets that `ogm simulate` made, which {path} is not")
    if path.is_dir() and not _is_recording(path) and grids_in(path):
        if truth:
            raise ValueError("--truth is for recordings; a folder of grids is the truth itself")
        return _grids(path, spec)
    return _recording(path, truth, "later" if judged == "maps" else "all")


def grids_in(folder: Path) -> dict[str, Path]:
    """Return the grids of a folder by the names of their frames."""
    files = sorted(
        file for file in folder.iterdir() if file.suffix.lower() in GRID_ENDINGS and file.is_file()
    )
    found: dict[str, Path] = {}
    for file in files:
        if file.stem in found:
            raise ValueError(
                f"{folder} holds two grids of {file.stem}: {found[file.stem].name} and {file.name}"
            )
        found[file.stem] = file
    return found


def _store(path: Path, split: str | None, judged: str) -> Source:
    from ogm.simulation.plan import SEQUENCE
    from ogm.simulation.store import FACTS, Store

    store = Store.open(path)
    name = split or ("validation" if store.counts.get("validation") else "sequences")
    if name not in store.counts:
        raise ValueError(f"{store.path} has no split {name!r}; it has {', '.join(store.counts)}")
    part = store[name]
    numbers = part.finished
    if not len(numbers):
        way = f"; go on with `ogm simulate {store.path} --resume`" if len(part) else ""
        raise ValueError(f"{store.path} has no sample of {name}{way}")
    stamps = part.facts[numbers, FACTS.index("stamp")]
    drive = name == "sequences"
    frames = tuple(
        Frame(
            f"sequence {n // SEQUENCE} frame {n % SEQUENCE}" if drive else f"{name} {n}",
            f"sequence {n // SEQUENCE}" if drive else "",
            float(stamp) if drive else None,
        )
        for n, stamp in zip(numbers.tolist(), stamps.tolist(), strict=True)
    )

    def read(k: int) -> Item:
        one = part[int(numbers[k])]
        truth = _known_only(one.truth) if judged == "maps" else one.truth
        return Item(truth, one.points, one.T_vehicle_sensor, one.T_world_sensor)

    facts = {"split": name, "plan": store.plan, "versions": store.versions, "samples": numbers.tolist()}
    how = HOW.get(str(store.plan.get("truth")), "rays from the sensor's place")
    description = f"Simulated: what {how} hit; participants with 50 returns or more as a whole; what nothing hit is unknown."
    if judged == "maps":
        description += " Maps may know that from other frames: it is left out."
    title = f"{shown_name(path)}, {name}"
    return Source(
        "simulated store", title, description, facts, frames, read, (path / "zarr.json", path / name)
    )


def _known_only(truth: Truth) -> Truth:
    return Truth(
        truth.spec, np.where(truth.state == CellState.UNKNOWN, np.uint8(CellState.IGNORE), truth.state)
    )


def _is_recording(path: Path) -> bool:
    """Tell whether a folder is a recording, and no folder of grids that might be one."""
    from ogm.recordings import is_recording

    try:
        return is_recording(path)
    except ValueError:  # arrays that say nothing of themselves, or a damaged recording
        return not grids_in(path)


def _recording(path: Path, truth: tuple[str, ...], later: str) -> Source:
    from ogm.recordings import open_recording

    recording = open_recording(path, truth=truth, others=later)

    def read(k: int) -> Item:
        one = recording[k]
        return Item(one.truth, one.points, one.T_vehicle_sensor, one.T_map_sensor)

    times = Counter(one.name for one in recording)  # some sets count each sequence's frames from 0
    frames = tuple(
        Frame(
            one.name if times[one.name] == 1 else f"{one.sequence} {one.name}",
            one.sequence,
            one.stamp if math.isfinite(one.stamp) else None,
        )
        for one in recording
    )
    facts = {"format": recording.format, "frames": len(frames)}
    name = recording.name or shown_name(path)
    return Source("real recording", name, recording.truth_description, facts, frames, read, (path,))


def _grids(path: Path, spec: GridSpec) -> Source:
    files = grids_in(path)
    names = tuple(files)
    description = "Grids of a folder: a cell is what has most mass, unknown included; what the pictures do not show, unknown."
    facts = {"files": len(names)}
    frames = tuple(Frame(name) for name in names)

    def read(k: int) -> Item:
        return Item(_truth(files[names[k]], spec))

    return Source(
        "folders of grids", shown_name(path), description, facts, frames, read, tuple(files.values())
    )


def _truth(path: Path, spec: GridSpec) -> Truth:
    """Read a truth grid: states (.npy uint8), a label of the paper (.png), or a grid of masses (.npz)."""
    if path.suffix.lower() == ".png":
        from ogm.simulation.exchange import read_label

        return read_label(path, spec)
    if path.suffix.lower() == ".npy":
        try:
            state = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, EOFError, OverflowError) as error:
            raise ValueError(f"{path} is damaged or no .npy file of numbers: {error}") from error
        if (
            state.dtype != np.uint8
            or state.shape != spec.shape
            or (state.size and state.max() > CellState.IGNORE)
        ):
            raise ValueError(
                f"{path} must hold states 0 unknown, 1 free, 2 occupied, 3 ignore, uint8 {spec.shape}, got "
                f"{state.dtype} {state.shape}"
            )
        return Truth(spec, np.array(state))
    grid = read_grid(path, spec)
    if not _fit(grid.spec, spec):
        raise ValueError(
            f"{path} has cells of {grid.spec.resolution:g} m from x {grid.spec.origin[0]:g}, y "
            f"{grid.spec.origin[1]:g} m on, but judged are cells of {spec.resolution:g} m from x {spec.origin[0]:g}, "
            f"y {spec.origin[1]:g} m on; a truth is not resampled: save it on those, or on whole multiples of them"
        )
    return Truth(grid.spec, predict_state(grid.mass))


def _fit(cells: GridSpec, spec: GridSpec) -> bool:
    """Tell whether each cell of `spec` lies in one cell of others, or outside of them all."""
    ratio = cells.resolution / spec.resolution
    steps = (np.array(cells.origin) - spec.origin) / spec.resolution
    return round(ratio) >= 1 and bool(
        np.allclose([ratio, *steps], np.rint([ratio, *steps]), rtol=0, atol=1e-3)
    )
