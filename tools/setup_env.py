"""Set up .venv, where everything runs: the wheels of ROS 2, our messages, this package.

    python3 tools/setup_env.py            set up what a run needs; instant when up to date
    python3 tools/setup_env.py --develop  ... and what the tests and the docs need
    python3 tools/setup_env.py --missing  print the Debian packages that this machine lacks

Needs Python's standard library only. The state of .venv is kept in .venv/setup.json, as hashes
of all that each step depends on. A step whose hashes differ is repeated: changed messages are
compiled without installing anything else, changed requirements are installed in place, and
another Python or a moved folder starts from nothing. Edits of Python files need no step.

Exit status: 0 done, 1 a step failed, 2 the machine lacks something.
"""

# A Python that is too old must get as far as saying so: no recent syntax here.
import argparse
import contextlib
import fcntl
import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
LOG = VENV / "setup.log"
STAMP = VENV / "setup.json"
RUN_EXTRAS = ("ros", "view", "study")
DEVELOP_EXTRAS = ("test",)
LOCK = Path("requirements", "lock.txt")

OLDEST_PYTHON = (3, 11)
NEWEST_PYTHON = (3, 14)  # no wheels of ROS for a later one

# Loads every message's compiled half.
CHECK = """
import capture_sim.msg
from rclpy.serialization import serialize_message
types = [t for t in vars(capture_sim.msg).values() if isinstance(t, type)]
print(sum(len(serialize_message(t())) > 0 for t in types), "messages work")
"""

COMPILE_KERNELS = "from capture_sim.dynamics.compilation import compile_kernels; compile_kernels()"


class SetupError(Exception):
    """A step failed; the text is for the user."""


def dotted(version):
    """Return a version tuple as text."""
    return ".".join(map(str, version))


def missing_packages():
    """Return what this machine lacks, as pairs of what and the Debian package that has it."""
    version = sys.version_info[:2]
    if version < OLDEST_PYTHON:
        newer = f"python{dotted(OLDEST_PYTHON)}"
        what = f"Python {dotted(OLDEST_PYTHON)} or later (this is {dotted(version)})"
        return [(what, f"{newer} {newer}-dev {newer}-venv g++")]
    missing = []
    if not all(map(importlib.util.find_spec, ("venv", "ensurepip"))):
        missing.append(("Python's venv module", "python3-venv"))
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        missing.append(("Python's headers", "python3-dev"))
    for variable, default in (("CC", "cc"), ("CXX", "c++")):
        compiler = os.environ.get(variable, default)
        if not shutil.which(compiler):
            missing.append((f"the compiler {compiler}", "g++"))
    return missing


def check_machine():
    """Name what is missing, with the command that installs it; return whether all is there."""
    missing = missing_packages()
    if missing:
        packages = sorted({package for _, package in missing})
        print(f"setup: missing: {', '.join(what for what, _ in missing)}.", file=sys.stderr)
        print(f"On Debian or Ubuntu: apt-get install {' '.join(packages)}", file=sys.stderr)
        if sys.version_info[:2] < OLDEST_PYTHON:
            print(f"and then: make PYTHON=python{dotted(OLDEST_PYTHON)} ...", file=sys.stderr)
    elif sys.version_info[:2] > NEWEST_PYTHON:
        print(
            f"setup: ROS 2 Jazzy has no wheels for Python {dotted(sys.version_info[:2])}, only for "
            f"{dotted(OLDEST_PYTHON)} to {dotted(NEWEST_PYTHON)}: make PYTHON=python3.12 ...",
            file=sys.stderr,
        )
    else:
        return True
    return False


def digest(paths):
    """Return a hash of files' names and contents."""
    sha = hashlib.sha256()
    for path in sorted(paths):
        data = path.read_bytes()
        sha.update(f"{path.relative_to(ROOT)} {len(data)}\n".encode() + data)
    return sha.hexdigest()


def wanted_state(develop=False):
    """Return what the finished set-up depends on, a key per step, in the order of the steps."""
    import tomllib

    with (ROOT / "pyproject.toml").open("rb") as file:
        pyproject = tomllib.load(file)
    project, lock = pyproject["project"], digest([ROOT / LOCK])
    interfaces = [f for kind in ("msg", "srv", "action") for f in ROOT.glob(f"{kind}/*.{kind}")]
    interfaces += [f for f in ROOT.glob("tf2_msgs/**/*.*") if f.is_file()]
    build = [ROOT / name for name in ("CMakeLists.txt", "package.xml", "setup.py")]
    # what setuptools reads: requirements have steps of their own, linters' settings need none
    metadata = {key: project[key] for key in ("name", "dynamic", "scripts")}
    state = {
        "python": [sys.version, os.path.realpath(sys.executable), str(VENV)],
        "requirements": {
            "packages": requirements(project, RUN_EXTRAS),
            "hashes": [lock, digest([ROOT / "tools" / "finish_venv.py"])],
        },
        "package": [digest([*interfaces, *build]), metadata, pyproject["tool"]["setuptools"]],
    }
    if develop:
        state["development"] = {
            "packages": requirements(project, DEVELOP_EXTRAS),
            "hashes": [lock],
        }
    return state


def requirements(project, extras):
    """Return what the package and some extras require, this package's own extras resolved."""
    found, extras = list(project["dependencies"]), list(extras)
    for extra in extras:  # grows meanwhile
        for requirement in project["optional-dependencies"][extra]:
            own = re.fullmatch(r"capture_sim\[(.*)\]", requirement)
            if not own:
                found.append(requirement)
            else:
                extras += [name for name in own.group(1).split(",") if name not in extras]
    return sorted(found)


def found_state():
    """Return what the present set-up was made of; empty when there is none."""
    with contextlib.suppress(OSError, ValueError):
        if PYTHON.exists():
            return json.loads(STAMP.read_text())
    return {}


def clean_environment():
    """Return the environment without what a sourced ROS or another set-up would mix in."""
    strangers = ("AMENT_", "CMAKE_PREFIX_PATH", "COLCON_", "LD_LIBRARY_PATH", "PYTHONHOME")
    strangers += ("PYTHONPATH", "VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
    return {k: v for k, v in os.environ.items() if not k.startswith(strangers)}


class Progress:
    """Shows each step on one line with its seconds: live on a terminal, else every 10 s."""

    #: Between two lines of one step, s, where there is no terminal
    PERIOD = 10.0

    def __init__(self):
        self.live = sys.stdout.isatty()
        self.start = time.monotonic()

    def run(self, title, command, env=None):
        """Run a command with its output in the log; raise SetupError when it fails."""
        self.finish(title, start_logged(title, command, env))

    def finish(self, title, process):
        """Wait for a process that writes into the log; raise SetupError when it fails."""
        start = shown = time.monotonic()
        while True:
            try:
                status = process.wait(timeout=0.2)
                break
            except subprocess.TimeoutExpired:
                now = time.monotonic()
                line = f"  {title} ... {now - start:.0f} s  {last_line()}"
                if self.live:
                    self.rewrite(line)
                elif now - shown >= self.PERIOD:
                    shown = now
                    print(line, flush=True)
        seconds = time.monotonic() - start
        if status:
            if self.live:
                self.rewrite("")
            raise SetupError(f"{title}: failed after {seconds:.1f} s")
        line = f"  {title}: done in {seconds:.1f} s"
        if self.live:
            self.rewrite(f"{line}\n")
        else:
            print(line, flush=True)

    @staticmethod
    def rewrite(line):
        """Replace the terminal's current line."""
        width = shutil.get_terminal_size().columns - 1
        end = "\n" if line.endswith("\n") else ""
        sys.stdout.write("\r\033[K" + line.rstrip()[:width] + end)
        sys.stdout.flush()


def start_logged(title, command, env=None):
    """Start a command with its output in the log; return the process."""
    command = [str(word) for word in command]
    with LOG.open("a") as log:
        log.write(f"\n=== {title}: {' '.join(command)}\n")
        log.flush()
        return subprocess.Popen(
            command,
            cwd=ROOT,
            env=env or clean_environment(),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )


def log_tail(lines):
    """Return the log's last lines."""
    with LOG.open("rb") as log:
        log.seek(max(0, LOG.stat().st_size - 200 * lines))
        return log.read().decode(errors="replace").splitlines()[-lines:]


def last_line():
    """Return the log's last line that is not empty, shortened."""
    said = [line.strip() for line in log_tail(5) if line.strip() and not line.startswith("===")]
    return said[-1][:60] if said else ""


def make_venv(progress, _):
    """Make an empty environment."""
    shutil.rmtree(VENV)
    for build in ROOT.glob("build/pip-*"):  # full of paths into the old one
        shutil.rmtree(build)
    VENV.mkdir()
    progress.run("Python environment", [sys.executable, "-m", "venv", VENV])


def install_requirements(progress, wanted):
    """Install what a run needs, and make the wheels of ROS one underlay that CMake can use."""
    pip = [PYTHON, "-m", "pip", "--disable-pip-version-check", "install", "--no-compile"]
    with contextlib.suppress(SetupError):
        progress.run("Installer", [*pip, "--require-hashes", "-r", locked_file(["uv"])])
    install(progress, "Packages", wanted["packages"])
    progress.run("ROS libraries", [PYTHON, ROOT / "tools" / "finish_venv.py"])


def install_development(progress, wanted):
    """Install what the tests, the docs and the linters need."""
    install(progress, "Packages of the tests", wanted["packages"])


def install(progress, title, packages):
    """Install packages at the locked versions: by uv, which needs seconds; else by pip.

    uv accepts only files with a hash of the lock file; pip checks the versions only.
    """
    env = clean_environment()
    index = pip_index()
    if index:
        env.setdefault("UV_DEFAULT_INDEX", index)
    if Path("/etc/ssl/certs/ca-certificates.crt").exists():  # as pip: also those of a laboratory
        env.setdefault("UV_SYSTEM_CERTS", "1")
        env.setdefault("UV_NATIVE_TLS", "1")  # as older versions of uv call it
    # with bytecode: the nodes are many processes, and each would compile it again where
    # Python may not write it
    uv = VENV / "bin" / "uv"
    try:
        wanted = locked(uv, packages, env)
        hashed = ["--require-hashes", "-r", wanted, "--compile-bytecode", "--python", PYTHON]
        progress.run(title, [uv, "pip", "install", *hashed], env)
    except (SetupError, OSError) as error:
        print(f"  {error}; trying pip")
        pip = [PYTHON, "-m", "pip", "--disable-pip-version-check", "install"]
        pins = ROOT / "build" / "pins.txt"  # pip takes no hashes of what it is not told to install
        pins.parent.mkdir(exist_ok=True)
        pins.write_text("".join(f"{head.split()[0]}\n" for head in lock_entries()))
        progress.run(title, [*pip, "-c", pins, *packages])


def locked(uv, packages, env):
    """Write the part of the lock file, with hashes, that these packages need; return its path.

    SetupError if one of them is not in the lock file, as with another Python.
    """
    resolve = [uv, "pip", "compile", "-q", "--no-annotate", "--no-header", "--no-emit-index-url"]
    resolve += ["--python", PYTHON, "-c", ROOT / LOCK, "-"]
    text = "\n".join(packages)
    found = subprocess.run(resolve, input=text, env=env, capture_output=True, text=True)
    if found.returncode:
        raise SetupError(f"uv: {found.stderr.strip().splitlines()[-1:]}")
    return locked_file(line.partition("==")[0] for line in found.stdout.splitlines())


def locked_file(names):
    """Write the entries of the lock file with these names; return the path.

    SetupError if one is missing.
    """
    by_name = {entry.partition("==")[0]: entry for entry in lock_entries()}
    names = [name for name in names if name and not name.startswith("#")]
    if missing := [name for name in names if name not in by_name]:
        raise SetupError(f"not in {LOCK}: {', '.join(missing)}")
    path = ROOT / "build" / "requirements.txt"
    path.parent.mkdir(exist_ok=True)
    path.write_text("".join(by_name[name] for name in names), encoding="utf-8")
    return path


def lock_entries():
    """Return the entries of the lock file, each with its hashes."""
    text = (ROOT / LOCK).read_text(encoding="utf-8")
    return [entry for entry in re.split(r"^(?=[\w.-]+==)", text, flags=re.M) if "==" in entry]


def pip_index():
    """Return the package index that pip is set up with, which uv does not know."""
    get = [PYTHON, "-m", "pip", "config", "get", "global.index-url"]
    answer = subprocess.run(get, capture_output=True, text=True, env=clean_environment())
    return os.environ.get("PIP_INDEX_URL") or answer.stdout.strip()


def install_package(progress, _):
    """Compile the messages and install this package so that it is used from its source.

    The generators of the messages keep one core busy, so the kernels compile on another one.
    """
    env = {**clean_environment(), "PYTHONPATH": str(ROOT)}
    kernels = start_logged("Kernels", [PYTHON, "-c", COMPILE_KERNELS], env)
    try:
        pip = [PYTHON, "-m", "pip", "--disable-pip-version-check", "install", "--verbose"]
        progress.run("Messages", [*pip, "--no-build-isolation", "--no-deps", "--editable", ROOT])
        progress.run("Check", [PYTHON, "-c", CHECK])
        with contextlib.suppress(SetupError):  # a run compiles what is not compiled
            progress.finish("Kernels", kernels)
    finally:
        kernels.kill()


def set_up(develop):
    """Run the steps whose state differs from the state of .venv."""
    wanted, found = wanted_state(develop), found_state()
    if all(found.get(step) == wanted[step] for step in wanted):
        return
    print("Setting up .venv", "again" if found else "(once)", flush=True)
    progress, done = Progress(), {}
    STAMP.parent.mkdir(exist_ok=True)
    LOG.unlink(missing_ok=True)
    steps = {
        "python": make_venv,
        "requirements": install_requirements,
        "package": install_package,
        "development": install_development,
    }
    for step in wanted:
        if found.get(step) != wanted[step]:
            found = {}  # the later steps build on this one
            STAMP.write_text(json.dumps(done))  # the steps that a failure need not repeat
            steps[step](progress, wanted[step])
        done[step] = wanted[step]
    done.update({step: found[step] for step in found if step not in done})
    STAMP.write_text(json.dumps(done, indent=1))
    print(f"Set up in {time.monotonic() - progress.start:.0f} s", flush=True)


def main():
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--missing",
        action="store_true",
        help="only print the Debian packages that this machine lacks",
    )
    parser.add_argument(
        "--develop", action="store_true", help="also set up what the tests and the docs need"
    )
    options = parser.parse_args()
    if options.missing:
        print(*sorted({package for _, package in missing_packages()}))
        return 0
    if not check_machine():
        return 2
    lock = os.open(ROOT, os.O_RDONLY)  # released at exit
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        print("setup: waiting for another set-up of this folder", flush=True)
        fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        set_up(options.develop)
    except SetupError as error:
        print("", *log_tail(40), sep="\n", file=sys.stderr)
        print(f"setup: {error}. The whole log: {LOG.relative_to(ROOT)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nsetup: interrupted", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
