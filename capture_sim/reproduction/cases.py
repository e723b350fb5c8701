"""The runs of the paper: those that come as scenes, and the docking from one metre away."""

from __future__ import annotations

from dataclasses import replace

from capture_sim.launch.plan import travel_to_touch
from capture_sim.scene.files import load_scene
from capture_sim.scene.parts import Scene
from capture_sim.simulation import Result, simulate

#: The scenes that come with the package, in the paper's order.
SCENES = (
    "paper_clamped",
    "paper_undamped",
    "paper_designed",
    "paper_case_1",
    "paper_case_2",
    "paper_case_3",
    "tilt_0",
    "tilt_p10",
    "tilt_m10",
)
#: The docking of Figure 12.
DOCKING = "docking"

_DISTANCE = 1.0  # m, of the tip from where it will touch


def docking_scene() -> Scene:
    """Return Figure 12's scene: the designed buffer, one metre before the first touch."""
    scene = load_scene("paper_designed")
    target = scene.initial.target
    far = replace(target, x=target.x + _DISTANCE - travel_to_touch(scene))
    return replace(
        scene,
        name=DOCKING,
        title="Paper, docking from 1 m away (Figure 12)",
        initial=replace(scene.initial, target=far),
        run=replace(scene.run, t_end=12.0),
    )


def scene_of(name: str) -> Scene:
    """Return one of the paper's scenes."""
    return docking_scene() if name == DOCKING else load_scene(name)


def run_cases(names: tuple[str, ...] = (*SCENES, DOCKING)) -> dict[str, Result]:
    """Run the paper's cases, each whole."""
    return {name: simulate(scene_of(name)) for name in names}
