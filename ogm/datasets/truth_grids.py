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
    """Return the grid files of a folder by frame name; empty if it is no folder."""
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else []:
        if file.suffix.lower() in GRID_ENDINGS and file.is_file():
            if file.stem in found:
                names = f"{found[file.stem].name} and {file.name}"
                raise OgmError(f"{folder} holds two grids of {file.stem}, {names}: remove one")
            found[file.stem] = file
    return found


class TruthGridsRecording(Recording):
    """Folder of grids: frames with truth and without scans."""

    format = "truth grids"
    description = "Grids of a folder: each cell has the state with the largest mass; unlabelled pixels are unknown."
    known_mount = True
    known_truth = True

    def __init__(self, path: Path, grids: dict[str, Path], spec: GridSpec) -> None:
        super().__init__(path, [FrameRef(name) for name in grids])
        self.files, self.facts, self._spec = list(grids.values()), {"files": len(grids)}, spec

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "TruthGridsRecording | None":
        """Return the grids of a folder, or None without `OpenOptions.spec`.

        States and pictures do not state their cells; the cells of masses must fit the spec.
        """
        if len(paths) > 1 or options.spec is None or not (grids := grid_files(paths[0])):
            return None
        return cls(paths[0], grids, options.spec)

    def read(self, n: int) -> NoReturn:
        """Raise OgmError, as there are no scans."""
        raise OgmError(
            f"{self.path} holds grids of truth and no scans: compare them with `ogm evaluate --grids FOLDER`, or give "
            "a dataset with scans"
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
        specs = grid.spec, spec
        cells = [f"cells of {s.resolution:g} m from x {s.origin[0]:g} m, y {s.origin[1]:g} m" for s in specs]
        way = "a truth is not resampled: save it on the wanted cells, or on whole multiples of them"
        raise OgmError(f"{path} has {cells[0]}, wanted {cells[1]}; {way}")
    return Truth(grid.spec, predict_state(grid.mass))
