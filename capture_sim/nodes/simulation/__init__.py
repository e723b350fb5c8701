"""What a simulator and a player do: play, pause, reset, pace, step, report.

Takes: Scenes, requests, a real-time factor.
Gives: Messages of runs at their times.
Must not know: Trials and real benches.
Begin with: ``simulated_runs.py``.
"""
