"""``capture-sim fmu``: write a scene as an FMI 3.0 unit or as a library in C."""

from __future__ import annotations

import argparse
from pathlib import Path

from capture_sim.base.exit_status import OK
from capture_sim.base.files import file_problem, is_device, writing_problem
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import add_overrides, load
from capture_sim.commands.output import echo
from capture_sim.errors import SceneError
from capture_sim.fmu.description import write_fmu
from capture_sim.fmu.library import make_unit, write_library

DESCRIPTION = "Write a scene as a co-simulation unit (FMI 3.0) or as a library in C."
EXAMPLE = "  capture-sim fmu tilt_0 --out tilt_0.fmu\n  capture-sim fmu tilt_0 --c build/tilt_0"
#: File suffix of a co-simulation unit; FMI tools open no files with another suffix.
SUFFIX = ".fmu"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="SCENE", help="name, YAML file or recording")
    add_overrides(parser)
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the unit to FILE, which gets the suffix .fmu if it lacks it (default: "
        "SCENE.fmu)",
    )
    form.add_argument(
        "--c", type=Path, metavar="FOLDER", help="write a shared library and its header instead"
    )
    parser.add_argument(
        "--portable",
        action="store_true",
        help="use instructions of every processor of this architecture only; results then differ "
        "by round-off from those of capture-sim on this machine",
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    scene = load(options.scene, options.overrides)
    path = options.out or Path(f"{scene.name}{SUFFIX}")
    if not options.c and path.suffix != SUFFIX and not path.is_dir() and not is_device(path):
        path = path.with_name(path.name + SUFFIX)
        echo(f"--out {options.out}: written to {path}, as FMI tools open files ending in {SUFFIX}")
    reason = writing_problem(options.c) if options.c else file_problem(path)
    if reason:
        raise SceneError(f"{options.c or path}: {reason}")
    compile_first()
    unit = make_unit(scene, portable=options.portable)
    if options.c:
        path = write_library(unit, options.c)
    else:
        write_fmu(unit, path)
    counts = f"{len(unit.parameters)} parameters, {len(unit.inputs)} inputs, "
    counts += f"{len(unit.outputs)} outputs"
    echo(f"{scene.name}: {path}, {path.stat().st_size / 1024:.0f} KiB, {counts}")
    return OK
