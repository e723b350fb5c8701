"""How nodes agree on a run: which nodes take part, when all are ready, and when all have ended it.

Takes: Announcements of runs, and each participant's messages on bench/roll.
Gives: A run that begins when all are ready and ends when all are done.
Must not know: What a node does with a run.
Begin with: ``roll.py``.
"""
