"""Weights by name or path, and engines to run them: ONNX Runtime, OpenVINO or torch.

>>> from ogm.deep.engines import weights_of
>>> with weights_of("lite") as path:
...     print(path.name)
lite.safetensors
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ogm.deep.onnx_engine import OnnxEngine
from ogm.deep.onnx_file import exported_from
from ogm.deep.runtimes import prefers_openvino
from ogm.extras import install_line
from ogm.storage.files import OgmError

if TYPE_CHECKING:
    from ogm.deep.torch_engine import TorchEngine

    Engine = OnnxEngine | TorchEngine

__all__ = ["ENGINES", "load_engine", "weights_of"]

SHIPPED = "lite"  # name of the weights in the package, which are also exported
ENGINES = ("onnxruntime", "openvino", "torch")
_TORCH = (
    f"{install_line('train')} (on a machine without an NVIDIA GPU install PyTorch's CPU build first), or export the "
    "weights on a machine with torch: ogm export WEIGHTS --out NAME.onnx"
)


def load_engine(
    source: str | os.PathLike[str] = "lite",
    *,
    engine: str | None = None,
    precision: str | None = None,
    threads: int | None = None,
    device: Any = "cpu",
    compile: bool = False,
) -> "Engine":
    """Load a network into an engine that runs it.

    Parameters
    ----------
    source : "lite", or path
        Weights in the package, a file of weights (``.safetensors``), the folder of a run (its best weights), or an
        exported network (``.onnx``).
    engine : "onnxruntime", "openvino" or "torch", optional
        Package that runs the network. By default, if the weights are exported, such as the weights in the package:
        OpenVINO in bfloat16 if it is installed and the processor has AMX, else ONNX Runtime. For other weights, and for
        another `device` or `compile`, torch.
    precision : "int8", "float32" or "bfloat16", optional
        Number format of the convolutions. ONNX Runtime computes in float32, or in 8-bit integers if such an export
        lies next to the weights (``NAME.int8.onnx``), which is then the default. The other engines compute in float32,
        the default if the engine is given, or bfloat16.
    threads, device, compile
        See `ogm.deep.onnx_engine.OnnxEngine` and `ogm.deep.torch_engine.TorchEngine`. `threads` is not for torch
        (see ``torch.set_num_threads``); `device` and `compile` are only for torch.

    Returns
    -------
    OnnxEngine or TorchEngine

    Raises
    ------
    FileNotFoundError
        If there are no such weights.
    OgmError
        If a file is damaged or of another kind, or the network was exported from other weights.
    ValueError
        If there is no such engine, or it lacks an option.
    ImportError
        If the engine is not installed; the message holds the pip command to install it.
    """
    if engine is not None and engine not in ENGINES:
        raise ValueError(f"engine must be one of {', '.join(ENGINES)}, got {engine!r}")
    of_torch = compile or str(device) != "cpu"
    if of_torch and engine not in (None, "torch"):
        raise ValueError(f"device and compile are for the engine torch, got {engine!r}: leave them out")
    with weights_of(source) as path:
        if engine != "torch" and not of_torch:
            if engine is precision is None and prefers_openvino() and (exported := _export_of(path, "openvino", None)):
                opened = OnnxEngine(exported, runtime="openvino", precision="bfloat16", threads=threads)
                if opened.precision == "float32":  # not of 8-bit integers, given by its path
                    return opened
            exported = _export_of(path, engine, precision)
            if exported is None and (engine or precision == "int8" or path.suffix == ".onnx"):
                raise _lacking(path, precision)
            if exported is not None:
                return _opened(exported, engine or "onnxruntime", precision, threads)
        if precision == "int8":
            raise ValueError("torch computes in float32 or bfloat16, got the precision 'int8': use onnxruntime")
        if path.suffix == ".onnx":
            raise OgmError(f"{path} is an exported network, wanted weights (.safetensors) for the engine torch")
        if threads is not None:
            raise ValueError("threads is not for the engine torch: leave it out and call torch.set_num_threads")
        load_network, TorchEngine = _of_torch()
        network, description = load_network(path)
        options: dict[str, Any] = {"device": device, "compile": compile, "precision": precision or "float32"}
        torch_engine: Engine = TorchEngine(network, description=description, **options)
        return torch_engine


@contextmanager
def weights_of(source: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the file of weights for a name, the folder of a run, or a file.

    Raises
    ------
    FileNotFoundError
        If `source` is no name, folder or file of weights.
    """
    if str(source) == SHIPPED:
        with as_file(files("ogm") / "data") as folder:
            yield folder / f"{SHIPPED}.safetensors"
        return
    path = Path(source)
    if path.is_dir():
        path /= "best.safetensors"
    elif path.suffix not in (".safetensors", ".onnx"):
        known = f"{SHIPPED!r}, the folder or .safetensors file of `ogm train`"
        raise FileNotFoundError(f"there are no weights {str(source)!r}: give {known}, or the .onnx of `ogm export`")
    yield path


_ENDINGS = {"int8": ".int8.onnx", "float32": ".onnx"}  # of exports


def _export_of(path: Path, engine: str | None, precision: str | None) -> Path | None:
    """Return the exported network for weights: the file itself, or one in its folder that was exported from it."""
    if path.suffix == ".onnx" and path.is_file():
        return path
    allowed = ("int8", "float32") if precision is None and engine != "openvino" else (_stored(precision),)
    for ending in (_ENDINGS[name] for name in allowed):
        exported = path.with_suffix(ending)
        if exported.is_file() and (not path.is_file() or exported_from(exported, path)):
            return exported
    return None


def _stored(precision: str | None) -> str:
    """Return the precision of the export that an engine reads."""
    return "int8" if precision == "int8" else "float32"


def _opened(path: Path, engine: str, precision: str | None, threads: int | None) -> OnnxEngine:
    """Return the engine of an exported network."""
    computed = "bfloat16" if precision == "bfloat16" else "float32"
    if engine == "openvino" and precision == "int8":
        raise ValueError("openvino computes in float32 or bfloat16, got the precision 'int8': use onnxruntime")
    opened = OnnxEngine(path, runtime=engine, precision=computed, threads=threads)
    if precision is not None and _stored(precision) != opened.precision:
        raise ValueError(f"{path} was exported in {opened.precision}, got the precision {precision!r}")
    return opened


def _lacking(path: Path, precision: str | None) -> Exception:
    """Return the error for weights without an export: there is none, or it was exported from other weights."""
    exported = path.with_suffix(_ENDINGS[_stored(precision)]) if path.suffix != ".onnx" else path
    calibrated = " --int8 DATA" if precision == "int8" else ""
    way = f"write it by `ogm export {path} --out {path.with_suffix('.onnx')}{calibrated}`"
    if exported.is_file():
        return OgmError(f"{exported} was exported from other weights than {path.name}: {way}")
    return FileNotFoundError(f"{exported} is not there, which this engine takes: {way}, or use the engine torch")


def _of_torch() -> tuple[Any, Any]:
    try:
        from ogm.deep.checkpoint import load_network
        from ogm.deep.torch_engine import TorchEngine
    except ImportError as error:
        raise ImportError(f"the engine torch needs a package that is missing ({error}): {_TORCH}") from error
    return load_network, TorchEngine
