"""The node that shows runs live in rerun.

From a simulator it reads BenchState, which contains the full state of an instant.  From a real
bench, whose geometry the parameter ``scene`` gives, it reads poses, buffer, contact and string.
No node waits for the viewer: of messages that arrive faster than they are shown, some are skipped.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from capture_sim.detection.align import Observation
from capture_sim.detection.criteria import CaptureState
from capture_sim.detection.measurements import Source
from capture_sim.dynamics.samples import SAMPLE
from capture_sim.messages.cdr import stamp_of
from capture_sim.messages.convert import stamp_in, stamp_seconds
from capture_sim.messages.measurements import OF_A_BENCH, MeasurementReader
from capture_sim.messages.topics import (
    BENCH_EVENT,
    BENCH_STATE,
    CAPTURE_STATUS,
    CONTACT_STATE,
    CONTACT_WRENCH,
    STRING_STATE,
    RunSource,
    Topic,
)
from capture_sim.nodes.base.endpoints import from_bytes
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import ParameterError
from capture_sim.nodes.base.process import run
from capture_sim.nodes.protocol.ends import RunEnd
from capture_sim.nodes.protocol.follower import AnnouncedRun, Follower, RunPart
from capture_sim.nodes.protocol.roll import RunReport
from capture_sim.run.reconstruction import measured_samples
from capture_sim.run.series import Series
from capture_sim.scene.loading import load_scene
from capture_sim.scene.parts import Scene

VIEWER = "viewer"

#: Read of a real bench besides poses and buffer.
EXTRA_TOPICS = (CONTACT_STATE, CONTACT_WRENCH, STRING_STATE)
_UNKNOWN = (math.nan, math.nan, math.nan)


class ViewerNode(BenchNode, RunPart):
    """Shows every announced run live in rerun, or a bench where no node announces runs."""

    _scene: Scene  # of the run that is on

    def __init__(self, **options: Any) -> None:
        super().__init__(VIEWER, **options)
        rate = self.declare(
            "rate", 50.0, "Hz (simulated), instants shown of each second", low=1.0, high=1000.0
        )
        refresh = self.declare(
            "refresh", 10.0, "Hz (wall), updates of the window", low=0.5, high=60.0
        )
        port = self.declare(
            "port", 9876, "TCP port of the recordings, on this machine", low=1024, high=65535
        )
        memory = self.declare(
            "memory", 64, "MB kept for viewers that connect late", low=8, high=65536
        )
        geometry = self.declare(
            "scene", "", "experiment whose geometry a bench has that announces no run"
        )
        self._geometry: Scene | None = load_scene(geometry) if geometry else None
        self._period = 1.0 / rate
        # the last two of each source and topic: stamps, ns, and what came
        self._newest: dict[Any, list[tuple[int, Any]]] = {}
        self._used: dict[Any, Topic] = {}  # which of its topics shows a source
        self._last_slot: dict[Topic, int] = {}
        self._zero: float | None = None  # s, stamp of a bench's first message
        self._unannounced = False
        self._last_status: bytes | None = None  # the detector's last
        self._last_verdict = 0.0
        try:
            from capture_sim.viewing.live import LiveView

            self._view = LiveView(port, memory, refresh)
        except ImportError as error:
            raise ParameterError(
                f"the viewer needs rerun ({error}); run it from an environment that has it"
            ) from None
        if self._geometry is None:
            self.listen(BENCH_STATE, self._receive_state, raw=True)
        else:
            self._readers = {topic: MeasurementReader(topic) for topic in OF_A_BENCH}
            for topic in (*OF_A_BENCH, *EXTRA_TOPICS):
                self.listen(topic, partial(self._receive_measurement, topic), raw=True)
        self.listen(CAPTURE_STATUS, self._receive_status, raw=True)
        # the last message is also shown when nothing follows: the run may be paused
        self.every(max(0.2, 1.0 / refresh), self._view.show)
        self._follower = Follower(self, VIEWER, self, list(RunSource), on_roll=False)
        # each event comes once: it is waited for, even after the run's end
        self._follower.follow(BENCH_EVENT, self._receive_event)
        self._follower.join()
        self.get_logger().info(f"look at the runs with: rerun {self._view.address}")

    @property
    def run(self) -> Any:
        """The run that is shown at the moment (AnnouncedRun), or None."""
        return self._follower.run

    def work(self) -> int:
        """Show runs until the process is to end; return the exit status."""
        return self._follower.work()

    def prepare(self, run: AnnouncedRun) -> None:
        """Begin to show a run that was announced."""
        self._unannounced = False
        self._scene = run.scene
        self._start(run.name)

    def end(self, run: AnnouncedRun, end: RunEnd) -> RunReport:
        """Show what has arrived and is not shown yet.

        The report that is returned is always empty: that something was not shown is no failure.
        """
        self._show_pending()
        self._show_verdict()
        self._view.show()
        reason = f", {end.reason}" if end.reason else ""
        self.get_logger().info(f"{run.name}: shown{reason}")
        return RunReport()

    def close(self) -> None:
        """End the node and the server that rerun's window reads from."""
        self._view.close()
        super().close()

    def _start(self, name: str) -> None:
        self._newest.clear()
        self._used.clear()
        self._last_slot.clear()
        self._last_status, self._last_verdict = None, 0.0
        self._view.begin(name, self._scene, measured=self._geometry is not None)

    def _is_shown(self, topic: Topic, data: bytes) -> bool:
        """Return True if this message is to be shown, judged by the stamp in its first bytes.

        Of each period of 1 / ``rate``, only the first message of a topic is.  Without an announced
        run, none is, unless the parameter ``scene`` gives a bench's geometry.
        """
        slot = math.floor(1e-9 * (stamp_of(topic, data) or 0) / self._period + 1e-6)
        if slot == self._last_slot.get(topic) or (
            self.run is None and not self._begin_unannounced()
        ):
            return False
        self._last_slot[topic] = slot
        return True

    def _receive_state(self, data: bytes) -> None:
        self._follower.note_message(BENCH_STATE)
        if not self._is_shown(BENCH_STATE, data):
            return
        message = from_bytes(BENCH_STATE, data)
        sample = np.zeros(1, dtype=SAMPLE)
        for name in SAMPLE.names or ():
            sample[name] = getattr(message, name)
        self._view.take(sample)

    def _receive_measurement(self, topic: Topic, data: bytes) -> None:
        self._follower.note_message(topic)
        if not self._is_shown(topic, data):
            return
        what: Any = OF_A_BENCH.get(topic, topic)
        if self._used.setdefault(what, topic) is not topic:
            return  # odometry and motion capture: the first one that has come is shown
        if what is Source.CHASER:
            # by now all of the instant before has come
            self._show_pending()
        if topic in OF_A_BENCH:
            stamp, content = self._readers[topic](data)
        else:
            content = from_bytes(topic, data)
            stamp = stamp_in(content)
        self._newest[what] = [*self._newest.get(what, [])[-1:], (stamp, content)]

    def _begin_unannounced(self) -> bool:
        """Begin to show a bench where no node announces runs; return False if that is not possible.

        It is possible if the parameter ``scene`` gives the geometry; if it has begun, nothing is
        done.
        """
        if self._unannounced or self._geometry is None:
            return self._unannounced
        self._unannounced = True
        self._zero = None
        self._scene = self._geometry
        self._start("bench")
        return True

    def _show_pending(self) -> None:
        """Show the bench at the last measured pose of the chaser.

        Of each other quantity, the message nearest in time is shown.  Nothing is shown before each
        source has sent one.
        """
        if not set(Source) <= self._newest.keys():
            return
        stamp, _ = self._newest[Source.CHASER][-1]
        parts = {
            what: min(contents, key=lambda content: abs(content[0] - stamp))[1]
            for what, contents in self._newest.items()
        }
        observation = Observation(stamp_seconds(stamp), *(parts[source] for source in Source))
        t = np.array([self._since_start(observation.t)])
        self._view.take(measured_samples(self._scene, t, _series_at(t, observation, parts)))

    def _since_start(self, t: float) -> float:
        """Return the time to show for a time ``t`` of the messages, s.

        In an announced run it is ``t`` itself.  Without one it is the time since the first instant
        that was shown.
        """
        if not self._unannounced:
            return t
        if self._zero is None:
            self._zero = t
        return t - self._zero

    def _receive_event(self, event: Any) -> None:
        self._view.event(event.t, event.kind, event.detail)
        if event.peak_force > 0.0:
            self._view.touch(event.peak_time, event.peak_force)

    def _receive_status(self, data: bytes) -> None:
        self._last_status = data
        over = self.run is None and not self._unannounced
        if over or self._is_shown(CAPTURE_STATUS, data):
            # the detector may judge at the end, after the simulator has ended the run
            self._show_verdict()

    def _show_verdict(self) -> None:
        if self._last_status is None:
            return
        status = from_bytes(CAPTURE_STATUS, self._last_status)
        t = self._since_start(stamp_seconds(stamp_in(status)))
        # one that is older belongs to the next run, which is not announced yet
        if self.run is not None or self._unannounced or t >= self._last_verdict:
            self._last_verdict = t
            self._view.verdict(t, CaptureState(status.state).label)


def _series_at(t: np.ndarray, observation: Observation, parts: dict[Any, Any]) -> dict[str, Series]:
    """Return the measurements of one instant as series of one value, by quantity.

    ``t``: its time, s, (1,).  ``observation``: poses and buffer.  ``parts``: the messages of that
    instant by topic, of which contact, force and string are used if there are any.  Rates that were
    not measured are NaN for the vehicles and 0 for the buffer.
    """
    rates: dict[str, Any] = {"chaser_rate": _UNKNOWN, "target_rate": _UNKNOWN}
    rates |= {"stroke_rate": 0.0, "torsion_rate": 0.0}
    if observation.has_rates:
        vehicles = {"chaser_rate": observation.chaser[3:], "target_rate": observation.target[3:]}
        buffer = dict(zip(("stroke_rate", "torsion_rate"), observation.buffer[2:], strict=True))
        rates = {**vehicles, **buffer}
    values: dict[str, Any] = {
        "chaser": observation.chaser[:3],
        "target": observation.target[:3],
        "stroke": observation.buffer[0],
        "torsion": observation.buffer[1],
        **rates,
    }
    if (contact := parts.get(CONTACT_STATE)) is not None:
        values |= {"normal_force": contact.normal_force, "walls": contact.walls}
    if (wrench := parts.get(CONTACT_WRENCH)) is not None:
        values["tip_force"] = (wrench.wrench.force.x, wrench.wrench.force.y)
    if (string := parts.get(STRING_STATE)) is not None:
        values |= {"string_phase": string.phase, "string_tension": string.tension}
        values |= {"mass_height": string.mass_height, "mass_speed": string.mass_speed}
    return {name: Series(t, np.array([value], dtype=float)) for name, value in values.items()}


main = partial(run, ViewerNode)

if __name__ == "__main__":
    raise SystemExit(main())
