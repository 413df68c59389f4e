"""Folders of truth grids without scans: states (.npy), labels of the paper (.png), masses (.npz)."""

from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from ogm.datasets.frames import FrameRef
from ogm.datasets.recording import OpenOptions, Recording
from ogm.grid import GridSpec
from ogm.io.grids.files import GRID_ENDINGS, read_grid
from ogm.io.reading import parse_array, read_bytes
from ogm.state import CellState, Truth, predict_state
from ogm.storage.files import OgmError


def grid_files(folder: Path) -> dict[str, Path]:
    """Return the grids of a folder by the names of their frames; none where it is no folder."""
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else []:
        if file.suffix.lower() in GRID_ENDINGS and file.is_file():
            if file.stem in found:
                raise OgmError(f"{folder} holds two grids of {file.stem}: {found[file.stem].name} and {file.name}")
            found[file.stem] = file
    return found


class TruthGridsRecording(Recording):
    """Grids of a folder: frames with a truth and without scans."""

    format = "truth grids"
    description = (
        "Grids of a folder: a cell has the state with most mass, unknown included; where pictures show none, it is "
        "unknown."
    )
    known_mount = True
    known_truth = True

    def __init__(self, path: Path, grids: dict[str, Path], spec: GridSpec) -> None:
        super().__init__(path, [FrameRef(name) for name in grids])
        self.files, self.facts, self._spec = list(grids.values()), {"files": len(grids)}, spec

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "TruthGridsRecording | None":
        """Return the grids of a folder, if `OpenOptions.spec` states their cells.

        States and pictures do not state their cells, and masses must fit those of the spec.
        """
        if len(paths) > 1 or options.spec is None or not (grids := grid_files(paths[0])):
            return None
        return cls(paths[0], grids, options.spec)

    def read(self, n: int) -> NoReturn:
        """Raise OgmError: there are no scans."""
        raise OgmError(
            f"{self.path} holds grids of truth, no scans: compare them by `ogm evaluate --grids FOLDER`, or give a "
            "dataset that has scans"
        )

    mount = read

    def truth(self, n: int) -> Truth:
        """Read the truth of a frame."""
        return _truth(self.files[n], self._spec)


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
