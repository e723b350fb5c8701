"""What every node is made of: one thread, parameters, publishers, a process that ends in order.

Takes: Topics as data (``messages/topics.py``).
Gives: ``BenchNode``, and its ``main``.
Must not know: Runs and trials.
Begin with: ``node.py``.
"""
