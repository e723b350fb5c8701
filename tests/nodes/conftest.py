"""Nodes for a test, ended with it."""

import pytest
from bench_processes import processes


@pytest.fixture
def start():
    """Start a node: its name, Python code that changes it before, and parameters."""
    with processes() as start:
        yield start
