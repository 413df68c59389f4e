"""Options and output files for `fuse_drive`."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path

from ogm.evidence.map_rules import DYNAMIC, NUSS, REVISE, RULES
from ogm.extras import import_extra
from ogm.fusion import make_mapper
from ogm.grid import GridSpec
from ogm.io.grids.files import MAP_ENDINGS, check_grid_output
from ogm.io.grids.placed import PlacedGrid
from ogm.models.named import default_model, for_all_kinds, load_model, with_radar
from ogm.scan import InverseSensorModel
from ogm.storage.files import check_writable

OUTPUT_ENDINGS = {
    "map": MAP_ENDINGS,
    "picture": (".png",),
    "movie": (".gif", ".webp", ".png"),
    "poses": (".csv", ".txt", ".tum"),
    "page": (".html",),
}


@dataclass(frozen=True)
class Outputs:
    """Output files of `fuse_drive`; None for an output that is not wanted.

    Parameters
    ----------
    map : path, optional
        The map: .npz, .yaml, .tif, .nc, .zarr, .png; or a log with the map after each scan: .mcap, .db3, .bag.
    picture : path, optional
        Last scan, its grid, the map and the conflict (.png).
    movie : path, optional
        Film with these pictures, scan by scan (.gif, .webp, .png).
    poses : path, optional
        Poses of the mapped scans (.csv, .txt, .tum).
    page : path, optional
        The map as a page for a browser (.html).
    """

    map: Path | None = None
    picture: Path | None = None
    movie: Path | None = None
    poses: Path | None = None
    page: Path | None = None

    def __post_init__(self) -> None:
        for name, path in self.given().items():
            object.__setattr__(self, name, Path(path))

    def given(self) -> dict[str, Path]:
        """Return the wanted files by name."""
        return {name: path for name, path in asdict(self).items() if path is not None}

    def prepare(self, inputs: Iterable[Path] = ()) -> None:
        """Create the folders of the outputs, and check that all files can be written, before hours of work.

        Parameters
        ----------
        inputs : iterable of Path
            Input files, which must not be replaced.

        Raises
        ------
        ValueError
            If a file name has a wrong ending, two outputs have one name, or an input would be replaced.
        OSError
            If a folder cannot be written.
        """
        used: dict[Path, str] = {}
        for name, path in self.given().items():
            if path.suffix.lower() not in OUTPUT_ENDINGS[name]:
                raise ValueError(f"the {name} must end in {' or '.join(OUTPUT_ENDINGS[name])}, got {path}")
            if name == "map":
                check_grid_output(path)
            if path.is_dir() and path.suffix.lower() != ".zarr":
                raise ValueError(f"{path} is a folder; give a file name for the {name}")
            if path.resolve() in (file.resolve() for file in inputs):
                raise ValueError(f"the {name} would replace the input {path}; give another name")
            if used.setdefault(path.resolve(), name) != name:
                raise ValueError(f"{used[path.resolve()]} and {name} would both be written to {path}; give two names")
            check_writable(path, f"the {name}")

    def within(self, folder: Path) -> "Outputs":
        """Return the outputs with the same file names in another folder."""
        return Outputs(**{name: folder / path.name for name, path in self.given().items()})

    @property
    def base(self) -> Path:
        """Main output; maps before a restart are saved in its folder."""
        return self.map or self.picture or self.movie or self.page or Path("map.npz")


@dataclass(frozen=True)
class FuseOptions:
    """Options to fuse a drive, with the defaults of ``ogm fuse`` for lidars.

    Parameters
    ----------
    ism : str, optional
        Sensor model, a name for `ogm.models.load_model`; by default from `ogm.models.default_model`,
        and ``planar`` for planar lasers and sonars.
    spec : GridSpec
        Cells of measurement grids, picture and film.
    rule : str
        See `ogm.fusion.make_mapper`.
    half_life : float, optional
        Time in which belief halves [s]; by default the half-life of the rule.
    window : {"rolling", "fixed"}
        Follow the vehicle, or cover the whole drive.
    particles : int
        Number of particles of a dynamic map.
    deskew : bool
        Undo the ego motion during a scan.
    radar_reliability : float
        Reliability of radars used with a lidar, [0, 1].
    sensors : tuple of str
        Sensors given to `ogm.datasets.open_dataset`.
    message : str, optional
        Message type of maps in logs.
    match : bool
        Refine the poses, used as odometry, by matching planar scans.
    odometry : str, optional
        Estimate the poses from the scans: "kiss-icp" or "small-gicp".
    rate : float
        Rate of scans without stamps [Hz].
    first : int, optional
        Number of scans to fuse; by default all.
    weights : dict, optional
        Facts about the model's weights: results of other weights are not reused.
    saved : PlacedGrid, optional
        Map to continue, in the frame of the poses: see `ogm.fusion.EvidentialMapper.from_grid`.
    """

    ism: str | None = None
    spec: GridSpec = field(default_factory=GridSpec.centered)
    rule: str = REVISE
    half_life: float | None = None
    window: str = "rolling"
    particles: int = 200_000
    deskew: bool = False
    radar_reliability: float = 0.25
    sensors: tuple[str, ...] = ()
    message: str | None = None
    match: bool = False
    odometry: str | None = None
    rate: float = 10.0
    first: int | None = None
    weights: Mapping[str, str] | None = None
    saved: PlacedGrid | None = None

    def __post_init__(self) -> None:
        if self.ism is None:
            object.__setattr__(self, "ism", for_all_kinds(default_model(self.spec, self.rule)[0]))

    def load_model(self) -> InverseSensorModel:
        """Return the sensor model for all sensors of the vehicle; the last loaded model is cached."""
        return _load_model(str(self.ism), self.spec)

    def check(self) -> None:
        """Raise an error for unknown names, missing packages and bad numbers, before any work."""
        self.load_model()
        make_mapper(self.rule, self.spec, self.half_life, self.window, self.particles)  # type: ignore[arg-type]
        if self.saved is not None and self.rule not in RULES:
            raise ValueError(f"a saved map is continued by the rules {', '.join(RULES)}, got {self.rule}")
        if self.rule in (DYNAMIC, NUSS):
            import_extra("filterpy", "track")


@lru_cache(1)
def _load_model(name: str, spec: GridSpec) -> InverseSensorModel:
    return load_model(with_radar(name), spec)
