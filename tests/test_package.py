"""What ``import ogm`` costs and loads, import contracts, and the documentation: examples run, tables match records."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import pytest
from cases import each, refused

import ogm
from ogm.extras import import_extra, install_line

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "open3d", "matplotlib", "numba", "scipy", "lightning", "filterpy", "zarr", "dask", "typer"}
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])

IN_TOWNS = pytest.mark.xdist_group("towns")  # tests/conftest.py


def in_town(page: Path) -> bool:
    """Whether examples of a page build a town of the simulator."""
    return "DatasetPlan(" in page.read_text()


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_import_ogm_loads_nothing_heavy() -> None:
    loaded = set(run("import ogm, sys; print(*{m.split('.')[0] for m in sys.modules})").split())
    assert not loaded & HEAVY


def test_import_ogm_is_quick() -> None:
    times = [
        float(run("import time; t = time.perf_counter(); import ogm; print(time.perf_counter() - t)")) for _ in range(3)
    ]
    assert min(times) < 0.1


def test_extras_are_installed_as_ogm_was(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert install_line("ros,geo") == f'{sys.executable} -m pip install -e "{ROOT}[ros,geo]"'
    monkeypatch.setattr("ogm.extras.__file__", str(tmp_path / "ogm" / "extras.py"))
    assert install_line("ros") == 'pip install "ogm-toolkit[ros]"'


def test_a_missing_system_library_is_no_missing_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As open3d is on a Debian without libusb."""
    text = "raise ImportError('libusb-1.0.so.0: cannot open shared object file')"
    (tmp_path / "open3d.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    refused(
        "cannot be loaded, libusb-1.0.so.0: .*apt install libusb-1.0-0",
        import_extra,
        "open3d",
        "sim",
        error=ImportError,
    )
    refused(r"is not installed: .*\[sim\]", import_extra, "no_such_module", "sim", error=ImportError)


def test_packages_are_loaded_on_first_use() -> None:
    code = "import sys, ogm; before = 'ogm.evidence' in sys.modules; print(before, ogm.evidence.dempster.__name__)"
    assert run(code).split() == ["False", "dempster"]
    packages = {path.parent.name for path in (ROOT / "ogm").glob("*/__init__.py")}
    assert packages - {"cli"} <= set(dir(ogm))
    for name in ("evidence", "fusion", "models", "workflows"):
        assert getattr(ogm, name).__name__ == f"ogm.{name}"


def test_heavy_packages_are_loaded_by_their_own_package_only() -> None:
    code = "import sys, ogm.geometric, ogm.fusion, ogm.datasets, ogm.metrics, ogm.evidence; print(*sys.modules)"
    assert not {"torch", "open3d", "matplotlib", "filterpy", "kiss_icp", "scipy.stats"} & set(run(code).split())


LOADED = """
import gc, sys
from numba.core.dispatcher import Dispatcher
from ogm.cli import main
try:
    main()
finally:
    gc.unfreeze()
    stats = [o.stats for o in gc.get_objects() if isinstance(o, Dispatcher)]
    print(sum(s.cache_hits.total() for s in stats), sum(s.cache_misses.total() for s in stats), *sys.modules)
"""


@each("ism, kernels", [("ray", 8), ("combined", 13)])
def test_a_map_loads_no_more_than_it_needs(ism: str, kernels: int, tmp_path: Path) -> None:
    """Kernels that are on disk load without numba's declarations for the compiler, which import scipy.linalg."""
    files = ["--out", str(tmp_path / "a.npz"), "--picture", str(tmp_path / "a.png")]
    command = [sys.executable, "-c", LOADED, "map", "--ism", ism, str(ROOT / "ogm/data/vls128_road.pcd.xz"), *files]
    for _ in "ab":  # the first one compiles what is not on disk
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    hits, misses, *loaded = done.stdout.splitlines()[-1].split()
    assert (int(hits) <= kernels, int(misses)) == (True, 0)
    assert not set(loaded) & {"torch", "open3d", "matplotlib", "scipy.linalg", "scipy.stats", "numba.np.arraymath"}


def test_the_package_exports_what_it_names() -> None:
    for name in ogm.__all__:
        assert getattr(ogm, name).__name__ == name
        assert name in dir(ogm)
    with pytest.raises(AttributeError, match="no attribute 'OccupancyGrid'"):
        _ = ogm.OccupancyGrid


def test_import_contracts_hold() -> None:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def modules() -> list[str]:
    """Every module of the package by its dotted name."""
    paths = sorted((ROOT / "ogm").rglob("*.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]


def test_no_module_has_the_name_of_a_public_function_beside_it() -> None:
    """``from ogm.fusion import warp`` must never give a module where a function is meant, or the reverse."""
    names = modules()
    for package in names:
        source = ROOT / package.replace(".", "/") / "__init__.py"
        below = {name.rpartition(".")[2] for name in names if name.rpartition(".")[0] == package}
        if source.exists():
            public = re.search(r"__all__ = \[(.*?)\]", source.read_text(), re.DOTALL)
            exported = set(re.findall(r'"(\w+)"', public[1])) if public else set()
            assert not below & exported, package


def test_public_classes_have_names_of_their_own() -> None:
    where: dict[str, list[str]] = {}
    for path in (ROOT / "ogm").rglob("*.py"):
        for name in re.findall(r"^class ([A-Z]\w*)", path.read_text(), re.MULTILINE):
            where.setdefault(name, []).append(path.name)
    assert {name: paths for name, paths in where.items() if len(paths) > 1} == {}


@pytest.mark.parametrize(
    "page",
    [pytest.param(one, id=one.name, marks=[IN_TOWNS, pytest.mark.slow] if in_town(one) else []) for one in PAGES],
)
def test_examples_of_the_documentation_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Run a page's Python blocks, one after the other, on the shipped scan; then its interactive examples."""
    if in_town(page):
        request.getfixturevalue("kept_towns")
    packed = (ROOT / "ogm/data/vls128_road.pcd.xz").read_bytes()
    (tmp_path / "drive").mkdir()
    for name in ("scan.pcd.xz", "drive/000000.pcd.xz", "drive/000001.pcd.xz"):
        (tmp_path / name).write_bytes(packed)
    for name in ("poses.txt", "drive/poses.txt"):
        (tmp_path / name).write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0.5 0 1 0 0 0 0 1 0\n")
    monkeypatch.chdir(tmp_path)
    text = page.read_text()
    namespace: dict = {}
    for block in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        if ">>>" not in block:
            exec(compile(block, page.name, "exec"), namespace)
    found = doctest.testfile(
        str(page), module_relative=False, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    assert found.failed == 0


@each("page", [*PAGES, ROOT / "benchmarks/README.md", ROOT / "CONTRIBUTING.md"])
def test_links_of_the_documentation_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith(("http", "generated/")):  # those are made by `./run docs`, which checks links, too
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE)
            slugs = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]
            assert anchor in slugs, link


def test_tables_of_the_documentation_are_those_of_the_records() -> None:
    done = subprocess.run(
        [sys.executable, "docs/build.py", "--check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
