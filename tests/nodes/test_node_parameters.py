"""config/nodes.yaml holds what the nodes declare, with their own defaults."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import yaml
from bench_processes import Client, processes

from capture_sim.resources import config_dir

FILE = config_dir() / "nodes.yaml"
NODES = ("simulator", "launcher", "capture_detector", "recorder")
IGNORED = re.compile(r"use_sim_time|qos_overrides\..*|start_type_description_service")


def plain(value):
    return value if isinstance(value, (str, float, int)) else list(value)


def test_file_and_nodes_agree(tmp_path):
    from rcl_interfaces.srv import GetParameters, ListParameters
    from rclpy.parameter import parameter_value_to_python

    content = yaml.safe_load(FILE.read_text())
    assert set(content) == {f"/**/{name}" for name in NODES}
    with processes() as start, Client() as client:
        own = {"recorder": {"out": tmp_path}}
        started = {name: start(name, exit_when_done="false", **own.get(name, {})) for name in NODES}
        for name in NODES:
            names = client.ask(ListParameters, f"/{name}/list_parameters").result.names
            ours = sorted(n for n in names if not IGNORED.match(n))
            declared = {}
            for key in ours:
                values = client.ask(GetParameters, f"/{name}/get_parameters", names=[key]).values
                if values:  # one without a value is not given in the file either
                    declared[key] = plain(parameter_value_to_python(values[0]))
            given = content[f"/**/{name}"]["ros__parameters"]
            if name == "recorder":
                assert declared.pop("out") == str(tmp_path)
                assert given.pop("out") == "runs"
            assert given == declared
        for node in started.values():
            node.process.send_signal(signal.SIGINT)
            assert node.status(10.0) == 0


def test_file_reaches_nodes_in_any_namespace(tmp_path):

    changed = Path(tmp_path, "nodes.yaml")
    changed.write_text(
        FILE.read_text().replace("consumer_timeout: 10.0", "consumer_timeout: 5000.0")
    )
    for namespace in ("/", "/bench_2"):
        done = subprocess.run(
            [
                *(sys.executable, "-m", "capture_sim.nodes.simulator", "--ros-args"),
                *("--params-file", str(changed), "-r", f"__ns:={namespace}"),
            ],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 2
        assert "consumer_timeout = 5000.0: allowed is" in done.stderr


def test_launcher_and_recorder_start_without_numba():
    program = "import sys, capture_sim.nodes.launcher, capture_sim.nodes.recorder\n"
    program += "raise SystemExit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
