"""The node that stands for contact hardware: it answers the tip's place with a wrench."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

from capture_sim.hardware.in_the_loop import CONTACT_RIG, TIP, TIP_WRENCH
from capture_sim.hardware.loop_messages import tip_of, wrench_message
from capture_sim.hardware.walls import TipState, WallLaw, contact_rig
from capture_sim.interrupts import STOP
from capture_sim.launch.scenes import load_scene
from capture_sim.nodes.node import BenchNode
from capture_sim.nodes.process import run
from capture_sim.nodes.start import OK


class ContactRigNode(BenchNode):
    """Walls with a law, see :func:`capture_sim.hardware.walls.contact_rig`."""

    def __init__(self) -> None:
        super().__init__(CONTACT_RIG)
        name = self.declare("scene", "_loop", "whose cone it is: name in config/scenes, or file")
        overrides = self.declare(
            "overrides", list, "changes of the scene, as cone.half_angle=0.8 (SI)"
        )
        stiffness = self.declare("stiffness", 2000.0, "N/m^exponent, of a wall", low=0.0, high=1e12)
        exponent = self.declare(
            "exponent", 1.0, "of the penetration: 1 a spring, 1.5 Hertz", low=1.0, high=3.0
        )
        damping = self.declare(
            "damping", 0.0, "s/m, by which the force grows with the rate", low=0.0, high=1e6
        )
        friction = self.declare("friction", 0.0, "coefficient, of a wall", low=0.0, high=10.0)
        lag = self.declare("lag", 0, "messages that it answers late, on purpose", low=0, high=1000)
        law = WallLaw(stiffness, exponent, stiffness * damping, friction=friction)
        self._rig = contact_rig(load_scene(name, overrides), law)
        self._places: deque[TipState] = deque(maxlen=lag + 1)
        self.open((TIP_WRENCH,))
        self.listen(TIP, self._answer)

    def work(self) -> int:
        """Answer until Ctrl-C."""
        self.get_logger().info("ready")
        STOP.wait()
        return OK

    def _answer(self, message: Any) -> None:
        self._places.append(tip_of(message))
        place = self._places[0]
        self.send(TIP_WRENCH, wrench_message(self.messages, place.t, self._rig(place)))


main = partial(run, ContactRigNode)

if __name__ == "__main__":
    raise SystemExit(main())
