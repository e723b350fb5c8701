"""The launch files, where ros2 launch is installed: a workstation has it, the wheels have not."""

import subprocess
import sys
from pathlib import Path

import pytest

from capture_sim.recording.bag import read_bag

pytest.importorskip("launch_ros")
FILES = Path(__file__).resolve().parents[2] / "launch"
PROGRAM = """
import sys
from launch import LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description import LaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
arguments = [argument.split(":=") for argument in sys.argv[2:]]
source = PythonLaunchDescriptionSource(sys.argv[1])
service = LaunchService()
service.include_launch_description(
    LaunchDescription([IncludeLaunchDescription(source, launch_arguments=arguments)])
)
sys.exit(service.run())
"""


def launched(file, *arguments):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, str(FILES / file), *arguments],
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_bench_is_launched_and_its_recording_replayed(tmp_path):
    done = launched("bench.launch.py", "experiment:=tilt_p10", "rtf:=0.0", f"out:={tmp_path}")
    assert done.returncode == 0, done.stdout
    path = tmp_path / "tilt_p10.mcap"
    assert read_bag(path).complete
    for namespace in ("/", "lab"):
        where = f"namespace:={namespace}"
        done = launched("replay.launch.py", f"bag:={path}", "detect:=true", "rtf:=0.0", where)
        assert done.returncode == 0, done.stdout
        name = f"{namespace}.capture_detector".removeprefix("/.")
        assert f"[{name}]: tilt_p10: captured" in done.stdout


@pytest.mark.parametrize(
    "argument, said",
    [
        ("rtf:=-1", "error: parameter rtf = -1.0: must be a number"),
        ("state:=gone", "'playing', 'paused', 'stopped'"),
        ("experiment:=tilt_1", "tilt_1"),
        ("experiment:=the crew's.yaml", "the crew's.yaml"),
        ("params:=nowhere.yaml", "params = nowhere.yaml: must be a file"),
    ],
)
def test_wrong_argument_is_named(argument, said):
    done = launched("bench.launch.py", argument)
    assert done.returncode == 1
    assert said in done.stdout + done.stderr
