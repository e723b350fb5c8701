"""The run as one compiled loop: stretches of motion between located events.

A *stretch* is a piece of motion under one set of equations: on the rail (closed form) or
one step of the integrator.  Samples are read from the stretch they fall into; a stretch
is cut where an event is located in it, and the event's consequences are drawn at the cut.
Nothing depends on where samples are asked for, so any cutting of the sample times into
calls gives the same bits.

``loop`` is what Python calls; ``rail`` and ``stretches`` are the two kinds of stretch; ``steps``,
``search`` and ``crossings`` take a step and find the first event in it; ``touches``, ``slip`` and
``rest`` draw the consequences; ``notebook`` is what the loop keeps of a run.
"""
