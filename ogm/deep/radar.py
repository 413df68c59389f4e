"""Trained radar network as an inverse sensor model, with the interface of the geometric models."""

import os
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.engines import weights_of
from ogm.deep.polar import RadarNoise, polar_features, view_of, write_masses
from ogm.deep.radar_onnx import RadarOnnxEngine
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan, as_scan, check_mount

if TYPE_CHECKING:
    from ogm.deep.radar_network import RadarNetwork
    from ogm.deep.torch_engine import TorchRadarEngine


DEFAULT_MOUNT = Mount(0.6)


class DeepRadarISM:
    """Inverse sensor model of radar, learned from simulated sweeps with the truth of lidars (after Wei et al. 2023).

    Maps one sweep to one evidential grid, without memory from sweep to sweep::

        model = DeepRadarISM.load("radar", mount=Mount(0.6, pose(3.7, 0.0, 0.6)))
        grid = model(scan)

    The input of the network is a polar grid around the sensor, so it does not depend on the vehicle or the mount. A
    sweep without detections gives an unknown grid. Cells outside the field of view, beyond the polar grid and under the
    ego vehicle are unknown. Detections with NaN or inf, and detections in the ego footprint, are dropped.

    The network predicts the usual surroundings of a few detections, and repeats this in every sweep from the same
    place. Sweeps are therefore no independent evidence (Bauer et al. 2020): fuse them by the cautious rule, the default
    of `ogm.fusion.EvidentialMapper`.

    Parameters
    ----------
    engine : RadarOnnxEngine, TorchRadarEngine, or RadarNetwork
        Engine, or a network to run by torch.
    spec : GridSpec, optional
        Output grid in the vehicle frame, of any resolution; by default `GridSpec.centered()`.
    mount : Mount, optional
        Mount of the sensor, with x along the middle of the field of view. By default the mount of each scan
        (`Scan.mount`), else 0.6 m above ground.
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
        engine: "RadarOnnxEngine | TorchRadarEngine | RadarNetwork",
        spec: GridSpec | None = None,
        mount: Mount | None = None,
        noise: RadarNoise | None = None,
    ) -> None:
        if mount is not None:
            check_mount(mount)
        self.mount = mount
        self.noise = RadarNoise() if noise is None else RadarNoise(*map(float, noise))
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
        """Load shipped weights by name, or weights from a file of `ogm train` or `ogm export`.

        Parameters
        ----------
        source : "radar", or path
            Weights in the package or an exported network (``.onnx``), run by ONNX Runtime; or a ``.safetensors`` file
            next to its ``.json`` or the folder of a run (its best weights), run by torch.
        spec, mount, noise
            See `DeepRadarISM`.
        threads : int, optional
            Number of threads of ONNX Runtime. By default ``OMP_NUM_THREADS``, or the number of cores of the process.

        Raises
        ------
        FileNotFoundError, OgmError, ImportError
            If there are no such weights, they are damaged, or the package to run them is not installed.
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
            Detections with x, y, z, and optionally `Scan.doppler` (relative to the sensor or over ground) and
            `Scan.rcs`.

        Returns
        -------
        EvidentialGrid
            Masses on `spec`; vacuous for a sweep without detections.
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


def _of_torch(network: Any) -> "TorchRadarEngine":
    from ogm.deep.torch_engine import TorchRadarEngine

    return TorchRadarEngine(network)
