"""Make an environment that holds the ros-* wheels one that CMake and colcon can build on.

Run with the environment's own Python after every installation of such wheels; running it
again changes nothing.

1. The CMake files in the wheels name places on the machine that built them: mend these.
2. Write setup.bash and its like, so that the environment can be sourced as a ROS workspace,
   and colcon chains overlays to it.
"""

import os
import re
import sys
import sysconfig
from pathlib import Path

import numpy

PREFIX = Path(sys.prefix)


def replace_text(path: Path, pattern: str, replacement: str) -> bool:
    """Replace in a file, by a new file: the old one may be shared with an installer's cache."""
    old = path.read_text()
    new = re.sub(pattern, lambda _: replacement, old)
    if new == old:
        return False
    fresh = path.with_name(path.name + ".new")
    fresh.write_text(new)
    os.replace(fresh, path)  # noqa: PTH105
    return True


def mend_cmake_files() -> int:
    """Mend the CMake files of the wheels; return how many changes that took."""
    changes = 0
    for path in PREFIX.glob("share/*/cmake/*rosidl_generator_py*Export.cmake"):
        # whatever version of NumPy was there before: 1 and 2 have different folders
        changes += replace_text(
            path, r'[^";]*/site-packages/numpy/_?core/include', numpy.get_include()
        )
        changes += replace_text(
            path,
            r"/opt/python/cp3\d+-cp3\d+/include/python3\.\d+",
            sysconfig.get_path("include"),
        )
    # Fast DDS brings its own OpenSSL and tinyxml2, yet asks for the system's to link to.
    fastrtps = PREFIX / "share" / "fastrtps" / "cmake"
    for path in fastrtps.glob("fastrtps-config.cmake"):
        changes += replace_text(path, r"find_package\(OpenSSL REQUIRED\)\n", "")
    for path in fastrtps.glob("fastrtps-shared-targets.cmake"):
        changes += replace_text(
            path,
            r'INTERFACE_LINK_LIBRARIES "[^"]*OpenSSL::[^"]*"',
            'INTERFACE_LINK_LIBRARIES "fastcdr;foonathan_memory"',
        )
    return changes


SETUP_SCRIPT = """\
# Written by tools/finish_venv.py: this environment as a ROS workspace to be sourced.
_prepend() {{  # variable, folder
  eval "_old=\\"\\${{$1-}}\\""
  case ":$_old:" in
    *":$2:"*) ;;
    *) eval "export $1=\\"$2${{_old:+:$_old}}\\"" ;;
  esac
}}
_prepend PATH "{prefix}/bin"
_prepend AMENT_PREFIX_PATH "{prefix}"
_prepend CMAKE_PREFIX_PATH "{prefix}"
_prepend LD_LIBRARY_PATH "{libraries}"
export ROS_VERSION=2 ROS_PYTHON_VERSION=3 ROS_DISTRO=jazzy
# Python need not start itself again to find the libraries:
export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
unset -f _prepend
unset _old
"""


def write_setup_scripts() -> None:
    """Write what colcon looks for in an underlay."""
    libraries = [PREFIX / "lib", *sorted(Path(sysconfig.get_path("platlib")).glob("ros_*.libs"))]
    text = SETUP_SCRIPT.format(prefix=PREFIX, libraries=":".join(map(str, libraries)))
    for name in ("local_setup.sh", "local_setup.bash", "setup.sh", "setup.bash"):
        (PREFIX / name).write_text(text)


if __name__ == "__main__":
    print(f"{mend_cmake_files()} places mended in CMake files")
    write_setup_scripts()
    print(f"{PREFIX}/setup.bash written")
