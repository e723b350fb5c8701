"""A scene as a library in C and as a unit of FMI 3.0; neither needs Python at run time.

Takes: A ``Scene``.
Gives: Sources, a compiled library, ``modelDescription.xml``, an archive.
Must not know: Runs, messages, files of recordings.
Begin with: ``library.py``.
"""
