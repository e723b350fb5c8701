"""Adds what is made from the code: the scene reference and the list of public names."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

from mkdocs.structure.files import File, Files

import capture_sim
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Declared, declared

PUBLIC = "<!-- public names -->"
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
    """Take Sphinx's roles off the names in docstrings."""
    return re.sub(r":(?:attr|class|data|func|meth|mod):(?=<code>)", "", html)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Name every public name to mkdocstrings where a page asks for them."""
    if PUBLIC not in markdown:
        return markdown
    found = (getattr(capture_sim, name) for name in capture_sim.__all__)
    return markdown.replace(PUBLIC, "\n".join(f"::: {x.__module__}.{x.__name__}" for x in found))
