"""Mapping single scans to grid files and pictures. ``ogm map`` calls `map_to_files`."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import NamedTuple

from ogm.datasets import Dataset
from ogm.geometric.inputs import explain_nothing, shows_nothing
from ogm.grid import EvidentialGrid
from ogm.io.grids.files import MAP_ENDINGS, check_grid_output, write_grid
from ogm.io.grids.placed import PlacedGrid
from ogm.models.layers import check_layers, map_layers
from ogm.models.named import title_of
from ogm.plot import layer_panel, points_panel, save_picture
from ogm.scan import Frame, InverseSensorModel, run_model
from ogm.storage.files import check_writable, error_text


class ScanMap(NamedTuple):
    """Grid of a scan and computing time of the model [s], or None, 0 and the text of the error."""

    frame: Frame
    grid: EvidentialGrid | None
    seconds: float
    error: str = ""


def map_to_files(
    dataset: Dataset,
    model: InverseSensorModel,
    grids: Path | None = None,
    pictures: Path | None = None,
    *,
    title: str = "",
    layers: Sequence[str] = (),
    first_call: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> Iterator[ScanMap]:
    """Map each scan, and write its grid and its picture.

    Parameters
    ----------
    dataset : Dataset
    model : InverseSensorModel
    grids : Path, optional
        Grid file of a single scan, in any format of `ogm.io.write_grid`, or a folder for ``.npz`` files with the names
        of the frames. Folders are created.
    pictures : Path, optional
        ``.png`` file, or folder.
    title : str
        Name of the model, for the titles of grids in pictures.
    layers : sequence of str
        Names in `ogm.models.layers.LAYERS`: drawn, and written as NAME_layers with the ending of the grid.
    first_call : function
        Returns a context manager for the first call of the model, which may compile kernels and is not timed.

    Returns
    -------
    iterator of ScanMap
        Results in order, each after its files are written. If there are several scans, a failed scan yields its error.

    Raises
    ------
    ValueError
        Before any mapping, if two scans share a name, several scans would share a file, or an ending is unknown. For a
        single scan also if it has no evidence on the grid.
    OSError
        Before any mapping, if an output cannot be written.
    """
    check_layers(layers)
    names = [frame.name.replace("/", "_") for frame in dataset]
    if len(set(names)) < len(names):
        raise ValueError("two scans share a name, so that their outputs would, too; map them separately")
    to_grids = _outputs(grids, names, MAP_ENDINGS, "`grids`")
    to_pictures = _outputs(pictures, names, (".png",), "`pictures`")
    if to_grids[0] is not None:
        check_grid_output(to_grids[0])
        if to_grids[0] == to_pictures[0]:
            raise ValueError(f"`grids` and `pictures` would both write {to_grids[0]}; give two names")

    def mapped() -> Iterator[ScanMap]:
        warm = False
        for frame, grid_file, picture in zip(dataset, to_grids, to_pictures, strict=True):
            try:
                if not warm:
                    with first_call():
                        run_model(model, frame)
                    warm = True
                start = time.perf_counter()
                if layers:
                    grid, more = map_layers(model, frame.scan, layers)
                else:
                    grid, more = run_model(model, frame), None
                seconds = time.perf_counter() - start
                if shows_nothing(frame.scan, grid):
                    raise ValueError(explain_nothing(frame.scan, grid.spec, frame.mount))
                if grid_file is not None:
                    write_grid(grid_file, PlacedGrid(grid, frame_id="vehicle", stamp=frame.stamp))
                    if more is not None:
                        write_grid(layers_path(grid_file), more)
                if picture is not None:
                    cloud = points_panel(frame.scan.points, grid.spec, frame.name)
                    panels = [layer_panel(more, name) for name in layers] if more is not None else []
                    titles = ["", title_of(title, frame.scan, frame.mount), *layers]
                    save_picture(picture, cloud, grid, *panels, titles=titles)
                yield ScanMap(frame, grid, seconds)
            except (ValueError, TypeError, OSError) as error:
                if len(names) == 1:
                    raise
                yield ScanMap(frame, None, 0.0, error_text(error))

    return mapped()


def layers_path(path: Path) -> Path:
    """Return the file for the layers of a grid file."""
    return path.with_stem(f"{path.stem}_layers")


def _outputs(path: Path | None, names: Sequence[str], endings: tuple[str, ...], option: str) -> list[Path | None]:
    """Return the path of each output: the file of a single scan, or files in a folder with the first ending."""
    if path is None:
        return [None] * len(names)
    ending = path.suffix.lower()
    if ending in endings and (ending == ".zarr" or not path.is_dir()):
        if len(names) > 1:
            raise ValueError(f"{option} {path} is one file for {len(names)} scans; give a folder")
        check_writable(path, option)
        return [path]
    if path.suffix and not path.is_dir():
        raise ValueError(f"{option} must be a folder or end in {', '.join(endings)}, got {path}")
    path.mkdir(parents=True, exist_ok=True)
    check_writable(path / f"{names[0]}{endings[0]}", option)
    return [path / f"{name}{endings[0]}" for name in names]
