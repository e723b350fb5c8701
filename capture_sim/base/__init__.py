"""Modules that every other part of the package may use: files, data folders, versions,
interrupts, tables.

Takes: Paths, texts, functions.
Gives: Files that are whole once they have their name, data folders, exit statuses, compiled
    functions.
Must not know: Scenes, runs, messages.
Begin with: ``files.py``.
"""
