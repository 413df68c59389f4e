"""A trained network as an inverse sensor model, with the same interface as the geometric ones."""

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from ogm.deep.checkpoint import load_network
from ogm.deep.network import PillarNetwork, fused
from ogm.deep.pillars import Pillars, collate, pillarize, pillarize_torch, to_ground_frame
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan, as_scan

__all__ = ["SHIPPED", "DeepISM", "weights_of"]

_log = logging.getLogger(__name__)

SHIPPED = ("lite",)  # weights in the package


class DeepISM:
    """An inverse sensor model learned from simulated scans (van Kempen et al. 2021).

    One scan in, one evidential grid out, without memory from scan to scan::

        deep = DeepISM.load("lite", mount=Mount(sensor_height=1.9))
        grid = deep(scan)

    Parameters
    ----------
    network : PillarNetwork
        As `ogm.deep.checkpoint.load_network` returns it.
    spec : GridSpec, optional
        The grid to fill, in the vehicle frame. By default the grid of the training, around the sensor. Another needs
        the same resolution; far beyond the extent of the training the network extrapolates.
    mount : Mount, optional
        Where the sensor is mounted; by default 1.9 m above ground. Returns from the ego footprint are dropped, and its
        cells are unknown.
    device : str or torch.device
        Where the network runs: ``"cpu"`` or ``"cuda"``.
    compile : bool
        Make the network faster by ``torch.compile``. The first call takes half a minute and needs a C++ compiler.
    description : mapping, optional
        The JSON of the weights; its entry ``seen`` holds the ranges of the training data.

    Attributes
    ----------
    spec : GridSpec
        The grid that the model fills, in the vehicle frame.

    Raises
    ------
    TypeError, ValueError
        If `mount` is no `Mount`, the network cannot fill `spec`, or there is no such device.

    Notes
    -----
    Points are normalised as in training: heights are counted from the ground below the sensor, x and y from the
    sensor. Intensities are in [0, 1], Velodyne's calibrated value / 255. A scan without intensities (three columns, or
    all 0) is mapped without them.

    A scan unlike those of the training is mapped too, with one warning in the log for each reason. Intensities whose
    mean lies outside the training's range are left out, since manufacturers calibrate differently. A scan of over 1.2
    times the most points of the training is thinned to that number, by the same random choice every time. A scan of a
    tenth of the fewest points of the training, or less, gives an unknown grid.
    """

    def __init__(
        self,
        network: PillarNetwork,
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        *,
        device: str | torch.device = "cpu",
        compile: bool = False,
        description: Mapping[str, Any] | None = None,
    ) -> None:
        self.mount = mount = Mount(1.9) if mount is None else mount
        if not isinstance(mount, Mount):
            raise TypeError(f"mount must be an ogm.Mount, got {mount!r}; give Mount(sensor_height=...) [m]")
        self.device = _device(device)
        self.description = dict(description or {})
        self._T, self._ego_footprint = to_ground_frame(mount)
        x, y = (float(value) for value in mount.origin[:2])
        default = _moved(network.spec, x, y)
        self.spec = default if spec is None else spec
        # The same cells around the sensor
        self._sensor_spec = network.spec if self.spec == default else _moved(self.spec, -x, -y)
        if self._sensor_spec != network.spec:
            network = network.on(self._sensor_spec)
        self.network = fused(network).to(self.device)
        self._evidence = torch.compile(self.network.evidence) if compile else self.network.evidence
        self._ego_cells = _cells_of(self.spec, mount.ego_footprint)
        ranges = {"points": (0.0, np.inf), "intensity": (0.0, 1.0), "height": (0.0, np.inf)}
        ranges |= self.description.get("seen", {})
        self._point_range, self._intensity_range, (low, high) = ranges.values()
        self._warned: set[str] = set()
        if not low - 0.1 <= mount.sensor_height <= high + 0.1:
            self._warn("height", f"sensor_height {mount.sensor_height:g} m, but in training {low:.2f} to {high:.2f} m")

    @classmethod
    def load(
        cls,
        source: str | os.PathLike[str] = "lite",
        *,
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        device: str | torch.device = "cpu",
        compile: bool = False,
    ) -> Self:
        """Load weights: those that come with the package by name, or a file or a run that `ogm train` wrote.

        Parameters
        ----------
        source : "lite", or path
            A ``.safetensors`` file with its ``.json`` beside it, or a run's folder, for its best weights.
        spec, mount, device, compile
            As of the class.

        Raises
        ------
        FileNotFoundError
            If there are no such weights.
        OgmError
            If the files are damaged or of another kind.
        """
        with weights_of(source) as path:
            network, description = load_network(path)
        return cls(network, spec, mount, device=device, compile=compile, description=description)

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Map one scan to its evidential grid.

        Parameters
        ----------
        scan : Scan, or (N, 4) or (N, 3) float array
            Points that are NaN or infinite are left out.
        """
        return self.batch([scan])[0]

    @torch.inference_mode()
    def batch(self, scans: Sequence[Scan | NDArray[np.float32]]) -> list[EvidentialGrid]:
        """Map some scans at once, which is faster on an accelerator."""
        if not scans:
            return []
        nx, ny = self._sensor_spec.shape
        pillars = [self._pillars(as_scan(scan).points) for scan in scans]
        evidence = self._evidence(self.network.feature_map(collate(pillars, nx * ny)))
        mass = evidence / (evidence[..., :1] + evidence[..., 1:] + 2)  # Sec. II: b = e / S
        # The network was not trained on cells under the ego vehicle, nor on scans without points: unknown
        mass[:, *self._ego_cells] = 0
        mass[[self._has_too_few(one) for one in pillars]] = 0
        return [EvidentialGrid.trusted(self.spec, one) for one in mass.cpu().numpy()]

    def _pillars(self, points: NDArray[np.float32]) -> Pillars:
        """Normalise a scan as the training data was."""
        most = self._point_range[1]
        if len(points) > 1.2 * most:
            points = points[np.isfinite(points).all(axis=1)]
        if len(points) > 1.2 * most:
            text = f"a scan of {len(points)} points, but in training at most {most:.0f}: such scans are thinned to that"
            self._warn("points", text)
            points = points[np.random.default_rng(0).random(len(points)) < most / len(points)]
        options = self._sensor_spec, self.network.config.z_range, self._ego_footprint
        if self.device.type == "cpu":
            pillars = pillarize(points, *options, self._T)
        else:
            T = torch.from_numpy(self._T).float().to(self.device)
            pillars = pillarize_torch(torch.tensor(points, device=self.device), *options, T)
        self._compare(pillars)
        return pillars

    def _has_too_few(self, pillars: Pillars) -> bool:
        """Return whether a scan has a tenth of the fewest points of the training, or less."""
        return len(pillars.features) <= 0.1 * self._point_range[0]

    def _compare(self, pillars: Pillars) -> None:
        """Compare a scan with those of the training; leave out intensities of another calibration."""
        features = pillars.features
        if self._has_too_few(pillars):
            self._warn("few", f"a scan with {len(features)} points on the grid: all cells are unknown")
            return
        intensity = features[:, 3]
        least, most, mean = float(intensity.min()), float(intensity.max()), float(intensity.mean())
        if most > 1 or least < 0:
            given = f"got {least:g} ... {most:g}; divide them by their greatest value"
            raise ValueError(f"intensities must lie in [0, 1], {given}")
        low, high = self._intensity_range
        if most > 0 and not low <= mean <= high:
            text = f"intensities of {mean:.3f} on average, but in training {low:.3f} to {high:.3f}: they are left out"
            self._warn("intensity", text)
            features[:, 3] = 0
        near = features[:: max(1, len(features) // 2000), :3]
        near = near[(near[:, :2] ** 2).sum(1) < 15**2]
        if len(near) > 100:
            lowest = float(near[:, 2].kthvalue(len(near) // 10 + 1)[0])
            if abs(lowest) > 0.5:
                text = (
                    f"the ground near the sensor seems to lie at {lowest:+.1f} m instead of 0: is sensor_height right?"
                )
                self._warn("ground", text)

    def _warn(self, reason: str, text: str) -> None:
        """Log a warning, once for each reason."""
        if reason not in self._warned:
            self._warned.add(reason)
            _log.warning("unlike the training data: %s", text)


@contextmanager
def weights_of(source: str | os.PathLike[str]) -> Iterator[Path]:
    """Return the file of weights that a name, a run's folder, or a file stands for.

    Raises
    ------
    FileNotFoundError
        If `source` is none of them.
    """
    if str(source) in SHIPPED:
        with as_file(files("ogm") / "data") as folder:
            yield folder / f"{source}.safetensors"
        return
    path = Path(source)
    if path.is_dir():
        path /= "best.safetensors"
    elif path.suffix != ".safetensors":
        known = f"{' or '.join(map(repr, SHIPPED))}, or the .safetensors file or the folder that `ogm train` wrote"
        raise FileNotFoundError(f"there are no weights {str(source)!r}: give {known}")
    yield path


def _moved(spec: GridSpec, x: float, y: float) -> GridSpec:
    return GridSpec(spec.resolution, spec.shape, (spec.origin[0] + x, spec.origin[1] + y))


def _cells_of(spec: GridSpec, box: tuple[float, float, float, float]) -> tuple[slice, slice]:
    """Return the cells of a grid that a rectangle (x_min, x_max, y_min, y_max) [m] touches; none if it is empty."""
    (x0, x1), (y0, y1) = spec.index(box[:2], box[2:])
    more = int(box[0] < box[1] and box[2] < box[3])
    return slice(max(x0, 0), max(x1 + more, 0)), slice(max(y0, 0), max(y1 + more, 0))


def _device(name: str | torch.device) -> torch.device:
    try:
        device = torch.empty(0, device=name).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(f"there is no device {str(name)!r} here ({error}); use cpu") from error
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"the network runs on cpu and cuda, got {str(name)!r}")
    return device
