"""What README and docs show works: their code runs and prints what they say.

A block of code is a fence, and runs in a folder that has `.venv` and the recordings of `make run`:

- `sh`: its lines; `console`: its lines behind `$`.  Lines beneath a command are what it prints,
  `...` for what differs from run to run.
- `python`: behind the blocks before it on the page; `# ->` is what it prints.
- `c` is compiled and run by tests/fmu.
- `yaml` with a title is a file of that name; without, it is laid over tilt_0.
- What cannot run here bears a class, and is counted: `{.ros2}` needs ROS's command-line tools,
  `{.terminals}` several terminals, `{.minutes}` takes long and is parsed only, `{.make}` is what
  runs these tests.
"""

import ast
import contextlib
import itertools
import json
import math
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest
import yaml

import capture_sim
from capture_sim.cli import command_parser, main
from capture_sim.dynamics.samples import TOUCH
from capture_sim.recording.offline import write_run
from capture_sim.run.loads import LOADS
from capture_sim.run.summary import KEYS
from capture_sim.scene.parts import Scene
from capture_sim.trial.interlocks import (
    MAX_REST_STROKE,
    MAX_REST_TORSION,
    RULES,
    TrialLimits,
)
from capture_sim.trial.rest import MAX_START_ERROR, POSE_LIMITS, WINDOW
from capture_sim.trial.starts import MAX_START_TURN
from tools import reference, setup_env

ROOT = Path(__file__).resolve().parents[2]
PAGES = [
    str(path.relative_to(ROOT))
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md"))
]
FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`capture-sim ([a-z][^`\n]*)`")
EXPERIMENTS = ("tilt_0", "tilt_p10", "tilt_m10")
#: Blocks that are not run, by why.
LEFT_OUT = {"ros2": 10, "terminals": 9, "minutes": 6, "make": 2}
#: Pages whose blocks take seconds, and show what tests of its own have.
SLOW_PAGES = {
    "docs/calibrate.md",
    "docs/design.md",
    "docs/fmu.md",
    "docs/looking_at_runs.md",
    "docs/sweep.md",
}


class Block(NamedTuple):
    """A fence: its language, what else stands at its head, and what is in it."""

    language: str
    head: str
    text: str

    @property
    def left_out(self) -> str:
        """Why it does not run here; empty where it does."""
        marked = re.search(r"\{\.(\w+)\}", self.head)
        return marked[1] if marked else ""


def blocks(page):
    return [Block(*found) for found in FENCE.findall((ROOT / page).read_text())]


@pytest.fixture
def run(monkeypatch, capfd):
    """A function that runs something in a folder, in this process, and returns what it prints.

    ``capture-sim`` with its arguments, other lines of a shell, or a script of Python with its own.
    """
    monkeypatch.setenv("MPLBACKEND", "agg")

    def run_in(folder, command):
        monkeypatch.chdir(folder)
        capfd.readouterr()
        program, *words = shlex.split(command, comments=True) or ["true"]
        if Path(program).name == "capture-sim":
            found = [sorted(map(str, Path().glob(w))) if "*" in w else [w] for w in words]
            assert main([word for words in found for word in words]) == 0, command
        elif program.endswith(".py"):
            monkeypatch.setattr(sys, "argv", [program, *words])
            runpy.run_path(program, run_name="__main__")
        else:
            subprocess.run(["bash", "-euc", command], check=True)
        return capfd.readouterr().out

    return run_in


def assert_printed(stated, printed, command):
    """Each line that is stated is printed, in this order; `...` stands for anything."""
    lines = iter(" ".join(line.split()) for line in printed.splitlines())
    for line in stated:
        pattern = re.escape(" ".join(line.split())).replace(re.escape("..."), ".*")
        found = any(re.fullmatch(pattern, printed_line) for printed_line in lines)
        assert found, f"{command} is to print {line!r}; it printed:\n{printed}"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """The folder of the recordings that `make run` leaves, and of its results."""
    folder = tmp_path_factory.mktemp("recordings") / "runs"
    assert main(["run", *EXPERIMENTS, "--no-record", "--out", str(folder)]) == 0
    for name in EXPERIMENTS:
        write_run(capture_sim.simulate(name), folder / f"{name}.mcap")
    return folder


@pytest.fixture
def folder(tmp_path, recordings, page):
    """A folder as after `make run`, with the bag of a bench that tutorials call trial.mcap.

    Of the recordings it holds those that the page's blocks name: all would be drawn each time.
    """
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "runs").mkdir()
    for name in EXPERIMENTS:
        if any(name in block.text for block in blocks(page)):
            shutil.copy(recordings / f"{name}.mcap", tmp_path / "runs")
    shutil.copy(recordings / "tilt_0.mcap", tmp_path / "trial.mcap")
    return tmp_path


def test_what_is_left_out_is_counted():
    left_out = Counter(block.left_out for page in PAGES for block in blocks(page))
    assert left_out.pop("") >= 20
    assert left_out == LEFT_OUT


@pytest.mark.parametrize("page", PAGES)
def test_every_block_is_a_fence_of_a_known_language(page):
    text = (ROOT / page).read_text()
    assert text.count("\n```") + text.startswith("```") == 2 * len(blocks(page))
    known = {"c", "sh", "console", "python", "yaml", "text", "math"}
    assert {block.language for block in blocks(page)} <= known
    outside = FENCE.sub("", text)
    assert not re.search(r"\n\n    [^ ]", outside), "indented code"


@pytest.mark.parametrize("page", PAGES)
def test_commands_between_the_lines_are_understood(page):
    found = INLINE.findall((ROOT / page).read_text())
    for block in blocks(page):
        if block.left_out == "minutes":
            commands = [command for command, _ in commands_of(block)]
            found += [c.removeprefix("capture-sim ") for c in commands if "capture-sim " in c]
    for line in found:
        command, *arguments = shlex.split(line)
        parser = command_parser(command)
        if arguments:
            parser.parse_args(arguments)


def commands_of(block):
    """Return each command of a block, and the lines that it is to print."""
    lines = re.sub(r" *\\\n *", " ", block.text).splitlines()
    if block.language == "sh":
        return [(line, []) for line in lines]
    found = []
    for line in lines:
        if line.startswith("$ "):
            found.append((line[2:], []))
        else:
            found[-1][1].append(line)
    return found


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.long] if page in SLOW_PAGES else [])
        for page in PAGES
        if any(not b.left_out for b in blocks(page))
    ],
)
def test_blocks_run_and_print_what_they_say(page, folder, run, capfd):
    names = {}
    for block in blocks(page):
        if block.left_out or block.language in ("c", "text", "math"):
            continue
        if block.language == "yaml":
            title = re.search(r'title="([^"]+)"', block.head)
            path = folder / (title[1] if title else "part.yaml")
            path.write_text(block.text if title else "extends: tilt_0\n" + block.text)
            scene = capture_sim.load_scene(path)
            for part, value in yaml.safe_load(block.text).items():
                assert part == "extends" or (getattr(scene, part) is None) == (value is None)
        elif block.language == "python":
            capfd.readouterr()
            with contextlib.chdir(folder):
                exec(block.text, names)
            stated = re.findall(r"^# -> (.*)$", block.text, re.MULTILINE)
            assert_printed(stated, capfd.readouterr().out, "the block")
        else:
            for command, stated in commands_of(block):
                assert_printed(stated, run(folder, command), command)


def test_the_table_of_the_readme_holds(recordings):
    head, *rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (ROOT / "README.md").read_text().splitlines()
        if re.match(r"\| (experiment|tilt_\w+) \|", line)
    ]
    assert [row[0] for row in rows] == list(EXPERIMENTS)
    results = {r["name"]: r for r in json.loads((recordings / "results.json").read_text())}
    for name, verdict, *cells in rows:
        r = results[name]
        assert verdict == r["verdict"]
        values = (
            ("{:.3f}", r["first_contact_time"]),
            ("{:.1f} ({})", r["first_contact_duration"] * 1e3, r["first_contact_touches"]),
            ("{:.1f} ({})", r["max_normal_force"], r["touches"]),
            *(
                ("{:.2f} ({:.2f})", r[f"max_{load}"] * 1e3, r[f"max_{load}_before_latch"] * 1e3)
                for load in ("axial_stroke_in", "axial_stroke_out", "torsion")
            ),
            ("{:.2f}", r["nearest_distance"] * 1e3),
        )
        assert cells == [text.format(*numbers) for text, *numbers in values], head


def test_sweep_finds_what_captures(tmp_path, run, drawn):
    captured, of = map(int, re.findall(r"\d+", run(tmp_path, f"{ROOT}/examples/sweep_damping.py")))
    assert 0 < captured < of
    assert (tmp_path / "sweep_damping.png").stat().st_size > 5000


@pytest.fixture
def own_contact_law():
    return SimpleNamespace(**runpy.run_path(str(ROOT / "examples/own_contact_law.py")))


def test_own_factor_is_the_law_of_that_factor():
    """Lankarani and Nikravesh's factor, given as one's own, is their law."""
    theirs = capture_sim.simulate("paper_undamped", t_end=0.1)
    changes = {"contact.hysteresis_factor": 0.75 * (1.0 - theirs.scene.contact.restitution**2)}
    own = capture_sim.simulate("paper_undamped", changes, t_end=0.1)
    assert len(own.touches) == len(theirs.touches) > 4
    assert own.touches["peak_force"] == pytest.approx(theirs.touches["peak_force"], rel=1e-6)


def test_own_force_meets_the_wall_as_the_packages_does(own_contact_law):
    """Hertz's law without losses, from outside, with a tenth of a percent of energy made."""
    how = {"contact.restitution": 1.0, "friction.law": "none"}
    scene = capture_sim.load_scene("paper_undamped", how)
    peak = capture_sim.simulate(scene, t_end=0.01).touches["peak_force"][0]
    found = own_contact_law.first_peak(scene, lambda d, _: scene.contact_stiffness * d**1.5, 1e-7)
    assert found == pytest.approx(peak, rel=1e-3)


def test_own_contact_runs_and_its_page_has_its_errors(tmp_path, run):
    lining, lip, *rows = run(tmp_path, f"{ROOT}/examples/own_contact.py").splitlines()
    assert lining.startswith("lining: captured")
    assert lip.startswith("lip: rebound")
    page = (ROOT / "docs/own_contact.md").read_text()
    for row in rows:
        points, force, duration = (float(cell) for cell in row.strip("|").split("|"))
        found = re.search(rf"^\| {points:g} \| (\S+) \| (\S+) \|$", page, re.MULTILINE)
        assert found is not None
        assert force == pytest.approx(float(found[1]), rel=0.1)
        assert duration == pytest.approx(float(found[2]), abs=2e-7)


def test_own_contact_law_runs(tmp_path, run):
    first, *peaks = run(tmp_path, f"{ROOT}/examples/own_contact_law.py").splitlines()
    assert first.startswith("Safaeifar: captured")
    rough, fine = (float(line.split()[-2]) for line in peaks)
    assert rough == pytest.approx(fine, rel=5e-3)


def test_the_notebook_runs_from_top_to_bottom(tmp_path, run):
    notebook = json.loads((ROOT / "examples/capture.ipynb").read_text())
    cells = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    (tmp_path / "notebook.py").write_text("\n".join(cells))
    run(tmp_path, "notebook.py")
    outputs = [c["outputs"] for c in notebook["cells"] if c["cell_type"] == "code"]
    assert all(outputs)  # a reader sees the results without running it


def test_a_recording_is_read_by_others(recordings, tmp_path, run):
    out = run(tmp_path, f"{ROOT}/examples/bag_to_pandas.py {recordings / 'tilt_0.mcap'}")
    assert "mean" in out


#: Most lines of a written page, without its measured and generated parts; most lines of the README;
#: and most words of all pages but those of the evidence.
LONGEST_PAGE, LONGEST_README, MOST_WORDS = 250, 110, 40_000


def test_pages_stay_few_and_short():
    """Without their measured and generated parts, and without docs/evidence."""
    written = {page.stem: page.read_text() for page in (ROOT / "docs").glob("*.md")}
    assert len(written) <= 30
    del written["scenes"]  # made by tools/reference.py, as is a part of reference_nodes.md
    generated = re.compile(r"<!-- (generated|measured)\b.*?<!-- end of \1 -->", re.DOTALL)
    lines = {stem: generated.sub("", text).count("\n") for stem, text in written.items()}
    assert not {stem: n for stem, n in lines.items() if n > LONGEST_PAGE}
    readme = (ROOT / "README.md").read_text()
    assert readme.count("\n") <= LONGEST_README
    texts = [readme, *(page.read_text() for page in (ROOT / "docs").glob("*.md"))]
    assert sum(len(text.split()) for text in texts) <= MOST_WORDS


@pytest.mark.parametrize("page", PAGES)
def test_no_command_is_wider_than_a_window(page):
    """Long ones are broken by a backslash."""
    for block in blocks(page):
        if block.language in ("sh", "console"):
            lines = block.text.splitlines()
            typed = [n for n in lines if block.language == "sh" or n.startswith(("$ ", "    -"))]
            assert not [line for line in typed if len(line) > 100]


def test_one_way_to_start():
    """Commands are bare, after `. .venv/bin/activate`."""
    for page in set(PAGES) - {"docs/evidence/benchmark.md"}:
        found = re.findall(r"\.venv/bin/(?!activate)\S+", (ROOT / page).read_text())
        assert not found, page


def test_pages_made_from_the_code_are_up_to_date():
    """`python -m tools.reference docs` writes them."""
    docs = ROOT / "docs"
    assert (docs / "scenes.md").read_text() == reference.scenes_page()
    pages = reference.pages_with_parts(docs)
    texts = {page: page.read_text() for page in pages}
    assert sum(text.count("<!-- end of generated -->") for text in texts.values()) >= 6
    stale = [page.name for page, text in texts.items() if reference.filled(text) != text]
    assert not stale


def test_the_page_on_rigs_has_the_limits_of_the_launcher():
    """Each rule that can be waived, and each limit with its default, as the code has them."""
    page = (ROOT / "docs" / "your_rig.md").read_text(encoding="utf-8")
    lines = (line for line in page.splitlines() if line.startswith("| "))
    rows = [row for line in lines if len(row := [c.strip() for c in line[1:-1].split("|")]) == 3]
    rules = [row[0] for row in rows if row[0].startswith("rule `")]
    assert {re.match(r"rule `(\w+)`", rule)[1] for rule in rules} == set(RULES)
    limits = {field.name: field.default for field in fields(TrialLimits)}
    written = {}
    for _, default, parameters in rows:
        for name in re.findall(r"`(\w+)`", parameters):
            if name in limits and (number := re.match(r"[\d.]+", default)):
                written[name] = float(number[0])
    missing = set(limits) - set(written)
    # the first two refuse and abort nothing, the last is no number
    assert missing == {"after_verdict", "closing_timeout", "require_emergency_stop"}
    assert written == {name: limits[name] for name in written}
    start, rest, still, moves = (
        next(row[1] for row in rows if row[0].startswith(f"rule `{name}`"))
        for name in ("start", "buffer_rest", "standstill", "target_standstill")
    )
    limits_of_start = f"{1e3 * MAX_START_ERROR:g} mm, {math.degrees(MAX_START_TURN):g} degrees"
    assert start.startswith(f"{limits_of_start}, at most a third of the distance")
    assert rest == f"{1e3 * MAX_REST_STROKE:g} mm, {MAX_REST_TORSION:g} rad"
    limit = POSE_LIMITS[0]
    permitted = f"{1e3 * limit.excursion:g} mm and {1e3 * limit.speed:g} mm/s within {WINDOW:g} s"
    assert still == moves == permitted


def test_the_scene_reference_explains_every_part_and_field():
    lines = reference.tables(Scene, "", {})
    for line, after in itertools.pairwise(line for line in lines if line):
        if line.startswith("### "):
            assert len(after) > 20, line
            assert not after.startswith("|"), line
    rows = [line.split(" | ") for line in lines if line.startswith("| `")]
    assert len(rows) > 90
    assert all(len(row) == 5 and len(row[4]) > 10 for row in rows)


def test_every_field_of_a_type_has_its_unit_or_meaning():
    """The pages lead to these files."""
    rows = [
        (path.name, name, comment)
        for kind in ("msg", "action", "srv")
        for path in sorted((ROOT / kind).iterdir())
        for name, _, comment in reference.message_rows(path.read_text(encoding="utf-8"))
    ]
    assert len(rows) > 200
    assert not [row for row in rows if not row[2]]


def test_the_python_page_has_every_key_of_the_results(recordings):
    page = (ROOT / "docs" / "api.md").read_text()
    [_, columns] = page.split("## Columns")
    named = set(re.findall(r"`(\w+)`", columns))
    endings = re.compile(r"(_plus_y|_minus_y)?(_before_latch)?(_time|_low|_high)?$")
    for result in json.loads((recordings / "results.json").read_text()):
        keys = {key if key in named else endings.sub("", key) for key in result}
        assert keys <= named
    assert set(TOUCH.names) <= named


def test_each_key_of_the_results_has_its_unit_and_meaning(recordings):
    ending = re.compile(r"(_before_latch)?(_time|_low|_high)?$")
    loads = {load.key for load in LOADS}
    for row in json.loads((recordings / "results.json").read_text()):
        assert {key for key in row if ending.sub("", key) not in loads} == set(KEYS)


def test_examples_need_what_a_set_up_installs():
    """Packages for the tests, or a reader's own, would stop him at the first line."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    installed = setup_env.requirements(project, setup_env.RUN_EXTRAS)
    names = {re.match(r"[\w-]+", requirement)[0].replace("-", "_") for requirement in installed}
    scripts = list((ROOT / "examples").glob("*.py"))
    own = {"capture_sim", "rclpy", *(path.stem for path in scripts)}
    for path in scripts:
        trees = ast.walk(ast.parse(path.read_text()))
        found = {node.module for node in trees if isinstance(node, ast.ImportFrom)}
        trees = ast.walk(ast.parse(path.read_text()))
        found |= {a.name for node in trees if isinstance(node, ast.Import) for a in node.names}
        found = {name.partition(".")[0] for name in found} - sys.stdlib_module_names - own
        assert {name for name in found if not name.endswith("_msgs")} <= names, path.name


def strings_of(folder):
    """Return each text in the code of a folder, pieces of f-strings apart."""
    trees = [ast.parse(path.read_text()) for path in folder.rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    return [n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)]


def test_messages_of_the_page_on_errors_are_those_of_the_code():
    page = (ROOT / "docs" / "faq.md").read_text()
    messages = re.findall(r"^\| `(.+?)` \| ", page, re.MULTILINE)
    assert len(messages) >= 14
    texts = [*strings_of(ROOT / "capture_sim"), (ROOT / "Makefile").read_text()]
    for message in messages:
        pieces = [piece.strip(" ;,()") for piece in message.split("...")]
        pieces = [piece for piece in pieces if len(piece) > 3]
        assert pieces, message
        for piece in pieces:
            assert any(piece in text for text in texts), f"{message}: {piece!r}"


def how_to_pages():
    """Return the pages under How to, by the site's contents."""
    contents = yaml.safe_load((ROOT / "mkdocs.yml").read_text().replace("!!", ""))["nav"]
    [entries] = [entry["How to"] for entry in contents if "How to" in entry]
    return [f"docs/{page}" for entry in entries for page in entry.values()]


def test_every_how_to_has_blocks_that_run():
    """But for those of a rig, which need ROS's command line: tests/nodes has their flows."""
    running = [p for p in how_to_pages() if any(not b.left_out for b in blocks(p))]
    assert len(running) >= 8
    assert set(how_to_pages()) - set(running) <= {
        "docs/nodes.md",
        "docs/your_rig.md",
        "docs/hardware_in_the_loop.md",
    }
