"""``capture-sim inspect``: the rows, the rules, what is missing, and the status."""

from __future__ import annotations

import json

import dirty
import pytest

from capture_sim.cli import main


def inspected(capsys, *arguments):
    status = main(["inspect", *map(str, arguments)])
    return status, *capsys.readouterr()


def test_a_clean_recording_has_a_row_for_each_topic(tmp_path, capsys):
    path = dirty.write(tmp_path, "plain")
    status, out, err = inspected(capsys, path, "--scene", "tilt_p10")
    assert (status, err) == (0, "")
    rows = {line.split()[0]: line for line in out.splitlines() if line.startswith("/")}
    assert set(rows) == {dirty.CHASER, dirty.TARGET, dirty.JOINTS, dirty.CELL}
    assert "geometry_msgs/msg/PoseStamped" in rows[dirty.CHASER]
    assert " 622 " in rows[dirty.CHASER]
    assert " 100 " in rows[dirty.CHASER]
    assert "chaser's pose" in rows[dirty.CHASER]
    assert "no rule is broken" in out
    assert [line for line in out.splitlines() if line.endswith("can be run")] == [
        f"{command}: can be run" for command in ("detect", "compare", "calibrate")
    ]


def test_what_is_missing_is_said_for_each_command(tmp_path, capsys):
    _, out, _ = inspected(capsys, dirty.write(tmp_path, "joints_nan"))
    assert "detect: not possible without a scene (--scene); the buffer's state" in out
    assert "compare: can be run" in out
    (line,) = (line for line in out.splitlines() if line.startswith("not applied, no scene"))
    assert "buffer_units" in line
    assert "left out (no_value)" in out


@pytest.mark.parametrize("kind", ["poses_in_mm", "y_up", "target_not_tracked"])
def test_a_refused_rule_is_status_1_unless_it_is_waived(kind, tmp_path, capsys):
    path = dirty.write(tmp_path, kind)
    status, out, _ = inspected(capsys, path, "--scene", "tilt_p10", "--json")
    [data] = json.loads(out)
    assert status == 1
    rules = [doubt["rule"] for doubt in data["doubts"] if doubt["grade"] == "refused"]
    assert rules
    for command in ("detect", "compare", "calibrate"):
        assert f"rule {rules[0]} kept" in data["missing"][command]
    waived = []
    for _ in range(4):  # a rule may have hidden those that rest on it
        waived += [x for rule in rules for x in ("--waive", rule)]
        status, out, _ = inspected(capsys, path, "--scene", "tilt_p10", "--json", *waived)
        [data] = json.loads(out)
        rules = [doubt["rule"] for doubt in data["doubts"] if doubt["grade"] == "refused"]
        assert status == bool(rules)
        assert not set(rules) & set(waived)
    assert rules == []


def test_several_recordings_are_one_table_and_a_bad_file_hides_none(tmp_path, capsys):
    good, bad = dirty.write(tmp_path, "plain"), tmp_path / "bad.mcap"
    bad.write_text("no recording")
    status, out, err = inspected(capsys, good, bad, dirty.write(tmp_path, "w_first"))
    assert status == 2
    assert "bad.mcap: not an MCAP file" in err
    assert sum(line.startswith(f"{good} ") and "622" in line for line in out.splitlines()) == 3
    assert "w_first.mcap: /motion_capture/chaser: refused (tilted)" in out


def test_an_unknown_rule_is_named(tmp_path, capsys):
    status, _, err = inspected(capsys, dirty.write(tmp_path, "plain"), "--waive", "unit")
    assert status == 2
    assert "rule 'unit': not found; rules: no_pose" in err
