"""The node that replaces contact hardware: it answers the tip's position with a wrench."""

from __future__ import annotations

from functools import partial
from typing import Any

from capture_sim.hardware.law import WallLaw
from capture_sim.hardware.messages import (
    CONTACT_RIG,
    RIG_TIP,
    TIP,
    TIP_WRENCH,
    tip_message,
    tip_of,
    wrench_message,
)
from capture_sim.hardware.rig import Cell, Rig, Servo, Transport
from capture_sim.launch.scenes import load_scene
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.process import run
from capture_sim.nodes.start import OK


class ContactRigNode(BenchNode):
    """Simulates a contact rig: servo, load cell, walls and transport.

    `-p ideal:=true` is a rig without servo, noise, bias and delay.  docs/hardware_in_the_loop.md
    lists the parameters.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(CONTACT_RIG, **options)
        name = self.declare("scene", "_loop", "scene with the cone: name in config/scenes, or file")
        overrides = self.declare(
            "overrides", list, "changes of the scene (SI), e.g. cone.half_angle=0.8"
        )
        number = partial(self.declare, low=0.0)
        ideal = self.declare("ideal", False, "true: no servo, noise, bias or delays")
        stiffness = number("stiffness", 2000.0, "stiffness of the walls, N/m^exponent", high=1e12)
        exponent = self.declare(
            "exponent", 1.0, "exponent of the penetration: 1 spring, 1.5 Hertz", low=1.0, high=3.0
        )
        damping = number("damping", 0.0, "damping c of F = k d^p (1 + c d'), s/m", high=1e6)
        offset = self.declare(
            "wall_offset", 0.0, "offset of the walls towards the tip, m", low=-0.1, high=0.1
        )
        friction = number("friction", 0.0, "friction coefficient of the walls", high=10.0)
        law = WallLaw(stiffness, exponent, stiffness * damping, offset, friction)

        def figure(name: str, standard: float, description: str, high: float = 1e6) -> Any:
            return number(name, 0.0 if ideal else standard, description, high=high)

        servo = Servo(
            figure("servo_bandwidth", Servo.bandwidth, "bandwidth, Hz; 0: no servo", 1e4),
            figure("servo_delay", Servo.delay, "delay of the servo, s", 1.0),
            number(
                "servo_acceleration", Servo.acceleration, "saturation of the servo, m/s^2", high=1e6
            ),
        )
        cell = Cell(
            figure("cell_cutoff", Cell.cutoff, "cutoff of the cell's low-pass, Hz; 0: none"),
            figure("cell_noise", Cell.noise, "standard deviation of a force component, N"),
            figure(
                "cell_torque_noise",
                Cell.torque_noise,
                "standard deviation of a torque component, N m",
            ),
            figure("cell_bias", Cell.bias, "bias of each force component, N"),
            figure("cell_resolution", Cell.resolution, "resolution, N and N m; 0: not quantised"),
            number(
                "cell_range", Cell.force_range, "saturation of each force component, N", high=1e9
            ),
        )
        transport = Transport(
            figure("transport_delay", Transport.delay, "round-trip delay, s", 10.0),
            figure(
                "transport_jitter",
                Transport.jitter,
                "scale of the random (half-normal) delay added to it, s",
                1.0,
            ),
            figure("drops", Transport.drops, "share of wrenches that are lost", 1.0),
            figure("doubles", Transport.doubles, "share of wrenches that are sent twice", 1.0),
        )
        hidden_lag = number("hidden_lag", 0.0, "age of the force at its stamp, s", high=1.0)
        sends_tip = self.declare("sends_tip", True, "send loop/rig_tip")
        seed = self.declare("seed", 0, "seed of noise and transport", low=0, high=2**31 - 1)
        scene = load_scene(name, overrides)
        self._rig = Rig(scene, law, servo, cell, transport, hidden_lag, sends_tip, seed)
        self.open((TIP_WRENCH, RIG_TIP))
        self.listen(TIP, self._answer)

    def work(self) -> int:
        """Answer until Ctrl-C."""
        self.get_logger().info("ready")
        self.wait()
        return OK

    def _answer(self, message: Any) -> None:
        for stamp, wrench, tip in self._rig.answer(tip_of(message)):
            if tip is not None:
                self.send(RIG_TIP, tip_message(self.messages, stamp, tip))
            self.send(TIP_WRENCH, wrench_message(self.messages, stamp, wrench))


main = partial(run, ContactRigNode)

if __name__ == "__main__":
    raise SystemExit(main())
