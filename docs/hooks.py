"""Adds the scene reference, made from the code, and typesets formulas as MathML."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

from docutils.utils.math.latex2mathml import tex2mathml
from mkdocs.structure.files import File, Files

from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Declared, declared

FENCE = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<![\\$\w])\$(?=\S)([^$\n]+?)(?<=\S)\$(?![$\w])")
MARK = re.compile(r"formula([bi])((?:[0-9a-f]{2})+)end")
HEAD = """# Scenes

Every field of a scene file, made from the declarations in `capture_sim/scene/parts.py`. A part that
is absent costs nothing: `null` takes it off the bench. A plain number is in the unit given here; a
text may have another one, as `'0.5 N/mm'` or `'45 deg'`.

"""


def default_of(field: Field[Any]) -> str:
    """Return the default as text; empty where the field must be given."""
    value = field.default
    if value is MISSING:
        return ""
    return "not set" if value is None else f"`{value}`"


def range_of(what: Declared) -> str:
    """Return what a field must be, as text."""
    kinds = {bool: "true or false", str: "text", tuple: "three points [x, y]"}
    return str(what.allowed or ", ".join(what.options) or kinds[what.kind])


def tables(part: type, path: str) -> list[str]:
    """Return one table a part, its own numbers first, the parts in it after."""
    rows, inner = [], []
    for field in fields(part):
        name = f"{path}.{field.name}" if path else field.name
        what = declared(part)[field.name]
        if is_dataclass(what.kind):
            inner += tables(what.kind, name)
        else:
            cells = (f"`{name}`", what.unit, range_of(what), default_of(field), what.doc)
            rows.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    head = [
        "",
        f"## {path or 'scene'}",
        "",
        "| field | unit | range | default | meaning |",
        "|---|---|---|---|---|",
    ]
    return (head + rows if rows else []) + inner


def on_files(files: Files, config: Any) -> Files:
    """Add the generated page."""
    text = HEAD + "\n".join(tables(Scene, "")) + "\n"
    files.append(File.generated(config, "scene_reference.md", content=text))
    return files


def on_page_content(html: str, **_: Any) -> str:
    """Take Sphinx's roles off the names in docstrings, and put the formulas in."""
    html = re.sub(r":(?:attr|class|data|func|meth|mod):(?=<code>)", "", html)
    html = re.sub(r"<p>(formulab[0-9a-f]+end)</p>", r"\1", html)
    return MARK.sub(lambda mark: mathml(bytes.fromhex(mark[2]).decode(), mark[1] == "b"), html)


def mathml(formula: str, is_block: bool) -> str:
    """Return a formula of LaTeX as MathML."""
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


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Mark the formulas."""
    return with_marks(markdown)
