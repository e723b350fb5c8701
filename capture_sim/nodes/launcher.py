"""The node that launches the chaser, in the runs of a simulator or in trials of a real bench."""

from __future__ import annotations

from functools import partial
from typing import Any

from rclpy.parameter import Parameter

from capture_sim.base.files import folder_problem
from capture_sim.errors import SceneError
from capture_sim.launcher.state_machine import LaunchSettings
from capture_sim.messages.topics import CAPTURE_DETECTOR, LAUNCHER, RECORDER
from capture_sim.nodes.base.node import BenchNode
from capture_sim.nodes.base.parameters import ParameterError, declare_scene
from capture_sim.nodes.base.process import run
from capture_sim.nodes.simulation.launch import SimulatedLaunch
from capture_sim.nodes.trials.server import TrialServer, TrialSettings
from capture_sim.plausibility.check import check_names
from capture_sim.trial.interlocks import RULES, TrialLimits

#: Parameters of :class:`LaunchSettings`, by field.
SETTINGS = {"tolerance": "speed_tolerance", "aborts": "abort_on_deviation"}


class LauncherNode(BenchNode):
    """Launches the chaser and compares the launch with its plan.

    The parameter ``actuator`` says what holds the chaser.  ``simulated``: a simulator; the launcher
    arms and releases in each run that a simulator announces.  ``output`` and ``none``: a real
    bench; the launcher serves the action ~/run_trial, and runs of simulators and players make it
    move nothing.  With ``output`` it lets the chaser go by a message on launcher/hold; with
    ``none`` somebody lets it go by hand.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(LAUNCHER, **options)
        self._launch = self.declare_fields(LaunchSettings(), SETTINGS.__getitem__, read_only=False)
        actuator = self.declare(
            "actuator",
            "simulated",
            "release actuator: the simulator, the output launcher/hold, or no node",
            choices=("simulated", "output", "none"),
        )
        auto_release = self.declare(
            "auto_release",
            True,
            "of a simulated chaser: release as soon as armed; false holds it until this is true",
            read_only=False,
        )
        scene = declare_scene(self, "of trials whose goal names none")
        text = "folder of scenes that a goal may name besides the packaged ones"
        scenes = self.declare_path("scene_folder", "", text, "a folder", folder_problem)
        limits = self.declare_fields(TrialLimits())
        needs_client = self.declare(
            "require_client",
            True,
            "let a chaser go only once the goal's client has asked for the result, which shows "
            "that it knows of the accepted goal and can cancel it",
        )
        waived = self.declare(
            "waive",
            list,
            "rules before a release that are not demanded, by name; the recording keeps the list",
            allowed="names of rules, see docs/your_rig.md",
        )
        try:
            check_names([name for name in waived if name not in RULES])
        except SceneError as error:
            raise ParameterError(f"parameter waive: {error}, {', '.join(RULES)}") from None
        required = [
            role
            for role, name, what in (
                (RECORDER, "require_recorder", "records"),
                (CAPTURE_DETECTOR, "require_detector", "evaluates"),
            )
            if self.declare(
                name,
                True,
                f"let a chaser go only if a {role} takes part; false: also a trial that none "
                f"{what}",
            )
        ]
        driver = self.declare(
            "driver",
            "",
            "node that must read launcher/hold before a release, by name or full name; empty: any "
            "node but recorders and ros2 topic",
        )
        self._part: SimulatedLaunch | TrialServer
        if actuator == "simulated":
            if scene is not None:
                raise ParameterError(
                    f"parameter scene = {scene.name!r}: must be empty with actuator simulated: the "
                    "simulator has the scene"
                )
            self._part = SimulatedLaunch(self, self._launch, auto_release=auto_release)
        else:
            settings = TrialSettings(
                actuator == "output",
                limits,
                needs_client,
                driver,
                tuple(required),
                tuple(waived),
                scene,
                scenes,
            )
            self._part = TrialServer(self, settings, self._launch)
        self.add_post_set_parameters_callback(self._parameters_set)

    def work(self) -> int:
        """Launch until the process is to end; return the exit status."""
        return self._part.work()

    def _parameters_set(self, parameters: list[Parameter]) -> None:
        values = {parameter.name: parameter.value for parameter in parameters}
        for field, name in SETTINGS.items():
            setattr(self._launch, field, values.get(name, getattr(self._launch, field)))
        if "auto_release" in values and isinstance(self._part, SimulatedLaunch):
            self._part.set_auto_release(values["auto_release"])
        self._part.settings_changed()


main = partial(run, LauncherNode)

if __name__ == "__main__":
    raise SystemExit(main())
