"""The parts of every node: one thread, parameters, publishers, a process with orderly shutdown.

Takes: Topics as data (``messages/topics.py``).
Gives: ``BenchNode``, and ``run``, with which each node's file makes its ``main``.
Must not know: Runs and trials.
Begin with: ``node.py``.
"""
