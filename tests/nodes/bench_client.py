"""A plain node that talks to the nodes under test, and the one way in which tests wait."""

import os
import re
import threading
import time

import capture_sim.srv
import rclpy
from rcl_interfaces.srv import ListParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from capture_sim.messages.topics import BENCH_STATE, CLOCK, RUN_INFO
from capture_sim.nodes.base.endpoints import message_class, qos_of
from capture_sim.nodes.simulation.control import State
from tests.nodes.own_domain import participant

#: What is waited for makes some progress within this long, s, where a process has a core; where
#: more processes want one, it gets a share of it (:func:`patience`) ...
PATIENCE = 30.0
#: ... and has come after this long.
LONGEST = 240.0
#: A service that does not know yet where to answer waits 0.1 s for that and then drops the answer
#: (rmw_fastrtps issue 842): s until a request that may be repeated is repeated.
AGAIN = 2.0


def patience():
    """Return the time in which a waiting process gets as much of a core as in PATIENCE alone, s."""
    share = os.getloadavg()[0] / (os.cpu_count() or 1)
    return min(PATIENCE * max(1.0, share), LONGEST)


def wait_until(condition, what="waited in vain", progress=lambda: None):
    """Wait until a condition holds, as long as the value of ``progress`` changes meanwhile."""
    began = since = time.monotonic()
    seen = progress()
    while not condition():
        now = time.monotonic()
        if now > since + PATIENCE and now > since + patience():
            before, seen, since = seen, progress(), now
            is_stuck = seen == before or now > began + LONGEST
            assert not is_stuck, what() if callable(what) else what
        time.sleep(0.002)


def ros_arguments(parameters):
    """Return parameters and remappings, by name, as a node's command line has them."""
    arguments = ["--ros-args"]
    for key, value in parameters.items():
        if key.startswith("--"):
            arguments += [key, str(value)]
        else:
            is_remap = key.startswith("__") or "/" in key
            arguments += ["-r" if is_remap else "-p", f"{key}:={value}"]
    return arguments


def statuses(nodes, first="simulator"):
    """Wait for the end of one node, then end the others; return all exit statuses by name."""
    found = {first: nodes[first].status()}
    return found | {name: node.end() for name, node in nodes.items() if name != first}


class Client:
    """A plain node of this process's participant: it calls services, sets parameters, listens.

    A response may be lost on the way to a client that its server has just met.  A request that may
    be repeated is repeated; before any other one, the server has to answer one that may.
    """

    def __init__(self, name="experimenter", **options):
        self.context = participant()
        self.node = rclpy.create_node(name, context=self.context, **options)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._clients = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=0.02)

    def stop(self):
        """Run no callback any more."""
        self._closing.set()
        self._thread.join()

    def close(self):
        """Leave the network."""
        self.stop()
        self._executor.remove_node(self.node)  # else its endpoints stay
        self._executor.shutdown()
        for part in list(self.node.waitables):  # of an action: destroy_node leaves them
            getattr(part, "destroy", lambda: None)()
        self.node.destroy_node()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def ask(self, kind, name, **fields):
        """Call a service and return its response."""
        return self.begin(kind, name, **fields)()

    def begin(self, kind, name, **fields):
        """Call a service; return a function that waits for the response."""
        client = self._clients.get(name)
        is_new = client is None
        if is_new:
            client = self._clients[name] = self.node.create_client(kind, name)
        wait_until(client.service_is_ready, f"no service {name}")
        is_repeatable = kind.__name__.startswith(("Get", "List", "Describe", "SetParameters"))
        if is_new and not is_repeatable:
            self.await_answers_of(name.rpartition("/")[0])
        request = kind.Request(**fields)
        answers = [client.call_async(request)]

        def response():
            began = time.monotonic()

            def has_come():
                if is_repeatable and time.monotonic() > began + AGAIN * len(answers):
                    answers.append(client.call_async(request))
                return any(answer.done() for answer in answers)

            wait_until(has_come, f"{name} did not answer")
            return next(answer for answer in answers if answer.done()).result()

        return response

    def await_answers_of(self, node):
        """Wait until a node, by its full name, knows all endpoints that were made here so far.

        Endpoints are announced in turn: a server that answers the last one knows them all.
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

    def listen(self, topic, is_wanted=lambda message: True, qos=None):
        """Return a list that collects a topic's messages from now on, those that are wanted."""
        messages = []

        def take(message):
            if is_wanted(message):
                messages.append(message)

        self.subscribe(topic.type_name, topic.name, take, qos or qos_of(topic))
        return messages

    def subscribe(self, type_name, name, callback, qos=10, **options):
        """Call a function with each message of any topic."""
        kind = message_class(type_name)
        self.node.create_subscription(kind, name, callback, qos, **options)


class Simulation:
    """The simulator, or a player, as a client of its services sees it."""

    def __init__(self, client, name="/simulator"):
        self.client, self.name = client, name
        self.runs = client.listen(RUN_INFO, lambda info: info.run_id)
        self.states = client.listen(BENCH_STATE)
        self.clock = client.listen(CLOCK)

    def _ask(self, kind, **fields):
        words = re.sub("(?<!^)(?=[A-Z])", "_", kind).lower()
        return self.client.ask(getattr(capture_sim.srv, kind), f"{self.name}/{words}", **fields)

    def set(self, state):
        kind = capture_sim.srv.SetSimulationState.Request().state.__class__
        result = self._ask("SetSimulationState", state=kind(state=int(state))).result
        return result.result, result.error_message

    @property
    def state(self):
        return State(self._ask("GetSimulationState").state.state)

    def reset(self, scope=0):
        result = self._ask("ResetSimulation", scope=scope).result
        return result.result, result.error_message
