"""The report: one page that needs nothing beside itself, and what it says."""

from __future__ import annotations

import base64
import dataclasses
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

import capture_sim
from capture_sim.cli import main
from capture_sim.recording.offline import write_run
from capture_sim.results import rows
from capture_sim.viewing import style
from capture_sim.viewing.report import error_statement, save_report
from capture_sim.viewing.source import Opened


@pytest.fixture(scope="module")
def page(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    paths = [str(write_run(run, folder / f"{run.scene.name}.mcap")) for run in runs]
    assert main(["report", *paths, "--out", str(folder / "report.html")]) == 0
    return folder / "report.html"


class Page(HTMLParser):
    """Collects what a page refers to, its tables' cells, and whether every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.references, self.cells, self.open, self.headings = [], [], [], []
        self.figures = {}
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)
        self.references += [v for k, v in attributes if k in ("src", "href", "srcset", "data")]
        self.figure = dict(attributes).get("data-for")
        if tag == "tr":
            self.cells.append([])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script" and self.figure:
            self.figures[self.figure] = json.loads(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1].append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def test_page_is_whole_and_refers_to_nothing_outside(page):
    text = page.read_text(encoding="utf-8")
    parsed = Page(text)
    assert parsed.open == []
    assert len(parsed.references) >= 10
    inside = ("data:", "#")
    assert all(reference.startswith(inside) for reference in parsed.references)
    what = "Results, Figures, Energy, How far to trust the numbers, Events, Parameters, Versions"
    assert parsed.headings == what.split(", ")
    assert page.stat().st_size < 8e6  # of which plotly is 4.8
    assert re.search(r"Made on \d{4}-\d\d-\d\d", text)
    assert "prefers-color-scheme: dark" in text
    names = re.findall(r' id="([^"]+)"', text[: text.index("<script>")])
    assert len(names) == len(set(names)) > 10  # a figure is drawn where its name is met first
    # every heading is in the contents
    assert text.count("<h2 id=") == text.count('<a href="#')


def values_of(axis):
    """Return the numbers of a curve as plotly stores them."""
    if isinstance(axis, dict):
        return np.frombuffer(base64.b64decode(axis["bdata"]), dtype=axis["dtype"])
    return np.array(axis, dtype=float)


def test_figures_hold_the_runs_in_their_colours(page, runs):
    found = Page(page.read_text(encoding="utf-8")).figures
    each = {f"{name}-{i}" for name in ("trajectory", "energy") for i in range(len(runs))}
    vehicles = {"velocities-chaser", "velocities-target"}
    assert {"impact_force", "distance", *each, *vehicles} <= set(found)
    for run, colour in zip(runs, style.RUNS, strict=False):
        mine = [
            curve
            for curve in found["impact_force"]["data"]
            if (curve.get("line") or curve["marker"])["color"] == colour
        ]
        [line] = [curve for curve in mine if curve["mode"] == "lines"]
        peak = run.touches["peak_force"].max()
        assert values_of(line["y"]).max() == pytest.approx(peak, rel=1e-6)
        marks = {curve["marker"]["symbol"]: curve for curve in mine if curve["mode"] == "markers"}
        for side, (_, symbol, _) in style.WALLS.items():
            expected = run.touches["peak_force"][run.touches["wall"] == side]
            shown = values_of(marks[symbol]["y"]) if expected.size else []
            assert sorted(shown) == pytest.approx(sorted(expected))


def test_page_tells_the_runs_numbers(page, runs):
    cells = Page(page.read_text(encoding="utf-8")).cells
    for run in runs:
        for expected in rows([run.summary]):
            assert list(filter(None, expected)) in [list(filter(None, row)) for row in cells]
    theta = next(row for row in cells if row and row[0] == "initial.target.theta")
    assert [float(cell) for cell in theta[2:5]] == pytest.approx(
        [run.scene.initial.target.theta for run in runs], abs=1e-6
    )
    # what all share stands there once
    [stiffness] = [row for row in cells if row and row[0] == "buffer.k_A"]
    assert stiffness[1:3] == ["N/m", "500"]
    damper = next(row for row in cells if row and row[0] == "dissipated axial")
    assert [float(cell) for cell in damper[1:]] == pytest.approx(
        [run.samples["dissipated_axial"][-1] * 1e3 for run in runs], abs=5e-4
    )


def test_ledger_in_the_page_adds_up(page, runs):
    cells = Page(page.read_text(encoding="utf-8")).cells
    start = next(i for i, row in enumerate(cells) if row and row[0] == "kinetic at the start")
    end = next(i for i, row in enumerate(cells) if row and row[0].startswith("largest residual"))
    ledger = {row[0]: [float(x) for x in row[1:]] for row in cells[start:end]}
    for i in range(len(runs)):
        put_in = ledger["kinetic at the start"][i] + ledger["work string"][i]
        rest = sum(
            values[i]
            for name, values in ledger.items()
            if name == "kinetic" or name.startswith(("elastic", "dissipated"))
        )
        assert rest == pytest.approx(put_in, abs=0.01)  # mJ, of rounded numbers


def test_errors_stated_are_those_found(page, runs):
    text = page.read_text(encoding="utf-8")
    for run in runs:
        [said] = re.findall(rf"<b>{run.scene.name}</b>: (a run made now.*?)</p>", text)
        assert "bit for bit" in said
        assert "same touches in the same order" in said
        stated = [float(number) for number in re.findall(r"[\d.]+e-\d+", said)]
        assert stated[-1] == pytest.approx(np.abs(run.samples["energy_residual"]).max(), rel=0.06)
        assert 0.0 < stated[0] <= stated[1] < 1e-7


def test_altered_recording_is_not_said_to_be_reproduced(runs):
    samples = runs[0].samples.copy()
    samples["q"][1000, 0] += 1e-6
    statement = error_statement(dataclasses.replace(runs[0], samples=samples))
    assert "the same states to 1.0e-06 m and rad" in statement
    assert "bit for bit" not in statement


def test_a_run_without_a_touch_and_a_title_that_is_a_script(tmp_path):
    short = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.5)
    title = ["title='<script>alert(1)</script> & co'"]
    odd = capture_sim.simulate(capture_sim.load_scene("paper_designed", title), t_end=0.3)
    paths = [str(write_run(run, tmp_path / f"{run.scene.name}.mcap")) for run in (short, odd)]
    assert main(["report", *paths, "--out", str(tmp_path / "x.html")]) == 0
    text = (tmp_path / "x.html").read_text(encoding="utf-8")
    assert "no touch" in text
    assert "<script>alert" not in text
    assert Page(text).open == []


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    "scene, changes",
    [
        ("paper_designed", {"initial.chaser.vx": 0, "run.t_end": 0.5}),
        ("tilt_0", {"run.t_end": 5e-4}),
    ],
    ids=["at rest", "one sample"],
)
def test_a_run_in_which_nothing_moves_is_drawn_without_a_warning(scene, changes, tmp_path):
    run = capture_sim.simulate(scene, changes)
    path = write_run(run, tmp_path / "still.mcap")
    assert main(["report", str(path), "--out", str(tmp_path / "x.html")]) == 0


def test_experiments_given_by_name_are_run(tmp_path, capsys):
    assert main(["report", "paper_designed", "--out", str(tmp_path / "x.html")]) == 0
    assert "captured" in (tmp_path / "x.html").read_text(encoding="utf-8")
    # a folder, as `view --out` takes one
    assert main(["report", "paper_designed", "--out", str(tmp_path)]) == 0
    assert main(["report", "paper_designed", "--out", str(tmp_path / "new")]) == 0
    pages = tmp_path / "report.html", tmp_path / "new" / "report.html"
    assert all("captured" in page.read_text(encoding="utf-8") for page in pages)
    capsys.readouterr()
    assert main(["report", "no_such", "--out", str(tmp_path / "x.html")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture(scope="module")
def nine(runs, undamped, tmp_path_factory):
    """The page of nine runs, and their names."""
    names = ("paper_case_1", "paper_case_2", "paper_case_3", "paper_designed", "paper_clamped")
    several = [*runs, undamped, *map(capture_sim.simulate, names)]
    opened = [Opened(run, run.scene.name, "a simulation", ["x 1"]) for run in several]
    done = []
    path = tmp_path_factory.mktemp("nine") / "report.html"
    save_report(opened, path, lambda *step: done.append(step))
    # progress is shown with every run
    assert [count for _, count in done] == [19] * 19
    assert [step for step, _ in done] == list(range(1, 20))
    return path, [one.label for one in opened]


def test_page_of_nine_runs_is_small(nine):
    """Of 6 MB plotly itself is 4.8."""
    path, names = nine
    text = path.read_text(encoding="utf-8")
    assert path.stat().st_size < 6.0e6
    assert text.count("!function") == 1 or text.count("plotly.js v") == 1  # the library, once
    found = Page(text).figures
    for i, name in enumerate(names):
        colours = {c["line"]["color"] for c in found[f"trajectory-{i}"]["data"]}
        assert style.run_colour(i) in colours
        assert f'data-run="{name}"' in text


# in a browser


def chromium(page, folder, *options):
    """Open a page in headless Chromium that can reach nothing; return what it reported."""
    command = [
        *("chromium", "--headless", "--disable-gpu", "--no-first-run", "--hide-scrollbars"),
        f"--user-data-dir={folder / 'profile'}",
        "--host-resolver-rules=MAP * ~NOTFOUND",
        "--disable-background-networking",
        "--enable-logging=stderr",
        *(("--no-sandbox",) if os.geteuid() == 0 else ()),
        *options,
        page.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


needs_chromium = pytest.mark.skipif(
    shutil.which("chromium") is None, reason="needs Debian's chromium to open the page"
)


@needs_chromium
def test_page_opens_without_errors_and_is_seen(page, tmp_path):
    shot = tmp_path / "page.png"
    size = ("--window-size=1240,7000", f"--screenshot={shot}")
    assert chromium(page, tmp_path, *size) == []
    image = np.asarray(Image.open(shot).convert("RGB"))
    assert image.shape[:2] == (7000, 1240)
    ink = image.min(axis=-1) < 204
    # every piece as high as a screen shows something, and nothing runs out at the right
    pieces = ink[: 6000 // 600 * 600].reshape(-1, 600, 1240)
    assert (pieces.mean(axis=(1, 2)) > 0.01).all()
    assert not ink[:, -8:].any()
    # the runs' colours are in the figures
    for colour in style.RUNS[:3]:
        near = np.abs(image - np.array(style.rgb(colour), np.int16)).max(axis=-1) < 13
        assert near.sum() > 2000


MEASURE = """<script>addEventListener("load", () => {
  const boxes = [...document.querySelectorAll("figure")].map((figure) => {
    const box = figure.getBoundingClientRect(), drawn = figure.querySelector("svg, img");
    return [box.left, box.right, drawn.getBoundingClientRect().width, box.height];
  });
  document.querySelectorAll(".key button")[1].click();
  const hidden = document.getElementById("figure-distance").data.filter((c) => c.visible === false);
  console.log("measured " + JSON.stringify({
    width: innerWidth, wide: document.documentElement.scrollWidth, boxes, hidden: hidden.length,
    names: [...new Set(hidden.map((curve) => curve.name))] }));
});</script></body>"""


@needs_chromium
@pytest.mark.parametrize("width", [500, 1400])
def test_every_figure_fits_a_phone_and_a_screen(nine, tmp_path, width):
    """And a button of the key hides its run."""
    path, names = nine
    measured = tmp_path / "measured.html"
    measured.write_text(path.read_text(encoding="utf-8").replace("</body>", MEASURE))
    reported = chromium(
        measured, tmp_path, f"--window-size={width},900", f"--screenshot={tmp_path / 'x.png'}"
    )
    [line] = [line for line in reported if "measured" in line]
    found = json.loads(re.search(r'measured (\{.*\})"', line)[1])
    assert found["width"] == width
    assert found["wide"] <= width  # nothing scrolls sideways but a table in its frame
    assert len(found["boxes"]) == 9 + 6 + 2 + 9 + 9
    for left, right, drawn, height in found["boxes"]:
        assert 0 <= left < right <= width
        assert drawn > 0.9 * (right - left)
        assert height > 200
    assert found["names"] == [names[1]]
    assert found["hidden"] > 0


@needs_chromium
def test_page_prints_and_what_it_asks_for_from_elsewhere_is_found_out(page, tmp_path):
    """So the check above can fail: the page itself forbids it."""
    altered, printed = tmp_path / "altered.html", tmp_path / "page.pdf"
    text = page.read_text(encoding="utf-8")
    altered.write_text(text.replace("<h1>", '<img src="http://example.org/x.png"><h1>'))
    reported = chromium(altered, tmp_path, f"--print-to-pdf={printed}", "--no-pdf-header-footer")
    assert any("Content Security Policy" in line for line in reported)
    data = printed.read_bytes()
    assert data.startswith(b"%PDF")
    # 13 with the table of loads, whole run and until the latch closes
    assert 4 <= len(re.findall(rb"/Type\s*/Page[^s]", data)) <= 13
    # A4, in points
    assert re.search(rb"/MediaBox\s*\[0 0 59[45][.\d]* 84[12][.\d]*\]", data)
