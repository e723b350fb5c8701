"""Search for buffers: designs within limits, and the design flow of the paper.

Takes: A ``Scene``, limits, objectives and free inputs.
Gives: The rows of a front, each with how far it has converged, or the reason for none.
Must not know: How results are drawn, printed or written.
Begin with: ``design.py``; ``coverage.py`` and ``refinement.py`` request its buffers.
"""
