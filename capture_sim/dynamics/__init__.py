"""What moves, and when: a scene integrated from the release to the end, each event located.

Takes: A ``Scene`` and sample times.
Gives: Samples of dtype SAMPLE, touches, ``Event``, ``Extremes`` (``samples.py``).
Must not know: Detection, runs, messages, files.
Begin with: ``bench.py``.

``model`` has the equations (``equations.py``), ``solver`` steps any equations
(``runge_kutta.py``), ``engine`` runs from event to event (``loop.py``); all three are compiled.
"""
