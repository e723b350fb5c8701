"""The files that CONTRIBUTING names on the ways of a pose and of a goal are on them.

Their order is tried where nothing else happens meanwhile: tests/detection/test_way.py.
"""

from rig_session import Session

from tests.walked import check_order, way

#: The largest number of files on a way.
LONGEST = 10


def test_a_trial_goes_the_ways_of_a_pose_and_of_a_goal(start, client, tmp_path):
    def watched(name, change=None, **parameters):
        change = f"from tests.walked import note_files\nnote_files({str(tmp_path / name)!r})"
        return start(name, change, **parameters)

    # watched nodes are slow, and the verdict is tried elsewhere
    session = Session(watched, client, tmp_path, launcher={"speed_tolerance": 10.0})
    with session.bench(is_disturbed=False, pace=2.0):
        _, result = session.goal(name="walked").result()
    assert session.let_go == 1, result.reason
    entered = {
        name: (tmp_path / name).read_text().split()
        for name in ("launcher", "recorder", "capture_detector")
    }
    pose = [file for files in way("From a pose to a verdict") for file in files]
    goal = [file for files in way("From a goal to results.json") for file in files]
    assert max(len(pose), len(goal)) <= LONGEST
    assert set(pose) <= set(entered["capture_detector"])
    own = goal.index("nodes/recorder.py")
    assert set(goal[:own]) <= set(entered["launcher"])
    # the recorder writes, checks and tabulates one after the other
    check_order([[file] for file in goal[own:]], entered["recorder"])
