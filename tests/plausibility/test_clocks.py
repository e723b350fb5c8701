"""Clocks of the sources: offsets at any rate of the bench, and steps, as a node and a file see."""

import re

import numpy as np
import pytest
from live_measurements import LiveMeasurements

from capture_sim.plausibility.check import rules_among
from capture_sim.plausibility.clocks import MAX_OFFSET
from capture_sim.plausibility.rules import Grade
from tests.live_measurements import check

TODAY = 1_760_000_000.0  # s
SOURCES = ("chaser", "target", "buffer", "force")


def lines(*, pace=1.0, off=None, batch=0.0, step=None, duration=2.0, ends=None, rate=50.0):
    """Return the lines about the clocks of four sources.

    ``pace``: s of the bench in a second; ``off``: s, of a source's clock; ``batch``: s, messages
    are read together this often; ``step``: source, s (arrival) and by how much its clock is set;
    ``ends``: source and s, when it falls silent.
    """
    live, noise = LiveMeasurements(duration), np.random.default_rng(0)
    rows = []
    for k in range(round(duration * pace * rate)):
        for number, source in enumerate(SOURCES):
            now = k / rate / pace + 0.002 * noise.random()
            stamp = TODAY + k / rate + (off or {}).get(source, 0.0)
            if step and step[0] == source and now > step[1]:
                stamp += step[2]
            if ends and ends[0] == source and now > ends[1]:
                continue
            read = (np.floor(now / batch) + 1.0) * batch + 0.01 * number * batch if batch else now
            rows.append((read, number, k, source, stamp))
    for read, _, k, source, stamp in sorted(rows):
        times = round(1e9 * stamp), round(1e9 * read)
        match source:
            case "buffer":
                live.add_buffer("joint_states", *times, 1e-6 * (k % 7), 0.0)
            case "force":
                live.add_force("load_cell/wrench", *times, (0.01 * (k % 7), 0.0, 0.0), "world")
            case _:
                place = (1e-6 * (k % 7) + 0.66 * (source == "target"), 0.0, 0.0)
                live.add_pose(source, source, *times, place, (0.0, 0.0, 0.0, 1.0))
    return [
        d.line
        for d in check(live.measured())
        if d.rule.name in ("clock_offset", "clock_steps") and d.grade is Grade.REFUSED
    ]


@pytest.mark.parametrize("pace", [0.3, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("offset", [0.8, -0.8, 0.26])
def test_a_clock_that_is_off_is_seen_whatever_the_rate_of_the_bench(pace, offset):
    [line] = lines(pace=pace, off={"buffer": offset})
    assert line.startswith("joint_states: refused (clock_offset): stamps 0.")
    assert ("ahead of" if offset > 0.0 else "behind") in line


@pytest.mark.parametrize("pace", [0.3, 1.0, 2.0, 5.0])
def test_a_clock_within_the_bound_is_not(pace):
    assert lines(pace=pace, off={"buffer": MAX_OFFSET - 0.005}) == []
    assert lines(pace=pace) == []


@pytest.mark.parametrize("batch", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("pace", [1.0, 2.0, 5.0])
def test_a_busy_node_that_reads_in_batches_sees_no_offset(pace, batch):
    assert lines(pace=pace, batch=batch) == []


def test_a_source_that_ends_early_at_another_rate_has_no_offset():
    assert lines(pace=2.0, ends=("buffer", 3.0), duration=20.0) == []


@pytest.mark.parametrize("source", ["chaser", "buffer"])
@pytest.mark.parametrize("pace", [1.0, 2.0])
@pytest.mark.parametrize("step", [-0.5, -0.23, 0.23, -5.0, 5.0])
def test_a_clock_that_was_set_is_seen(source, pace, step):
    """Also shortly before the release, while the old stamps are in the last seconds."""
    found = lines(pace=pace, step=(source, 1.7, step))
    steps = re.findall(r"\(clock_steps\): clock stepped by ([-+.\d]+) s", "\n".join(found))
    assert [float(each) for each in steps] == [pytest.approx(step, abs=0.02)], found


def test_a_step_of_all_clocks_together_is_seen():
    """As of one computer that stamps all: no source differs from another one."""
    live = LiveMeasurements()
    for k in range(200):
        stamp = 0.01 * k - 0.5 * (k > 150)
        live.add_buffer("joint_states", round(1e9 * stamp), 10_000_000 * k, 1e-6 * (k % 7), 0.0)
    assert "clock_steps" in {doubt.rule.name for doubt in check(live.measured())}


@pytest.mark.parametrize("step", [-0.19, 0.19])
def test_a_step_within_the_bound_is_not(step):
    assert lines(step=("chaser", 1.0, step)) == []


def test_wild_overtaken_and_late_messages_are_no_step():
    rows = [(0.01 * k, 0.01 * k + 0.003) for k in range(400)]
    rows[100] = 3600.0, rows[100][1]  # a wild stamp
    rows[200:203] = [(stamp, arrival + 0.4) for stamp, arrival in rows[200:203]]  # overtaken
    rows[300:340] = [(stamp, max(arrival, 3.4)) for stamp, arrival in rows[300:340]]  # late
    rows[299:301] = [rows[299], (rows[298][0] - 0.005, 3.4)]  # the first late one was overtaken
    del rows[310:335]  # lost within what comes late
    live = LiveMeasurements(10.0)
    for k, (stamp, arrival) in enumerate(sorted(rows, key=lambda row: row[1])):
        live.add_buffer("joint_states", round(1e9 * stamp), round(1e9 * arrival), 1e-6 * k, 0.0)
    assert "clock_steps" not in {doubt.rule.name for doubt in check(live.measured())}


def test_a_frame_that_was_corrected_is_forgotten_with_its_poses():
    """A driver that starts again under the right frame_id is refused while the old poses stay."""
    live = LiveMeasurements(2.0)
    for k in range(400):
        stamp = round(k * 1e7)
        frame_id = "map" if k < 100 else "world"
        live.add_pose("chaser", "chaser/odom", stamp, stamp, (0, 0, 0), (0, 0, 0, 1), frame_id)
        seen = {doubt.rule.name for doubt in check(live.measured())}
        if k in (150, 350):
            assert ("frame_changes" in seen) == (k == 150)


def test_a_clock_whose_rate_varies_was_not_set_where_any_clock_will_do():
    """As of a bench of tests on a busy machine, while the cameras see nothing."""
    live = LiveMeasurements(10.0)
    for k in range(600):
        stamp = 0.02 * k
        arrival = stamp / 5.0 if stamp < 4.0 else 0.8 + (stamp - 4.0) / 2.5
        if not 1.0 < stamp < 6.0:
            live.add_buffer("joint_states", *(round(1e9 * t) for t in (stamp, arrival)), 0.0, 0.0)
    assert "clock_steps" in {doubt.rule.name for doubt in check(live.measured())}
    waived = rules_among(("start", "machine_clock", "buffer_scale"))
    assert set(waived) == {"clock_steps", "buffer_scale"}
    assert not set(waived) & {doubt.rule.name for doubt in check(live.measured(), waived=waived)}
