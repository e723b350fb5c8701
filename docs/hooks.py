"""Makes the start page from the README, fills in tables, and typesets formulas as MathML."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

from docutils.utils.math.latex2mathml import tex2mathml
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from tools import reference  # noqa: E402

FENCE = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<![\\$\w])\$(?=\S)([^$\n]+?)(?<=\S)\$(?![$\w])")
MARK = re.compile(r"formula([bi])((?:[0-9a-f]{2})+)end")
#: docutils reads all digits as one argument, TeX only the first.
UNBRACED = re.compile(r"(?:\\frac|\\sqrt|[\^_])\s*\d{2,}")
#: A link of the README: to a page or a picture in docs/, or to another file of the repository.
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:)([^)\s]+)\)")


#: A mark in place of which the site has a table.
ON_THE_SITE = re.compile(r"^<!-- on the site: ([\w ]+) -->$", re.MULTILINE)
#: A link from a page to a file of the repository that the site does not have.
OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./(?:config|examples|benchmarks|action)/[^)\s]+\)")
#: The page of the types that the nodes exchange.
TYPES = "reference_types.md"


def start_page(readme: str) -> str:
    """Return the site's first page: the README, with links as they are from within docs/."""

    def link(found: re.Match[str]) -> str:
        if found[3].startswith("docs/"):
            return f"{found[1]}[{found[2]}]({found[3].removeprefix('docs/')})"
        return found[2]  # a file of the repository, that the site does not have

    return LINK.sub(link, readme)


def on_files(files: Files, config: Any) -> Files:
    """Add the start page."""
    readme = Path(config["docs_dir"]).parent / "README.md"
    text = start_page(readme.read_text(encoding="utf-8"))
    files.append(File.generated(config, "index.md", content=text))
    files.append(File.generated(config, TYPES, content=types_page(readme.parent)))
    return files


def types_page(folder: Path) -> str:
    """Return a page with the definitions of all messages, actions and services in a folder."""
    lines = ["# Messages, actions and services", ""]
    lines += [
        "What the nodes exchange. Comments say unit and meaning of a field.",
        "",
    ]
    for kind in ("msg", "action", "srv"):
        for path in sorted((folder / kind).glob(f"*.{kind}")):
            lines += [f"## {path.stem}", "", "```text", path.read_text(encoding="utf-8").rstrip()]
            lines += ["```", ""]
    return "\n".join(lines)


def on_page_content(html: str, **_: Any) -> str:
    """Take Sphinx's roles off the names in docstrings, and put the formulas in."""
    html = re.sub(r":(?:attr|class|data|func|meth|mod):(?=<code>)", "", html)
    html = re.sub(r"<p>(formulab[0-9a-f]+end)</p>", r"\1", html)
    return MARK.sub(lambda mark: mathml(bytes.fromhex(mark[2]).decode(), mark[1] == "b"), html)


def mathml(formula: str, is_block: bool) -> str:
    """Return a formula of LaTeX as MathML.

    Raises
    ------
    ValueError
        If an argument of several digits has no braces, e.g. in ``x^12``.
    """
    if found := UNBRACED.search(formula):
        raise ValueError(f"formula {formula.strip()!r}: write {found[0]!r} with braces")
    text = tex2mathml(formula, as_block=is_block)
    applied = "<mo>&ApplyFunction;</mo>"
    text = text.replace(applied, f'{applied}<mspace width="0.17em"></mspace>')  # as in "sin x"
    return f'<div class="formula">{text}</div>' if is_block else text


def mark(formula: str, kind: str) -> str:
    """Return a word that Markdown leaves alone, in place of a formula."""
    return f"formula{kind}{formula.strip().encode().hex()}end"


def with_marks(markdown: str) -> str:
    """Return a page with a mark for each formula: fences of math, and $...$ outside of code."""
    markdown = FENCE.sub(lambda fence: f"\n{mark(fence[1], 'b')}\n", markdown)
    pieces = CODE.split(markdown)  # code at the odd places
    pieces[::2] = [INLINE.sub(lambda m: mark(m[1], "i"), piece) for piece in pieces[::2]]
    return "".join(pieces)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put in the tables that only the site has, and mark the formulas.

    A link to the messages' folder leads to their page, and one to another file nowhere.  A search
    finds the evidence last.
    """
    if page.file.src_uri.startswith("evidence/"):
        page.meta["search"] = {"boost": 0.1}
    markdown = ON_THE_SITE.sub(lambda found: reference.ON_THE_SITE[found[1]](), markdown)
    markdown = OUTSIDE.sub(r"`\1`", markdown)
    return with_marks(markdown.replace("](../msg)", f"]({TYPES})"))
