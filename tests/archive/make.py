"""Make the archive's files of one version, by the program of that version.

    python3 tests/archive/make.py CHECKOUT

CHECKOUT is a clone or worktree of the commit in which ``make setup`` was run; for the files of the
present state it is this one (``.``).  The files are written to ``tests/archive/VERSION/``; of the
commits that all called themselves 0.1.0, to a folder named by the commit:

offline.mcap    capture-sim run every_part.yaml
nodes.mcap      capture-sim bench every_part.yaml
trial.mcap      a trial of examples/fake_rig.py with launcher, detector and recorder
sweep.csv       capture-sim sweep every_part.yaml --vary ... (if the version has the command)
results.json    of both runs, as offline_results.json and nodes_results.json
scene.yaml      capture-sim show every_part.yaml: every field of that version's scenes
made.json       commit, version, the commands above, and what `detect` of that version printed
msg/            the definitions of that version's messages

In sweep.csv, the folder of every_part.yaml is left out of the commands.

Needs Python's standard library only.  The program itself runs in CHECKOUT's ``.venv``.  Nodes use
ROS_DOMAIN_ID of the environment and the loopback interface.  Exit status 1: a command failed, or
a file is larger than 100 kB.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ARCHIVE = Path(__file__).resolve().parent
SCENE = ARCHIVE / "every_part.yaml"
#: Largest size of a file, bytes.
LIMIT = 100 * 1024
VARIED = ("--vary", "buffer.c_A=10,20", "--vary", "approach.angle=0 deg,10 deg")
STREAMS = (
    "/motion_capture/chaser",
    "/motion_capture/target",
    "/joint_states",
    "/load_cell/wrench",
    "/capture/status",
    "/capture/criteria",
    "/launcher/command",
    "/launcher/hold",
)
#: A busy machine is no dead camera.
PATIENCE = {"max_pose_age": 10.0, "max_buffer_age": 10.0, "max_hold_silence": 10.0}
PATIENCE |= {"start_timeout": 60.0, "after_verdict": 0.1}


class Checkout:
    """A version of the program, in its own environment."""

    def __init__(self, root, out):
        self.root, self.out, self.commands = root.resolve(), out, {}
        self.bin = self.root / ".venv" / "bin"
        profile = self.root / "config" / "fast_dds_loopback.xml"
        self.environment = {
            **os.environ,
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
            "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile),
        }

    def has(self, command):
        return f"\n  {command} " in self.run("--help")

    def run(self, *arguments, names=(), statuses=(0,)):
        """Run capture-sim; note the command as made for the files ``names``; return its output."""
        answer = subprocess.run(
            [self.bin / "capture-sim", *map(str, arguments)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=self.out,
            env=self.environment,
        )
        if answer.returncode not in statuses:
            raise SystemExit(f"capture-sim {' '.join(map(str, arguments))}: {answer.returncode}")
        for name in names:
            shown = [Path(a).name if isinstance(a, Path) else a for a in arguments]
            self.commands[name] = " ".join(["capture-sim", *shown])
        return answer.stdout

    def start(self, *arguments):
        """Start a Python program of the version; return its process once it is ready."""
        log = tempfile.TemporaryFile("w+")  # noqa: SIM115 - open as long as the process
        process = subprocess.Popen(
            [self.bin / "python", *map(str, arguments)],
            stdout=log,
            stderr=subprocess.STDOUT,
            cwd=self.out,
            env=self.environment,
        )
        return process, log


def until(condition, what, limit=120.0):
    """Wait until something is so; SystemExit after ``limit`` seconds."""
    end = time.monotonic() + limit
    while not (value := condition()):
        if time.monotonic() > end:
            raise SystemExit(f"not within {limit:g} s: {what}")
        time.sleep(0.05)
    return value


def text_of(log):
    log.seek(0)
    return log.read()


def run_trial(checkout, folder):
    """Run one trial of the example's rig; return its recording."""
    code = (checkout.root / "examples/fake_rig.py").read_text()
    rig = folder / "fake_rig.py"  # the first one has no parameters
    folder.mkdir()
    rig.write_text(
        code.replace("\nRATE, CLOCK, SPEED, DROP = 100.0,", "\nRATE, CLOCK, SPEED, DROP = 25.0,")
    )
    for part in checkout.root.glob("examples/fake_chaser.py"):
        shutil.copy(part, folder)
    nodes = {
        "capture_detector": {"exit_when_done": False},
        "recorder": {"exit_when_done": False, "out": folder, "topics": f"[{', '.join(STREAMS)}]"},
        "launcher": {"scene": "tilt_0", "actuator": "output"},
    }
    own = checkout.root / "capture_sim" / "nodes"
    started = [checkout.start(rig, "--ros-args", "-p", "rate:=25.0")]
    try:
        for name, values in nodes.items():
            code = "".join(path.read_text() for path in own.rglob("*.py"))
            known = {**values, **(PATIENCE if name == "launcher" else {})}
            known = {k: v for k, v in known.items() if f'"{k}"' in code}
            parameters = [x for k, v in known.items() for x in ("-p", f"{k}:={_yaml(v)}")]
            arguments = ["-m", f"capture_sim.nodes.{name}", "--ros-args", *parameters]
            started.append(checkout.start(*arguments))
            log = started[-1][1]
            until(lambda log=log: "ready" in text_of(log), f"{name} ready: {text_of(log)}")
        operator = checkout.start(__file__, "--operate", ".")
        started.append(operator)
        until(lambda: operator[0].poll() is not None, "the trial's end", 240.0)
        if operator[0].returncode:
            logs = "\n".join(text_of(log) for _, log in started)
            raise SystemExit(f"the trial failed:\n{logs}")
        recorder = started[2][1]
        until(lambda: "complete" in text_of(recorder), "the recording")
    finally:
        for process, _ in reversed(started):
            process.terminate()
        for process, _ in started:
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    return next(folder.glob("*.mcap"))


def _yaml(value):
    return str(value).lower() if isinstance(value, bool) else str(value)


def operate():
    """Run one trial as an operator does: by the action, or by the services before there was one."""
    import rclpy

    try:
        from capture_sim.nodes.base.dds import configure
    except ImportError:  # of a state before 0.2.0
        from capture_sim.nodes.dds import configure

    configure(os.environ)
    rclpy.init()
    node = rclpy.create_node("operator")

    def answer(future):
        rclpy.spin_until_future_complete(node, future, timeout_sec=200.0)
        return future.result()

    try:
        from capture_sim.action import RunTrial
    except ImportError:
        from capture_sim.msg import CaptureStatus
        from std_srvs.srv import Trigger

        verdicts = []
        node.create_subscription(CaptureStatus, "capture/status", verdicts.append, 100)

        def ask(name):
            client = node.create_client(Trigger, name)
            until(client.service_is_ready, name)
            response = answer(client.call_async(Trigger.Request()))
            if not response.success:
                raise SystemExit(f"{name}: {response.message}")

        time.sleep(2.0)  # discovery
        ask("/launcher/launch")
        end = time.monotonic() + 60.0
        while not any(status.final for status in verdicts) and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
        ask("/launcher/end_trial")
        return
    from rclpy.action import ActionClient

    client = ActionClient(node, RunTrial, "/launcher/run_trial")
    until(client.server_is_ready, "/launcher/run_trial")
    time.sleep(2.0)
    note = "made for the archive"
    goal = answer(client.send_goal_async(RunTrial.Goal(name="trial", note=note)))
    result = answer(goal.get_result_async()).result
    print(result)
    if not result.complete:
        raise SystemExit("the trial's recording is not complete")


def make(root, out):
    """Write the files of a checkout to a folder."""
    checkout = Checkout(root, out)
    checkout.run("run", SCENE, "--out", out / "run", names=["offline.mcap", "offline_results.json"])
    checkout.run("bench", SCENE, "--out", out / "bench", names=["nodes.mcap", "nodes_results.json"])
    (out / "scene.yaml").write_text(checkout.run("show", SCENE, names=["scene.yaml"]))
    for folder, name in (("run", "offline"), ("bench", "nodes")):
        (out / folder / "every_part.mcap").rename(out / f"{name}.mcap")
        (out / folder / "results.json").rename(out / f"{name}_results.json")
        shutil.rmtree(out / folder)
    if checkout.has("sweep"):
        checkout.run("sweep", SCENE, *VARIED, "--out", out / "s/sweep.csv", names=["sweep.csv"])
        table = (out / "s/sweep.csv").read_text()
        (out / "sweep.csv").write_text(table.replace(f"{ARCHIVE}/", ""))
        shutil.rmtree(out / "s")
    run_trial(checkout, out / "trial").rename(out / "trial.mcap")
    shutil.rmtree(out / "trial")
    checkout.commands["trial.mcap"] = "examples/fake_rig.py, capture_detector, recorder, launcher"
    # status 1: not the verdict of the nodes, or a problem of the file
    detected = {
        p.name: checkout.run("detect", p, statuses=(0, 1)) for p in sorted(out.glob("*.mcap"))
    }
    shutil.copytree(root / "msg", out / "msg")
    made = {
        "commit": git(root, "rev-parse", "--short=7", "HEAD"),
        "version": checkout.run("--version").split()[-1],
        "commands": checkout.commands,
        "detected": detected,
    }
    (out / "made.json").write_text(json.dumps(made, indent=2) + "\n")


def git(root, *arguments):
    return subprocess.check_output(["git", "-C", root, *arguments], text=True).strip()


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("checkout", type=Path, help="a clone in which `make setup` was run")
    parser.add_argument("--operate", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.operate:
        return operate()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        make(options.checkout, out)
        made = json.loads((out / "made.json").read_text())
        target = ARCHIVE / (made["commit"] if made["version"] == "0.1.0" else made["version"])
        large = [p.name for p in out.rglob("*") if p.is_file() and p.stat().st_size > LIMIT]
        for path in sorted(out.rglob("*")):
            if path.is_file():
                print(f"{path.stat().st_size:8d}  {path.relative_to(out)}")
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(out, target)
    print(target)
    if large:
        print(f"larger than {LIMIT} bytes: {', '.join(large)}", file=sys.stderr)
    return 1 if large else 0


if __name__ == "__main__":
    raise SystemExit(main())
