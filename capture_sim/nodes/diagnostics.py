"""The simulator's pace, lateness and integrator statistics, on the topic diagnostics."""

from __future__ import annotations

from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType

from capture_sim.control.simulation import SimulationControl, State
from capture_sim.nodes.endpoints import message_class
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.stepping import Stepping

#: Published this often, s (wall).
PERIOD = 1.0
#: Progress is logged every so many of them.
_LOG_EVERY = 5
#: The achieved factor may differ by this much, relative, before it is a warning.
_SLACK = 0.01


class SimulatorDiagnostics:
    """Publishes pace, lateness, integrator statistics and energy residual of a run.

    Stamped with the wall's time, as diagnostics are: they are about the process.
    """

    def __init__(self, node: BenchNode, control: SimulationControl) -> None:
        self._node = node
        self._control = control
        self._array = message_class("diagnostic_msgs/msg/DiagnosticArray")
        self._status = message_class("diagnostic_msgs/msg/DiagnosticStatus")
        self._value = message_class("diagnostic_msgs/msg/KeyValue")
        self._publisher = node.create_publisher(self._array, "diagnostics", 10)
        self._wall = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._run: Stepping | None = None
        self._on = False
        self._ticks = 0
        self._rounds = 0
        node.every(PERIOD, self._tick)

    def begin(self, stepping: Stepping) -> None:
        """Report on this run from now on."""
        self._run = stepping
        self._on = True
        self._ticks = self._rounds = 0

    def end(self) -> None:
        """Publish the numbers of the whole run."""
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
        values: dict[str, object] = {"state": self._control.state.name.lower()}
        level, text = self._status.OK, values["state"]
        if self._run is not None:
            level, text = self._judge(self._run, values, whole=whole)
        status = self._status(
            level=level,
            name=f"{self._node.get_name()}: stepping",
            message=str(text),
            hardware_id="capture_sim",
            values=[self._value(key=key, value=str(value)) for key, value in values.items()],
        )
        message = self._array(status=[status])
        message.header.stamp = self._wall.now().to_msg()
        self._publisher.publish(message)

    def _judge(
        self, stepping: Stepping, values: dict[str, object], *, whole: bool
    ) -> tuple[Any, str]:
        scene, statistics = stepping.bench.scene, stepping.bench.statistics
        pacer = self._control.pacer
        factor, achieved = pacer.factor, pacer.achieved
        fresh, self._ticks = pacer.ticks - self._ticks, pacer.ticks
        lateness = pacer.lateness(None if whole else fresh) if fresh or whole else None
        period = 1.0 / (scene.run.state_rate * factor) if factor > 0.0 else 0.0
        values |= {
            "experiment": scene.name,
            "figures of": "the whole run" if whole else f"the last {PERIOD:g} s",
            "simulated time [s]": f"{stepping.t:.6f}",
            "samples sent": stepping.count,
            "real-time factor requested": f"{factor:g}",
            "real-time factor achieved": f"{achieved:.6f}",
            "ticks": pacer.ticks,
            "late ticks (more than a period)": pacer.late_ticks(period) if whole else "",
            "skipped [s]": f"{pacer.skipped_delay:.6f}",
            "integrator steps": statistics.steps,
            "integrator steps rejected": statistics.rejected,
            "evaluations": statistics.evaluations,
            "energy residual [J]": f"{stepping.residual:.3e}",
        }
        if lateness is not None:
            for key, late in zip(("p50", "p99", "p99.9", "max"), lateness, strict=True):
                values[f"tick lateness {key} [us]"] = f"{1e6 * late:.1f}"
        settled = factor > 0.0 and pacer.wall > PERIOD and not whole
        if settled and abs(achieved / factor - 1.0) > _SLACK:
            return self._status.WARN, f"real-time factor {achieved:.3f}, requested {factor:g}"
        return self._status.OK, f"{scene.name}: {stepping.figures}"
