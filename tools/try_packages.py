"""Tries the packages of a lock file in an environment that has them; run by `make lock`.

    python tools/try_packages.py requirements/workstation.txt

Imports each package, and uses those of the extras as this package does: pins that a resolver
accepts may still not work together.
"""

from __future__ import annotations

import importlib
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

#: Packages that need a ROS environment, or are programs and plugins rather than modules.
_LEFT_OUT = re.compile(r"ros-.*|cmake|ninja|uv|ruff|mypy|launch.*")


def modules_of(lock: Path) -> Iterator[tuple[str, str]]:
    """Yield each public module of the locked packages, and its package."""
    lines = lock.read_text(encoding="utf-8").splitlines()
    names = {_normal(line.partition("==")[0]) for line in lines if "==" in line}
    for module, packages in sorted(packages_distributions().items()):
        package = _normal(packages[0])
        is_public = module.isidentifier() and not module.startswith("_")
        if is_public and package in names and not _LEFT_OUT.fullmatch(package):
            yield module, package


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name.strip()).lower()


def use_tables() -> None:
    """Write and read a table as Parquet."""
    import pandas

    from capture_sim.recording.sweep_file import arrow

    _, parquet = arrow()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.parquet"
        table = pandas.DataFrame({"a": [1.0, 2.0], "b": ["x", "y"]})
        table.to_parquet(path)
        assert pandas.read_parquet(path).equals(table)
        assert parquet.read_table(path).num_rows == 2


def use_indices() -> None:
    """Draw by Saltelli's design, and analyse a known function of it."""
    import numpy as np
    from SALib.analyze import sobol as analysis
    from SALib.sample import sobol

    from capture_sim.studies.vary.sampling import problem_of

    problem = problem_of(2)
    shares = sobol.sample(problem, 256, calc_second_order=False, seed=1)
    found = analysis.analyze(problem, shares[:, 0], calc_second_order=False, seed=1)
    assert np.allclose(found["S1"], [1.0, 0.0], atol=0.05)


def use_front() -> None:
    """Sort points into fronts."""
    import numpy as np

    from capture_sim.studies.search.front import layers

    assert [front.tolist() for front in layers(np.array([[0.0, 0.0], [1.0, 1.0]]))] == [[0], [1]]


def use_viewer() -> None:
    """Log one value."""
    import rerun

    stream = rerun.RecordingStream("capture_sim_try")
    stream.log("value", rerun.Scalars(1.0))


def use_cluster() -> None:
    """Have a cluster of one thread add two numbers."""
    from distributed import Client

    with Client(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as c:
        assert c.submit(sum, [1, 2]).result() == 3


#: One use of each extra, by a package that shows whether the lock file has it.
USES: dict[str, tuple[Callable[[], None], ...]] = {
    "pandas": (use_tables, use_indices, use_front),
    "rerun-sdk": (use_viewer,),
    "distributed": (use_cluster,),
}


def main(lock: Path) -> int:
    """Try all; print what fails, one line each."""
    failures = []
    packages = set()
    for module, package in modules_of(lock):
        packages.add(package)
        try:
            importlib.import_module(module)
        except Exception as error:  # whatever a package raises when it is imported
            failures.append(f"import {module} ({package}): {error}")
    for package in packages & USES.keys():
        for use in USES[package]:
            try:
                use()
            except Exception as error:
                failures.append(f"{use.__name__}: {type(error).__name__}: {error}")
    for line in failures:
        print(f"{lock.name}: {line.splitlines()[0]}", file=sys.stderr)
    print(f"{lock.name}: {len(packages)} packages tried, {len(failures)} failures")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
