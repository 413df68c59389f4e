"""Folders of truth grids without scans: states (.npy), labels of the paper (.png), masses (.npz)."""

from pathlib import Path
from typing import NoReturn

import numpy as np

from ogm.datasets.layout import FrameRef, Layout
from ogm.grid import GridSpec
from ogm.io.grids import GRID_ENDINGS, read_grid
from ogm.io.reading import parse_array, read_bytes
from ogm.state import CellState, Truth, predict_state
from ogm.storage.files import OgmError

__all__ = ["grid_files", "truth_grids"]


def grid_files(folder: Path) -> dict[str, Path]:
    """Return the grids of a folder by the names of their frames; none where it is no folder."""
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else []:
        if file.suffix.lower() in GRID_ENDINGS and file.is_file():
            if file.stem in found:
                raise OgmError(f"{folder} holds two grids of {file.stem}: {found[file.stem].name} and {file.name}")
            found[file.stem] = file
    return found


def truth_grids(folder: Path, spec: GridSpec) -> Layout:
    """Line up the grids of a folder.

    Parameters
    ----------
    folder : Path
    spec : GridSpec
        The cells of states and pictures, which do not state it, and those that masses must fit.
    """
    files = grid_files(folder)
    paths = tuple(files.values())

    def refuse(k: int) -> NoReturn:
        raise OgmError(
            f"{folder} holds grids of truth, no scans: compare them with grids (--grids FOLDER), or give a data set "
            "that has scans"
        )

    return Layout(
        "truth grids",
        tuple(FrameRef(name) for name in files),
        refuse,
        mount=refuse,
        truth=lambda k: _truth(paths[k], spec),
        description="Grids of a folder: a cell has the state with most mass, unknown included; where pictures show "
        "none, it is unknown.",
        facts={"files": len(files)},
        files=paths,
    )


def _truth(path: Path, spec: GridSpec) -> Truth:
    if path.suffix.lower() == ".png":
        from ogm.simulation.exchange import read_label

        return read_label(path, spec)
    if path.suffix.lower() == ".npy":
        wanted = f"states 0 unknown, 1 free, 2 occupied, 3 ignore, uint8 {spec.shape}"
        state = parse_array(read_bytes(path)[0], path, lambda shape: shape == spec.shape, wanted)
        if state.dtype != np.uint8 or state.max(initial=0) > CellState.IGNORE:
            raise OgmError(f"{path} must hold {wanted}, got {state.dtype} up to {state.max(initial=0)}")
        return Truth(spec, np.array(state))
    grid = read_grid(path, spec)
    ratio = grid.spec.resolution / spec.resolution
    places = np.array([ratio, *(np.array(grid.spec.origin) - spec.origin) / spec.resolution])
    if round(ratio) < 1 or not np.allclose(places, np.rint(places), rtol=0, atol=1e-3):
        has, wanted = (
            f"cells of {s.resolution:g} m from x {s.origin[0]:g}, y {s.origin[1]:g} m" for s in (grid.spec, spec)
        )
        raise OgmError(
            f"{path} has {has} on, but wanted are {wanted} on; a truth is not resampled: save it on those, or on whole "
            "multiples of them"
        )
    return Truth(grid.spec, predict_state(grid.mass))
