"""The part of the pip installation that is not plain Python: data files and the ROS messages.

    pip install .

where there is no ROS installs the core, recording and viewing: plain Python.

    pip install --no-build-isolation [-e] .

in an environment that has ROS (the wheels of pyproject.toml's extra ros, or a sourced
workspace) runs the same CMakeLists.txt as colcon into a staging folder, and hands what it
installs to setuptools, so that pip records and removes it.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

NAME = "capture_sim"
HERE = Path(__file__).resolve().parent
PREFIX = Path(sys.prefix)
INTERFACES = ("msg", "srv", "action")
DATA = (".action", ".csv", ".json", ".msg", ".py", ".rviz", ".srv", ".xml", ".yaml")
SITE_PACKAGES = Path(sysconfig.get_path("platlib")).relative_to(PREFIX)


def ament_prefixes() -> list[str]:
    """Return where packages of ROS may be, this environment first."""
    sourced = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return list(dict.fromkeys([str(PREFIX), *filter(None, sourced)]))


def makes_messages() -> bool:
    """Whether there is what compiles ROS messages."""
    return any(
        Path(prefix, "share", "rosidl_default_generators").is_dir() for prefix in ament_prefixes()
    )


def plain_data() -> list[tuple[str, list[str]]]:
    """Return the data files by the folder below PREFIX that they go to, without ROS."""
    by_folder: dict[str, list[str]] = {}
    for name in ("config", "launch", *INTERFACES):
        for file in sorted((HERE / name).rglob("*.*")):
            if file.suffix in DATA:
                path = file.relative_to(HERE)
                by_folder.setdefault(f"share/{NAME}/{path.parent}", []).append(str(path))
    return sorted(by_folder.items())


def cmake_install(build: Path) -> Path:
    """Configure, build and install below `build`; return the folder that stands for PREFIX."""
    # rosidl's rules do not notice a message that has gone
    interfaces = "\n".join(sorted(f.name for d in INTERFACES for f in (HERE / d).glob("*.*")))
    built = build / "interfaces.txt"
    if not built.is_file() or built.read_text() != interfaces:
        shutil.rmtree(build, ignore_errors=True)
        build.mkdir(parents=True)
        built.write_text(interfaces)
    stage = build / "stage"
    shutil.rmtree(stage, ignore_errors=True)
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONNOUSERSITE")}
    env["AMENT_PREFIX_PATH"] = env["CMAKE_PREFIX_PATH"] = os.pathsep.join(ament_prefixes())
    env["PATH"] = os.pathsep.join([str(PREFIX / "bin"), env["PATH"]])
    # The final prefix, reached through DESTDIR: with any other one CMake refuses an
    # environment that lies within the source tree, as .venv does.
    env["DESTDIR"] = str(stage)
    generator = ["-G", "Ninja"] if shutil.which("ninja", path=env["PATH"]) else []
    configure = [
        *("cmake", "-S", HERE, "-B", build, *generator, "-Wno-dev"),
        f"-DCMAKE_INSTALL_PREFIX={PREFIX}",
        f"-DPython3_EXECUTABLE={sys.executable}",
        "-DCMAKE_BUILD_TYPE=None",  # copying fields gains nothing from optimisation
        "-DCPP_MESSAGES=OFF",
        "-DBUILD_TESTING=OFF",
        "-DINSTALL_COMMAND=OFF",  # setuptools makes it, see pyproject.toml
    ]
    compile_and_install = [
        *("cmake", "--build", build, "--target", "install"),
        *("--parallel", str(os.cpu_count() or 1)),
    ]
    for command in (configure, compile_and_install):
        status = subprocess.run([str(word) for word in command], env=env).returncode
        if status:  # SystemExit: setuptools overlooks other errors of an editable build
            sys.exit(f"{command[0]} failed with status {status}; its output is above (pip -v)")
    return stage / PREFIX.relative_to(PREFIX.anchor)


class BuildWithMessages(build_py):
    """Add what CMake made to the plain Python package."""

    def run(self):
        super().run()
        stage = cmake_install(HERE / "build" / f"pip-{sys.implementation.cache_tag}")
        files = [f.relative_to(stage) for f in stage.rglob("*") if f.is_file()]
        package = SITE_PACKAGES / NAME
        messages = [f for f in files if package in f.parents and self.is_message(package, f)]
        tf2_msgs = SITE_PACKAGES / "tf2_msgs"  # where the distribution has none
        others = [f for f in files if SITE_PACKAGES not in f.parents or tf2_msgs in f.parents]
        if self.editable_mode:
            # Modules and data stay in the source tree, and it stays clean: the messages go
            # to site-packages, where the package's extend_path finds them.
            data = [f for f in others if f.parts[2:3] not in (("config",), ("launch",))]
            data += messages
        else:
            data = others
            for f in messages:
                target = Path(self.build_lib) / f.relative_to(SITE_PACKAGES)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(stage / f, target)
        by_folder = {}
        for f in sorted(data):
            by_folder.setdefault(str(f.parent), []).append(os.path.relpath(stage / f, HERE))
        self.distribution.data_files = sorted(by_folder.items())

    @staticmethod
    def is_message(package, file):
        """Whether rosidl made this file of the package: msg/*.py, srv/*.py, ... or a library."""
        inside = file.relative_to(package)
        return inside.suffix == ".so" or (inside.parts[0] in INTERFACES and inside.suffix == ".py")


class BinaryDistribution(Distribution):
    """Gives the wheel a platform tag, and its data files a place in an editable one."""

    def has_ext_modules(self):
        return True

    def has_data(self):
        return self.has_data_files()


if makes_messages():
    setup(cmdclass={"build_py": BuildWithMessages}, distclass=BinaryDistribution)
else:
    setup(data_files=plain_data())
