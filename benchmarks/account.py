"""Where the time of a run goes: the account on docs/evidence/benchmark.md.

    python -m benchmarks.account            # ten minutes; writes the table and the picture
    python -m benchmarks.account --dry      # only shows the table

In a copy of the package one part of the kernels is done twice, to the same result, or left out
where it does not act on the motion: by so much more or less a run of the copy needs.  Every copy
must have the touches of the original, and its steps within 1 %: other code rounds otherwise.  They
run in turn, a process each, and the least processor time counts.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.before import ROOT, Server
from benchmarks.pages import EVIDENCE, table, write_parts
from capture_sim import load_scene

_SOLVER, _STEPS = "dynamics/solver/runge_kutta.py", "dynamics/engine/steps.py"
_SEGMENT, _EQUATIONS = "dynamics/engine/segment.py", "dynamics/model/equations.py"
#: Runs of the account: scene, changes, end (s; 0: where the scene has it).
CASES = {
    "paper_designed to 0.35 s": ("paper_designed", ["run.rtol=1e-6"], 0.35),
    "tilt_0": ("tilt_0", ["run.rtol=1e-6"], 0.0),
    "tilt_p10": ("tilt_p10", ["run.rtol=1e-6"], 0.0),
    "tilt_m10": ("tilt_m10", ["run.rtol=1e-6"], 0.0),
}


class Change(NamedTuple):
    """A text that stands once in a file of the package, and what it is in the copy."""

    file: str
    text: str
    instead: str


class Copy(NamedTuple):
    """A copy of the package: what changes, and whether a part is then done twice or not at all."""

    changes: list[Change]
    twice: bool = True
    base: str = ""  # the copy that it is compared with; the package itself


def _repeated(file: str, text: str) -> Change:
    return Change(file, text, text + text)


_NO_WEIGHTS = [
    Change(
        "dynamics/engine/step_length.py",
        "    return np.array([*lengths, *speeds, *(N_WATCHED - 16) * [energy]])\n",
        "    return np.array([*lengths, *speeds, *(N_WATCHED - 16) * [np.inf + 0 * energy]])\n",
    )
]
_LEDGER_RATES = """\
    f[AXIAL] = out.axial
    f[TORSION] = out.torsion
    f[HYSTERESIS] = out.hysteresis[0]
    f[HYSTERESIS + 1] = out.hysteresis[1]
    f[FRICTION] = out.friction
    f[ROLLING] = out.rolling
    f[LATCH] = out.latch
    f[STOP] = out.stop
    f[IMPULSE] = out.normal[0]
    f[IMPULSE + 1] = out.normal[1]
"""
_ROLLING = """\
            rolling_S = rolling_wrench(y[8], y[9], omega, cS, sS, par.balls_S, par.v_eps_ball)
        if not mode.rest_T:
            rolling_T = rolling_wrench(y[13], y[14], y[15], cT, sT, par.balls_T, par.v_eps_ball)
    out.rolling = rolling_S[3] + rolling_T[3]
"""
# min() keeps the compiler from seeing that both are the same
_ROLLING_TWICE = """\
            rolling_S = rolling_wrench(y[8], y[9], omega, cS, sS, par.balls_S, par.v_eps_ball)
            again = rolling_wrench(
                y[8], y[9], min(omega, 1e300), cS, sS, par.balls_S, par.v_eps_ball
            )
            rolling_S = (rolling_S[0], rolling_S[1], rolling_S[2], min(rolling_S[3], again[3]))
        if not mode.rest_T:
            rolling_T = rolling_wrench(y[13], y[14], y[15], cT, sT, par.balls_T, par.v_eps_ball)
            again = rolling_wrench(
                y[13], y[14], min(y[15], 1e300), cT, sT, par.balls_T, par.v_eps_ball
            )
            rolling_T = (rolling_T[0], rolling_T[1], rolling_T[2], min(rolling_T[3], again[3]))
    out.rolling = rolling_S[3] + rolling_T[3]
"""
_ERROR = """\
        sum5, sum3 = squares_of_sums(
            step.weights, K, step.E_stages, step.E5, step.E3, step.E_count, h, watched
        )
"""
_FACTOR = "        factor = next_factor(error, step.error, stepper.order)\n"
#: The copies, by the part whose cost they show.
COPIES = {
    "equations": Copy(
        [
            _repeated(_SOLVER, "        rhs(t + step.C[s] * h, step.y_stage, step.K[s], system)\n"),
            _repeated(_SOLVER, "        rhs(t + h, step.y_new, K[stages], system)\n"),
        ]
    ),
    "supports": Copy([Change(_EQUATIONS, _ROLLING, _ROLLING_TWICE)]),
    "sums of stages": Copy(
        [
            _repeated(
                _SOLVER,
                "        add_rows(\n            step.y_stage, step.y, step.K, step.A_stages[s], "
                "step.A[s], step.A_count[s], h, states\n        )\n",
            ),
            _repeated(
                _SOLVER,
                "        add_rows(step.y_new, step.y, K, step.A_stages[stages], step.A[stages], "
                "count, h, total)\n",
            ),
        ]
    ),
    "error and next step": Copy(
        [
            Change(
                _SOLVER,
                _ERROR,
                _ERROR
                + _ERROR.replace("sum5, sum3", "again5, again3")
                + "        sum5, sum3 = min(sum5, again5), min(sum3, again3)\n",
            ),
            Change(
                _STEPS,
                _FACTOR,
                _FACTOR
                + "        factor = min(\n            factor, next_factor(min(error, 1e308), "
                "step.error, stepper.order)\n        )\n",
            ),
        ]
    ),
    "distances": Copy([_repeated(_STEPS, "    measure_new_state(w)\n")]),
    "events": Copy(
        [
            Change(
                _SEGMENT,
                "    search_step(w)\n    in_contact",
                "    search_step(w)\n    search_step(w)\n    in_contact",
            )
        ]
    ),
    "extremes": Copy(
        [
            Change(
                _SEGMENT,
                "            watch_extremes(w)\n            watch_loads(w)\n",
                "            pass\n",
            )
        ],
        twice=False,
    ),
    "dense output": Copy(
        [_repeated(_STEPS, "        prepare_dense(w.system, w.stepper, w.step.t0, w.step.h)\n")]
    ),
    "without weights": Copy(_NO_WEIGHTS),
    "ledger": Copy(
        [
            *_NO_WEIGHTS,
            Change(_EQUATIONS, _LEDGER_RATES, ""),
            Change(
                _STEPS,
                "make_stepper(rate_of_change, N_STATE, N_TOTAL, N_WATCHED)",
                "make_stepper(rate_of_change, N_STATE, N_STATE, N_STATE)",
            ),
            # the norm over as many entries as before, or the steps would be others
            Change(_SOLVER, "* watched)\n", f"* {24})\n"),
        ],
        twice=False,
        base="without weights",
    ),
}


def changed(copy: Copy, folder: Path) -> Path:
    """Write a copy of the package into a folder; return that."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("capture_sim", "config", "msg"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "package.xml", folder)
    for change in copy.changes:
        path = folder / "capture_sim" / change.file
        text = path.read_text(encoding="utf-8")
        if text.count(change.text) != 1:
            raise ValueError(f"{change.file} has not once: {change.text!r}")
        path.write_text(text.replace(change.text, change.instead), encoding="utf-8")
    return folder


def least(work: Any, times: int) -> float:
    """Return the least processor time of ``work``, which prepares a job and returns it, s."""
    found = []
    for _ in range(times):
        job = work()
        began = time.process_time()
        job()
        found.append(time.process_time() - began)
    return min(found)


def serve(times: int) -> None:
    """Answer each line on standard input with the least times of all runs, s, as JSON.

    A first line has the counts of each run: steps, rejected steps, touches, evaluations.  Each run
    has three times: without samples, with those of the scene's rate, and of the set-up with the
    first call.
    """
    from capture_sim import Bench  # of the copy, as is load_scene

    runs, counted = [], []
    for name, changes, t_end in CASES.values():
        scene = load_scene(name, changes)
        bench = Bench(scene)
        bench.advance(np.array([t_end] if t_end else []))
        counted.append([bench.statistics.steps, bench.statistics.rejected, len(bench.touches)])
        until = t_end or scene.run.t_end
        sampled = bench.times(0, int(until * scene.run.state_rate) + 1)
        runs.append((scene, np.array([t_end] if t_end else []), sampled))
        counted[-1].append(bench.statistics.evaluations)
    print(json.dumps(counted), flush=True)
    for _ in sys.stdin:
        answer = []
        for scene, end, sampled in runs:

            def run(at: np.ndarray, scene: Any = scene) -> Any:
                bench = Bench(scene)
                return lambda: bench.advance(at)

            def call(scene: Any = scene) -> Any:
                return lambda: Bench(scene).advance(np.array([1e-9]))

            answer.append(
                [
                    least(lambda at=end: run(at), times),
                    least(lambda at=sampled: run(at), times),
                    least(call, times),
                ]
            )
        print(json.dumps(answer), flush=True)


class Account(NamedTuple):
    """A run's parts, ns for each of its evaluations."""

    evaluations: int
    whole: float
    parts: dict[str, float]  # the rest is what they do not explain
    apart: dict[str, float]  # not in the whole

    def all_parts(self) -> dict[str, float]:
        """Return the parts with the rest."""
        return self.parts | {"rest": self.whole - sum(self.parts.values())}


def measure(rounds: int, times: int, folder: Path) -> dict[str, Account]:
    """Measure all copies in turn; return the account of each case."""
    places = {"": ROOT} | {
        name: changed(copy, folder / str(number))
        for number, (name, copy) in enumerate(COPIES.items())
    }
    servers = {name: Server(__file__, place, times) for name, place in places.items()}
    counted = {name: server.answer() for name, server in servers.items()}
    for name, copy in COPIES.items():
        if name != "without weights":
            for (steps, _, touches, _), base in zip(counted[name], counted[copy.base], strict=True):
                assert touches == base[2], f"{name}: {touches} touches, not {base[2]}"
                assert abs(steps - base[0]) <= 0.01 * base[0], f"{name}: {steps} steps"
    spent: dict[str, list[Any]] = {name: [] for name in servers}
    for _ in range(rounds):
        for name, server in servers.items():
            spent[name].append(server.ask())
    for server in servers.values():
        server.end()
    best = {name: np.min(values, axis=0) for name, values in spent.items()}  # case, kind
    accounts = {}
    for k, case in enumerate(CASES):
        evaluations = counted[""][k][3]
        unit = 1e9 / evaluations
        parts = {}
        for name, copy in COPIES.items():
            if name != "without weights":
                steps = [sum(counted[of][k][:2]) for of in (name, copy.base)]
                more = best[name][k, 0] * steps[1] / steps[0] - best[copy.base][k, 0]
                parts[name] = unit * float(more if copy.twice else -more)
        if load_scene(CASES[case][0]).supports is None:
            parts["supports"] = 0.0
        parts["equations"] -= parts["supports"]
        whole, sampled, call = (unit * float(value) for value in best[""][k])
        apart = {"samples": sampled - whole, "set-up and call": call}
        accounts[case] = Account(evaluations, whole, parts, apart)
    return accounts


def account(asked: Namespace, _: Path) -> list[str]:
    """Write the table of all accounts, and their picture."""
    # at the same place each time: compiled kernels are found by it
    found = measure(asked.rounds, asked.times, ROOT / "build" / "account")
    names = list(next(iter(found.values())).all_parts())
    rows = [["evaluations", *(str(each.evaluations) for each in found.values())]]

    def row(name: str, values: list[float]) -> None:
        cells = zip(values, found.values(), strict=True)
        rows.append([name, *(f"{v:.1f} ({100 * v / each.whole:.0f} %)" for v, each in cells)])

    for name in names:
        row(name, [each.all_parts()[name] for each in found.values()])
    row("**whole**", [each.whole for each in found.values()])
    for name in next(iter(found.values())).apart:
        row(f"besides: {name}", [each.apart[name] for each in found.values()])
    if not asked.dry:
        draw(found, EVIDENCE / "benchmark" / "account.svg")
    return [table(["ns for each evaluation", *found], rows)]


def draw(found: dict[str, Account], path: Path) -> None:
    """Draw the accounts as bars, one above the other."""
    from capture_sim.viewing import style  # half a second: matplotlib
    from capture_sim.viewing.canvas import save, subplots

    colours = (
        *(style.BLUE, style.SKY, style.GREEN, style.LIME, style.ORANGE, style.VERMILION),
        *(style.PURPLE, style.YELLOW, style.BROWN, style.LIGHT),
    )
    names = list(next(iter(found.values())).all_parts())
    figure, [[axes]] = subplots(12.0, 4.2, 1, 1, font=11.5)
    places, left = np.arange(len(found))[::-1], np.zeros(len(found))
    for name, colour in zip(names, colours, strict=True):
        rests = [each.whole - sum(each.parts.values()) for each in found.values()]
        values = [
            each.parts.get(name, rest) for each, rest in zip(found.values(), rests, strict=True)
        ]
        widths = np.maximum(values, 0.0)
        axes.barh(places, widths, left=left, color=colour, label=name, height=0.6)
        left += widths
    axes.set_yticks(places, list(found))
    axes.set_xlabel("CPU time for each evaluation of the equations, ns")
    axes.legend(ncols=5, loc="lower center", bbox_to_anchor=(0.45, 1.0), frameon=False)
    save(figure, path)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(int(sys.argv[2]))
    else:
        write_parts(
            "benchmark",
            __doc__,
            {"account": account},
            rounds=(12, "of all copies"),
            times=(5, "that a run is repeated in a round"),
        )
