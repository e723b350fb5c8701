"""The run as one compiled loop: segments of motion between located events.

A *segment* is a piece of motion under one set of equations: motion on the rail (closed form) or one
step of the integrator.  A sample is computed from the segment that contains its time.  If an event
is located in a segment, the segment ends there, and the event is applied at its end.  The motion
does not depend on the sample times, so dividing these into several calls gives bit-identical
results.

``state`` is the record of a run; ``steps`` takes a step; ``events`` locates the first event in it;
``extremes`` finds peak forces, strokes and penetrations inside it; ``consequences`` applies an
event; ``segment`` and ``rail`` are the two kinds of segment; ``loop`` has the entries that Python
calls.
"""
