"""Export of a scene as a C library and as a unit of FMI 3.0 (FMU); neither needs Python to run.

Takes: A ``Scene``.
Gives: Sources, a compiled library, ``modelDescription.xml``, an archive.
Must not know: Runs, messages, files of recordings.
Begin with: ``library.py``.
"""
