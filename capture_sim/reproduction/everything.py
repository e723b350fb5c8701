"""All of the reproduction in one go: runs, second engine, readings, table, figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from capture_sim.errors import SceneError
from capture_sim.reproduction import claims, drawing, second_engine
from capture_sim.reproduction.cases import run_cases
from capture_sim.reproduction.page import Reproduction
from capture_sim.reproduction.readings import CASES, Scan, scan_readings, vary_together
from capture_sim.scene.files import load_scene
from capture_sim.simulation import simulate
from capture_sim.studies.design import Wish, design_buffer
from capture_sim.studies.executors import Executor
from capture_sim.studies.first_contact import run_first_contact

#: Restitutions at which the undamped first contact is timed.
RESTITUTIONS = (0.2, 0.4, 0.5)

_NUMBERED = [*(picture.name for picture in drawing.PICTURES), *drawing.ENGINE_PICTURES]
FIGURES = (
    *sorted(_NUMBERED, key=lambda name: (int("".join(filter(str.isdigit, name))), name)),
    drawing.READINGS_PICTURE[0],
)


def reproduce(executor: Executor, folder: Path | None, tell: Callable[[str], None]) -> Reproduction:
    """Run and judge everything; draw the figures into ``folder`` (None draws none).

    Raises
    ------
    RecordingError
        A figure cannot be written.
    """
    tell("the paper's cases")
    runs = run_cases()
    durations = claims.contact_durations(
        {
            e: simulate(load_scene("paper_undamped", [f"contact.restitution={e}"]), t_end=0.5)
            for e in RESTITUTIONS
        }
    )
    tell("the design flow")
    undamped = load_scene("paper_undamped")
    own = run_first_contact(undamped)
    design = design_buffer(undamped, Wish(own.axial_stroke, own.torsion))
    missing = second_engine.missing()
    tell(missing or "a second engine: Exudyn")
    comparison = None if missing else second_engine.compare()
    tell("readings, one by one")
    scans = scan_readings(executor)
    tell("readings, together")
    together = vary_together(executor)
    found = Reproduction(
        claims=[
            *claims.buffer_against_clamped(runs),
            *claims.undamped(runs, durations),
            *claims.designed(runs, design),
            *claims.velocities(comparison, missing),
            *claims.docking(runs),
            *claims.cases(runs, scans, together),
            *claims.experiments(runs),
        ],
        scans=scans,
        together=together,
    )
    if folder is None:
        return found
    tell("figures")
    for picture in drawing.PICTURES:
        drawing.save_picture(picture.draw(runs), folder, picture.name)
        found.pictures[picture.name] = picture.title
    if comparison is not None:
        for name, figure in drawing.draw_engines(comparison).items():
            drawing.save_picture(figure, folder, name)
            found.pictures[name] = drawing.ENGINE_PICTURES[name]
    else:
        found.left_out.update(dict.fromkeys(drawing.ENGINE_PICTURES.values(), missing))
    name, title = drawing.READINGS_PICTURE
    drawing.save_picture(_draw_scans(scans), folder, name)
    found.pictures[name] = title
    found.pictures = {key: found.pictures[key] for key in FIGURES if key in found.pictures}
    return found


def reproduce_figure(name: str, executor: Executor, folder: Path) -> Path:
    """Run what one figure needs, and draw it.

    Raises
    ------
    SceneError
        There is no such figure, or the second engine that it needs is not installed.
    """
    if name == drawing.READINGS_PICTURE[0]:
        return drawing.save_picture(_draw_scans(scan_readings(executor)), folder, name)
    if name in drawing.ENGINE_PICTURES:
        missing = second_engine.missing()
        if missing:
            raise SceneError(f"--only {name}: {missing}")
        figures = drawing.draw_engines(second_engine.compare())
        return drawing.save_picture(figures[name], folder, name)
    for picture in drawing.PICTURES:
        if picture.name == name:
            return drawing.save_picture(picture.draw(run_cases(picture.cases)), folder, name)
    raise SceneError(f"--only {name}: allowed are {', '.join(FIGURES)}")


def _draw_scans(scans: list[Scan]) -> object:
    from capture_sim.viewing.readings_map import draw_readings

    captured = [
        {case: [point.captured for point in scan.points[case]] for case in CASES} for scan in scans
    ]
    return draw_readings([scan.reading for scan in scans], captured, CASES)
