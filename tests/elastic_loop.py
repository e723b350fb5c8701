"""The stage of the hardware loop, with the elastic law of its walls in place of a rig."""

from capture_sim.hardware.law import WallLaw
from capture_sim.hardware.stage import LoopStage
from capture_sim.scene.parts import Scene


def advanced(scene: Scene, until: float) -> tuple[LoopStage, float]:
    """The stage at a time (s), and the change of its energy since the start (J)."""
    stage = LoopStage(scene, 1e-3)
    stage.set_law(WallLaw(scene.contact_stiffness, 1.5))
    for _ in range(round(until / 1e-3)):
        stage.take_step()
    return stage, stage.energy
