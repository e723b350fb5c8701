"""Files that are complete when they get their name, safe file names, and checks of paths."""

from __future__ import annotations

import errno
import os
import re
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from capture_sim.base.outputs import check_replaceable
from capture_sim.errors import RecordingError

#: Largest length of a file name's stem, bytes; file systems accept 255 bytes for a name.  The
#: rest is for a number, a suffix and the mark of an unfinished file.
NAME_BYTES = 180

#: Temporary files of this process that are being written.
_parts: set[Path] = set()
_UNSAFE = re.compile(r"[^\w.+=,@-]+")


def file_name(text: str, fallback: str = "unnamed") -> str:
    """Return the name of a file, without a folder, for any text such as a run's or a topic's name.

    Letters, digits and ``. _ + = , @ -`` stay; each sequence of other characters becomes one
    ``_``.  Leading dots, which would hide the file, and leading dashes, which commands take for an
    option, are removed.  The name is cut to :data:`NAME_BYTES`.  If only ``_`` and ``.`` are left,
    ``fallback`` is returned.
    """
    # no file system accepts lone surrogates
    clean = _UNSAFE.sub("_", text.encode(errors="replace").decode()).lstrip(".-")
    clean = clean.encode()[:NAME_BYTES].decode(errors="ignore")
    return clean if clean.strip("_.") else fallback


def free_path(path: Path) -> Path:
    """Return a path at which nothing exists: this one, or with ``_2``, ``_3`` ... after its stem.

    A broken link counts as existing.
    """
    candidate, number = path, 1
    while os.path.lexists(candidate):
        number += 1
        candidate = path.with_name(f"{path.stem}_{number}{path.suffix}")
    return candidate


def is_device(path: Path) -> bool:
    """Return True if a path exists and is neither a file nor a folder, e.g. ``/dev/stdout``."""
    return path.exists() and not path.is_file() and not path.is_dir()


@contextmanager
def whole_file(path: Path, *, replace: bool = True) -> Iterator[Path]:
    """Yield a temporary path with the same suffix, and rename the file there when it is complete.

    The block must write the file at the yielded path.  If it ends without an error, the file gets
    its name ``path`` in one step, so other processes never find an incomplete file.  After an
    error, the temporary file is removed and an earlier file at ``path`` stays as it was.  If the
    process is killed, ``.<stem>.part-<random><suffix>`` remains.  A missing folder is created.  A
    device (``/dev/stdout``) is yielded itself and written to directly.

    FileExistsError is raised if ``replace`` is False and ``path`` exists.  RecordingError is raised
    if the file cannot be written, or if a command must not replace the one that has the name, see
    :mod:`capture_sim.base.outputs`.  An error about another file, such as one that the block reads,
    is raised unchanged.
    """
    part = path.with_name(f".{path.stem[:NAME_BYTES]}.part-{secrets.token_hex(4)}{path.suffix}")
    _parts.add(part)
    try:
        if is_device(path):
            yield path
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        check_replaceable(path)
        yield part
        if replace:
            check_replaceable(path, part)
            part.replace(path)
        else:
            _link_new(part, path)
    except OSError as error:
        if isinstance(error, FileExistsError) and path.exists():
            raise
        if error.filename is not None and error.filename not in map(str, (part, path, path.parent)):
            raise  # another file, e.g. one that is read
        raise RecordingError(f"{path}: cannot write: {error.strerror or error}") from None
    finally:
        _parts.discard(part)
        with suppress(OSError):
            part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> Path:
    """Write a text file, which gets its name only when it is complete; return its path.

    Errors are those of :func:`whole_file`.
    """
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def discard_parts() -> None:
    """Remove the files of this process that are not complete, before it ends without cleaning."""
    for part in list(_parts):
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _link_new(part: Path, path: Path) -> None:
    """Give a file a new name, without replacing another file; FileExistsError if one has the name.

    It takes one step on a file system with hard links; the file then also keeps its old name.  On
    another file system, an empty file has the new name for a moment.
    """
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links: create the name first
        path.open("xb").close()
        part.replace(path)


def writing_problem(folder: Path) -> str:
    """Return the reason why no file can be written into a folder, empty if one can.

    A missing folder is not created, so a command that is rejected later leaves nothing behind.
    Its nearest existing parent is tested instead.
    """
    try:
        existing = next(path for path in (folder, *folder.parents) if _is_taken(path))
        if not existing.is_dir():
            return "it is a file" if existing == folder else f"{existing} is a file"
        with tempfile.TemporaryFile(dir=existing):
            return ""
    except FileNotFoundError:
        return f"{existing} takes no new files"  # as /proc
    except OSError as error:
        return error.strerror or str(error)


def file_problem(path: Path) -> str:
    """Return the reason why a file cannot be written at a path, empty if it can.

    A missing folder is a reason.
    """
    if path.is_dir():
        return "it is a folder"
    if not path.parent.is_dir():
        return f"{path.parent} is not a folder"
    if path.exists():
        return "" if os.access(path, os.W_OK) else os.strerror(errno.EACCES)
    return writing_problem(path.parent)


def folder_problem(path: Path) -> str:
    """Return the reason why a path is not an existing folder, empty if it is one."""
    return "" if path.is_dir() else "there is none"


def _is_taken(path: Path) -> bool:
    """Return True if a path exists, also as a broken link.

    OSError if that cannot be found out, e.g. if a name in the path is too long.
    """
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True
