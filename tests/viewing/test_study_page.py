"""The page of a study: what its command has printed, with its pictures, in one file."""

import html
import io
import re
from contextlib import redirect_stdout

import pytest
from browser import needs_chromium, open_page

from capture_sim.cli import main

STUDIES = {
    "sweep": [
        *("sweep", "tilt_0", "--vary=approach.offset=-60 mm:60 mm:5"),
        *("--vary=approach.angle=-10 deg:10 deg:3", "--set=run.t_end=3", "--workers=1"),
    ],
    "compare": ["compare", "tilt_0", "tilt_p10"],
}
OUT = {"sweep": ("study.csv", "study.html"), "compare": ("", "tilt_0_vs_tilt_p10.html")}


@pytest.fixture(scope="module", params=STUDIES)
def study(request, tmp_path_factory):
    """The page of a study, and what its command has printed."""
    folder = tmp_path_factory.mktemp(request.param)
    out, page = OUT[request.param]
    with redirect_stdout(io.StringIO()) as printed:
        assert main([*STUDIES[request.param], f"--out={folder / out}"]) == 0
    return folder / page, printed.getvalue().splitlines()


def test_a_page_says_what_the_command_has_said(study):
    page, printed = study
    text = html.unescape(page.read_text(encoding="utf-8"))
    shown = " ".join(re.sub(r"<[^>]+>", " ", text).split())
    lines = [line for line in printed if not re.search(r" in .*\.\w+$|\u2500", line)]
    cells = [cell for line in lines for cell in re.split(r"  +", line.strip()) if cell]
    assert len(cells) > 50  # of lines and of tables
    assert not [cell for cell in cells if cell not in shown]
    assert "<svg" not in text  # pictures are data, which the page's policy permits
    assert text.count("data:image/svg+xml") == 1
    assert "http" not in text.replace("http-equiv", "")


@needs_chromium
def test_a_page_fits_on_a_phone_and_opens_without_errors(study, tmp_path):
    page, _ = study
    frame = tmp_path / "phone.html"
    script = "console.log('wide', this.contentDocument.documentElement.scrollWidth)"
    frame.write_text(
        f'<iframe width="390" height="800" src="{page.as_uri()}" onload="{script}"></iframe>'
    )
    (line,) = open_page(frame, tmp_path, "--allow-file-access-from-files", "--dump-dom")
    assert int(re.search(r"wide (\d+)", line)[1]) <= 390
