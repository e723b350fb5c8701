"""The site: every page is there, links resolve, formulas are typeset, and a browser shows it."""

import functools
import html
import json
import re
import runpy
import subprocess
import sys
import threading
from collections import Counter
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest
from browser import chromium_command, console_lines, needs_chromium

import capture_sim

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
#: Paths of the pages below docs/, without their ending
STEMS = sorted(str(path.relative_to(DOCS).with_suffix("")) for path in DOCS.rglob("*.md"))
SOURCES = [ROOT / "README.md", *(DOCS / f"{stem}.md" for stem in STEMS)]
#: Paths of the pages on the site, the first one from README
ADDRESSES = ["/", *(f"/{stem}/" for stem in STEMS)]
#: Widths of the browser's window: a phone, and two screens, px
WIDTHS = (400, 1240, 1300)
#: What Markdown or TeX leaves in a text that it did not understand
LEFT_OVER = re.compile(
    r"\*\*|\*#|^\s*#+ |`|\$\S|\]\(|^\||:::|<!--|\\[a-z]{2,}|formula[bi][0-9a-f]{4}", re.MULTILINE
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site; a warning fails the build."""
    folder = tmp_path_factory.mktemp("site") / "site"
    build = [sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True)
    return folder


def test_site_has_every_page_and_starts_with_the_readme(site):
    for stem in STEMS:
        assert (site / stem / "index.html").is_file(), stem
    for page, text in {"reference_commands": "--weighed", "fmu": "buffer.k_T3"}.items():
        assert text in (site / page / "index.html").read_text()  # made for the site alone
    start = (site / "index.html").read_text()
    assert "The three experiments" in start
    assert 'href="tutorial/"' in start


class Text(HTMLParser):
    """The text of a page's article outside of code and formulas."""

    def __init__(self, page):
        super().__init__()
        self.text, self.open = "", Counter()
        self.feed(page[page.index("<article") : page.index("</article>")])

    def handle_starttag(self, tag, attributes):
        self.open[tag] += 1

    def handle_endtag(self, tag):
        self.open[tag] -= 1

    def handle_data(self, data):
        if not any(self.open[tag] for tag in ("code", "pre", "math", "script", "style")):
            self.text += data


@pytest.mark.parametrize("page", ["", *STEMS])
def test_no_markup_is_left_on_the_site(site, page):
    text = Text((site / page / "index.html").read_text()).text
    left = LEFT_OVER.search(text)
    assert not left, text[max(0, left.start() - 60) : left.end() + 60]


def test_every_link_and_anchor_of_the_site_resolves(site):
    """Also those in tables of contents and in docstrings, which a strict build does not check."""
    pages = {path.resolve(): path.read_text() for path in site.rglob("*.html")}
    names = {path: set(re.findall(r'\bid="([^"]+)"', text)) for path, text in pages.items()}
    for path, text in pages.items():
        if path.name == "404.html":
            continue
        for link in re.findall(r'<(?:a|img|link|script)\b[^>]*?\b(?:href|src)="([^"]*)"', text):
            place, _, anchor = html.unescape(link).partition("#")
            if re.match(r"https?:|data:|mailto:", place):
                continue
            target = (path.parent / place).resolve() if place else path
            target = target / "index.html" if target.is_dir() else target
            assert target.is_file(), f"{path}: {link}"
            if anchor and target in names and anchor not in ("__tabbed", "__codelineno"):
                assert unquote(anchor) in names[target], f"{path}: {link}"


def test_steps_after_a_block_keep_their_numbers(site):
    page = (site / "sweep" / "index.html").read_text()
    assert [int(n) for n in re.findall(r'<ol start="(\d+)"', page)] == [2, 3, 2, 3, 2]


def test_the_python_page_has_every_public_name_in_the_order_one_meets_it(site):
    source = (DOCS / "api.md").read_text()
    named = re.findall(r"^::: capture_sim\.[\w.]*\b(\w+)$", source, re.MULTILINE)
    assert named[:4] == ["simulate", "read_run", "Run", "plot"]
    assert {name for name in dir(capture_sim) if name[0] != "_"} <= set(named)
    page = (site / "api" / "index.html").read_text()
    places = [page.index(f'id="{path}"') for path in re.findall(r"^::: (\S+)$", source, re.M)]
    assert places == sorted(places)


@pytest.fixture(scope="module")
def hooks():
    return SimpleNamespace(**runpy.run_path(str(DOCS / "hooks.py")))


def test_formulas_are_typeset_when_the_site_is_built(site):
    """As MathML, the matrix with its rows and columns; showing them fetches nothing."""
    page = (site / "model" / "index.html").read_text()
    source = (DOCS / "model.md").read_text()
    written = source.count("```math") + len(re.findall(r"\$[^$\n]+\$", source))
    assert len(re.findall("<math", page)) == written > 30
    [matrix, *_] = re.findall("<mtable.*?</mtable>", page, re.DOTALL)
    rows = [row.split("<mtd")[1:] for row in matrix.split("<mtr")[1:]]
    assert [len(row) for row in rows] == [5] * 5
    cells = [re.sub(r"^[^>]*>|<[^>]*>|\s|\u2061", "", html.unescape(cell)) for cell in rows[3]]
    assert cells == ["⋅", "⋅", "⋅", "J", "0"]
    loaded = re.findall(r'<(?:script|img|source)\b[^>]*?src="([^"]*)"', page)
    loaded += re.findall(r'<link[^>]*?href="([^"]*)"[^>]*?rel="stylesheet"', page)
    assert loaded
    assert not [place for place in loaded if "//" in place]


def test_no_fraction_index_or_power_of_a_formula_is_lost(hooks):
    n_fractions = 0
    for page in SOURCES:
        for found in hooks.MARK.finditer(hooks.with_marks(page.read_text())):
            source = bytes.fromhex(found[2]).decode()
            tree = ElementTree.fromstring(re.sub(r"&\w+;", "", hooks.tex2mathml(source)))
            tags = Counter(element.tag.rpartition("}")[2] for element in tree.iter())
            scripts = len(re.findall(r"[_^]", source))
            assert tags["msub"] + tags["msup"] + 2 * tags["msubsup"] == scripts, (page, source)
            assert tags["mfrac"] == source.count(r"\frac"), (page, source)
            n_fractions += tags["mfrac"]
    assert n_fractions >= 7


def test_a_formula_with_an_argument_that_docutils_misreads_is_rejected(hooks):
    for formula in (r"\frac34 (1 - e^2)", "x^12", "h_10"):
        with pytest.raises(ValueError, match="braces"):
            hooks.mathml(formula, is_block=False)


def test_a_dollar_in_code_is_no_formula(hooks):
    text = "`$HOME` costs $x$ and 5 $ or 6 $\n\n```sh\necho $HOME $PATH\n```\n"
    marked = hooks.with_marks(text)
    assert marked == text.replace("$x$", hooks.mark("x", "i"))
    assert "<mi>x</mi>" in hooks.on_page_content(marked)


WATCH = """<script>
  window.errors = [];
  window.addEventListener('error', (e) => errors.push(e.message || e.target.outerHTML), true);
</script>"""


class Server(ThreadingHTTPServer):
    """Serves the site on this machine, and look.js, which sends back what it found."""

    def __init__(self, site):
        super().__init__(("127.0.0.1", 0), functools.partial(Handler, directory=site))
        self.found, self.has_found, self.missing = None, threading.Event(), set()
        self.address = f"http://127.0.0.1:{self.server_port}/look.html"


class Handler(SimpleHTTPRequestHandler):
    """Answers one request of the browser."""

    def do_GET(self):
        if self.path == "/look.html":
            icon, script = '<link rel="icon" href="data:,">', '<script src="look.js"></script>'
            self.answer("text/html", f"<head>{icon}</head><body>{script}</body>")
        elif self.path == "/look.js":
            self.answer("text/javascript", (Path(__file__).parent / "look.js").read_text())
        elif self.path == "/pages.json":
            self.answer("application/json", json.dumps({"pages": ADDRESSES, "widths": WIDTHS}))
        elif self.path in ADDRESSES:
            page = Path(self.translate_path(self.path), "index.html").read_text()
            self.answer("text/html; charset=utf-8", page.replace("<head>", f"<head>{WATCH}", 1))
        else:
            super().do_GET()

    def do_POST(self):
        self.server.found = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.server.has_found.set()
        self.answer("text/plain", "")

    def answer(self, kind, text):
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.end_headers()
        self.wfile.write(text.encode())

    def send_error(self, code, *arguments):
        self.server.missing.add(self.path)
        super().send_error(code, *arguments)

    def log_message(self, *arguments):
        pass  # errors are gathered instead


@pytest.fixture(scope="module")
def seen(site, tmp_path_factory):
    """What Chromium finds on each page at each width, by page and width."""
    folder = tmp_path_factory.mktemp("browser")
    server, log = Server(site), folder / "log"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with log.open("w") as errors:
        command = chromium_command(server.address, folder, "--remote-debugging-port=0")
        browser = subprocess.Popen(command, stdout=errors, stderr=errors)
        try:
            while not server.has_found.wait(0.2):
                assert browser.poll() is None, log.read_text()
        finally:
            browser.terminate()
            browser.wait()
            server.shutdown()
            server.server_close()
    assert isinstance(server.found, list), server.found
    pages = {(page["path"], page["width"]): page for page in server.found}
    console = console_lines(log.read_text())
    return SimpleNamespace(pages=pages, console=console, missing=server.missing)


@needs_chromium
@pytest.mark.long
def test_a_browser_opens_every_page_without_an_error(seen):
    assert set(seen.pages) == {(path, width) for path in ADDRESSES for width in WIDTHS}
    assert not seen.console
    assert not seen.missing
    for place, page in seen.pages.items():
        assert not page["errors"], place
        assert not page["images"], place


@needs_chromium
@pytest.mark.long
def test_no_markup_is_left_in_what_a_browser_shows(seen):
    for place, page in seen.pages.items():
        left = LEFT_OVER.search(page["prose"])
        assert not left, (place, left)
        assert len(page["prose"]) > 500, place


@needs_chromium
@pytest.mark.long
def test_no_page_is_wider_than_the_window(seen):
    """Tables and code scroll on their own."""
    wide = {place: page["widest"] for place, page in seen.pages.items() if page["overflow"] > 0}
    assert not wide


@needs_chromium
@pytest.mark.long
def test_on_a_screen_tables_and_the_start_page_show_all_their_columns(seen):
    cut = {path: seen.pages[path, 1300]["cut"] for path in ADDRESSES}
    assert not cut["/"]
    assert not [part for parts in cut.values() for part in parts if part.startswith("table")]


@needs_chromium
@pytest.mark.long
def test_a_browser_draws_every_formula_as_it_is_written(seen, hooks):
    """Fractions, powers, indices and dots are in place, and brackets are as high as a matrix."""
    n_brackets = 0
    for path, source in zip(ADDRESSES, SOURCES, strict=True):
        written = len(hooks.MARK.findall(hooks.with_marks(source.read_text())))
        for width in WIDTHS:
            page = seen.pages[path, width]
            assert page["n_formulas"] >= written, path  # docstrings have some as well
            assert not page["formulas"], (path, width)
            n_brackets += page["n_brackets"]
    assert seen.pages["/model/", WIDTHS[0]]["n_formulas"] > 30
    assert n_brackets >= 2 * len(WIDTHS)
