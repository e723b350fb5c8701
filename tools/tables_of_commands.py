"""Tables of the commands, of their results and of a unit's variables, for the pages in docs."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby

from capture_sim.base.exit_status import OF_COMMANDS, OF_NODES
from capture_sim.cli import command_parser
from capture_sim.commands import COMMANDS, GROUPS
from capture_sim.dynamics.bench import Bench
from capture_sim.fmu.variables import Kind, inputs, outputs, parameters
from capture_sim.run.loads import LOADS
from capture_sim.run.summary import KEYS
from capture_sim.run.summary_table import COLUMNS
from capture_sim.scene.loading import load_scene

#: An option that as many commands have, with the same meaning, stands in a table of its own.
_SHARED = 3


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows as a table of Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    cells = ([str(cell).replace("|", r"\|") for cell in line] for line in lines)
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


class _Option:
    """An argument of a command as a reader types it, and its meaning with its default."""

    def __init__(self, parser: argparse.ArgumentParser, action: argparse.Action) -> None:
        value = ""
        if action.nargs != 0:
            metavar = action.metavar or "|".join(map(str, action.choices or ()))
            value = " ".join(metavar) if isinstance(metavar, tuple) else metavar
            value = value or action.dest.upper()
            value = {"?": f"[{value}]", "+": f"{value}..."}.get(str(action.nargs), value)
        self.typed = f"`{' '.join(filter(None, [', '.join(action.option_strings), value]))}`"
        formatter = parser._get_formatter()
        text = formatter._expand_help(action) if action.help else ""
        if action.choices and action.option_strings and action.metavar is not None:
            text += f"; one of {', '.join(map(str, action.choices))}"
        self.meaning = text

    @property
    def row(self) -> tuple[str, str]:
        """What a reader types, and what it means."""
        return self.typed, self.meaning


def _options(command: str) -> list[_Option]:
    parser = command_parser(command)
    actions = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    return [_Option(parser, a) for a in actions if "--help" not in a.option_strings]


def commands() -> str:
    """Return a section for each command: usage, options, and when its exit status is 1."""
    options = {command: _options(command) for command in COMMANDS}
    count = Counter(option.row for some in options.values() for option in some)
    shared = [row for row, n in count.items() if n >= _SHARED]
    lines = ["### Options of several commands", ""]
    owners = {
        row: ", ".join(c for c, some in options.items() if row in [o.row for o in some])
        for row in shared
    }
    lines += [table(("option", "meaning", "commands"), [(*r, owners[r]) for r in shared]), ""]
    for group in GROUPS.values():
        for command, line in group.items():
            lines += [f"### {command}", "", f"{line[0].upper()}{line[1:]}.", ""]
            own = [o.row for o in options[command] if o.row not in shared]
            if own:
                lines += [table(("argument", "meaning"), own), ""]
            also = [
                f"`{row[0].split()[0].strip('`')}`"
                for row in shared
                if row in [o.row for o in options[command]]
            ]
            if also:
                lines += [f"Also {', '.join(also)}, [as above](#options-of-several-commands).", ""]
            if reason := command_parser(command).get_default("fails"):
                lines += [f"Exit status 1: {reason}.", ""]
    return "\n".join(lines).rstrip()


def statuses() -> str:
    """Return the exit statuses of commands and of nodes."""
    rows = [(str(status), text, OF_NODES.get(status, "")) for status, text in OF_COMMANDS.items()]
    return table(("exit status", "of a command", "of a node"), rows)


def statuses_of_nodes() -> str:
    """Return the exit statuses of nodes."""
    return table(("status", "meaning"), [(str(k), text) for k, text in OF_NODES.items()])


def results() -> str:
    """Return the keys of results.json, with units and the columns of results.txt."""
    shown = {column.key: column for column in COLUMNS}

    def in_table(key: str) -> str:
        column = shown.get(key)
        if column is None:
            return ""
        return " ".join(
            filter(None, [column.group, column.name, column.unit and f"({column.unit})"])
        )

    rows = [(f"`{key}`", unit, in_table(key), text) for key, (unit, text, _) in KEYS.items()]
    loads = [(f"`{load.key}`", load.unit, in_table(load.key), load.meaning) for load in LOADS]
    measured = ", ".join(f"`{load.key}`" for load in LOADS if load.is_measured)
    head = ("key", "unit", "in results.txt", "meaning")
    endings = [
        ("none, `_time`", "value of the whole run, and its time (s since the release)"),
        ("`_before_latch`, `_before_latch_time`", "value until the latch closes, and its time"),
        ("`_low`, `_high`", f"bounds in the whole run, of {measured}; `null`: not known"),
    ]
    return "\n".join(
        [
            table(head, rows),
            "",
            "Each load has four keys, by their endings; `max_latch_force` has no `_before_latch`:",
            "",
            table(("load", *head[1:]), loads),
            "",
            "Force and torque of the buffer include its stops and seat; torsion is to either side.",
            "",
            table(("ending", "meaning"), endings),
        ]
    )


#: Changes of a packaged scene by which it has every part that a unit's variables come from.
_FULL = {
    "buffer.friction": 1.0,
    "latch": {"radius": 1e-5, "stiffness": 2e4, "damping": 80.0},
    "stops": {"compression": 0.05, "extension": 0.05, "stiffness": 1e5, "damping": 10.0},
    "thrusters": {k: {"force": 1.0, "torque": 1.0} for k in ("chaser", "target")},
}
_FULL_SCENE = "_loop"


def variables(meanings: dict[str, str]) -> str:
    """Return the variables of a unit; ``meanings`` of a sample's fields, each after its unit."""
    scene = load_scene(_FULL_SCENE, _FULL)
    head = ("name", "unit", "range", "meaning")
    settable = [
        (
            f"`{v.name}`",
            v.unit,
            "true or false" if v.kind is Kind.BOOLEAN else str(v.allowed),
            v.meaning,
        )
        for v in parameters(scene, Bench(scene).initial_workspace())
    ]
    fed = [(f"`{v.name}`", v.unit, v.meaning) for v in inputs(scene)]
    read = []
    for field, members in groupby(outputs(), lambda v: v.name.partition(".")[0]):
        some = list(members)
        units = list(dict.fromkeys(v.unit for v in some))
        text = some[0].meaning or meanings.get(field, "")
        if len(units) == 1:  # a message's comment begins with it
            text = text.removeprefix(units[0]).removeprefix(", ")
        read.append((", ".join(f"`{v.name}`" for v in some), ", ".join(units), text))
    parts = {
        "Parameters": table(head, settable),
        "Inputs": table((*head[:2], head[3]), fed),
        "Outputs": table((*head[:2], head[3]), read),
    }
    return "\n\n".join(f"### {name}\n\n{text}" for name, text in parts.items())
