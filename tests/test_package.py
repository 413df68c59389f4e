"""The front door: what ``import ogm`` costs and loads, and that the house's walls stand."""

import hashlib
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ogm

ROOT = Path(__file__).parents[1]
HEAVY = {"torch", "open3d", "matplotlib", "numba", "scipy", "lightning", "filterpy", "zarr", "dask", "typer"}


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def test_import_ogm_loads_nothing_heavy() -> None:
    loaded = set(run("import ogm, sys; print(*{m.split('.')[0] for m in sys.modules})").split())
    assert not loaded & HEAVY


def test_import_ogm_is_quick() -> None:
    times = [
        float(run("import time; t = time.perf_counter(); import ogm; print(time.perf_counter() - t)"))
        for _ in range(3)
    ]
    assert min(times) < 0.2


def test_no_wing_loads_torch_open3d_or_matplotlib() -> None:
    code = "import sys, ogm.geometric, ogm.fusion, ogm.recordings, ogm.metrics, ogm.evidence; print(*sys.modules)"
    assert not {"torch", "open3d", "matplotlib", "filterpy", "kiss_icp"} & set(run(code).split())


def test_the_front_door_holds_what_it_names() -> None:
    for name in ogm.__all__:
        assert getattr(ogm, name).__name__ == name
        assert name in dir(ogm)
    with pytest.raises(AttributeError, match="no attribute 'OccupancyGrid'"):
        _ = ogm.OccupancyGrid


def test_import_contracts_hold() -> None:
    done = subprocess.run(
        ["lint-imports", "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_every_public_name_is_documented() -> None:
    import importlib

    ground = ("evidence", "pose", "files", "grid", "io", "truth", "geometric", "plot", "metrics")
    for room in (*ground, "deep", "fusion", "recordings"):
        module = importlib.import_module(f"ogm.{room}")
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isroutine(value):
                assert value.__doc__, f"ogm.{room}.{name} has no docstring"


def test_readme_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the README's Python blocks, one after the other, on the shipped scan."""
    import matplotlib

    matplotlib.use("Agg")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    (tmp_path / "scan.pcd.xz").write_bytes((ROOT / "ogm/data/vls128_road.pcd.xz").read_bytes())
    monkeypatch.chdir(tmp_path)
    namespace: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), namespace)
    matplotlib.pyplot.close("all")


def test_readme_figures_are_the_measured_ones() -> None:
    """The README's tables hold what the benchmarks last wrote."""
    text = (ROOT / "README.md").read_text()
    result = {
        name: json.loads((ROOT / f"benchmarks/results/{name}.json").read_text())
        for name in ("speed", "ground")
    }
    scans = {c["size"]: c["times"] for c in result["speed"]["comparisons"] if c["scan"].startswith("KITTI")}

    def ms(size: str, name: str) -> str:
        return f"{scans[size][name]['median [ms]']:.3g} ms"

    copy = "copy of the bytes it must read and write"
    for row, name in (
        ("copying the bytes it must read and write", copy),
        ("KISS-SLAM's native mapper", "KISS-SLAM mapper"),
    ):
        assert f"| {row} | {ms('57.6k', name)} | {ms('120k', name)} |" in text
    assert (
        f"**`HeightBandISM`** | **{ms('57.6k', 'HeightBandISM')}** | **{ms('120k', 'HeightBandISM')}**"
        in text
    )
    assert f"included | **{ms('57.6k', 'RayISM')}** | **{ms('120k', 'RayISM')}**" in text
    for wanted in (
        f"{v['got']:.0f}"
        for v in result["speed"]["verdicts"]
        if "KITTI" in v["what"] and "faster" in v["what"]
    ):
        assert re.search(rf"\b{wanted} times", text), wanted
    for name, groups in result["ground"]["labelled"].items():
        for who, scores in groups["not seen while choosing"]["together"].items():
            for kind in ("obstacle", "ground"):
                row = " / ".join(
                    f"{100 * scores[f'{kind} {what}']:.1f}" for what in ("precision", "recall", "F1")
                )
                assert who == "flat_ground" or row in text, (name, who, kind)


def test_the_simulators_figures_are_the_measured_ones() -> None:
    """docs/simulation.md holds what the benchmarks last wrote, and says where it falls short of what is wanted."""
    text = (ROOT / "docs/simulation.md").read_text()
    results = ROOT / "benchmarks/results"
    table = text[text.index("<!-- realism -->") : text.index("<!-- /realism -->")]
    rows = [line for line in table.splitlines() if line.startswith("|")]
    measured = (results / "realism.md").read_text().splitlines()
    assert len(rows) > 25
    assert [row for row in rows if row not in measured] == []
    modes = json.loads((results / "truth_modes.json").read_text())["against the reference"]
    for what in ("free found", "occupied found", "occupied called free"):
        shares = (f"{100 * modes[mode][what]:.1f} %" for mode in ("hd", "aimed"))
        assert f"| {what} | {' | '.join(shares)} |" in text
    cost = json.loads((results / "simulation.json").read_text())
    times, ratios = cost["one sample"]["seconds, median"], cost["one sample"]["times the rays alone, median"]
    assert f"in one scene) | {times['rays alone']:.2f} s |" in text
    assert f"written to disk | {times['hd']:.2f} s |" in text
    assert f"(worst) | {ratios['hd']:.2f} (" in text
    assert f"gain of the second | {cost['two workers']['gain']:.2f} |" in text
    assert f"lidars | {cost['two workers']['bytes per sample']:,} |" in text
    assert f"two processes | {cost['reading']['samples per second, 2 processes']:.0f} per second" in text


def test_the_deep_models_figures_are_the_measured_ones() -> None:
    """docs/deep.md, the model card and the README hold what the benchmarks last wrote, of the weights that ship."""
    results = ROOT / "benchmarks/results"
    page, card, front = ((ROOT / name).read_text() for name in ("docs/deep.md", "docs/lite.md", "README.md"))
    record = {
        name: json.loads((results / f"deep_{name}.json").read_text())
        for name in ("quality", "real", "speed", "losses")
    }
    shipped = (ROOT / "ogm/data/lite.safetensors").read_bytes()
    assert record["quality"]["weights"]["sha256"] == hashlib.sha256(shipped).hexdigest()
    assert record["quality"]["data"]["split"] == "test"

    means = {name: one["macro"] for name, one in record["quality"]["models"].items()}
    for metric in (
        "kl_e10",
        "kl_e1",
        "iou_free",
        "iou_occupied",
        "auroc_unknown",
        "ece",
        "ece_relative",
        "false_free",
    ):
        cells = []
        for name in ("height-band", "height-band-released", "ray", "lite"):
            one = means[name][metric]
            cells.append(f"{one['value']:.3f} ± {(one['high'] - one['low']) / 2:.3f}")
        assert " | ".join(cells) in page, metric
    for metric in ("kl_e10", "iou_free", "iou_occupied", "auroc_unknown", "false_free"):
        values = {name: f"{means[name][metric]['value']:.3f}" for name in means}
        assert f"| {values['height-band']} | {values['ray']} | {values['lite']} |" in front, metric
        assert f"| {values['lite']} | {values['ray']} | {values['height-band']} |" in card, metric
    for row in record["quality"]["wanted"]:
        said = "met" if row["met"] else "**missed**"
        assert f"| {row['what']} | {row['wanted']} | {row['value']:.3f} | {said} |" in page
    for kind in ("participants", "thick", "thin"):
        for what in ("false free", "called occupied"):
            found = record["quality"]["occupied cells by what stands there, pooled"]
            shares = [f"{100 * one[kind][what]:.1f} %" for one in found.values()]
            assert " | ".join(shares) in page, (kind, what)
    for weight, scores in record["quality"][
        "occupied cells weighed more, 20 validation frames, pooled"
    ].items():
        assert f"| x {weight} | {' | '.join(f'{value:.3f}' for value in scores.values())} |" in page, weight
    boxes = record["real"]["boxes"]["all, each place once"]["models"]
    for what in ("occupied", "free"):
        shares = [
            f"{100 * boxes[n][what]['mean over objects']:.1f} %"
            for n in ("HeightBandISM", "RayISM", "DeepISM")
        ]
        assert " | ".join(shares) in page
        assert " | ".join(shares) in front
    lite = record["speed"]["summary"]["lite"]
    assert f"{lite['scans per second']:.1f} per second" in page
    assert f"{lite['scans per second']:.1f} scans per second" in front
    for name, scores in record["losses"]["scores"].items():
        assert re.search(rf"\| \**{re.escape(name)}\** \| {scores['kl_e10']['value']:.3f} ", page), name
    assert "LOSSES_SETUP" not in page
    assert not re.search(r"<!-- (\w+) -->\s*<!-- /\1 -->", page)  # tables that were not filled


def test_the_fusion_pages_figures_are_the_measured_ones() -> None:
    """docs/fusion.md holds what the benchmarks last wrote."""
    results = ROOT / "benchmarks/results"
    page = (ROOT / "docs/fusion.md").read_text()
    quality, real, speed = (
        json.loads((results / f"fusion_{name}.json").read_text()) for name in ("quality", "real", "speed")
    )
    assert quality["judged"]["what"] == "test"
    static = ("iou_occupied", "false_free", "brier", "known")
    columns = (*((f"static_{name}", 3) for name in static), ("ghost_area", 2))
    for maps in (quality["maps"], quality["maps behind lite"]):
        for name in ("scan alone", "classical Bayes", "cautious, what came leaves, 0.04 s", "Dempster, 2 s"):
            means = maps[name]["mean and 95 % interval"]
            ratio = maps[name]["ratio to the classical filter"]["ghost_area"]
            cells = [f"{means[key][0]:.{digits}f}" for key, digits in columns]
            cells.append(f"{ratio[0]:.2f} ({ratio[1]:.2f} to {ratio[2]:.2f})")
            assert f"| {' | '.join(cells)} |" in page, name
    drive = real["recordings"]["KITTI drive 0005"]
    for name, means in drive["maps"]["mean"].items():
        if name.count(",") == 1:
            cells = [f"{100 * means[key]:.1f}" for key in ("complete", "iou_occupied", "false_free", "brier")]
            assert f"| {' | '.join(cells)} |" in page, name
    for name in ("update, default", "RayISM + update", "scipy", "update, numpy reference"):
        median = speed["times [ms]"][name]["median"]
        assert f"| {median:.3g} | {median / speed['times [ms]']['copy']['median']:.3g} |" in page, name
    assert not re.search(r"<!-- (\w+) -->\s*<!-- /\1 -->", page)  # tables that were not filled


def test_the_deep_page_runs() -> None:
    import doctest

    assert (
        doctest.testfile(
            str(ROOT / "docs/deep.md"), module_relative=False, optionflags=doctest.ELLIPSIS
        ).failed
        == 0
    )


def test_the_page_on_evaluation_tells_every_metric_and_what_judging_costs() -> None:
    from ogm.metrics import METRICS

    page = (ROOT / "docs/evaluation.md").read_text()
    rows = [
        line.split(" | ")
        for line in page.splitlines()
        if re.match(r"\| `\w+` \| .* \| (lower|higher|-) \|", line)
    ]
    told = {name.strip("| `"): (title, better, says.removesuffix(" |")) for name, title, better, says in rows}
    plain = str.maketrans({"∥": "|", "∣": "|"})
    assert list(told) == list(METRICS)
    for name, metric in METRICS.items():
        title, better, says = told[name]
        assert (title, better) == (metric.title, metric.better or "-")
        assert says.translate(plain).replace("|", "") == metric.says.replace("|", "")
    speed = json.loads((ROOT / "benchmarks/results/evaluation_speed.json").read_text())
    (slowest,) = (
        max(
            one["median"]
            for group in speed["frame [ms]"].values()
            for what, one in group.items()
            if start in what
        )
        for start in ("all ",)
    )
    report = speed["report"]
    seconds = report["judging and pictures [s]"] + report["reporting [s]"]
    mask = json.loads((ROOT / "benchmarks/results/truth_mask.json").read_text())["drives"][
        "KITTI, drive 0005"
    ]
    every, later = (mask[others]["share that is taken out"] for others in ("all", "later"))
    assert (
        f"{100 * every['free']:.1f} % of the free and {100 * every['occupied']:.1f} % of the occupied" in page
    )
    assert f"({100 * later['free']:.1f} and {100 * later['occupied']:.1f} % where later" in page
    pairs = [means for one in mask.values() for means in one["means, with and without"].values()]
    for metric, words in (("iou_occupied", "IoU of occupied by"), ("false_free", "false\nfree by")):
        gains = [abs(means[metric][0] - means[metric][1]) for means in pairs]
        assert f"{words} {min(gains):.3f} to {max(gains):.3f}" in page, metric
        moved = [
            one["by how much differences between methods move, at most"][metric] for one in mask.values()
        ]
        assert max(moved) < 0.005
    for said in (f"{slowest:.0f} ms", f"{seconds:.0f} s", f"{report['page [MB]']:.1f} MB"):
        assert said in page, said
