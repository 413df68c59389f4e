"""Engines: the same grid from each, none of them loaded in vain, and torch only where it is asked for."""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import each, refused
from commands import completed, ogm

from ogm import Mount, OgmError, read_scan
from ogm.deep import DeepISM, PillarNetwork
from ogm.deep.checkpoint import save_network
from ogm.deep.engines import load_engine, weights_of
from ogm.deep.export import export_onnx
from ogm.deep.network import NetworkConfig
from ogm.deep.onnx_engine import OnnxEngine
from ogm.deep.onnx_file import read_onnx, weights_sum
from ogm.deep.quantize import quantize_onnx
from ogm.deep.runtimes import default_threads, prefers_openvino
from ogm.deep.torch_engine import TorchEngine
from ogm.scan import Scan

BOUND, BF16_BOUND, INT8_BOUND = 2e-3, 0.05, 0.2  # of mass; measured on the shipped scan: 2e-6, 0.02 and 0.12
MOUNT = Mount(1.98)


@pytest.fixture(scope="module")
def scan() -> Scan:
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        return read_scan(path, axes=("+y", "-x", "+z"))


@pytest.fixture(scope="module")
def by_torch(scan: Scan) -> np.ndarray:
    return DeepISM.load("lite", mount=MOUNT, engine="torch")(scan).mass


def test_the_shipped_export_is_that_of_the_shipped_weights() -> None:
    """Else `ogm export lite --out ogm/data/lite.onnx` was forgotten."""
    with weights_of("lite") as path:
        for precision, suffix in (("float32", ".onnx"), ("int8", ".int8.onnx")):
            file = read_onnx(path.with_suffix(suffix))
            assert file.weights_sum == weights_sum(path)
            assert file.precision == precision


_FAKE = None, {"feature_map", "sensor_coords"}  # a session of OpenVINO, and the names of its inputs


def test_the_quantised_network_computes_masses_in_float32() -> None:
    """Rounded terms of evidence / (evidence + 2) gave a mass of 1.017 in one of 40 million cells."""
    import onnx

    with as_file(files("ogm") / "data" / "lite.int8.onnx") as path:
        names = [node.op_type for node in onnx.load(path).graph.node]
    last = len(names) - names[::-1].index("Conv")
    assert "QuantizeLinear" in names[:last]
    assert {"Exp", "Log", "Div"} <= set(names[last:])
    assert not any(name.endswith("QuantizeLinear") for name in names[last:])


@each("engine, precision, bound", [
        ("onnxruntime", "float32", BOUND),
        ("onnxruntime", None, INT8_BOUND),
        ("openvino", "float32", BOUND),
        ("openvino", "bfloat16", BF16_BOUND),
        ("torch", "bfloat16", BF16_BOUND),
    ])  # fmt: skip
def test_every_engine_gives_the_same_grid(
    engine: str, precision: str | None, bound: float, scan: Scan, by_torch: np.ndarray
) -> None:
    if engine != "torch":
        pytest.importorskip(engine, reason=f"the package {engine} is not installed")
    ism = DeepISM.load("lite", mount=MOUNT, engine=engine, precision=precision)
    grid = ism(scan)
    difference = np.abs(grid.mass - by_torch)
    assert difference.max() <= bound
    assert difference.mean() <= 0.005
    assert getattr(ism.engine, "precision", "float32") == ("float32" if precision else "int8")
    assert grid.at(0.0, 0.0).unknown == 1  # under the ego vehicle
    assert grid.mass.min() >= 0
    np.testing.assert_array_equal(ism(scan).mass, grid.mass)


@each("amx, installed, runtime, precision", [
        (True, True, "openvino", "float32"),
        (True, False, "onnxruntime", "int8"),
        (False, True, "onnxruntime", "int8"),
    ])  # fmt: skip
def test_a_processor_with_amx_takes_openvino_where_it_is_installed(
    amx: bool, installed: bool, runtime: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.deep.runtimes.has_amx", lambda: amx)
    monkeypatch.setattr("ogm.deep.runtimes.find_spec", lambda name: installed or None)
    opened = []
    monkeypatch.setattr("ogm.deep.onnx_engine.open_openvino", lambda data, *options: opened.append(options) or _FAKE)
    engine = load_engine("lite", threads=2)
    assert ("openvino" if opened else "onnxruntime", engine.precision) == (runtime, precision)
    assert opened in ([], [("bfloat16", 2)])
    assert not prefers_openvino() or load_engine("lite", precision="int8").precision == "int8"  # as asked


def test_mapping_needs_no_torch() -> None:
    """A process in which nothing of the training can be imported maps a scan by the shipped network."""
    code = """
import sys
for name in ("torch", "lightning", "safetensors", "onnx", "onnxscript", "openvino", "matplotlib"):
    sys.modules[name] = None
import numpy as np
import ogm
from ogm.deep import DeepISM
grid = DeepISM.load("lite", mount=ogm.Mount(1.9))(np.random.default_rng(0).uniform(-20, 20, (20000, 3)))
model = ogm.load_model("lite", grid.spec, ogm.Mount(1.9))
print(grid.spec.shape, model.engine.spec.shape)
print(*{"open3d", "ogm.deep.network"} & set(sys.modules))
try:
    import ogm.deep
    ogm.deep.PillarNetwork
except ImportError as error:
    print(error)
try:
    DeepISM.load("lite", engine="torch")
except ImportError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    shapes, loaded, network, engine = done.stdout.strip().splitlines()
    assert (shapes, loaded) == ("(512, 352) (512, 352)", "")
    for message in (network, engine):
        assert '[train]"' in message


@each("package", ["onnxruntime", "openvino"])
def test_a_missing_runtime_is_answered_with_the_pip_command(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    extra = {"onnxruntime": "deep"}.get(package, package)
    refused(rf'pip install .*\[{extra}\]"', load_engine, "lite", error=ImportError, engine=package)


def test_threads_may_share_a_model(scan: Scan) -> None:
    ism = DeepISM.load("lite", mount=MOUNT, threads=2)
    scans = [Scan(np.ascontiguousarray(scan.points[k::7])) for k in range(4)]
    alone = [ism(one).mass for one in scans]
    with ThreadPoolExecutor(4) as pool:
        together = [grid.mass for grid in pool.map(ism, scans)]
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_batch_is_its_scans_one_by_one(scan: Scan) -> None:
    ism = DeepISM.load("lite", mount=MOUNT)
    scans = [Scan(np.ascontiguousarray(scan.points[k::7])) for k in range(2)]
    for one, together in zip(map(ism, scans), ism.batch(scans), strict=True):
        np.testing.assert_array_equal(one.mass, together.mass)


def test_threads_that_wait_use_no_processor_time(scan: Scan) -> None:
    ism = DeepISM.load("lite", mount=MOUNT, threads=4)
    ism(scan)
    before = time.process_time()
    time.sleep(0.2)
    assert time.process_time() - before < 0.05


def test_the_default_number_of_threads_is_torchs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert default_threads() == 3
    for odd in ("", "0", "many"):
        monkeypatch.setenv("OMP_NUM_THREADS", odd)
        assert default_threads() >= 1


@each("options, message", [
        ({"engine": "tensorflow"}, "engine must be one of onnxruntime, openvino, torch"),
        ({"engine": "onnxruntime", "device": "cuda"}, "device and compile are for the engine torch"),
        ({"engine": "onnxruntime", "compile": True}, "device and compile are for the engine torch"),
        ({"engine": "torch", "threads": 2}, "set_num_threads"),
        ({"precision": "bfloat16"}, "ONNX Runtime computes in float32"),
        ({"engine": "openvino", "precision": "int8"}, "use onnxruntime"),
        ({"engine": "torch", "precision": "int8"}, "float32 or bfloat16"),
        ({"threads": 0}, "at least 1"),
        ({"device": "warp"}, "use cpu"),
    ])  # fmt: skip
def test_options_that_an_engine_lacks_are_refused(options: dict, message: str) -> None:
    refused(message, load_engine, "lite", **options)


def test_grids_that_do_not_suit_the_network_are_refused() -> None:
    from ogm.grid import GridSpec

    engine = load_engine("lite")
    refused("cells of 0.16 m", engine.on, GridSpec.centered(length=10.24, width=10.24, resolution=0.32))
    refused("multiples of 16 cells", engine.on, GridSpec.centered(length=9 * 0.16, width=8 * 0.16, resolution=0.16))


@pytest.mark.slow
def test_own_weights_run_by_torch_until_they_are_exported(tiny, small, frames, tmp_path: Path, monkeypatch) -> None:
    """The life of a run's weights: trained, exported, mapped without torch, trained again."""
    monkeypatch.setattr("ogm.deep.engines.prefers_openvino", lambda: False)
    network = PillarNetwork(tiny, small).eval()
    weights = save_network(tmp_path / "best.safetensors", network, {"seen": {"points": [10, 10**6]}})
    assert isinstance(load_engine(tmp_path), TorchEngine)
    refused("ogm export", load_engine, tmp_path, error=FileNotFoundError, engine="onnxruntime")
    refused("ogm export", load_engine, tmp_path / "best.onnx", error=FileNotFoundError)

    exported = weights.with_suffix(".onnx")
    export_onnx(network, exported, description={"seen": {"points": [10, 10**6]}}, weights=weights)
    cloud, mount = frames[0].scan.points, Mount(1.8)
    wanted = DeepISM.load(tmp_path, mount=mount, engine="torch")(cloud).mass
    for source in (tmp_path, weights, exported):
        ism = DeepISM.load(source, mount=mount)
        assert isinstance(ism.engine, OnnxEngine)
        assert ism.description["seen"] == {"points": [10, 10**6]}
        np.testing.assert_allclose(ism(cloud).mass, wanted, atol=1e-5)
    refused("exported in float32", load_engine, exported, precision="int8")

    small_export = weights.with_suffix(".int8.onnx")
    quantize_onnx(exported, small_export, frames)
    refused("already quantised", quantize_onnx, small_export, small_export, frames, error=OgmError)
    refused("no frame", quantize_onnx, exported, small_export, [])
    for source in (tmp_path, weights, small_export):
        ism = DeepISM.load(source, mount=mount)
        assert ism.engine.precision == "int8"
        assert 0 < np.abs(ism(cloud).mass - wanted).max() < 0.05
    np.testing.assert_allclose(DeepISM.load(tmp_path, mount=mount, precision="float32")(cloud).mass, wanted, atol=1e-5)
    refused("wanted weights .* for the engine torch", load_engine, exported, error=OgmError, engine="torch")

    network.head.bias.data += 1
    save_network(weights, network, {})
    assert isinstance(load_engine(tmp_path), TorchEngine)
    for precision in ("int8", "float32"):
        refused(
            "exported from other weights",
            load_engine,
            tmp_path,
            error=OgmError,
            engine="onnxruntime",
            precision=precision,
        )
    assert isinstance(load_engine(exported), OnnxEngine)


@pytest.mark.slow
def test_a_network_that_takes_rays_is_the_same_exported(tiny, small, frames, tmp_path: Path) -> None:
    engines = [name for name in ("onnxruntime", "openvino") if find_spec(name)]
    assert engines
    network = PillarNetwork(replace(tiny, rays=True), small).eval()
    weights = save_network(tmp_path / "best.safetensors", network, {})
    export_onnx(network, tmp_path / "best.onnx", weights=weights)
    cloud, mount = frames[0].scan.points, Mount(1.8)
    wanted = DeepISM.load(tmp_path, mount=mount, engine="torch")(cloud).mass
    for engine in engines:
        found = DeepISM.load(tmp_path, mount=mount, engine=engine)
        assert found.engine.rays
        np.testing.assert_allclose(found(cloud).mass, wanted, atol=1e-5)
    with torch.no_grad():  # the rays are taken
        network.blocks[0][0][0].weight[:, -2:] = 0
    save_network(tmp_path / "best.safetensors", network, {})
    without = DeepISM.load(tmp_path, mount=mount, engine="torch")(cloud).mass
    assert np.abs(without - wanted).max() > 1e-3


@pytest.mark.slow
def test_commands_map_and_export_without_words_of_torch(small, tmp_path: Path) -> None:
    config = NetworkConfig(2, ((2, 1),), join="concatenate", up=2)
    save_network(tmp_path / "best.safetensors", PillarNetwork(config, small), {})
    out, grid = tmp_path / "best.onnx", tmp_path / "grid.npz"
    result = completed("export", tmp_path, "--out", out)
    assert read_onnx(out).weights_sum == weights_sum(tmp_path / "best.safetensors")
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        words = ("map", path, "--axes", "+y,-x,+z", "--sensor-height", 1.98, "--out", grid, "--ism", out)
        result = ogm(*words, "--length", small.length, "--width", small.width, "--resolution", small.resolution)
    assert result.exit_code == 0, result.output
    assert grid.exists()
