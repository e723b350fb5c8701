"""Motion of a scene: integration from the release to the end, with the time of each event.

Takes: A ``Scene`` and sample times.
Gives: Samples of dtype SAMPLE, touches, ``Event``, ``Extremes`` (``samples.py``).
Must not know: Detection, runs, messages, files.
Begin with: ``bench.py``.

``model`` has the equations of motion (``equations.py``), and ``solver`` the integrator for any
equations (``runge_kutta.py``).  ``engine`` integrates from event to event (``loop.py``).  All three
are compiled.
"""
