"""Plugin of pytest for run.py: writes the outcomes, and runs only what passed before."""

import json
import os
from pathlib import Path

_OUTCOMES = Path(os.environ["FAULTS_OUTCOMES"])
_ONLY = os.environ.get("FAULTS_ONLY")
_found = {"passed": [], "failed": [], "not run": []}


def pytest_collection_modifyitems(config, items):
    if _ONLY:
        only = set(json.loads(Path(_ONLY).read_text(encoding="utf-8")))
        items[:] = [item for item in items if item.nodeid in only]


def pytest_collectreport(report):
    if report.failed:
        _found["not run"].append(str(report.longrepr).strip().splitlines()[-1])


def pytest_runtest_logreport(report):
    if report.failed:
        _found["failed"].append(report.nodeid)
    elif report.skipped and isinstance(report.longrepr, tuple):
        _found["not run"].append(report.longrepr[2])
    elif report.when == "call" and report.passed:
        _found["passed"].append(report.nodeid)


def pytest_unconfigure():
    _OUTCOMES.write_text(json.dumps(_found), encoding="utf-8")
