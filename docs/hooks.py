"""Adds the scene reference, made from the code, and typesets formulas as MathML."""

from __future__ import annotations

import re
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

from docutils.utils.math.latex2mathml import tex2mathml
from mkdocs.structure.files import File, Files

from capture_sim.model.contact import NEED_POSITIVE_RESTITUTION
from capture_sim.scene.parts import CONTACT_LAWS, Scene
from capture_sim.scene.quantities import Declared, declared

FENCE = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<![\\$\w])\$(?=\S)([^$\n]+?)(?<=\S)\$(?![$\w])")
MARK = re.compile(r"formula([bi])((?:[0-9a-f]{2})+)end")
#: docutils reads all digits as one argument, TeX only the first.
UNBRACED = re.compile(r"(?:\\frac|\\sqrt|[\^_])\s*\d{2,}")
HEAD = """# Scenes

A scene is a YAML file that describes a bench. This page lists every field; it is made from the
declarations in `capture_sim/scene/parts.py`. `capture-sim show tilt_0` prints a complete scene.

A plain number is in the unit given here. A text may have another unit. `extends` names the scene
whose values apply to all fields that the file does not contain; `null` removes an optional part
from the bench.

```yaml
extends: tilt_p10
title: "A softer buffer, no latch"
buffer: {k_A: '0.4 N/mm', c_A: 20.0}
cone: {half_angle: '45 deg'}
latch: null
```

An invalid value is reported in one line: `buffer.k_A = -5 N/m: must be >= 0`.

"""
RULES = """
## Rules between fields

| field | rule |
|---|---|
| `string` | exactly two of `impact_speed`, `hanging_mass`, `drop_height`; the third is computed |
| `string` | needs a `rail`, and a chaser that starts from rest |
| `string.hanging_mass` | overcomes the rolling resistance |
| `string.drop_height` | at most `rail.length`: the mass lands before the rail ends |
| `rail.length` | less than the chaser's travel to the first touch |
| `initial.chaser` | on the rail: no rotation, velocity forwards along the heading |
| `initial.target` | at rest while the scene has a rail |
| `supports.*.balls` | a triangle around the vehicle's centre of mass |
| `cone.R_c`, `buffer.rest_length` | greater than the tip's radius; `R_c` may be equal to it |
| `latch.radius` | less than the depth of the cone, `L_c` times the cosine of `half_angle` |
| `stops.extension` | null with a `buffer.preload` |
| `contact.restitution` | > 0 with the laws {positive} |
| `friction.mu_s` | at least `friction.mu` |
| `run.rate`, `sensors.*.rate` | `run.state_rate` divided by a whole number |
"""


def default_of(field: Field[Any]) -> str:
    """Return the default as text; empty where the field must be given."""
    value = field.default
    if value is MISSING:
        return ""
    if value is None:
        return "not set"
    return f"`{value}`".lower() if isinstance(value, bool) else f"`{value}`"


def range_of(what: Declared) -> str:
    """Return what a field must be, as text."""
    kinds = {bool: "true or false", str: "text", tuple: "three points [x, y]"}
    return str(what.allowed or ", ".join(what.options) or kinds[what.kind])


def description(part: type, *, is_optional: bool) -> str:
    """Return what a part is, from its docstring, and whether a bench may be without it."""
    text = " ".join((part.__doc__ or "").partition("    Attributes\n")[0].split())
    return f"{text} Optional." if is_optional else text


def tables(part: type, path: str, *, is_optional: bool = False) -> list[str]:
    """Return one section for each part: its own fields first, then the parts in it."""
    rows, inner = [], []
    for field in fields(part):
        name = f"{path}.{field.name}" if path else field.name
        what = declared(part)[field.name]
        if is_dataclass(what.kind):
            inner += tables(what.kind, name, is_optional=what.optional)
        else:
            cells = (f"`{name}`", what.unit, range_of(what), default_of(field), what.doc)
            rows.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    section = ["", f"## {path or 'scene'}", "", description(part, is_optional=is_optional)]
    if rows:
        section += [
            "",
            "| field | unit | range | default | meaning |",
            "|---|---|---|---|---|",
            *rows,
        ]
    return section + inner


def on_files(files: Files, config: Any) -> Files:
    """Add the generated page."""
    laws = ", ".join(f"`{law}`" for law in CONTACT_LAWS if law in NEED_POSITIVE_RESTITUTION)
    text = HEAD + "\n".join(tables(Scene, "")) + "\n" + RULES.format(positive=laws)
    files.append(File.generated(config, "scene_reference.md", content=text))
    return files


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


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Mark the formulas."""
    return with_marks(markdown)
