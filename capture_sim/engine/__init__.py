"""The run as one compiled loop: segments of motion between located events.

A *segment* is a piece of motion under one set of equations: on the rail (closed form) or
one step of the integrator.  Samples are read from the segment they fall into; a segment
is cut where an event is located in it, and the event's consequences are drawn at the cut.
Nothing depends on where samples are asked for, so any cutting of the sample times into
calls gives the same bits.

``state`` is what the loop keeps of a run; ``steps`` takes a step; ``events`` finds the first event
in it; ``extremes`` finds the largest force, strokes and penetrations inside it; ``consequences``
draws those of an event; ``segment`` and ``rail`` are the two kinds of segment; ``loop`` is what
Python calls.
"""
