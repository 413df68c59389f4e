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
from ogm.deep.network import Network, fused
from ogm.deep.pillars import Box, Pillars, collate, pillarize, pillarize_torch
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan, as_scan

__all__ = ["SHIPPED", "DeepISM", "weights_of"]

_log = logging.getLogger(__name__)

SHIPPED = ("lite",)  # weights in the package


def _device(name: str | torch.device) -> torch.device:
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(f"there is no device {str(name)!r} here ({error}); use cpu") from error
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"the network runs on cpu and cuda, got {str(name)!r}")
    return device


@contextmanager
def weights_of(source: str | os.PathLike[str]) -> Iterator[Path]:
    """Return the file of weights that is meant by a name, a run's folder, or a file.

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
        path = path / "best.safetensors"
    elif path.suffix != ".safetensors":
        raise FileNotFoundError(
            f"there are no weights {str(source)!r}: give {' or '.join(map(repr, SHIPPED))}, which come with the "
            "package, or the .safetensors file or the folder that `ogm train` wrote"
        )
    yield path


class DeepISM:
    """An inverse sensor model learned from simulated scans (van Kempen et al. 2021).

    One scan in, one evidential grid out, without memory from scan to scan::

        deep = DeepISM.load("lite", mount=Mount(sensor_height=1.9))
        grid = deep(scan)

    Parameters
    ----------
    network : Network
        As `ogm.deep.checkpoint.load_network` returns it.
    spec : GridSpec, optional
        The grid to fill, in the vehicle's frame. By default that of the training, around the sensor; another needs the
        same resolution, and far beyond the training's ranges the network only guesses.
    mount : Mount, optional
        Where the sensor is mounted, 1.9 m above ground by default. Returns from the ego footprint are left out, its
        cells are unknown.
    device : str or torch.device
        Where the network runs.
    compile : bool
        Let ``torch.compile`` make the network faster; its first call takes half a minute and wants a C++ compiler.
    description : mapping, optional
        What the weights' JSON says; `seen` in it are the ranges of the training data.

    Notes
    -----
    Points are normalised as in training: heights are counted from the ground below the sensor, and x and y from the
    sensor. The grid lies around the sensor, in the vehicle's axes. Intensities are in [0, 1], Velodyne's calibrated
    value / 255. They may be missing (three columns, or all 0), as in a tenth of the training's scans, and are left
    out where their mean is outside what training saw: other makers calibrate otherwise. Scans of many more points
    than any in training are thinned at random, always alike. A scan of less than a tenth of the points of the sparsest
    in training, or of none, says nothing: all its cells are unknown. What is unlike the training data is logged as a
    warning, once for each reason.

    Raises
    ------
    ValueError
        If a height, pose or box makes no sense.
    """

    def __init__(
        self,
        network: Network,
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
        x, y, z = (float(value) for value in mount.origin)
        box, sensor_height = mount.ego_footprint, mount.sensor_height
        self.device = _device(device)
        origin = network.spec.origin
        place = GridSpec(network.spec.resolution, network.spec.shape, (origin[0] + x, origin[1] + y))
        self._spec = place if spec is None else spec
        self._place = network.spec  # the same cells, seen from the sensor
        if spec is not None and spec != place:
            self._place = GridSpec(spec.resolution, spec.shape, (spec.origin[0] - x, spec.origin[1] - y))
            network = network.on(self._place)
        self.network = fused(network).to(self.device)
        self.description = dict(description or {})
        self._T = mount.T_vehicle_points.copy()  # to the ground below the sensor
        self._T[:3, 3] += (-x, -y, sensor_height - z)
        self._box: Box = (box[0] - x, box[1] - x, box[2] - y, box[3] - y)
        (x0, x1), (y0, y1) = self._spec.index(box[:2], box[2:])
        there = box[0] < box[1] and box[2] < box[3]
        self._own = slice(max(x0, 0), max(x1 + there, 0)), slice(max(y0, 0), max(y1 + there, 0))
        self._warned: set[str] = set()
        self._seen = {name: tuple(value) for name, value in self.description.get("seen", {}).items()}
        low, high = self._seen.get("height", (0.0, np.inf))
        if not low - 0.1 <= sensor_height <= high + 0.1:
            self._warn(
                "height", f"sensor_height {sensor_height:g} m, but in training {low:.2f} to {high:.2f} m"
            )
        self._evidence = torch.compile(self.network.evidence) if compile else self.network.evidence

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
            A ``.safetensors`` file with its ``.json`` beside it, or a run's folder, whose best weights are meant.
        spec, mount, device, compile
            As of the class.

        Raises
        ------
        FileNotFoundError
            If there are no such weights.
        ValueError
            If the files are damaged or foreign.
        """
        with weights_of(source) as path:
            network, description = load_network(path)
        return cls(network, spec, mount, device=device, compile=compile, description=description)

    @property
    def spec(self) -> GridSpec:
        """The grid that the model fills, in the vehicle's frame."""
        return self._spec

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
        nx, ny = self._place.shape
        pillars = [self._pillars(as_scan(scan).points) for scan in scans]
        evidence = self._evidence(self.network.canvas(collate(pillars, nx * ny)))
        mass = evidence / (evidence[..., :1] + evidence[..., 1:] + 2)  # Sec. II: b = e / S
        # Nothing was learned of the cells under the own vehicle, nor of scans without points: nobody knows.
        mass[:, self._own[0], self._own[1]] = 0
        for number, scan in enumerate(pillars):
            if self._too_few(scan):
                mass[number] = 0
        return [EvidentialGrid.trusted(self._spec, one) for one in mass.cpu().numpy()]

    def _pillars(self, points: NDArray[np.float32]) -> Pillars:
        """Normalise a scan as the training data was."""
        most = self._seen.get("points", (0, np.inf))[1]
        if len(points) > 1.2 * most and points.ndim == 2 and points.dtype.kind == "f":
            points = points[np.isfinite(points).all(axis=1)]
        if len(points) > 1.2 * most:
            self._warn(
                "points",
                f"a scan of {len(points)} points, but in training at most {most:.0f}: such scans are thinned to that",
            )
            points = points[np.random.default_rng(0).random(len(points)) < most / len(points)]
        options = (self._place, self.network.config.z_range, self._box)
        if self.device.type == "cpu":
            pillars = pillarize(points, *options, self._T)
        else:
            pillars = pillarize(points[:0], *options, self._T)  # checks the type and the shape
            columns = torch.zeros(len(points), 4)
            columns[:, : min(4, points.shape[1])] = torch.from_numpy(np.asarray(points, np.float32))[:, :4]
            T = torch.from_numpy(self._T).float().to(self.device)
            pillars = pillarize_torch(columns.to(self.device), *options, T)
        self._compare(pillars)
        return pillars

    def _too_few(self, pillars: Pillars) -> bool:
        """Say whether a scan has less than a tenth of the points of the sparsest in training."""
        return len(pillars.features) <= 0.1 * self._seen.get("points", (0.0, 0.0))[0]

    def _compare(self, pillars: Pillars) -> None:
        """Warn of a scan that is unlike those in training."""
        features = pillars.features
        if self._too_few(pillars):
            self._warn("few", f"a scan with {len(features)} points on the grid: all cells are unknown")
            return
        least, most = float(features[:, 3].min()), float(features[:, 3].max())
        if most > 1 or least < 0:
            raise ValueError(
                f"intensities must lie in [0, 1], got {least:g} ... {most:g}; divide them by their greatest value"
            )
        low, high = self._seen.get("intensity", (0.0, 1.0))
        mean = float(features[:, 3].mean())
        if most > 0 and not low <= mean <= high:
            self._warn(
                "intensity",
                f"intensities of {mean:.3f} on average, but in training {low:.3f} to {high:.3f}: they are left out",
            )
            features[:, 3] = 0
        near = features[:: max(1, len(features) // 2000), :3]
        near = near[(near[:, :2] ** 2).sum(1) < 15**2]
        if len(near) > 100:
            lowest = float(near[:, 2].kthvalue(len(near) // 10 + 1)[0])
            if abs(lowest) > 0.5:
                self._warn(
                    "ground",
                    f"the ground near the sensor seems to lie at {lowest:+.1f} m instead of 0: is sensor_height right?",
                )

    def _warn(self, reason: str, text: str) -> None:
        if reason not in self._warned:
            self._warned.add(reason)
            _log.warning("unlike the training data: %s", text)
