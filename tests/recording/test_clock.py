"""The release of a recording, by every way in which it is found."""

from __future__ import annotations

import numpy as np
import pytest

from capture_sim.errors import RecordingError
from capture_sim.messages.convert import EPOCH_NS
from capture_sim.recording.clock import Logged, find_clock
from capture_sim.run.origin import Release

SECOND = 1_000_000_000
WALL = 1_790_000_000 * SECOND
BOOT = 40 * SECOND  # a bench's own clock when its recording begins


def logged(stamps, log_times):
    return Logged(np.array(stamps, dtype=np.int64), np.array(log_times, dtype=np.int64))


def poses(first, log_time, n=1001, offset=0):
    """Poses of 100 Hz from a stamp on, logged ``offset`` ns later than evenly."""
    steps = np.arange(n, dtype=np.int64) * (SECOND // 100)
    return Logged(first + steps, log_time + steps + offset)


def command(stamp, log_time):
    return logged([stamp], [log_time])


def test_simulated_run_begins_at_the_stamp_of_one_second_however_late_its_bag_begins():
    late = poses(EPOCH_NS + 5 * SECOND, WALL)
    announced = command(EPOCH_NS, WALL + 3000)  # transient local: it arrives with the first poses
    for release in (announced, None):
        clock = find_clock(late, release, WALL, is_simulated=True)
        assert (clock.origin, clock.release) == (Release.STAMP, EPOCH_NS)
        assert clock.since(late.stamps)[[0, -1]].tolist() == [5.0, 15.0]
        # what has no stamp counts by the log
        assert clock.since_by_log(late.log_times)[[0, -1]] == pytest.approx([5.0, 15.0], abs=1e-9)
        assert clock.t_release == 0.0


def test_release_stamped_by_the_clock_of_the_poses_counts_by_its_stamp():
    seen = poses(WALL, WALL + 20_000_000)
    clock = find_clock(seen, command(WALL + SECOND, WALL + 1_300_000_000), WALL, is_simulated=False)
    assert (clock.origin, clock.release) == (Release.STAMP, WALL + SECOND)
    assert clock.after_first_pose == 1.0
    assert clock.log_time == WALL + SECOND + 20_000_000  # as poses of that stamp were


def test_poses_that_begin_long_after_the_release_count_from_its_stamp():
    seen = poses(WALL + 9 * SECOND, WALL + 9 * SECOND)
    clock = find_clock(seen, command(WALL, WALL), WALL, is_simulated=False)
    assert (clock.origin, clock.release) == (Release.STAMP, WALL)
    assert clock.since(seen.stamps)[0] == 9.0


@pytest.mark.parametrize("first", [BOOT, EPOCH_NS // 2], ids=["own clock", "clock of the trial"])
def test_bench_with_a_clock_of_its_own_counts_from_the_arrival_of_the_release(first):
    """The trial's stamp of the release may even be among those of the poses."""
    seen = poses(first, WALL)
    release = command(EPOCH_NS, WALL + 3 * SECOND)
    clock = find_clock(seen, release, WALL, is_simulated=False)
    assert (clock.origin, clock.release) == (Release.ARRIVAL, first + 3 * SECOND)
    assert clock.since(seen.stamps)[[0, 300]].tolist() == [-3.0, 0.0]
    # the launcher goes by the trial's clock first, then by the bench's
    assert clock.since_by_trial(np.array([EPOCH_NS, first + 9 * SECOND])).tolist() == [0.0, 6.0]


def test_drift_of_a_bench_clock_counts_from_the_release_only():
    """It runs 1 % fast: by the first poses, the release would be 30 ms early."""
    n = 1001
    log_times = WALL + np.arange(n, dtype=np.int64) * (SECOND // 100)
    seen = Logged(BOOT + np.arange(n, dtype=np.int64) * 10_100_000, log_times)
    clock = find_clock(seen, command(EPOCH_NS, WALL + 3 * SECOND), WALL, is_simulated=False)
    assert clock.release == pytest.approx(BOOT + 3.03e9, abs=1.1e6)


def test_poses_without_a_release_count_from_the_first():
    seen = logged([WALL + SECOND, WALL, WALL + 2 * SECOND], [5, 6, 7])
    clock = find_clock(seen, None, 3, is_simulated=False)
    assert (clock.origin, clock.release, clock.after_first_pose) == (Release.BEGINNING, WALL, 0.0)


def test_recording_of_nothing_that_the_bench_has_counts_from_its_first_message():
    clock = find_clock(None, None, WALL, is_simulated=False)
    assert clock.origin is Release.BEGINNING
    assert clock.since_by_log(np.array([WALL + SECOND])).tolist() == [1.0]
    assert clock.since(np.array([WALL + SECOND])).tolist() == [1.0]


def test_release_without_poses_counts_by_stamp_and_log():
    clock = find_clock(None, command(EPOCH_NS, WALL), WALL - SECOND, is_simulated=False)
    assert clock.since(np.array([EPOCH_NS])).tolist() == [0.0]
    assert clock.since_by_log(np.array([WALL])).tolist() == [0.0]


def test_given_release_counts_from_the_first_pose_whatever_is_recorded():
    seen = poses(BOOT, WALL)
    clock = find_clock(seen, command(BOOT, WALL), WALL, is_simulated=False, given_release=2.5)
    assert (clock.origin, clock.after_first_pose) == (Release.GIVEN, 2.5)
    assert clock.since_by_log(np.array([WALL])).tolist() == [-2.5]
    with pytest.raises(RecordingError, match="release = 60 s: must be 0 to 10 s"):
        find_clock(seen, None, WALL, is_simulated=False, given_release=60.0)
    with pytest.raises(RecordingError, match="no pose"):
        find_clock(None, None, WALL, is_simulated=False, given_release=1.0)
