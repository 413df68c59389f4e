"""The HTML report: complete, harmless whatever names it is given, and working in a browser without a network."""

import json
import re
import shutil
import subprocess
from base64 import b64decode
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each
from test_evaluation_frame_pictures import luminance

from ogm.evaluation import Evaluation, FrameInfo, Interval, evaluation_record
from ogm.evaluation.chart_data import HEADLINE, frame_keys, group_metrics
from ogm.evaluation.frame_pictures import draw_frame
from ogm.evaluation.page import write_page
from ogm.evaluation.report import describe_extent, describe_intervals
from ogm.evaluation.text import as_json
from ogm.grid import GridSpec
from ogm.metrics import METRICS, accumulate, distances

SPEC = GridSpec.centered(6.4, 4.8, 0.4)  # 16 x 12 cells
FRAMES = 6
METHODS = ("base", "sharp", "vague")
HOSTILE = '</script><img src=x onerror="hacked=1"><!-- \u2028 &amp; {{data}} \udcff \' " against <b>'
VOID = {"meta", "link", "input", "br", "img", "hr"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
NOTHING = {"value": None, "low": None, "high": None}


def truth_and_masses() -> tuple[np.ndarray, np.ndarray]:
    """Make frames of all four states, and three methods: a rough one, a sharp one, one that is mostly unknown."""
    rng = np.random.default_rng(5)
    truth = rng.choice(4, p=[0.4, 0.4, 0.15, 0.05], size=(FRAMES, *SPEC.shape)).astype(np.uint8)
    noise = rng.dirichlet((1, 1, 2), size=(FRAMES, *SPEC.shape))[..., :2]

    def method(wrong: float, sure: float, noisy: float) -> np.ndarray:
        state = np.where(rng.random(truth.shape) < wrong, rng.integers(0, 3, truth.shape), truth)
        return sure * np.stack([state == 1, state == 2], axis=-1) + noisy * noise

    masses = np.stack([method(0.4, 0.6, 0.4), method(0.1, 0.8, 0.2), method(0.1, 0.2, 0.1)], axis=1)
    return truth, masses.astype(np.float32)


@pytest.fixture(scope="module")
def made() -> tuple[dict[str, Any], dict[int, dict[str, bytes]]]:
    """A record, as `ogm evaluate` writes it, and its pictures."""
    truth, masses = truth_and_masses()
    away = distances(SPEC)
    sums = [[accumulate(mass, state, away) for mass in row] for row, state in zip(masses, truth, strict=True)]
    shares = [np.bincount(state.ravel(), minlength=4) / state.size for state in truth]
    frames = [FrameInfo(f"{k:03d}", f"drive {max(k - 1, 0)}", 0.1 * k) for k in range(FRAMES)]
    result = Evaluation.from_sums(METHODS, SPEC, zip(sums, shares, strict=True), frames)
    weights = {"file": "sharp.safetensors", "sha256": "ab" * 32}
    facts = {
        name: {"description": f"how {name} works", "weights": weights if name == "sharp" else None} for name in METHODS
    }
    data = {"kind": "simulated data set", "name": "made", "truth": "drawn at random", "towns": 2}
    data["plan"] = {"a": [1, {"b": 2}]}
    record = {
        "title": "A made-up town",
        "command": "ogm evaluate data/ --ism base sharp vague",
        "date": "2020-02-02",
        **evaluation_record(replace(result, data=data, facts=facts)),
    }
    points = np.random.default_rng(1).uniform(-3, 3, (200, 4)).astype(np.float32)
    views = {k: draw_frame(points, truth[k], list(masses[k]), SPEC) for k in range(FRAMES)}
    return json.loads(json.dumps(record, allow_nan=False)), views


@pytest.fixture
def record(made: tuple[dict[str, Any], Any]) -> dict[str, Any]:
    """A record to change."""
    return deepcopy(made[0])


class Page(HTMLParser):
    """What stands in a page: elements that are closed as they were opened, texts, scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.text = text
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.scripts: dict[str, str] = {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attributes]
        assert len(names) == len(set(names)), (tag, names)
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, (tag, self.getpos())

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[self.elements[-1][1].get("id") or "code"] = data
        elif not (self.open and self.open[-1] == "style"):
            self.words.append(data)

    def all(self, attribute: str) -> list[str]:
        return [found[attribute] or "" for _, found in self.elements if attribute in found]

    @property
    def content(self) -> str:
        return re.sub(r"\s+", " ", "".join(self.words))

    @property
    def data(self) -> Any:
        return json.loads(self.scripts["data"])


@pytest.fixture
def page(tmp_path: Path) -> Callable[..., Page]:
    """Write a page and read it."""

    def write(record: dict[str, Any], views: dict[int, dict[str, bytes]] | None = None) -> Page:
        write_page(tmp_path / "report.html", record, views or {})
        assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
        return Page((tmp_path / "report.html").read_text("utf-8"))

    return write


def test_a_page_needs_nothing_but_itself(made: Any, page: Callable[..., Page]) -> None:
    found = page(*made)
    for address in [*found.all("href"), *found.all("src")]:
        assert address.startswith(("#", "data:")), address
    code = found.scripts["code"] + found.text[found.text.index("<style>") : found.text.index("</style>")]
    for word in ("fetch(", "XMLHttpRequest", "import(", "@import", "url(", "localStorage", "innerHTML", "eval("):
        assert word not in code
    assert "http" not in code.replace("http://www.w3.org/2000/svg", "")
    (policy,) = (a["content"] for tag, a in found.elements if tag == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in (policy or "")


def test_parts_of_a_page_refer_to_parts_that_are_there(made: Any, page: Callable[..., Page]) -> None:
    found = page(*made)
    names = found.all("id")
    assert len(names) == len(set(names))
    wanted = {a[1:] for a in found.all("href") if a.startswith("#")} | set(found.all("aria-labelledby"))
    assert {"summary", "scores", "frames", "run"} <= wanted <= set(names)
    asked = set(re.findall(r'\$\("([a-z-]+)"\)', found.scripts["code"]))
    assert {name for name in asked if name not in names} <= {"range-metric"}  # which the script makes
    assert "noscript" in {tag for tag, _ in found.elements}


def test_the_page_states_all_of_the_run(made: Any, page: Callable[..., Page]) -> None:
    record, views = made
    content = page(record, views).content
    for word in (record["title"], record["command"], record["date"], "drawn at random", "ab" * 32, "how vague works"):
        assert word in content
    assert "16 x 12 cells of 0.4 m" in content
    assert all(version in content for version in record["versions"].values())
    for metric in METRICS.values():
        assert metric.title in content
        assert metric.description in content


def test_every_metric_of_every_method_is_tabulated(made: Any, page: Callable[..., Page]) -> None:
    record, views = made
    found = page(record, views)
    values = set(found.all("data-v"))
    for model in record["methods"].values():
        for metric in METRICS:
            for value in (model["macro"][metric]["value"], model["micro"][metric]):
                assert value is None or repr(value) in values


def test_each_metric_is_in_one_group() -> None:
    names = [name for group in group_metrics(METRICS).values() for name in group]
    assert sorted(names) == sorted(METRICS)
    assert set(HEADLINE) < set(METRICS)


def test_the_summary_names_the_best_and_its_significance(made: Any, page: Callable[..., Page]) -> None:
    words = page(*made).content
    assert "sharp is best in" in words
    nll = [made[0]["methods"][name]["macro"]["nll"]["value"] for name in ("sharp", "base")]
    assert f"In NLL, sharp has {nll[0]:.3f} and base, the next best, {nll[1]:.3f}" in words
    assert "vague makes the fewest false free cells at the lowest IoU free" in words


def test_a_difference_within_its_interval_or_without_one_is_not_significant(
    record: dict[str, Any], page: Callable[..., Page]
) -> None:
    def rows(value: float, low: float | None, high: float | None) -> tuple[str, list[str | None]]:
        for pair in record["paired"].values():
            for one in pair.values():
                one["difference"] = {"value": value, "low": low, "high": high}
        found = page(record)
        return found.content, [a.get("class") for tag, a in found.elements if tag == "td"]

    content, classes = rows(0.0, -1.0, 1.0)
    assert "though not significantly" in content
    assert "not significant" in content
    assert "sure" in rows(-2.0, -3.0, -1.0)[1]
    assert "sure" not in rows(-2.0, None, None)[1] + classes


def test_a_cautious_method_is_named(record: dict[str, Any], page: Callable[..., Page]) -> None:
    for iou, description in (
        (0.0, "a method that hardly ever predicts free makes no such error"),
        (0.4, "a method that predicts free less often is wrong less often"),
    ):
        record["methods"]["vague"]["macro"]["iou_free"]["value"] = iou
        assert description in page(record).content


def test_the_head_of_the_page_states_drives_towns_and_intervals(made: Any, page: Callable[..., Page]) -> None:
    head = page(*made).content.split("Summary", 2)[1]
    assert "3 methods on 6 frames of 5 drives in 2 towns, made (simulated data set)" in head
    assert "Intervals: 95 %, Student's t over 5 drives." in head


@each(("sequences", "extent", "intervals"), [
        (["a", "b", "b", "c", "d"], "5 frames of 4 drives", "95 %, Student's t over 4 drives"),
        ([""] * 5, "5 frames", "95 %, Student's t over 5 frames"),
        (["a"] * 99, "99 frames of 1 drive", "none: 1 drive cannot show how much drives differ"),
        ([""], "1 frame", "none: 1 frame cannot show how much frames differ"),
    ])  # fmt: skip
def test_few_drives_are_stated(sequences: list[str], extent: str, intervals: str) -> None:
    result = Evaluation((), SPEC, {}, (), np.zeros((0, 4)), tuple(FrameInfo("", one) for one in sequences))
    assert (describe_extent(result), describe_intervals(result)) == (extent, intervals)


def test_parts_of_one_long_drive_are_stated() -> None:
    result = Evaluation((), SPEC, {}, (), np.zeros((0, 4)), (FrameInfo("", "a"),) * 100, {"towns": 1})
    assert describe_extent(result) == "100 frames of 1 drive in 1 town"
    assert describe_intervals(result).endswith("4 parts of one drive; not valid for other drives")


def test_of_two_that_were_not_compared_the_intervals_decide(record: dict[str, Any], page: Callable[..., Page]) -> None:
    record["paired"] = {}
    assert "sharp is best in" in page(record).content
    for model in record["methods"].values():
        for one in model["macro"].values():
            one["low"], one["high"] = -9.0, 9.0
    assert "though not significantly" in page(record).content


def test_what_is_missing_is_a_dash_with_its_reason(record: dict[str, Any], page: Callable[..., Page]) -> None:
    for model in record["methods"].values():
        model["macro"]["auroc_unknown"] = NOTHING
        model["micro"]["auroc_unknown"] = None
        model["missing"]["auroc_unknown"] = "the truth has no unknown cell"
        model["per frame"]["auroc_unknown"] = [None] * FRAMES
    found = page(record)
    assert "no value: the truth has no unknown cell" in found.all("title")
    assert "– AUROC unknown: no value, the truth has no unknown cell." in found.content
    assert "No method has a value for AUROC unknown" in found.content
    assert found.data["perFrame"]["auroc_unknown"] == [[None] * FRAMES] * 3


def test_names_are_text_wherever_they_stand(made: Any, record: dict[str, Any], page: Callable[..., Page]) -> None:
    plain = page(*made)
    record["methods"] = {HOSTILE if name == "sharp" else name: one for name, one in record["methods"].items()}
    record["paired"] = {
        " against ".join(HOSTILE if part == "sharp" else part for part in name.split(" against ")): one
        for name, one in record["paired"].items()
    }
    record["title"] = record["command"] = record["data"]["name"] = record["data"]["truth"] = HOSTILE
    record["data"][HOSTILE] = {HOSTILE: [HOSTILE]}
    record["frames"][2]["name"] = record["frames"][0]["sequence"] = HOSTILE
    record["methods"][HOSTILE]["description"] = record["methods"]["base"]["missing"]["kl_e1"] = HOSTILE
    found = page(record, made[1])
    assert {tag for tag, _ in found.elements} - {tag for tag, _ in plain.elements} <= {"pre"}
    assert "img" not in {tag for tag, _ in found.elements}
    written = HOSTILE.replace("\udcff", "?")
    assert found.data["methods"][1] == written
    assert found.data["frames"][2][0] == written
    assert found.data["paired"].keys() == plain.data["paired"].keys()
    assert found.content.count(re.sub(r"\s+", " ", written)) > 8
    assert found.scripts["code"] == plain.scripts["code"]


def test_pictures_that_do_not_fit_are_left_out_evenly(made: Any, tmp_path: Path) -> None:
    record, views = made
    size = sum(len(data) for pictures in views.values() for data in pictures.values()) * 4 / 3
    path = tmp_path / "report.html"
    for most, kept in ((size, range(6)), (0.55 * size, (0, 2, 5)), (0, (0,))):
        write_page(path, record, views, max_bytes=int(most))
        found = Page(path.read_text("utf-8"))
        assert found.data["pictures"] == list(kept)
        assert sorted(name for name in found.scripts if name.startswith("pictures-")) == [f"pictures-{k}" for k in kept]
        assert f"Pictures of {len(kept)} of 6 frames" in found.content
        assert ("left out to keep the page small" in found.content) == (len(kept) < 6)


def test_frames_have_names_of_their_own() -> None:
    frames = [{"name": name, "sequence": place} for name, place in ("ab", "ab", "ac", "db", "e ")]
    assert frame_keys(frames) == ["b/a #0", "b/a #1", "c/a", "d", "e"]


def test_numbers_are_short() -> None:
    values = {"a": [1 / 3, 123456.7, 2.0, 0.0, None, 7, "x", float("nan"), float("inf")]}
    assert as_json(values, 4) == {"a": [0.3333, 123500, 2, 0, None, 7, "x", None, None]}
    assert as_json({1: np.arange(2), "b": Interval(1 / 3, np.nan, 2.0)}, 4) == {
        "1": [0, 1],
        "b": {"value": 0.3333, "low": None, "high": 2.0},
    }


@each(("frames", "methods", "most"), [(102, 5, 800_000), (240, 40, 6_000_000)])
def test_many_methods_on_many_frames_carry_the_headline_metrics_and_weigh_little(
    record: dict[str, Any], page: Callable[..., Page], frames: int, methods: int, most: int
) -> None:
    record, times = deepcopy(record), frames // FRAMES
    model, pair = record["methods"]["sharp"], next(iter(record["paired"].values()))
    model["per frame"] = {name: values * times for name, values in model["per frame"].items()}
    record["frames"] = [record["frames"][0] | {"name": str(k)} for k in range(frames)]
    record["truth per frame"] = {name: values * times for name, values in record["truth per frame"].items()}
    names = [f"method {k}" for k in range(methods)]
    record["methods"] = dict.fromkeys(names, model)
    some = names[:5]
    record["paired"] = {f"{b} against {a}": pair for k, a in enumerate(some) for b in some[k + 1 :]}
    found = page(record)
    assert {*HEADLINE, "kl_e1", "legacy_kl", "mean_free"} <= set(found.data["perFrame"]) <= set(METRICS)
    assert (len(found.data["perFrame"]) < len(METRICS)) == (methods == 40)
    assert len(found.text) < most


@each("theme", [0, 1])
def test_colours_stand_out_from_the_page_in_light_and_in_dark(theme: int) -> None:
    style = (resources.files("ogm") / "data" / "report.css").read_text("utf-8")
    pairs = re.findall(r"--([a-z]+\d?): light-dark\((#[0-9a-f]{6}), (#[0-9a-f]{6})\)", style)
    parts = {name: tuple(bytes.fromhex(both[theme][1:])) for name, *both in pairs}
    colours = {name: luminance(part) for name, part in parts.items()}
    for back in ("page", "panel", "best", "worse"):
        assert contrast(colours["ink"], colours[back]) > 7
        assert contrast(colours["soft"], colours[back]) > 4.5
    assert contrast(colours["link"], colours["page"]) > 4.5
    for line in ("focus", *(f"s{k}" for k in range(8))):
        assert contrast(colours[line], colours["page"]) > 3


def contrast(one: float, other: float) -> float:
    return (max(one, other) + 0.05) / (min(one, other) + 0.05)


# ---------- in a browser

WATCH = """<script>
window.outcome = {errors: [], blocked: []};
addEventListener("error", event => outcome.errors.push(String(event.message)));
addEventListener("unhandledrejection", event => outcome.errors.push(String(event.reason)));
addEventListener("securitypolicyviolation", event => outcome.blocked.push(event.blockedURI));
</script>"""
ACT = """<script>
(async () => {
  const $ = id => document.getElementById(id);
  const wait = () => new Promise(done => setTimeout(done, 30));
  const key = name => document.activeElement.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
  const choose = (id, value) => { $(id).value = value; $(id).dispatchEvent(new Event("change", {bubbles: true})); };
  const frame = () => $("pick").selectedOptions[0].textContent;
  const alts = () => [...$("stage").querySelectorAll("img")].map(image => image.alt);
  const numbers = () => [...$("stage").querySelectorAll(".tile:nth-child(2) dd")].map(cell => Number(cell.textContent));
  const o = window.outcome;
  try {
%s
  } catch (error) { o.errors.push(String(error.stack)); }
  o.requests = performance.getEntriesByType("resource").map(r => r.name).filter(name => !name.startsWith("data:"));
  const out = document.createElement("pre");
  out.id = "outcome";
  out.textContent = btoa(unescape(encodeURIComponent(JSON.stringify(o))));
  document.body.append(out);
})();
</script>"""


@pytest.fixture
def browse(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Open a page in a browser, do something there, and return what was found."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser on the path: none of {', '.join(BROWSERS)}")

    def run(record: dict[str, Any], views: Any, steps: str, hash_: str = "", size: str = "1280,900") -> dict[str, Any]:
        path = tmp_path / "report.html"
        write_page(path, record, views)
        text = path.read_text("utf-8").replace("<style>", WATCH + "<style>", 1)
        path.write_text(text.replace("</body>", ACT % steps + "</body>"), "utf-8")
        words = [program, "--headless=new", "--no-sandbox", "--disable-gpu", f"--window-size={size}"]
        words += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000", "--dump-dom"]
        done = subprocess.run([*words, f"{path.as_uri()}{hash_}"], capture_output=True, timeout=60, check=False)
        match = re.search(r'<pre id="outcome">([^<]*)</pre>', done.stdout.decode("utf-8", "replace"))
        assert match, done.stderr[-2000:]
        return json.loads(b64decode(match[1]))

    return run


@pytest.mark.slow
def test_in_a_browser_frames_are_stepped_sorted_and_linked(made: Any, browse: Callable[..., dict[str, Any]]) -> None:
    record, views = made
    nll = record["methods"]["sharp"]["per frame"]["nll"]
    seen = browse(
        record,
        views,
        """
    o.linked = frame();
    o.alts = alts();
    o.source = $("stage").querySelector("img").src.slice(0, 22);
    key("ArrowRight"); o.right = frame(); o.hash = location.hash; o.alt = alts()[0];
    key("k"); key("ArrowLeft"); o.left = frame();
    $("stage").focus(); key("End"); o.end = frame(); key("ArrowRight"); o.beyond = frame();
    key("Home"); o.home = frame(); key("ArrowDown"); o.down = frame();
    location.hash = "#frame=001"; await wait(); o.followed = frame();
    choose("sort-method", "1"); choose("sort-metric", "nll");
    o.sorted = []; for (let i = 0; i < 6; i++) { o.sorted.push(frame()); key("j"); }
    choose("sort-way", "best"); o.best = frame();
    await wait();
    o.loaded = [...$("stage").querySelectorAll("img")].every(image => image.complete && image.naturalWidth === 12);
    """,
        "#frame=003",
    )
    assert seen["errors"] == seen["blocked"] == seen["requests"] == []
    assert seen["linked"] == "003"
    assert seen["alts"] == [
        "points of 003, coloured by height",
        "truth of 003",
        *(f"{what} of {name} in 003" for name in METHODS for what in ("masses", "errors")),
    ]
    assert seen["source"] == "data:image/webp;base64"
    assert (seen["right"], seen["hash"], seen["alt"]) == ("004", "#frame=004", "points of 004, coloured by height")
    assert (seen["left"], seen["end"], seen["beyond"]) == ("002", "005", "005")
    assert (seen["home"], seen["down"], seen["followed"]) == ("000", "005", "001")
    assert seen["sorted"] == [f"{k:03d}" for k in np.argsort(nll)[::-1]]
    assert seen["best"] == f"{np.argmin(nll):03d}"
    assert seen["loaded"] is True


@pytest.mark.slow
def test_in_a_browser_charts_tables_and_theme_answer(made: Any, browse: Callable[..., dict[str, Any]]) -> None:
    record, views = made
    seen = browse(
        record,
        {k: view for k, view in views.items() if k != 5},
        """
    const ground = () => getComputedStyle(document.body).backgroundColor;
    o.light = ground(); $("theme").click(); o.dark = ground(); key("t"); o.again = ground();
    o.charts = document.querySelectorAll("svg.plot").length;
    const lines = () => $("chart-metric").querySelectorAll(".dots").length;
    o.lines = lines(); o.tiles = $("stage").children.length;
    document.querySelector("#chips input").click();
    o.fewer = lines(); o.fewerTiles = $("stage").children.length;
    o.hidden = document.querySelector("[data-method='0']").hidden;
    const svg = $("chart-metric").querySelector("svg"), box = svg.getBoundingClientRect();
    const at = {bubbles: true, clientX: box.right - 20, clientY: box.top + 40};
    svg.dispatchEvent(new PointerEvent("pointermove", at));
    o.tip = $("tip").textContent;
    svg.dispatchEvent(new MouseEvent("click", at));
    o.jumped = frame(); o.focus = document.activeElement.id;
    o.without = [alts().length, $("no-pictures").hidden, $("place").textContent, numbers().length];
    key("k"); o.back = frame();
    const table = document.querySelector("#scores table"), head = table.tHead.querySelectorAll("button")[1];
    const column = () => [...table.tBodies[0].rows].map(row => Number(row.cells[1].dataset.v));
    head.click(); o.rising = column(); head.click(); o.falling = column();
    const first = () => $("paired-table").querySelector("tbody td").firstChild.textContent;
    const marks = () => [...$("paired-table").querySelectorAll("tbody td:nth-child(2)")].map(cell => cell.className);
    o.marks = marks(); choose("reference", "1"); o.turnedMarks = marks(); choose("reference", "0");
    o.against = first(); choose("reference", "1"); o.turned = first();
    choose("rival", "0"); o.pairs = $("paired-table").querySelectorAll("tbody tr").length;
    choose("figure-metric", "brier"); o.description = $("figure-metric-description").textContent;
    document.querySelector("#figure-switch [data-metric=legacy_kl]").click(); o.legacy = $("figure-metric").value;
    choose("order", "browser"); choose("range-metric", "false_free");
    document.activeElement.blur(); key("?"); o.help = $("help").open; key("?"); o.shut = $("help").open;
    $("stage").querySelector(".view").click(); o.large = $("large").open; o.caption = $("large-caption").textContent;
    key("Home"); o.stepped = $("large-caption").textContent; $("large").close();
    for (const box of document.querySelectorAll("#chips :checked")) box.click();
    o.none = $("stage").children.length;
    o.wide = document.documentElement.scrollWidth - innerWidth;
    """,
        size="800,900",
    )
    assert seen["errors"] == seen["blocked"] == seen["requests"] == []
    assert seen["light"] == seen["again"] == "rgb(255, 255, 255)"
    assert seen["dark"] != seen["light"]
    assert seen["charts"] >= 4 + 6 + len(METHODS)
    assert (seen["lines"], seen["fewer"], seen["tiles"], seen["fewerTiles"]) == (3, 2, 4, 3)
    assert seen["hidden"] is True
    assert seen["tip"].startswith("005")
    assert (seen["jumped"], seen["focus"]) == ("005", "stage")
    assert seen["without"] == [0, False, "no pictures; 5 frames have some", 6]
    assert seen["back"] == "004"
    assert seen["rising"] == sorted(seen["rising"])
    assert seen["falling"] == seen["rising"][::-1]
    assert seen["against"] == "6 : 0"
    assert seen["turned"] == "0 : 6"
    assert seen["marks"][0] == "best"  # sharp is nearer to the truth than base, and both than vague
    assert seen["turnedMarks"] == ["worse", "worse"]
    assert seen["pairs"] > 30
    assert seen["description"].startswith("Brier ↓: ")
    assert seen["legacy"] == "legacy_kl"
    assert (seen["help"], seen["shut"], seen["large"]) == (True, False, True)
    assert "004" in seen["caption"]
    assert seen["stepped"] != seen["caption"]
    assert seen["none"] == 1
    assert seen["wide"] <= 0  # nothing sticks out sideways


@pytest.mark.slow
def test_in_a_browser_one_frame_without_points_or_unknown_is_shown(
    made: Any, record: dict[str, Any], browse: Callable[..., dict[str, Any]]
) -> None:
    model = record["methods"]["base"]
    empty = ("iou_unknown", "auroc_unknown", "nll")
    for name in METRICS:
        model["per frame"][name] = [None if name in empty else model["per frame"][name][0]]
        model["macro"][name] = NOTHING if name in empty else model["macro"][name]
    for name in model["curves"]:
        model["curves"][name] = {} if name in ("reliability", "precision_recall") else None
    record["methods"], record["paired"] = {HOSTILE: model}, {}
    record["frames"] = [{"name": HOSTILE, "sequence": "", "stamp": None}]
    record["truth per frame"] = {name: values[:1] for name, values in record["truth per frame"].items()}
    view = {name: data for name, data in made[1][0].items() if name in ("truth", "mass 0", "error 0")}
    seen = browse(record, {0: view}, 'key("j"); o.frame = frame(); o.alts = alts(); o.hacked = "hacked" in window;')
    written = HOSTILE.replace("\udcff", "?")
    assert seen["errors"] == seen["blocked"] == seen["requests"] == []
    assert seen["frame"] == written
    assert seen["alts"][0] == f"truth of {written}"
    assert len(seen["alts"]) == 3
    assert seen["hacked"] is False
