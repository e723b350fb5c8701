"""Writes what pages say of interfaces, from the code: scenes.md, and the marked parts of others.

    python -m tools.reference docs

A part of a page is between two marks, see :data:`PARTS`.  The test in tests/docs compares the
committed pages with it.  ``--pictures`` also draws each packaged scene into ``docs/scenes``.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from capture_sim.base.files import whole_file
from capture_sim.hardware.messages import HOLD, RIG_TIP, TIP, TIP_WRENCH
from capture_sim.messages.topics import CHASER_CMD_WRENCH, ROLL, TARGET_CMD_WRENCH, TOPICS
from capture_sim.plausibility.rules import in_order
from capture_sim.run.simulation import simulate
from capture_sim.scene.files import scene_names
from capture_sim.scene.laws import CONTACT_LAWS, NEED_POSITIVE_RESTITUTION
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.scene.quantities import Declared, declared
from capture_sim.viewing import style
from capture_sim.viewing.canvas import draw_shapes, save, subplots
from capture_sim.viewing.curves import HOLDS, plotted_runs, split
from capture_sim.viewing.drawing import frame_bounds
from capture_sim.viewing.shapes import cone_shapes, tip_in_cone
from capture_sim.viewing.source import verdict
from tools import tables_of_commands
from tools.explain import draw_scale

ROOT = Path(__file__).resolve().parent.parent
HEAD = """# Scenes

<!-- made by `python -m tools.reference docs` -->

A scene is a YAML file that describes a bench. This page is made from the declarations in
`capture_sim/scene/parts.py` and from the packaged scenes. `capture-sim show tilt_0` prints a
complete scene, `capture-sim scenes --template` one with the unit, range and meaning of each field.

A plain number is in the unit given here. A text may have another unit. Units are spelled as in pint
(`N/mm`, `newton/millimeter`, `deg`, `°`, `%`), multiplied by a space, `*` or `·`, with powers `^2`,
`**2` or `²`. `extends` names the scene whose values apply to all fields that the file does not
contain; `null` removes an optional part from the bench.

```yaml title="softer.yaml"
extends: tilt_p10
title: "A softer buffer, no latch"
buffer: {k_A: '0.4 N/mm', c_A: 20.0}
cone: {half_angle: '45 deg'}
latch: null
```

An invalid value is reported in one line: `buffer.k_A = -5 N/m: must be >= 0`.

Five short names are those of every command and call: `c_rr` and `drag` (of both vehicles), `e`
(`contact.restitution`), `mu` (`friction.mu`) and `c_A` (`buffer.c_A`).

Scenes whose name begins with `_` are made for others to extend, and `capture-sim scenes` does not
list them: `_bench`, `_free` and `_table_2` of the paper, and `_loop`, which
[the hardware loop](hardware_in_the_loop.md) takes unless its parameter `scene` names yours.

## From a drawing to a scene

Measure these lengths in your CAD model or on the bench, in the plane of motion:

![Chaser, buffer, cone and their symbols](geometry.svg)

| in the figure | field | measured |
|---|---|---|
| a | `buffer.hinge_offset` | chaser's centre of mass to the hinge, along its heading |
| L_p, R_t | `probe.length`, `probe.tip_radius` | rod without the tip; radius of the tip |
| h_0 | `buffer.rest_length` | hinge to the tip's centre, buffer at rest (default: L_p + R_t) |
| L_C | `cylinder.length` | the buffer's cylinder, which turns with the probe |
| R_c | `cone.R_c` | half-width of BE, the inner edge of the cone |
| L_c | `cone.L_c` | length of a wall, from its inner edge to its lip |
| beta | `cone.half_angle` | angle of a wall to the cone's axis |
| L_T | `cone.L_T` | target's centre of mass to the plane of BE |

`chaser.mass` and `chaser.inertia` apply to the vehicle without probe and cylinder; mass and
inertia of the probe are computed from its density. Start from a packaged scene with `extends` and
replace one part after the other.

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
| `initial` | the tip does not start inside of a wall; it may touch one |
| `buffer.force_table` | rules of a [measured spring](forces.md#measured-spring) |
| `contact.force_table` | rules of a [contact of your own](own_contact.md) |
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
    kinds = {bool: "true or false", str: "text"}
    return str(what.allowed or what.points or ", ".join(what.options) or kinds[what.kind])


def description(part: type, *, is_optional: bool) -> str:
    """Return what a part is, from its docstring, and whether a bench may be without it."""
    text = " ".join((part.__doc__ or "").partition("    Attributes\n")[0].split())
    return f"{text} Optional." if is_optional else text


def tables(
    part: type, path: str, shown: dict[type, str], *, is_optional: bool = False
) -> list[str]:
    """Return one section for each part: its own fields first, then the parts in it.

    ``shown`` are the paths of the parts that have a section; a second one of a kind refers to it.
    """
    if part in shown:
        return ["", f"### {path}", "", f"The same fields as `{shown[part]}`."]
    shown[part] = path
    rows, inner = [], []
    for field in fields(part):
        name = f"{path}.{field.name}" if path else field.name
        what = declared(part)[field.name]
        if is_dataclass(what.kind):
            inner += tables(what.kind, name, shown, is_optional=what.optional)
        else:
            cells = (f"`{name}`", what.unit, range_of(what), default_of(field), what.doc)
            rows.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    section = ["", f"### {path or 'scene'}", "", description(part, is_optional=is_optional)]
    if rows:
        section += [
            "",
            "| field | unit | range | default | meaning |",
            "|---|---|---|---|---|",
            *rows,
        ]
    return section + inner


def catalogue() -> list[str]:
    """Return the section on the packaged scenes: name, title and picture of each."""
    lines = [
        "## Packaged scenes",
        "",
        "Path of the tip's centre in the cone, from above: black while free, orange while it",
        "touches a wall, blue once it is latched. The circle is the capture zone.",
        "`capture-sim scenes` lists them, `capture-sim show NAME` prints one.",
        "",
        "| scene | title | path of the tip |",
        "|---|---|---|",
    ]
    for name in scene_names():
        title = load_scene(name).title
        lines.append(f"| `{name}` | {title} | ![Path of the tip in {name}](scenes/{name}.svg) |")
    return lines


def scenes_page() -> str:
    """Return docs/scenes.md."""
    laws = ", ".join(f"`{law}`" for law in CONTACT_LAWS if law in NEED_POSITIVE_RESTITUTION)
    body = [*catalogue(), "", "## Fields", *tables(Scene, "", {})]
    return HEAD + "\n".join(body) + "\n" + RULES.format(positive=laws)


FIELD = re.compile(r"^(?P<type>[\w/\[\]]+) (?P<name>\w+)(?: +[^#=]+?)? *(?:# ?(?P<comment>.*))?$")
CONSTANT = re.compile(
    r"^(?P<type>\w+) (?P<name>[A-Z][A-Z0-9_]*) *= *(?P<value>\w+) *(?:# ?(?P<comment>.*))?$"
)
CONTINUED = re.compile(r"^ {8,}# ?(?P<comment>.*)$")  # of the comment of the line before


def message_rows(text: str) -> list[list[str]]:
    """Return name, type and content of each constant and each field of a message, in its order."""
    rows: list[list[str]] = []
    for line in text.splitlines():
        found = CONSTANT.match(line) or FIELD.match(line)
        if found:
            value = found.groupdict().get("value")
            name = found["name"] if value is None else f"{found['name']} = {value}"
            rows.append([name, found["type"], found["comment"] or ""])
        elif rows and (more := CONTINUED.match(line)):
            rows[-1][2] += f" {more['comment']}"
    return rows


def sample_meanings() -> dict[str, str]:
    """Return what each field of a sample is, without its unit, from BenchState.msg."""
    text = (ROOT / "msg" / "BenchState.msg").read_text(encoding="utf-8")
    return {name: comment for name, _, comment in message_rows(text)}


def quality_of_service() -> str:
    """Return the quality of service of each topic that the nodes describe as data."""
    described = [
        *TOPICS,
        ROLL,
        CHASER_CMD_WRENCH,
        TARGET_CMD_WRENCH,
        TIP,
        RIG_TIP,
        TIP_WRENCH,
        HOLD,
    ]
    lines = ["| topic | type | history | durability |", "|---|---|---|---|"]
    for topic in described:
        history = f"KEEP_LAST, depth {topic.depth}" if topic.keeps_last else "KEEP_ALL"
        kept = "transient local" if topic.transient_local else "volatile"
        lines.append(f"| `{topic.name}` | {topic.type_name} | {history} | {kept} |")
    return "\n".join(lines)


def table_of_rules() -> str:
    """Return the rules of plausibility as a table in Markdown."""
    head = "| rule | grade | compares | broken | reason of the threshold |\n|---|---|---|---|---|\n"
    return head + "".join(
        f"| `{each.name}` | {each.grade} | {each.compares} | {each.threshold} | {each.reason} |\n"
        for each in in_order()
    )


PART = re.compile(
    r"<!-- generated: (?P<name>[\w ]+) -->\n.*?\n?<!-- end of generated -->", re.DOTALL
)
#: What stands between ``<!-- generated: NAME -->`` and ``<!-- end of generated -->``, on any page.
PARTS: dict[str, Callable[[], str]] = {
    "quality of service": quality_of_service,
    "rules": table_of_rules,
    "exit statuses": tables_of_commands.statuses,
    "exit statuses of nodes": tables_of_commands.statuses_of_nodes,
    "results": tables_of_commands.results,
}
#: What the site has in place of ``<!-- on the site: NAME -->``: the programs print it, too.
ON_THE_SITE: dict[str, Callable[[], str]] = {
    "commands": tables_of_commands.commands,
    "variables": lambda: tables_of_commands.variables(sample_meanings()),
}


def filled(page: str) -> str:
    """Return a page with its generated parts as they are now; KeyError for an unknown part."""

    def part(found: re.Match[str]) -> str:
        name = found["name"]
        return f"<!-- generated: {name} -->\n\n{PARTS[name]()}\n\n<!-- end of generated -->"

    return PART.sub(part, page)


def pages_with_parts(docs: Path) -> list[Path]:
    """Return the pages of a folder, and of those in it, that have generated parts."""
    pages = sorted(docs.rglob("*.md"))
    return [page for page in pages if PART.search(page.read_text(encoding="utf-8"))]


def draw_scene(name: str) -> Figure:
    """Draw the path of the tip's centre in the cone, in the run of a packaged scene."""
    [plotted] = plotted_runs(simulate(name))
    figure, [[axes]] = subplots(3.1, 2.9, grid=None)
    draw_shapes(axes, cone_shapes(plotted.scene).values(), 1e3)
    path = tip_in_cone(plotted.samples) * 1e3
    for hold, colour in zip(HOLDS, (style.BLACK, style.VERMILION, style.BLUE), strict=True):
        part = split(path, plotted.holds).get(hold)
        if part is not None:
            axes.plot(*part[::4].T, color=colour, lw=1.2, zorder=5)
    draw_scale(axes, (15.0, -62.0), 20.0, "20 mm")
    (_, _), bounds = frame_bounds(plotted.scene)
    axes.set(xlim=(-115.0, 40.0), ylim=bounds, aspect="equal")
    axes.set_axis_off()
    axes.set_title(verdict(plotted.run), fontsize=13)
    return figure


def main() -> None:
    """Write the pages, and the pictures if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("docs", type=Path, help="folder of the pages")
    parser.add_argument("--pictures", action="store_true", help="draw the packaged scenes, too")
    asked = parser.parse_args()
    texts = {p: filled(p.read_text(encoding="utf-8")) for p in pages_with_parts(asked.docs)}
    texts[asked.docs / "scenes.md"] = scenes_page()
    for path, text in texts.items():
        with whole_file(path) as part:
            part.write_text(text, encoding="utf-8")
    if asked.pictures:
        (asked.docs / "scenes").mkdir(exist_ok=True)
        for name in scene_names():
            save(draw_scene(name), asked.docs / "scenes" / f"{name}.svg")


if __name__ == "__main__":
    main()
