"""A pose and a goal go through the files that CONTRIBUTING names, in this order."""

from rig_session import Session

from tests.walked import check_order, way

#: Of each node, the function from which on it is watched.
BEGINS = {
    "launcher": "_receive_goal",
    "recorder": "prepare",
    "capture_detector": "_receive_measurement",
}
#: The largest number of files on a way.
LONGEST = 10


def test_the_ways_of_a_pose_and_of_a_goal(start, client, tmp_path):
    def watched(name, change=None, **parameters):
        change = f"from tests.walked import note_files\nnote_files({str(tmp_path / name)!r}, "
        return start(name, change + f"{BEGINS[name]!r})", **parameters)

    # watched nodes are slow, and the verdict is tried elsewhere
    session = Session(watched, client, tmp_path, launcher={"speed_tolerance": 10.0})
    with session.bench(is_disturbed=False, pace=2.0):
        _, result = session.goal(name="walked").result()
    assert session.let_go == 1, result.reason
    launcher, recorder, detector = ((tmp_path / name).read_text().split() for name in BEGINS)
    pose, goal = way("From a pose to a verdict"), way("From a goal to results.json")
    for steps in (pose, goal):
        assert 6 <= len([file for files in steps for file in files]) <= LONGEST
    check_order(pose, detector)
    recorded = goal.index(["nodes/recorder.py"])
    check_order(goal[:recorded], launcher)
    check_order(goal[recorded:], recorder)
