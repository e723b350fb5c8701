"""A domain and nodes for a test, ended with it."""

import faulthandler

import pytest

from tests.nodes.bench_client import Client
from tests.nodes.bench_processes import processes
from tests.nodes.forked import Forked
from tests.nodes.own_domain import own_domain

#: No test takes as long, s; where Python hangs with its lock, pytest-timeout does not help.
HANGS = 600.0


@pytest.fixture(autouse=True)
def _ends():
    """End this process if a test hangs: pytest-xdist goes on with the other tests in a new one."""
    faulthandler.dump_traceback_later(HANGS, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(autouse=True)
def _domain():
    with own_domain():
        yield


@pytest.fixture
def start(_domain):
    """Start a node: its name, Python code that changes it before, and parameters."""
    with processes(Forked) as start:
        yield start


@pytest.fixture
def client(_domain):
    with Client() as client:
        yield client
