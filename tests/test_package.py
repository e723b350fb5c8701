"""The package's files agree with each other."""

import ast
import doctest
import inspect
import os
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from importlib import import_module
from pathlib import Path

import pytest

import capture_sim
from capture_sim import cli
from capture_sim.base import resources
from capture_sim.nodes import start

ROOT = Path(__file__).resolve().parent.parent
MANIFEST = ET.parse(ROOT / "package.xml").getroot()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CMAKE = (ROOT / "CMakeLists.txt").read_text()
INTERFACES = sorted(f for kind in ("msg", "srv", "action") for f in ROOT.glob(f"{kind}/*.{kind}"))


def cmake_list(name):
    """Return the words of ``set(name ...)`` in CMakeLists.txt."""
    return re.search(rf"set\({name}\s+([^)]*)\)", CMAKE).group(1).split()


WITH_EXAMPLES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in (ROOT / "capture_sim").rglob("*.py")
    if "\n>>> " in (text := path.read_text()) or "    >>> " in text
)


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_of_docstrings_run(module):
    results = doctest.testmod(import_module(module))
    assert results.attempted > 0
    assert results.failed == 0


@pytest.mark.parametrize("begin", ["cli.main(['scenes'])", "nodes.start.start('simulator')"])
def test_commands_and_nodes_have_one_thread_for_linear_algebra(begin):
    """Else threads wait for each other on a busy machine.  It must be so when NumPy is loaded."""
    code = f"""
import os, sys, capture_sim.cli, capture_sim.nodes.start

class Watch:
    def find_spec(name, *_):
        if name == "numpy":
            print("loaded with", os.environ.get("OPENBLAS_NUM_THREADS"), flush=True)

sys.meta_path.insert(0, Watch)
sys.argv = ["simulator", "--help"]
try:
    capture_sim.{begin}
finally:
    import numpy
"""
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    command = [sys.executable, "-c", code]
    shown = subprocess.run(command, env=environment, capture_output=True, text=True).stdout
    assert re.findall("loaded with (.*)", shown) == ["1"]


#: Functions and classes of the first lines of a script, by their modules where not at the top.
TEACH = ("simulate", "load_scene", "read_run", "Scene", "Bench", "sweep", "calibrate", "Run")
TEACH += ("CaptureState", "EventKind", "Phase", "studies.search.design.design_buffer")


@pytest.mark.parametrize("name", TEACH)
def test_what_a_script_begins_with_has_an_example(name):
    module, _, name = f"capture_sim.{name}".rpartition(".")
    text = inspect.getdoc(getattr(import_module(module), name))
    assert text.count("\n>>> ") >= 2
    for other in re.findall(r"^(capture_sim[\w.]+) : ", text, re.MULTILINE):  # See Also
        module, _, name = other.rpartition(".")
        assert hasattr(import_module(module), name) or import_module(other)


def test_manifest_and_project_agree():
    assert MANIFEST.findtext("version") == capture_sim.__version__
    assert PROJECT["dynamic"] == ["version"]  # the package's: it has none of its own
    assert MANIFEST.findtext("name") == PROJECT["name"] == "capture_sim"
    assert MANIFEST.findtext("license") == PROJECT["license"] == "Apache-2.0"
    description = PROJECT["description"]
    assert MANIFEST.findtext("description") == description
    maintainer = MANIFEST.find("maintainer")
    assert PROJECT["authors"] == [{"name": maintainer.text, "email": maintainer.get("email")}]


def test_the_project_is_described_once(capsys):
    """In the index of packages, README, the site, a citation, `help` and `import`."""
    description = PROJECT["description"]
    assert description.startswith("Simulation of ")
    readme = (ROOT / "README.md").read_text().split("\n\n")
    assert readme[:2] == ["# capture_sim", f"{description}."]
    site = re.search(r"^site_description: (.*)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    assert site[1] == description
    [title] = re.findall(r'^title: "capture_sim: (.*)"$', (ROOT / "CITATION.cff").read_text(), re.M)
    assert title == description[0].lower() + description[1:]
    assert capture_sim.__doc__.splitlines()[0] == f"{description}."
    assert cli.main(["--help"]) == 0
    assert description in capsys.readouterr().out


def test_help_of_a_node_is_for_a_user():
    """The docstring of its class is printed, so it names pages and not modules."""
    nodes = []
    for path in (ROOT / "capture_sim" / "nodes").glob("*.py"):
        classes = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.ClassDef)]
        nodes += [n for n in classes if "BenchNode" in map(ast.unparse, n.bases)]
    assert len(nodes) == 8
    for node in nodes:
        text = ast.get_docstring(node)
        assert not re.search(r":\w+:`|capture_sim\.", text), node.name
        for page in re.findall(r"docs/[\w/]+\.md", text):
            assert (ROOT / page).is_file(), page


def test_addresses_belong_to_nobody():
    """Those of RFC 2606, which nobody can register: an invented one may be somebody's."""
    names = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).splitlines()
    reserved = re.compile(r"example\.(com|net|org)|.*\.(example|invalid|test|localhost)")
    for name in names:
        try:
            text = (ROOT / name).read_text()
        except UnicodeDecodeError:
            continue  # a picture
        for host in re.findall(r"\b[\w.+-]+@((?:[a-z0-9-]+\.)+[a-z]{2,})\b", text):
            assert reserved.fullmatch(host), f"{name}: {host}"


def test_interface_dependencies_are_declared():
    used = {
        match.group(1)
        for path in INTERFACES
        for match in re.finditer(r"^\s*(\w+)/\w+", path.read_text(), re.MULTILINE)
    }
    assert used <= set(cmake_list("interface_dependencies"))
    assert set(cmake_list("interface_dependencies")) == {e.text for e in MANIFEST.iter("depend")}


def imported_packages(path):
    """Return the packages that a file imports or takes message types of, Python's own left out."""
    tree, names = ast.parse(path.read_text()), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module.partition(".")[0])
        elif isinstance(node, ast.Constant):
            found = re.fullmatch(r"([a-z][a-z0-9_]*)/(?:msg|srv)/[A-Z]\w*", str(node.value))
            names |= {found[1]} if found else set()
    return names - sys.stdlib_module_names - {"capture_sim"}


def test_all_that_is_imported_is_declared():
    """What ROS brings in package.xml; what PyPI brings, where rosdep has not all, in pyproject."""
    ros = {e.text for tag in ("depend", "exec_depend") for e in MANIFEST.iter(tag)}
    extras = [line for lines in PROJECT["optional-dependencies"].values() for line in lines]
    pip = {
        re.match(r"[\w-]+", line)[0].lower().replace("-", "_")
        for line in (*PROJECT["dependencies"], *extras)
    }
    # modules of another name, and what a package brings along by its own metadata
    brought = {"yaml": "pyyaml", "rerun": "rerun_sdk", "llvmlite": "numba"}
    brought |= {"lz4": "mcap", "zstandard": "mcap", "PIL": "pillow", "markupsafe": "jinja2"}
    pip |= {name for name, package in brought.items() if package in pip}
    named = {"mocap4r2_msgs", "motion_capture_tracking_interfaces"}  # in errors only: never read
    used = {}
    for path in [*ROOT.glob("capture_sim/**/*.py"), *ROOT.glob("launch/*.py")]:
        for name in imported_packages(path):
            used.setdefault(name, path.relative_to(ROOT))
    assert {n: path for n, path in used.items() if not {n, n.lower()} & (ros | pip | named)} == {}


def test_executables_exist():
    executables = cmake_list("executables")
    for name in executables:
        assert callable(import_module(f"capture_sim.nodes.{name}").main)
    scripts = {
        f"capture-sim-{n.replace('_', '-')}": f"capture_sim.nodes.start:{n}" for n in executables
    }
    assert all(callable(getattr(start, name)) for name in executables)
    assert PROJECT["scripts"] == {"capture-sim": "capture_sim.cli:main", **scripts}
    assert callable(cli.main)


@pytest.mark.parametrize(
    "data, patterns",
    [("config", ("*.csv", "*.json", "*.rviz", "*.xml", "*.yaml")), ("launch", ("*.py",))],
)
def test_all_data_is_installed(data, patterns):
    assert all(f"{data}/{pattern}" in CMAKE for pattern in patterns)
    installed = {path for pattern in patterns for path in (ROOT / data).rglob(pattern)}
    files = {p for p in (ROOT / data).rglob("*") if p.is_file() and "__pycache__" not in p.parts}
    assert files == installed


@pytest.mark.parametrize(
    "layout", ["lib/python3.11/site-packages", "local/lib/python3.12/dist-packages"]
)
def test_installed_data_is_found(tmp_path, layout):
    """An installed copy, away from the sources and from sys.prefix, finds its share folder."""
    package = tmp_path / layout / "capture_sim"
    (package / "base").mkdir(parents=True)
    for folder in (package, package / "base"):
        (folder / "__init__.py").touch()
    (package / "base" / "resources.py").write_bytes(Path(resources.__file__).read_bytes())
    for name in ("config", "msg"):
        (tmp_path / "share" / "capture_sim" / name).mkdir(parents=True)
    script = "from capture_sim.base import resources as r; print(r.config_dir(), r.message_dir())"
    command = [sys.executable, "-c", script]
    found = subprocess.check_output(command, cwd=package.parent, text=True)
    share = tmp_path / "share" / "capture_sim"
    assert found.split() == [str(share / "config"), str(share / "msg")]


def numbers_without_reason(path):
    """Return the numeric constants of a module that have no comment: on, in or above them."""
    lines = path.read_text(encoding="utf-8").splitlines()
    found, commented = [], 0  # last line of the constants that share a comment
    for node in ast.parse("\n".join(lines)).body:
        if not isinstance(node, ast.Assign):
            continue
        begin, end = node.lineno - 1, node.end_lineno  # from 0, without the end
        own = any("#" in line for line in lines[begin:end])
        if own or lines[begin - 1].startswith("#") or begin == commented:
            commented = end
            continue
        names = [leaf.id for leaf in ast.walk(node.targets[0]) if isinstance(leaf, ast.Name)]
        kinds = (ast.Constant, ast.Tuple, ast.UnaryOp, ast.BinOp, ast.unaryop, ast.operator)
        is_number = all(
            isinstance(leaf, (*kinds, ast.expr_context)) for leaf in ast.walk(node.value)
        )
        numbers = [leaf.value for leaf in ast.walk(node.value) if isinstance(leaf, ast.Constant)]
        if is_number and any(type(number) in (int, float) for number in numbers):
            found.append(f"{path.name}: {', '.join(names)}")
    return found


def test_every_number_has_its_reason_beside_it():
    """A constant of a module, or a group of them, has a comment: what it is, and why so much."""
    modules = sorted(Path(capture_sim.__file__).parent.rglob("*.py"))
    assert [line for path in modules for line in numbers_without_reason(path)] == []
