"""``capture-sim calibrate``: fit the parameters of a bench to its trials, and predict a trial."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from capture_sim.base.exit_status import FAILED, INTERRUPTED, OK
from capture_sim.base.files import write_text
from capture_sim.base.tables import Section, print_table, table_text, transcript
from capture_sim.commands.compiling import compile_first
from capture_sim.commands.inputs import (
    add_geometry,
    add_out,
    add_overrides,
    add_release,
    add_remaps,
    add_seed,
    add_workers,
    is_recording,
    not_negative,
    prepare_folder,
    whole,
)
from capture_sim.commands.output import (
    Progress,
    command_line,
    drawing,
    echo,
    give,
    write_json,
)
from capture_sim.commands.recordings import RecordingReader
from capture_sim.errors import SceneError
from capture_sim.recording.bag_folder import sha256_of
from capture_sim.run.run import Run
from capture_sim.scene.files import scene_names
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.studies.evaluate.executors import open_executor
from capture_sim.studies.fit.calibrate import TOUCHES, calibrate, predicted
from capture_sim.studies.fit.checks import ALARM_BLOCKS, PHASES, neighbours
from capture_sim.studies.fit.descent import RESTARTS
from capture_sim.studies.fit.files import JSON, SCENE, as_data, scene_text
from capture_sim.studies.fit.parameters import DEFAULT, SENSOR_ERRORS, read_weighed
from capture_sim.studies.fit.prediction import (
    Prediction,
    read_placement,
    shown_figure,
)
from capture_sim.studies.fit.result import INSEPARABLE, Calibration
from capture_sim.studies.fit.score_tests import NAMED
from capture_sim.studies.fit.trial import launched
from capture_sim.studies.vary.inputs import Known

DESCRIPTION = (
    "Fit the parameters of a bench to all of its trials, or to one recording. Each trial has its "
    "own start poses and release, which are fitted as well. Measurements after the first "
    "launcher/hold that follows the release are not used. Print values with standard errors and "
    "the tests of the fit; write a calibrated scene, the covariance and plots."
)
FAILS = (
    "the fit is neither found nor usable, with the reasons: searches or trials that do not agree, "
    "residuals that are not noise, something that the model lacks, a value at the end of its "
    "range, or a direction without information"
)
GIVES = "what is in calibration.json"
EXAMPLE = """\
  capture-sim calibrate trial_0.mcap trial_p10.mcap trial_m10.mcap \\
    --weighed chaser.mass='22.6 +- 0.02 kg' --out runs/my_bench
  capture-sim calibrate trial_*.mcap --predict next.yaml --placement '0.2 mm, 1 mrad'"""
#: File for the scene of the trials, which is written if it is not a scene of the package.
_BENCH = "bench.yaml"
#: Captions of the plots on the page, by name; others are of trials.
_CAPTIONS = {
    "values": "Fitted values",
    "correlation": "Correlation of the errors",
    "prediction": "Prediction",
}
#: Number of candidates for what the model lacks that are printed.
_SHOWN = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "trials", nargs="+", metavar="TRIAL", help="recordings: .mcap files, or folders of bags"
    )
    parser.add_argument(
        "--fit",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="fit these parameters: c_rr, e, mu, c_A, fields of the scene, e.g. buffer.k_A, or "
        f"errors of sensors: {', '.join(SENSOR_ERRORS)} (default: {', '.join(DEFAULT)}, as far as "
        "the scene has them)",
    )
    parser.add_argument(
        "--weighed",
        action="append",
        default=[],
        metavar="NAME='VALUE +- ERROR UNIT'",
        help="use a value that is known from elsewhere, e.g. chaser.mass='22.6 +- 0.02 kg'; may be "
        "repeated",
    )
    parser.add_argument(
        "--uncertain",
        action="append",
        default=[],
        metavar="NAME=ERROR",
        help="standard uncertainty of a value that is held, e.g. floor.tilt_x='0.02 mrad' or "
        "target.mass=0.5%%; 0 if it is exact; may be repeated",
    )
    parser.add_argument(
        "--predict",
        metavar="SCENE",
        help="predict this trial: a scene, or a recording, of which only the scene and the launch "
        "are used",
    )
    parser.add_argument(
        "--placement",
        metavar="'LENGTH, ANGLE'",
        help="with --predict, include these standard deviations of the placement of each vehicle, "
        "e.g. '0.2 mm, 1 mrad' (default: placed exactly)",
    )
    parser.add_argument(
        "--touches",
        type=whole(),
        default=TOUCHES,
        metavar="N",
        help="fit time and strength of the first N touches of each trial, as far as its "
        f"measurements resolve them; 0 for none (default: {TOUCHES})",
    )
    parser.add_argument(
        "--restarts",
        type=whole(),
        default=RESTARTS,
        metavar="N",
        help="begin N further searches near the result, which must find no better one (default: "
        f"{RESTARTS})",
    )
    parser.add_argument(
        "--until",
        type=not_negative,
        default=math.inf,
        metavar="S",
        help="use only measurements up to this time, s since the release (default: up to the first "
        "launcher/hold after the release)",
    )
    parser.add_argument(
        "--profile",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="try the standard errors of these fitted parameters: fit all others again with each "
        "of them at -2, -1, 1 and 2 errors",
    )
    add_geometry(parser)
    add_release(parser)
    add_remaps(parser)
    add_overrides(parser)
    add_workers(parser)
    add_seed(parser, "the restarts and of the prediction's draws")
    add_out(parser, "runs/calibration")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    if options.placement and not options.predict:
        raise SceneError("--placement: must be given with --predict")
    placement = read_placement(options.placement) if options.placement else None
    for number, source in enumerate(options.trials):
        if source in options.trials[:number]:
            raise SceneError(f"trial {source}: given twice: must be given once")
    names = None
    if options.fit is not None:
        names = [name for text in options.fit for name in text.split(",") if name]
    to_come = _to_predict(options)
    runs = list(map(RecordingReader.of(options).run, options.trials))
    # now: a fit takes minutes, and by its end a recording may have been moved
    hashes = {run.origin.path: sha256_of(Path(run.origin.path)) for run in runs}
    weighed = _weighed(runs[0].scene, options.weighed)
    prepare_folder(options.out)
    compile_first()
    workers = open_executor(options.workers, options.scheduler)
    with workers as executor, Progress("simulations") as progress:
        found = calibrate(
            runs,
            names,
            weighed=weighed,
            uncertain=_uncertain(options.uncertain),
            until=options.until,
            restarts=options.restarts,
            touches=options.touches,
            profile=options.profile,
            seed=options.seed,
            report=lambda done, _: progress.at("calibrate", done, None),
            executor=executor,
        )
    is_unfinished = unfinished(found)
    if to_come is not None and not is_unfinished:
        prediction = predicted(found, to_come, placement, seed=options.seed)
        found = dataclasses.replace(found, prediction=prediction)
    with transcript() as shown:
        _print(found)
    _write(found, runs, hashes, shown, options)
    if is_unfinished:
        return INTERRUPTED
    return OK if found.is_usable else FAILED


def unfinished(found: Calibration) -> bool:
    """Return True if Ctrl-C has ended the fit."""
    return any(finding.kind == "unfinished" for finding in found.findings)


def _to_predict(options: argparse.Namespace) -> Scene | None:
    if not options.predict:
        return None
    if is_recording(options.predict):
        return launched(RecordingReader(options.remaps, scene=options.scene).run(options.predict))
    return load_scene(options.predict)


def _weighed(scene: Scene, texts: Sequence[str]) -> dict[str, Known]:
    weighed: dict[str, Known] = {}
    for text in texts:
        name, value = read_weighed(scene, text)
        if name in weighed:
            raise SceneError(f"weighed {name}: given twice: must be given once")
        weighed[name] = value
    return weighed


def _uncertain(texts: Sequence[str]) -> dict[str, str]:
    given: dict[str, str] = {}
    for text in texts:
        name, sign, error = (part.strip() for part in text.partition("="))
        if not (name and sign and error) or name in given:
            raise SceneError(f"--uncertain {text}: must be NAME=ERROR, each name once")
        given[name] = error
    return given


#: A held value that the trials find further away is named, in its standard uncertainties.
_FAR = 3.0
#: Share of a parameter's error above which a held value's part in it is named.
_NAMED_SHARE = 0.3


def held_lines(found: Calibration) -> list[str]:
    """Return a line for each parameter to whose error held values add much."""
    lines = []
    for k, name in enumerate(found.names):
        value, error = found.values[k], found.errors[k]
        parts = sorted(found.held, key=lambda one: -abs(one.moves[k]))
        parts = [one for one in parts if abs(one.moves[k]) > _NAMED_SHARE * error][:_SHOWN]
        if not (parts and value and math.isfinite(error)):
            continue
        moved = ", ".join(
            f"{one.name} +- {one.known_to:.2g} {'' if one.unit == '1' else one.unit}".rstrip()
            + f" moves it by {one.moves[k] / value:+.2%}"
            for one in parts
        )
        noise = found.noise_errors[k] / abs(value)
        lines.append(f"{name}: +- {noise:.2%} by noise; held, {moved}")
    for one in found.held:
        off = abs(one.fitted - one.value) / one.error
        if off > _FAR:
            unit = "" if one.unit == "1" else f" {one.unit}"
            lines.append(
                f"held, {one.name} = {one.value:.4g}{unit}: the trials show {one.fitted:.4g} +- "
                f"{one.known_to:.2g}{unit}, {off:.1f} of its standard uncertainties away: correct "
                "it, or mend the bench"
            )
    return lines


def parameter_rows(found: Calibration) -> list[list[str]]:
    """Return a row of text for each fitted parameter, with the columns of :data:`HEAD`."""
    rows = []
    for name, value, error, unit, begun in zip(
        found.names, found.values, found.errors, found.units, found.begun, strict=True
    ):
        share = f"{error / abs(value):.2%}" if value and math.isfinite(error) else "-"
        note = "weighed" if name in found.weighed else ""
        unit = "" if unit == "1" else unit
        rows.append([name, f"{value:.6g}", f"{error:.2g}", share, unit, f"{begun:.6g}", note])
    return rows


HEAD = ["parameter", "value", "+-", "%", "unit", "start", ""]


def print_starts(found: Calibration) -> None:
    """Print a table of the start of each trial, and the time up to which the trial was used.

    A start is the fitted poses of both vehicles less the poses of the scene, and the release time.
    """
    assert found.problem is not None
    rows = []
    has_release = any(start.is_release_fitted for start in found.starts)
    for start, trial in zip(found.starts, found.problem.trials, strict=True):
        initial = trial.scene.initial
        row = [Path(start.trial).name]
        for pose, k in ((initial.chaser, 0), (initial.target, 3)):
            scene = (pose.x, pose.y, pose.theta)
            for i in range(3):
                off, error = start.values[k + i] - scene[i], start.errors[k + i]
                row.append(f"{off * 1e3:+.3f} +- {error * 1e3:.2g}")
        release = f"{start.release * 1e3:+.2f} +- {start.release_error * 1e3:.2g}"
        if has_release:
            row.append(release if start.is_release_fitted else "known")
        row.append(f"{start.end:.3f}")
        row.append("launcher/hold" if start.end >= start.cut - 0.05 else "")
        rows.append(row)
    head = ["start less scene", "chaser x, mm", "y, mm", "theta, mrad"]
    head += ["target x, mm", "y, mm", "theta, mrad", *(["release, ms"] if has_release else [])]
    head += ["used to, s", "ended by"]
    print_table(head, rows)


def _print(found: Calibration) -> None:
    print_table(HEAD, parameter_rows(found))
    for i, first in enumerate(found.names):
        for j, second in enumerate(found.names[:i]):
            if abs(found.correlation[i, j]) > INSEPARABLE:
                echo(f"{second} and {first} are hard to separate: {found.correlation[i, j]:+.3f}")
    print_starts(found)
    for line in (*found.notes, *held_lines(found), *_test_lines(found)):
        echo(line)
    if found.prediction is not None:
        _print_prediction(found.prediction)
    for line in verdict_lines(found):
        echo(line)


def verdict_lines(found: Calibration) -> list[str]:
    """Return the verdict with its reasons, one in a line."""
    if found.is_found:
        return ["found: all tests passed"]
    lines = [f"{found.verdict}: {finding.line}" for finding in found.findings]
    if found.is_usable:
        lines.append("usable: the errors above are enlarged by what these residuals pull them by")
    return lines


def _test_lines(found: Calibration) -> list[str]:
    """Return lines with the results of the tests of a fit, to be printed and written to a file."""
    lines = [profile.text for profile in found.profiles]
    lines += [
        f"chi2 {found.reduced_chi2:.4g} per degree of freedom ({found.freedom}), "
        f"{found.simulations} simulations",
        f"converged to {found.left:.2g} standard errors",
    ]
    if found.restarts:
        higher, apart = (max(column) for column in zip(*found.restarts, strict=True))
        lines[-1] += (
            f"; {len(found.restarts)} restarts ended within {apart:.2g} standard errors of it, "
            f"chi2 up to {max(higher, 0.0):.2g} higher"
        )
    if found.agreement.freedom:
        agreement = found.agreement
        lines.append(
            f"trials: chi2 {agreement.statistic:.4g} for {agreement.freedom} that they have the "
            f"same parameters, p = {agreement.p:.2g}"
        )
    if found.blocks:
        worst = min(found.blocks, key=lambda block: block.p)
        lines.append(
            f"residuals: {len(found.blocks)} sets of means over 30 ms, least p = {worst.p:.2g}, "
            f"{min(worst.p * len(found.blocks), 1.0):.2g} for so many"
        )
    if found.scores:
        best = ", ".join(f"{s.name} {s.gain:.3g}" for s in found.scores[:_SHOWN])
        lines.append(
            f"{len(found.scores)} candidates for what the model lacks; largest gains of chi2: "
            f"{best} (named above {NAMED:g})"
        )
    return lines


def residual_rows(found: Calibration) -> list[list[str]]:
    """Return a row for each measured part of each trial, with the columns of RESIDUALS.

    A phase has chi2 of the means over 30 ms per mean, and a star where noise does not explain it.
    """
    assert found.problem is not None
    assert found.linear is not None
    means = {(b.trial, b.channel, b.part, b.phase): b for b in found.blocks}
    alike = neighbours(found.linear, found.problem)
    rows = []
    for n, trial in enumerate(found.problem.trials):
        for channel, of_parts in zip(trial.channels, alike[n], strict=True):
            for part, correlation in enumerate(of_parts):
                axis = ("x", "y", "theta")[part] if len(of_parts) == 3 else ""
                row = [Path(trial.name).name, f"{channel.name} {axis}".strip()]
                for phase in PHASES:
                    mean = means.get((n, channel.name, part, phase))
                    star = "*" if mean and mean.p * len(found.blocks) < ALARM_BLOCKS else ""
                    row.append(f"{mean.statistic / mean.means:.2f}{star}" if mean else "-")
                rows.append([*row, f"{correlation:+.2f}"])
    return rows


RESIDUALS = ["chi2 per mean", "of", *PHASES, "neighbours"]


def left_out_rows(found: Calibration) -> list[list[str]]:
    """Return a row for each parameter: its change if a trial were left out, in its errors."""
    off = found.left_out
    moved = np.divide(off, found.errors, out=np.zeros_like(off), where=found.errors > 0.0)
    return [[name, *(f"{each:+.1f}" for each in moved[:, k])] for k, name in enumerate(found.names)]


def _more_tables(found: Calibration) -> list[Section]:
    """Return the tables that are too long for the terminal."""
    heading = "Residuals by trial, part and phase; neighbours: correlation of successive ones"
    sections = [Section(heading, head=RESIDUALS, rows=residual_rows(found))]
    if len(found.starts) > 1:
        head = ["without", *(Path(start.trial).name for start in found.starts)]
        heading = "Change of each value, in its errors, if one trial were left out"
        sections.append(Section(heading, head=head, rows=left_out_rows(found)))
    return sections


def _print_prediction(prediction: Prediction) -> None:
    rows = []
    for figure in prediction.figures:
        meaning, factor, unit = shown_figure(figure.name)
        rows.append(
            [
                f"{meaning}, {unit}",
                f"{figure.value * factor:.4f}",
                f"{figure.error * factor:.2g}",
                f"{figure.low * factor:.4f}",
                f"{figure.high * factor:.4f}",
            ]
        )
    print_table(["predicted", "value", "+- by parameters", "95 % from", "to"], rows)
    placement = prediction.placement
    how = "both vehicles placed exactly: give --placement for a real trial"
    if placement is not None:
        how = (
            f"with a placement of {placement.position * 1e3:.3g} mm, "
            f"{placement.angle * 1e3:.3g} mrad"
        )
    echo(f"{prediction.scene.name}, {how}")
    if prediction.failed:
        echo(f"{prediction.failed} draws could not be simulated")


def _write(
    found: Calibration,
    runs: Sequence[Run],
    hashes: Mapping[str, str],
    shown: Sequence[str | Section],
    options: argparse.Namespace,
) -> None:
    """Write the calibrated scene, the values as JSON, table, plots and page to ``--out``."""
    out: Path = options.out
    scene = runs[0].scene
    extends = _extended(scene, out)
    title = f"{scene.title}, calibrated by {len(runs)} trial{'s' if len(runs) > 1 else ''}"
    path = write_text(out / SCENE, scene_text(found, scene, extends, title))
    load_scene(path)  # what is written can be read
    echo(f"calibrated scene in {path}")
    data = as_data(found, hashes)
    give(lambda: data)
    echo(f"values, covariance and tests in {write_json(out / JSON, data)}")
    lines = [table_text(HEAD, parameter_rows(found)), ""]
    lines += [*found.notes, *held_lines(found), *_test_lines(found)]
    lines += verdict_lines(found)
    tables = [] if unfinished(found) else _more_tables(found)
    for table in tables:
        lines += ["", table.name, table_text(table.head, table.rows, left=2)]
    write_text(out / "calibration.txt", "\n".join(lines) + "\n")
    with drawing():
        from capture_sim.viewing.calibration import draw_calibration
        from capture_sim.viewing.canvas import save
        from capture_sim.viewing.study_page import drawn, save_page

        figures = draw_calibration(found)
        for name, figure in figures.items():
            echo(f"plot in {save(figure, out / f'{name}.png')}")
        pictures = {
            name: drawn({_CAPTIONS.get(name, f"Trial {name}"): figure})
            for name, figure in figures.items()
        }
        asked = {
            "result": "; ".join(verdict_lines(found)),
            "command": command_line(),
            "scene": f"{scene.name}: {scene.title}",
            "trials": ", ".join(start.trial for start in found.starts),
            "fitted": ", ".join(found.names),
            "weighed": "; ".join(options.weighed) or "nothing",
        }
        files = {"calibrated scene": SCENE, "values, covariance and tests": JSON}
        page = save_page(
            out / "calibration.html",
            f"Calibration: {scene.name}",
            asked,
            [each for name in pictures if name in _CAPTIONS for each in pictures[name]],
            [*shown, *tables],
            files=files,
            last=[each for name in pictures if name not in _CAPTIONS for each in pictures[name]],
            scene=scene,
        )
        echo(f"page in {page}")


def _extended(scene: Scene, folder: Path) -> str:
    """Return the name of the scene that the calibrated scene extends.

    If ``scene``, the scene of the trials, is not a scene of the package, it is written to the
    folder as ``bench.yaml``, and the name is ``bench``.
    """
    if scene.name in scene_names() and load_scene(scene.name) == scene:
        return scene.name
    write_text(folder / _BENCH, scene.to_yaml())
    return _BENCH.removesuffix(".yaml")
