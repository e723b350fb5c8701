"""The bench as described: parts with units and ranges, read from YAML, checked one by one and
together.

Takes: YAML files or texts, overrides, an approach.
Gives: A frozen ``Scene`` in SI units, and the ``LaunchPlan`` of its string.
Must not know: How a bench moves: nothing here integrates.
Begin with: ``parts.py``.
"""
