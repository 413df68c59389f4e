"""Trained lidar network as an inverse sensor model, with the interface of the geometric models."""

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.engines import load_engine
from ogm.deep.points import to_ground_frame
from ogm.deep.runtimes import default_threads
from ogm.geometric import RayISM, points_down, shows_ground
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan, as_scan, check_mount

if TYPE_CHECKING:
    from ogm.deep.engines import Engine
    from ogm.deep.network import PillarNetwork
    from ogm.scan import InverseSensorModel


DEFAULT_MOUNT = Mount(1.9)
MAX_MOUNTS = 8  # mounts of which a model keeps the parts

_log = logging.getLogger(__name__)
_warned: set[tuple[str, str]] = set()  # (model name, reason) of the warnings of this process


class DeepISM:
    """Inverse sensor model learned from simulated lidar scans (van Kempen et al. 2021).

    Maps one scan to one evidential grid, without memory from scan to scan::

        deep = DeepISM.load("lite", mount=Mount(sensor_height=1.9))
        grid = deep(scan)

    Parameters
    ----------
    network : OnnxEngine, TorchEngine, or PillarNetwork
        Engine, see `ogm.deep.engines.load_engine`; or a network to run by torch, see
        `ogm.deep.checkpoint.load_network`.
    spec : GridSpec, optional
        Output grid in the vehicle frame. By default the grid of the training, around the sensor of `mount`. It must
        have the resolution of the training; far beyond the extent of the training the network extrapolates.
    mount : Mount, optional
        Mount of the sensor. By default the mount of each scan (`Scan.mount`), else 1.9 m above ground. Returns in the
        ego footprint are dropped, and cells in it are unknown.
    description : mapping, optional
        Description of the weights, with the ranges of the training data under ``seen``. By default the engine's.

    Attributes
    ----------
    spec : GridSpec
        Output grid in the vehicle frame.
    engine : OnnxEngine or TorchEngine
        Engine that runs the network.

    Raises
    ------
    TypeError, ValueError
        If `mount` is no `Mount`, or the network does not fit `spec`.

    Notes
    -----
    Points are normalised as in training: heights are relative to the ground below the sensor, x and y to the sensor.
    Intensities are in [0, 1], Velodyne's calibrated value / 255. A scan without intensities (three columns, or all 0)
    is mapped without them.

    Scans unlike the training data are mapped too, with one warning per process for each reason and model name:

    * Intensities with a mean outside the training's range are ignored, since manufacturers calibrate differently.
    * A scan with more than 1.2 times the largest number of points in training is thinned to that number, with a fixed
      random seed.
    * A scan with at most a tenth of the smallest number of points in training gives an unknown grid.
    * A scan that does not show the ground gives the masses of rays, or an unknown grid if the network does not take
      rays. If the training had such scans, this applies only to scans without beams that point down, as of lidars with
      few level layers; if it had no others, never. Fog and spray hide the ground from beams that point down.
    """

    mount: Mount | None
    description: dict[str, Any]
    spec: GridSpec

    def __init__(
        self,
        network: "Engine | PillarNetwork",
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        *,
        description: Mapping[str, Any] | None = None,
    ) -> None:
        if mount is not None:
            check_mount(mount)
        self.mount = mount
        engine: Any = network if hasattr(network, "masses") else _of_torch(network)
        self.engine = engine
        self.description = dict(engine.description if description is None else description)
        x, y = (0.0, 0.0) if mount is None else map(float, mount.origin[:2])
        self.spec = _shifted(self.engine.spec, x, y) if spec is None else spec
        ranges = {"points": (0.0, np.inf), "intensity": (0.0, 1.0), "height": (0.0, np.inf), "ground": (1.0, 1.0)}
        ranges |= self.description.get("seen", {})
        self._point_range, self._intensity_range, self._height_range, self._ground_range = ranges.values()
        self._placed: dict[Mount, _Placed] = {}
        if mount is not None:
            self._at(mount)
        elif self.spec != self.engine.spec:
            self.engine.on(self.spec)  # raises an error for a grid that does not fit

    @classmethod
    def load(
        cls,
        source: str | os.PathLike[str] = "lite",
        *,
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        engine: str | None = None,
        precision: str | None = None,
        threads: int | None = None,
        device: Any = "cpu",
        compile: bool = False,
    ) -> Self:
        """Load shipped weights by name, or weights from a file of `ogm train` or `ogm export`.

        Parameters
        ----------
        source : "lite", or path
            Weights in the package, a ``.safetensors`` file next to its ``.json``, the folder of a run (its best
            weights), or an exported network (``.onnx``).
        spec, mount
            See `DeepISM`.
        engine : "onnxruntime", "openvino" or "torch", optional
            Package that runs the network. By default for exported weights, such as ``"lite"``, ONNX Runtime, or
            OpenVINO if it is installed and the processor has AMX; else torch.
        precision : "int8", "float32" or "bfloat16", optional
            Number format of the convolutions; see `ogm.deep.engines.load_engine`. By default 8-bit integers for
            ``"lite"`` by ONNX Runtime, bfloat16 on processors with AMX, else float32.
        threads : int, optional
            Number of threads of ONNX Runtime and OpenVINO. By default ``OMP_NUM_THREADS``, or the number of cores of
            the process.
        device : str or torch.device
            Device of torch: ``"cpu"`` or ``"cuda"``.
        compile : bool
            Whether to use ``torch.compile``. The first call takes half a minute and needs a C++ compiler.

        Raises
        ------
        FileNotFoundError, OgmError, ValueError, ImportError
            See `ogm.deep.engines.load_engine`.
        """
        options: dict[str, Any] = {"precision": precision, "threads": threads, "device": device, "compile": compile}
        return cls(load_engine(source, engine=engine, **options), spec, mount)

    def __call__(self, scan: Scan | NDArray[np.float32], rays: NDArray[np.float32] | None = None) -> EvidentialGrid:
        """Map one scan to its evidential grid.

        Parameters
        ----------
        scan : Scan, or (N, 4) or (N, 3) float array
            Points in the sensor's frame. NaN and infinite points are left out.
        rays : (nx, ny, 2) float32, optional
            Masses of the scan from a model that `takes_rays_of` accepts; by default they are computed.
        """
        return self.batch([scan], None if rays is None else [rays])[0]

    def takes_rays_of(self, model: "InverseSensorModel") -> bool:
        """Return whether the masses of another model are the masses of rays that the network takes as input."""
        if not self.engine.rays or type(model) is not RayISM:
            return False
        return vars(model) == vars(RayISM(self.spec, self.mount, threads=model.threads))

    def batch(
        self, scans: Sequence[Scan | NDArray[np.float32]], rays: Sequence[NDArray[np.float32]] | None = None
    ) -> list[EvidentialGrid]:
        """Map several scans together, which is faster on an accelerator.

        Parameters
        ----------
        scans : sequence of Scan or array
            See `__call__`.
        rays : sequence of (nx, ny, 2) float32, optional
            Masses of rays of each scan, see `__call__`.
        """
        if not scans:
            return []
        given = [as_scan(scan) for scan in scans]
        mounts = [self.mount or scan.mount or DEFAULT_MOUNT for scan in given]
        if len(set(mounts)) > 1:  # an engine has a fixed sensor position in the grid
            return [self(scan, None if rays is None else rays[k]) for k, scan in enumerate(given)]
        placed = self._at(mounts[0])
        pillars = [self._pillars(scan.points, placed) for scan in given]
        if placed.rays is None:
            rays = None
        elif rays is None:
            rays = [placed.rays(scan).mass for scan in given]
        mass = placed.engine.masses(pillars, rays)
        for k, scan in enumerate(given):
            if self._is_unlike_training(scan, mounts[0]):
                mass[k] = 0 if rays is None else rays[k]
        # Cells under the ego vehicle and scans without points: unknown
        mass[:, *placed.ego_cells] = 0
        mass[[self._has_too_few(scan_pillars) for scan_pillars in pillars]] = 0
        return [EvidentialGrid.trusted(self.spec, scan_mass) for scan_mass in mass]

    def _is_unlike_training(self, scan: Scan, mount: Mount) -> bool:
        """Return whether a scan shows no ground, and the training had no such scans; see the notes of the class."""
        least, most = self._ground_range
        if not most or shows_ground(scan, mount):
            return False
        return bool(least) or not points_down(scan, mount)

    def __repr__(self) -> str:
        return f"DeepISM({self.engine!r}, {self.spec}, {self.mount})"

    def _at(self, mount: Mount) -> "_Placed":
        """Return the parts of the model for a mount; recent mounts are cached."""
        if mount not in self._placed:
            low, high = self._height_range
            if not low - 0.1 <= mount.sensor_height <= high + 0.1:
                height = f"sensor_height {mount.sensor_height:g} m, in training {low:.2f} to {high:.2f} m"
                self._warn("height", height)
            x, y = (float(value) for value in mount.origin[:2])
            around = _shifted(self.spec, -x, -y)  # the same cells around the sensor
            engine = self.engine if self.spec == _shifted(self.engine.spec, x, y) else self.engine.on(around)
            rays = RayISM(self.spec, mount, threads=min(default_threads(), 2)) if engine.rays else None
            if len(self._placed) >= MAX_MOUNTS:
                self._placed.clear()
            cells = _cells_of(self.spec, mount.ego_footprint)
            self._placed[mount] = _Placed(*to_ground_frame(mount), engine, rays, cells)
        return self._placed[mount]

    def _pillars(self, points: NDArray[np.float32], placed: "_Placed") -> Any:
        """Normalise a scan like the training data; return SortedPoints or Pillars, depending on the engine."""
        max_points = self._point_range[1]
        if len(points) > 1.2 * max_points:
            points = points[np.isfinite(points).all(axis=1)]
        if len(points) > 1.2 * max_points:
            text = f"a scan of {len(points)} points, in training at most {max_points:.0f}: such scans are thinned"
            self._warn("points", text)
            points = points[np.random.default_rng(0).random(len(points)) < max_points / len(points)]
        pillars: Any = placed.engine.pillars(points, placed.ego_footprint, placed.T)
        self._compare(pillars)
        return pillars

    def _has_too_few(self, pillars: Any) -> bool:
        """Return whether a scan has at most a tenth of the smallest number of points in training."""
        return len(pillars.features) <= 0.1 * self._point_range[0]

    def _compare(self, pillars: Any) -> None:
        """Compare a scan with the training data; ignore intensities of another calibration."""
        features = pillars.features
        if self._has_too_few(pillars):
            self._warn("few", f"a scan with {len(features)} points on the grid: all cells are unknown")
            return
        intensity = features[:, 3] + 0  # side by side, which three passes read faster
        smallest, largest, mean = float(intensity.min()), float(intensity.max()), float(intensity.mean())
        if largest > 1 or smallest < 0:
            given = f"got {smallest:g} ... {largest:g}: divide them by their greatest value"
            raise ValueError(f"intensities must lie in [0, 1], {given}")
        low, high = self._intensity_range
        if largest > 0 and not low <= mean <= high:
            text = f"intensities of {mean:.3f} on average, in training {low:.3f} to {high:.3f}: they are left out"
            self._warn("intensity", text)
            features[:, 3] = 0
        near = features[:: max(1, len(features) // 2000), :3]
        near = near[(near[:, :2] ** 2).sum(1) < 15**2]
        if len(near) > 100:
            z = near[:, 2].cpu().numpy() if hasattr(near, "cpu") else near[:, 2]
            lowest = float(np.partition(z, len(z) // 10)[len(z) // 10])
            if abs(lowest) > 0.5:
                text = f"the ground near the sensor lies at {lowest:+.1f} m instead of 0 m: check sensor_height"
                self._warn("ground", text)

    def _warn(self, reason: str, text: str) -> None:
        """Log a warning, once per process for each reason and model name."""
        name = PurePath(str(self.description.get("card", ""))).stem or "DeepISM"
        if (name, reason) not in _warned:
            _warned.add((name, reason))
            _log.warning("%s, unlike the training data: %s", name, text)


class _Placed(NamedTuple):
    """Parts of a model that depend on the mount."""

    T: NDArray[np.float64]
    ego_footprint: tuple[float, float, float, float]
    engine: Any
    rays: "InverseSensorModel | None"
    ego_cells: tuple[slice, slice]


def _shifted(spec: GridSpec, x: float, y: float) -> GridSpec:
    return GridSpec(spec.resolution, spec.shape, (spec.origin[0] + x, spec.origin[1] + y))


def _cells_of(spec: GridSpec, box: tuple[float, float, float, float]) -> tuple[slice, slice]:
    """Return slices of the cells that a rectangle (x_min, x_max, y_min, y_max) [m] touches; empty without area."""
    (x0, x1), (y0, y1) = spec.index(box[:2], box[2:], unbounded=True)
    more = int(box[0] < box[1] and box[2] < box[3])
    return slice(max(x0, 0), max(x1 + more, 0)), slice(max(y0, 0), max(y1 + more, 0))


def _of_torch(network: Any) -> "Engine":
    from ogm.deep.torch_engine import TorchEngine

    return TorchEngine(network)
