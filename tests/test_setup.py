"""The set-up of .venv: what it notices, and what it says when the machine lacks something."""

import importlib.util
import os
import re
import shutil
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def load(name):
    """Load a script of tools/ as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def setup_env():
    return load("setup_env")


@pytest.fixture
def project(tmp_path, setup_env, monkeypatch):
    """Return a copy of what the set-up depends on, which `setup_env` then takes for the project."""
    for name in ("CMakeLists.txt", "package.xml", "pyproject.toml", "setup.py"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("msg", "requirements", "tools"):
        shutil.copytree(ROOT / name, tmp_path / name)
    monkeypatch.setattr(setup_env, "ROOT", tmp_path)
    return tmp_path


def test_a_change_is_noticed(project, setup_env):
    for file, text, part in (
        ("msg/BenchState.msg", "\nbool more  # or not\n", "package"),
        ("msg/Another.msg", "bool more  # or not\n", "package"),
        ("srv/Reset.srv", "---\n", "package"),
        ("action/Wait.action", "---\n---\n", "package"),
        ("CMakeLists.txt", "\n", "package"),
        ("setup.py", "\n", "package"),
        ("requirements/lock.txt", "\n", "requirements"),
        ("tools/finish_venv.py", "\n", "requirements"),
        ("pyproject.toml", "\n[tool.other]\n", None),
        ("capture_sim/errors.py", "\n", None),
        ("msg/BenchState.msg", None, "package"),
    ):
        before, path = setup_env.wanted_state(), project / file
        path.parent.mkdir(exist_ok=True)
        if text is None:
            path.unlink()
        else:
            path.write_text((path.read_text() if path.exists() else "") + text)
        after = setup_env.wanted_state()
        assert [key for key in before if before[key] != after[key]] == ([part] if part else []), (
            file
        )


def test_what_is_done_is_not_done_again_after_a_failure(project, setup_env, monkeypatch):
    for name, path in (("STAMP", "setup.json"), ("LOG", "setup.log"), ("PYTHON", "python")):
        monkeypatch.setattr(setup_env, name, project / path)
    (project / "python").touch()
    done = []

    def steps(develop):
        done.clear()
        setup_env.set_up(develop)
        return done

    def fail(*_):
        done.append("package")
        raise setup_env.SetupError("a message is wrong")

    monkeypatch.setattr(setup_env, "make_venv", lambda *_: done.append("python"))
    monkeypatch.setattr(setup_env, "install_requirements", lambda *_: done.append("packages"))
    monkeypatch.setattr(setup_env, "install_development", lambda *_: done.append("development"))
    monkeypatch.setattr(setup_env, "install_package", fail)
    for expected in (["python", "packages", "package"], ["package"]):
        with pytest.raises(setup_env.SetupError):
            steps(True)
        assert done == expected
    monkeypatch.setattr(setup_env, "install_package", lambda *_: done.append("package"))
    assert steps(False) == ["package"]
    assert steps(True) == ["development"]
    assert steps(False) == steps(True) == []
    setup_env.STAMP.write_text("{half a fi")
    assert setup_env.found_state() == {}


def test_every_line_of_the_set_up_names_its_step(tmp_path, setup_env, monkeypatch, capsys):
    """Where the output is no terminal: lines while a step lasts, and one at its end."""
    monkeypatch.setattr(setup_env, "LOG", tmp_path / "setup.log")
    monkeypatch.setattr(setup_env.Progress, "PERIOD", 0.0)
    wait = "import time; print('compiling', flush=True); time.sleep(1.5)"
    setup_env.Progress().run("Messages", [sys.executable, "-c", wait])
    *lines, last = capsys.readouterr().out.splitlines()
    assert all(re.fullmatch(r"  Messages \.\.\. \d+ s  (compiling)?", line) for line in lines)
    assert any(line.endswith("compiling") for line in lines)
    assert re.fullmatch(r"  Messages: done in [\d.]+ s", last)


def test_a_machine_that_lacks_something_is_told_what(setup_env, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(sys, "argv", ["setup_env.py"])
    with monkeypatch.context() as lacking:
        lacking.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
        lacking.setenv("CC", "no-such-cc")
        assert setup_env.main() == 2
    said = capsys.readouterr().err
    assert "Python's headers, the compiler no-such-cc" in said
    assert "apt-get install g++ python3-dev\n" in said
    for version, words in (((3, 9), "3.11 or later (this is 3.9)"), ((3, 15), "no wheels")):
        monkeypatch.setattr(sys, "version_info", (*version, 0, "final", 0))
        assert not setup_env.check_machine()
        assert words in capsys.readouterr().err


def test_nothing_of_a_sourced_ros_gets_in(setup_env, monkeypatch):
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"):
        monkeypatch.setenv(name, "/opt/ros/jazzy")
    assert "/opt/ros/jazzy" not in setup_env.clean_environment().values()


def test_every_requirement_is_pinned(setup_env):
    pins = (ROOT / "requirements" / "lock.txt").read_text().lower()
    pinned = set(re.findall(r"^([\w.-]+)==[\w.]+(?: \\)?$", pins, re.MULTILINE))
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    wanted = setup_env.requirements(project, (*setup_env.RUN_EXTRAS, *setup_env.DEVELOP_EXTRAS))
    for extra in (*project["optional-dependencies"].values(), wanted):
        for requirement in extra:
            name = re.match(r"[\w.-]+", requirement).group().lower()
            assert name in pinned or name == "capture_sim", requirement


def test_mending_changes_no_shared_file(tmp_path):
    """An installer may link files from its cache: the cache's copy stays as it was."""
    finish_venv = load("finish_venv")
    cached, installed = tmp_path / "cached", tmp_path / "installed"
    cached.write_text("include /opt/python/cp311-cp311/include/python3.11\n")
    os.link(cached, installed)
    pattern = r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+"
    assert finish_venv.replace_text(installed, pattern, "/here")
    assert installed.read_text() == "include /here\n"
    assert cached.read_text().startswith("include /opt/python")
