"""The report: one page without scripts that needs no other file, and the numbers on it."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import needs_chromium, open_page
from cases import cases
from PIL import Image

import capture_sim
from capture_sim.cli import main
from capture_sim.recording.offline import write_run
from capture_sim.run.summary_table import rows
from capture_sim.viewing import style
from capture_sim.viewing.report import error_statement

SECTIONS = ["Results", "Plots", "Energy", "Accuracy", "Events", "Parameters"]
PLOTS = 10  # of simulated runs: five quantities, path, load over stroke, velocities, energy, bench


class Page(HTMLParser):
    """Collects a page's tags, references, cells of tables and headings; every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.references, self.cells, self.open, self.headings = [], [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)
        self.references += [v for k, v in attributes if k in ("src", "href", "srcset", "data")]
        if tag == "tr":
            self.cells.append([])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1].append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


def reported(runs, folder):
    """Return the text of the report that the command writes of the runs' recordings."""
    paths = [str(write_run(run, folder / f"{run.scene.name}.mcap")) for run in runs]
    assert main(["report", *paths, "--out", str(folder / "report.html")]) == 0
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def text(runs, folder):
    return reported(runs, folder)


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_page_has_no_scripts_and_refers_to_nothing_outside(text, page):
    assert "script" not in page.tags
    assert all(reference.startswith(("data:", "#")) for reference in page.references)
    assert page.headings == SECTIONS
    assert [r for r in page.references if r.startswith("#")] == [f"#{s.lower()}" for s in SECTIONS]
    assert len(text) < 1_100_000


def test_every_plot_is_in_the_page(page):
    images = [r.partition("base64,")[2] for r in page.references if r.startswith("data:image")]
    assert len(images) == PLOTS
    for data in images:
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            image.verify()


def test_page_has_the_runs_numbers_and_what_made_them(text, page, runs):
    for run in runs:
        assert f"scene {run.scene.name} ({run.made_by['scene_sha256'][:12]})" in text
    cells = [list(filter(None, row)) for row in page.cells]
    for run in runs:
        for expected in rows([run.summary]):
            assert list(filter(None, expected)) in cells
    theta = next(row for row in cells if row and row[0] == "initial.target.theta")
    angles = [run.scene.initial.target.theta for run in runs]
    assert [float(cell) for cell in theta[2:5]] == pytest.approx(angles, abs=1e-6)
    # a value that all share is in one row, once
    [stiffness] = [row for row in cells if row and row[0] == "buffer.k_A"]
    assert stiffness[1:3] == ["N/m", "500"]


def test_ledger_in_the_page_adds_up(page, runs):
    names = [row[0] if row else "" for row in page.cells]
    start, end = names.index("kinetic at the start"), names.index("largest residual of the ledger")
    ledger = {row[0]: np.array(row[1:], float) for row in page.cells[start:end]}
    put_in = ledger["kinetic at the start"] + ledger["work string"]
    kept = [v for n, v in ledger.items() if n.startswith(("elastic", "dissipated"))]
    assert np.sum(kept, axis=0) + ledger["kinetic"] == pytest.approx(put_in, abs=0.01)  # rounded
    damper = [run.samples["dissipated_axial"][-1] * 1e3 for run in runs]
    assert ledger["dissipated axial"] == pytest.approx(damper, abs=5e-4)


def test_stated_errors_are_of_the_run_and_small(text, runs):
    for run in runs:
        [statement] = re.findall(rf"<b>{run.scene.name}</b>: (a run made now.*?)</p>", text)
        assert "the same states bit for bit" in statement
        assert "same touches in the same order" in statement
        stated = [float(number) for number in re.findall(r"[\d.]+e-\d+", statement)]
        assert stated[-1] == pytest.approx(np.abs(run.samples["energy_residual"]).max(), rel=0.06)
        assert 0.0 < stated[0] <= stated[1] < 1e-7


def test_a_recording_that_was_altered_is_not_stated_as_reproduced(runs, folder):
    samples = runs[0].samples.copy()
    samples["q"][1000, 0] += 1e-6
    statement = error_statement(runs[0].replaced(samples=samples))
    assert "the same states to 1.0e-06 m and rad" in statement


@pytest.mark.usefixtures("blank_pictures")
def test_a_title_that_is_a_script_and_a_run_without_a_touch(tmp_path):
    title = ["title='<script>alert(1)</script> & co'"]
    odd = capture_sim.simulate(capture_sim.load_scene("paper_designed", title), t_end=0.3)
    short = capture_sim.simulate(capture_sim.load_scene("tilt_0"), t_end=0.5)
    page = Page(text := reported([short, odd], tmp_path))
    assert "script" not in page.tags
    assert "ended before a contact" in text


@pytest.mark.usefixtures("blank_pictures")
def test_scenes_are_run_and_a_folder_gets_the_page(tmp_path, capsys):
    assert main(["report", "paper_designed", "--out", str(tmp_path / "new")]) == 0
    assert "captured" in (tmp_path / "new" / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["report", "no_such", "--out", str(tmp_path / "x.html")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# in a browser


@needs_chromium
@pytest.mark.parametrize("width", cases(few=[500], all=[500, 1240]))
def test_page_opens_on_a_phone_and_a_screen_without_errors(text, folder, tmp_path, width):
    shot = tmp_path / "page.png"
    size = (f"--window-size={width},3000", f"--screenshot={shot}")
    assert open_page(folder / "report.html", tmp_path, *size) == []
    image = np.asarray(Image.open(shot).convert("RGB"), int)
    assert not (image.min(axis=-1) < 204)[:, -4:].any()  # nothing runs out at the right
    for colour in style.RUNS[:3]:
        assert (np.abs(image - style.rgb(colour)).max(axis=-1) < 30).sum() > 500


@needs_chromium
def test_page_fits_on_a_phone_of_390_pixels(folder, tmp_path):
    """In a frame, as the browser's own window is not below 500; before, its links ran out."""
    frame = tmp_path / "phone.html"
    script = "console.log('wide', this.contentDocument.documentElement.scrollWidth)"
    source = (folder / "report.html").as_uri()
    frame.write_text(f'<iframe width="390" height="800" src="{source}" onload="{script}"></iframe>')
    (line,) = open_page(frame, tmp_path, "--allow-file-access-from-files", "--dump-dom")
    assert int(re.search(r"wide (\d+)", line)[1]) <= 390


@needs_chromium
@pytest.mark.long
def test_page_prints_on_a4_and_forbids_requests(text, tmp_path):
    altered, printed = tmp_path / "altered.html", tmp_path / "page.pdf"
    altered.write_text(text.replace("<h1>", '<img src="http://example.org/x.png"><h1>'))
    lines = open_page(altered, tmp_path, f"--print-to-pdf={printed}", "--no-pdf-header-footer")
    assert any("Content Security Policy" in line for line in lines)
    data = printed.read_bytes()
    assert 4 <= len(re.findall(rb"/Type\s*/Page[^s]", data)) <= 15
    # A4, in points
    assert re.search(rb"/MediaBox\s*\[0 0 59[45][.\d]* 84[12][.\d]*\]", data)
