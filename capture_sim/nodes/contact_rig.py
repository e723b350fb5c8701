"""The node that stands in for contact hardware: it answers positions of the tip with wrenches."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from capture_sim.base.exit_status import OK
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
from capture_sim.hardware.rig import IDEAL, Cell, Rig, Servo, Transport
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import declare_scene
from capture_sim.nodes.base.process import run


class ContactRigNode(BenchNode):
    """Simulates a contact rig: servo, load cell, walls and transport.

    With the parameter ``ideal`` it has no servo lag, noise, bias or delay.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(CONTACT_RIG, **options)
        scene = declare_scene(self, "scene with the cone", "_loop")
        number = partial(self.declare, low=0.0)
        ideal = self.declare("ideal", False, "true: no servo, noise, bias or delays")
        names = {"offset": "wall_offset", "damping": ""}
        law = self.declare_fields(WallLaw(2000.0), lambda name: names.get(name, name))
        damping = number("damping", 0.0, "damping c of F = k d^p (1 + c d'), s/m", high=1e6)
        law = replace(law, damping=law.stiffness * damping)
        servo, cell, transport = IDEAL if ideal else (Servo(), Cell(), Transport())
        servo = self.declare_fields(servo, "servo_{}".format)
        cell = self.declare_fields(cell, lambda name: f"cell_{name.removeprefix('force_')}")
        transport = self.declare_fields(
            transport, lambda name: name if name in ("drops", "doubles") else f"transport_{name}"
        )
        hidden_lag = number("hidden_lag", 0.0, "age of the force at its stamp, s", high=1.0)
        sends_tip = self.declare("sends_tip", True, "send loop/rig_tip")
        seed = self.declare("seed", 0, "seed of noise and transport", low=0, high=2**31 - 1)
        assert scene is not None
        self._rig = Rig(scene, law, servo, cell, transport, hidden_lag, sends_tip, seed)
        self.open((TIP_WRENCH, RIG_TIP))
        self.listen(TIP, self._answer)

    def work(self) -> int:
        """Answer the positions that arrive until Ctrl-C; return the exit status."""
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
