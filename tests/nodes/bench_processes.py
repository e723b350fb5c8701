"""Nodes in processes of their own, and a client to talk to them, for tests and benchmarks."""

import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache

import rclpy
from rcl_interfaces.srv import ListParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from capture_sim.control.simulation import State
from capture_sim.messages.topics import BENCH_STATE, CLOCK, RUN_INFO
from capture_sim.nodes.endpoints import message_class, qos_of
from capture_sim.nodes.services import definitions

#: A service that does not know yet where to answer waits 0.1 s for that and then drops the answer
#: (rmw_fastrtps issue 842): s until one that may be asked twice is asked again.
AGAIN = 2.0
#: What is waited for comes within this long, s, on a slow and busy machine too.
PATIENCE = 120.0


@dataclass
class Started:
    """A node's process and what it says."""

    process: subprocess.Popen
    lines: list = field(default_factory=list)

    def __post_init__(self):
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        self.lines.extend(iter(self.process.stdout.readline, ""))

    @property
    def text(self):
        return "".join(self.lines)

    def wait_for(self, words, timeout=PATIENCE, since=0):
        """Wait until the node says something, in the lines from ``since`` on."""
        deadline = time.monotonic() + timeout
        while words not in "".join(self.lines[since:]):
            assert time.monotonic() < deadline, f"never said {words!r}:\n{self.text}"
            time.sleep(0.01)

    def end(self):
        """End the node as Ctrl-C does and return its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        return self.status()

    def status(self, timeout=PATIENCE):
        """Wait for the end and return the exit status."""
        status = self.process.wait(timeout)
        self.reader.join(5.0)
        return status


def fresh(program, arguments):
    """Start Python with a program."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def statuses(nodes, first="simulator"):
    """Wait for the end of one node, then end the others; return all exit statuses by name."""
    found = {first: nodes[first].status()}
    return found | {name: node.end() for name, node in nodes.items() if name != first}


@contextmanager
def processes(begin=fresh):
    """Give a function that starts a node: its name, Python code that changes it, parameters.

    ``begin`` starts a process of a program and its arguments.
    """
    started = []

    def start(name, change="", **parameters):
        arguments = ["--ros-args"]
        ends = {"exit_when_done": "true"} if name == "simulator" else {}
        for key, value in (ends | parameters).items():
            remaps = key.startswith("__") or "/" in key
            arguments += ["-r" if remaps else "-p", f"{key}:={value}"]
        program = f"from capture_sim.nodes import {name} as node\n{textwrap.dedent(change)}\n"
        program += "raise SystemExit(node.main())"
        started.append(Started(begin(program, arguments)))
        return started[-1]

    try:
        yield start
    finally:
        for node in started:
            if node.process.poll() is None:
                node.process.kill()
            node.process.wait()


@cache
def join_dds():
    """Let this process take part, once and until it ends; return the node that keeps it there.

    A DDS participant is destroyed with its last node, and Fast DDS may then spin for ever if
    another comes or goes in that moment: see capture_sim.interrupts.end_within.
    """
    rclpy.init(args=[])
    return rclpy.create_node("keeper", enable_rosout=False, start_parameter_services=False)


class Asking:
    """Calls services for a client with a ``node`` that is spun in another thread.

    A response may be lost on the way to a client that its server has just met.  A request that may
    be repeated is repeated; before any other one, the server has to answer one that may.
    """

    def ask(self, kind, name, **fields):
        """Call a service and return its response."""
        return self.begin(kind, name, **fields)()

    def begin(self, kind, name, **fields):
        """Call a service; return a function that waits for the response."""
        client = self._clients.get(name)
        is_new = client is None
        if is_new:
            client = self._clients[name] = self.node.create_client(kind, name)
        wait_until(client.service_is_ready, what=f"no service {name}")
        is_repeatable = kind.__name__.startswith(("Get", "List", "SetParameters"))
        if is_new and not is_repeatable:
            self.await_answers_of(name.rpartition("/")[0])
        request = kind.Request(**fields)
        answers = [client.call_async(request)]

        def response():
            began = time.monotonic()
            while not (done := [answer for answer in answers if answer.done()]):
                waited = time.monotonic() - began
                assert waited < PATIENCE, f"{name} did not answer"
                if is_repeatable and waited > AGAIN * len(answers):
                    answers.append(client.call_async(request))
                time.sleep(0.0005)
            return done[0].result()

        return response

    def await_answers_of(self, node):
        """Wait until a node, by its full name, knows where to answer all clients made so far.

        Nodes announce their endpoints in turn: a server that answers the last one knows them all.
        """
        name = f"{node}/list_parameters"
        self._clients.pop(name, None)  # a new client, which is announced after the others
        self.ask(ListParameters, name)

    def set(self, node, **parameters):
        """Set parameters together; return whether that worked, and the reason if not."""
        wanted = [
            Parameter(key, value=value).to_parameter_msg() for key, value in parameters.items()
        ]
        name = f"/{node}/set_parameters_atomically"
        result = self.ask(SetParametersAtomically, name, parameters=wanted).result
        return result.successful, result.reason


class Client(Asking):
    """A node of this process that calls services, sets parameters and listens."""

    def __init__(self):
        join_dds()
        self.node = rclpy.create_node("experimenter")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._clients = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def close(self):
        self._closing.set()
        self._thread.join()
        self._executor.shutdown()
        # a node lives on until it is collected, and a simulator of the next test would wait for
        # its subscriptions
        self.node.destroy_node()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def listen(self, topic, wanted=lambda message: True):
        """Return a list that collects a topic's messages from now on, those that are wanted."""
        messages = []
        self.node.create_subscription(
            message_class(topic.type_name),
            topic.name,
            lambda message: messages.append(message) if wanted(message) else None,
            qos_of(topic),
        )
        return messages


def wait_until(condition, timeout=PATIENCE, what=""):
    """Wait until something is so."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, what or "waited in vain"
        time.sleep(0.002)


def service(name):
    return getattr(__import__(f"{definitions()}.srv", fromlist=[name]), name)


class Simulation:
    """The simulator, or a player, as a client of simulation_interfaces sees it."""

    def __init__(self, client, name="simulator"):
        self.client, self.name = client, name
        self.runs = client.listen(RUN_INFO, lambda info: info.run_id)
        self.states = client.listen(BENCH_STATE)
        self.clock = client.listen(CLOCK)

    def _ask(self, kind, **fields):
        words = re.sub("(?<!^)(?=[A-Z])", "_", kind).lower()
        return self.client.ask(service(kind), f"/{self.name}/{words}", **fields)

    def set(self, state):
        kind = service("SetSimulationState").Request().state.__class__
        result = self._ask("SetSimulationState", state=kind(state=int(state))).result
        return result.result, result.error_message

    @property
    def state(self):
        return State(self._ask("GetSimulationState").state.state)

    def reset(self, scope=0):
        result = self._ask("ResetSimulation", scope=scope).result
        return result.result, result.error_message

    def settle(self):
        """Return how many states have come once no more do."""
        count = -1
        while count != len(self.states):
            count = len(self.states)
            time.sleep(0.2)
        return count
