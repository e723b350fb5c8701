"""Nodes for a test, ended with it."""

import pytest
from bench_processes import processes
from forked import Forked


@pytest.fixture
def start():
    """Start a node: its name, Python code that changes it before, and parameters."""
    with processes(Forked) as start:
        yield start
