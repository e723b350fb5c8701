"""The description of a bench: parts with units and ranges, read from YAML and checked.

Takes: YAML files or texts, overrides, an approach.
Gives: A frozen ``Scene`` in SI units, and the ``LaunchPlan`` of its string.
Must not know: How a bench moves: no module of this package integrates.
Begin with: ``parts.py``.
"""
