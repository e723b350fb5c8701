"""How nodes agree on a run: who takes part, who is ready, when it ends, who has all of it.

Takes: Announcements and the participants' lines of the roll.
Gives: A run that begins when all are ready and ends when all are done.
Must not know: What a node does with a run.
Begin with: ``roll.py``.
"""
