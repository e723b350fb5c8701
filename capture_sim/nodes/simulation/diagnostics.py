"""Diagnostics of the simulator: its pace, lateness, integrator steps and energy residual."""

from __future__ import annotations

from capture_sim.nodes.base.diagnostics import PERIOD, Diagnostics, DiagnosticStatus, Level
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.simulation.control import SimulationControl, State
from capture_sim.nodes.simulation.stepping import Stepping

#: Number of periods of publication from one log line of a run's progress to the next.
_LOG_EVERY = 5
#: Relative deviation of the achieved from the requested real-time factor above which the status is
#: a warning.
_SLACK = 0.01


class SimulatorDiagnostics:
    """Publishes pace, lateness, integrator steps and energy residual of a run every second.

    It also logs the progress of a playing run every five seconds.
    """

    def __init__(self, node: BenchNode, control: SimulationControl) -> None:
        self._node = node
        self._control = control
        self._diagnostics = Diagnostics(node)
        self._run: Stepping | None = None
        self._on = False
        self._ticks = 0
        self._rounds = 0
        node.every(PERIOD, self._tick)

    def begin(self, stepping: Stepping) -> None:
        """Report on the run of this :class:`Stepping` from now on."""
        self._run = stepping
        self._on = True
        self._ticks = self._rounds = 0

    def end(self) -> None:
        """Publish the diagnostics of the run, from its begin to its complete or early end."""
        self._on = False
        self._publish(whole=True)

    def _tick(self) -> None:
        self._publish(whole=not self._on)
        self._rounds += 1
        playing = self._on and self._control.state is State.PLAYING
        if playing and self._run is not None and self._rounds % _LOG_EVERY == 0:
            scene = self._run.bench.scene
            text = f"{scene.name}: {self._run.figures}, at most {scene.run.t_end:g} s"
            self._node.get_logger().info(text)

    def _publish(self, *, whole: bool) -> None:
        state = self._control.state.name.lower()
        level, text, values = Level.OK, state, {"state": state}
        if self._run is not None:
            level, text, figures = self._figures(self._run, whole=whole)
            values |= figures
        self._diagnostics.publish(DiagnosticStatus("stepping", level, text, values))

    def _figures(self, stepping: Stepping, *, whole: bool) -> tuple[Level, str, dict[str, str]]:
        scene, pacer = stepping.bench.scene, self._control.pacer
        factor, achieved = pacer.factor, pacer.achieved
        fresh, self._ticks = pacer.ticks - self._ticks, pacer.ticks
        lateness = pacer.lateness(None if whole else fresh) if fresh or whole else None
        values = {
            "experiment": scene.name,
            "figures of": "the whole run" if whole else f"the last {PERIOD:g} s",
            "simulated time [s]": f"{stepping.t:.6f}",
            "samples sent": f"{stepping.count}",
            "real-time factor requested": f"{factor:g}",
            "real-time factor achieved": f"{achieved:.6f}",
            "ticks": f"{pacer.ticks}",
            "skipped [s]": f"{pacer.skipped_delay:.6f}",
            "integrator steps": f"{stepping.bench.statistics.steps}",
            "energy residual [J]": f"{stepping.residual:.3e}",
        }
        if lateness is not None:
            for key, late in zip(("p50", "p99", "p99.9", "max"), lateness, strict=True):
                values[f"tick lateness {key} [us]"] = f"{1e6 * late:.1f}"
        settled = factor > 0.0 and pacer.wall > PERIOD and not whole
        if settled and abs(achieved / factor - 1.0) > _SLACK:
            text = f"real-time factor {achieved:.3f}, requested {factor:g}"
            return Level.WARN, text, values
        return Level.OK, f"{scene.name}: {stepping.figures}", values
