"""Adds what is made from the code: the scene reference and the list of public names."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, get_args, get_type_hints

from mkdocs.structure.files import File, Files

import capture_sim
from capture_sim.scene.parts import Scene

PUBLIC = "<!-- public names -->"
HEAD = """# Scenes

Every field of a scene file, made from the declarations in `capture_sim/scene/parts.py`. A part that
is absent costs nothing: `null` takes it off the bench.

"""


def default_of(field: Field[Any]) -> str:
    """Return the default as text; empty where the field must be given."""
    value = field.default
    if value is MISSING:
        return ""
    return "not set" if value is None else f"`{value}`"


def part_of(hint: object) -> type | None:
    """Return the dataclass in a type hint, as in `Buffer | None`; None if there is none."""
    return next(
        (t for t in (hint, *get_args(hint)) if isinstance(t, type) and is_dataclass(t)), None
    )


def tables(part: type, path: str) -> list[str]:
    """Return one table a part, its own numbers first, the parts in it after."""
    hints = get_type_hints(part)
    rows, inner = [], []
    for field in fields(part):
        name = f"{path}.{field.name}" if path else field.name
        nested = part_of(hints[field.name])
        if nested is not None:
            inner += tables(nested, name)
        elif "allowed" in field.metadata or "options" in field.metadata:
            allowed = field.metadata.get("allowed") or ", ".join(field.metadata["options"])
            unit = field.metadata.get("unit", "")
            doc = field.metadata.get("doc", "")
            cells = (f"`{name}`", unit, str(allowed), default_of(field), doc)
            rows.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    head = [
        "",
        f"## {path or 'scene'}",
        "",
        "| field | unit | allowed | default | meaning |",
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
