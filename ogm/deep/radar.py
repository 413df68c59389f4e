"""A trained network of radar as an inverse sensor model, with the same interface as the geometric ones."""

import os
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.engines import weights_of
from ogm.deep.polar import RadarGrid, RadarNoise, polar_features, view_of, write_masses
from ogm.deep.radar_onnx import RadarOnnxEngine
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan, as_scan, check_mount

if TYPE_CHECKING:
    from ogm.deep.radar_network import RadarNetwork


DEFAULT_MOUNT = Mount(0.6)


class _Engine(Protocol):
    """What computes: `RadarOnnxEngine`, or `ogm.deep.torch_engine.TorchRadarEngine`."""

    polar: RadarGrid
    description: dict[str, Any]

    def evidence(self, features: NDArray[np.float32]) -> NDArray[np.float32]: ...


class DeepRadarISM:
    """An inverse sensor model of radar, learned from simulated sweeps with the truth of lidars (after Wei et al. 2023).

    One sweep in, one evidential grid out, without memory from sweep to sweep::

        model = DeepRadarISM.load("radar", mount=Mount(0.6, pose(3.7, 0.0, 0.6)))
        grid = model(scan)

    The network sees the detections on a polar grid around the sensor, so it does not know the vehicle or the mount. A
    sweep without detections gives an unknown grid; cells outside the field of view, beyond the polar grid and under the
    ego vehicle are unknown. Detections with NaN or inf, and those in the ego footprint, are dropped.

    The network predicts what is usual behind a few detections. It repeats that in every sweep from the same place:
    sweeps are no independent evidence (Bauer et al. 2020). Fuse them by the cautious rule, which is the default of
    `ogm.fusion.EvidentialMapper`.

    Parameters
    ----------
    engine : RadarOnnxEngine, or RadarNetwork
        What computes.
    spec : GridSpec, optional
        The grid to fill, in the vehicle frame; by default `GridSpec.centered()`. Any resolution: the network's own
        cells are polar.
    mount : Mount, optional
        Where the sensor is mounted; by default each scan's own, `Scan.mount`, or else 0.6 m above ground. Its x axis
        points to the middle of the field of view.
    noise : RadarNoise, optional
        Field of view, and errors of Doppler and azimuth. Trained with half widths of 60 and 75 degrees.

    Raises
    ------
    TypeError
        If `mount` is no `Mount`.
    ValueError
        If a number of `noise` is out of its range.
    """

    mount: Mount | None
    noise: RadarNoise
    spec: GridSpec

    def __init__(
        self,
        engine: "_Engine | RadarNetwork",
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        noise: RadarNoise | None = None,
    ) -> None:
        if mount is not None:
            check_mount(mount)
        self.mount = mount
        self.noise = RadarNoise() if noise is None else RadarNoise(*(float(one) for one in noise))
        for name, high in (("half_width", np.pi), ("doppler_noise", 20), ("azimuth_noise", 0.5)):
            if not 0 < getattr(self.noise, name) <= high:
                raise ValueError(f"{name} must be above 0 and up to {high:g}, got {getattr(self.noise, name)}")
        self.engine: Any = engine if hasattr(engine, "polar") else _of_torch(engine)
        self.spec = GridSpec.centered() if spec is None else spec

    @classmethod
    def load(
        cls,
        source: str | os.PathLike[str] = "radar",
        *,
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        noise: RadarNoise | None = None,
        threads: int | None = None,
    ) -> Self:
        """Load weights: shipped weights by name, or a file of `ogm train` or `ogm export`.

        Parameters
        ----------
        source : "radar", or path
            An exported network (``.onnx``), which needs no torch; a ``.safetensors`` file with its ``.json``, or a
            run's folder, for its best weights, by torch.
        spec, mount, noise
            As of the class.
        threads : int, optional
            Of ONNX Runtime. By default ``OMP_NUM_THREADS``, or the cores of the process.

        Raises
        ------
        FileNotFoundError, OgmError, ImportError
            If there are no such weights, they are damaged, or the package that runs them is not installed.
        """
        with weights_of(source) as path:
            exported = path.with_suffix(".onnx") if str(source) == "radar" else path
            if exported.suffix == ".onnx":
                return cls(RadarOnnxEngine(exported, threads=threads), spec, mount, noise)
            from ogm.deep.checkpoint import load_radar_network
            from ogm.deep.torch_engine import TorchRadarEngine

            return cls(TorchRadarEngine(*load_radar_network(path)), spec, mount, noise)

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Map one sweep.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Uses x, y, z, `Scan.doppler`, against the sensor or over ground, and `Scan.rcs`.

        Returns
        -------
        EvidentialGrid
            Vacuous for a sweep without detections.
        """
        polar, scan = self.engine.polar, as_scan(scan)
        mount = self.mount or scan.mount or DEFAULT_MOUNT
        features = polar_features(scan, mount, self.noise, polar)
        mass = np.zeros((*self.spec.shape, 2), np.float32)
        if features[:2].any():
            evidence = self.engine.evidence(features).reshape(2, -1)
            view = view_of(self.spec, mount, self.noise, polar)
            write_masses(evidence, polar.shape[1], view, mass.reshape(-1, 2))
        return EvidentialGrid.trusted(self.spec, mass)

    def __repr__(self) -> str:
        return f"DeepRadarISM({self.engine!r}, {self.spec}, {self.mount}, {self.noise})"


def _of_torch(network: Any) -> _Engine:
    from ogm.deep.torch_engine import TorchRadarEngine

    return TorchRadarEngine(network)
