"""Nodes that are killed in trials: the others are free again, and the result names the loss."""

import pytest
from capture_sim.action import RunTrial
from rig_session import ABORTED, SUCCEEDED, Session


@pytest.mark.long
def test_killed_nodes_are_named_and_missed_by_no_later_trial(start, client, tmp_path):
    limits = {"closing_timeout": 10.0, "start_timeout": 60.0}
    session = Session(start, client, tmp_path, launcher=limits)
    with session.bench(is_disturbed=False, pace=1.0):
        for role in ("recorder", "capture_detector", "launcher"):
            goal = session.goal(0.0, name=f"without {role}")
            goal.await_phase(RunTrial.Feedback.APPROACH)
            session.kill(role)
            if role != "launcher":
                status, result = goal.result()
                assert status == (SUCCEEDED if role == "recorder" else ABORTED), result.reason
                text = " ".join([*result.problems, result.reason])
                assert role in text, text
                assert not result.complete
                assert session.holds[-1][1]
            session.restart(role)
            goal = session.goal(0.0, name=f"after {role}")
            goal.await_phase(RunTrial.Feedback.APPROACH)
            status, result = goal.result()
            assert (status, result.verdict) == (SUCCEEDED, "captured"), result.reason
            assert result.complete, list(result.problems)
            assert result.recording
        # killed while no trial is on: the new one has never seen the one that it replaces
        for role in ("capture_detector", "recorder"):
            session.kill(role)
            session.restart(role)
            status, result = session.goal(0.0, name=f"{role} again").result()
            assert (status, result.verdict) == (SUCCEEDED, "captured"), result.reason
            assert result.complete, list(result.problems)
