"""Selection of the files in a bag's folder that are read, and the order of reading."""

from __future__ import annotations

import filecmp
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from capture_sim.errors import RecordingError

#: The file that rosbag2 looks for in a bag's folder.
FILE_NAME = "metadata.yaml"
#: The only top-level key of that file.
IN_FOLDER = "rosbag2_bagfile_information"
#: Ends of the names of compressed files.
_PACKED = (".zst", ".zstd", ".lz4")
_NAME = re.compile(r"(?P<stem>.*?)(?P<kind>\.mcap|\.db3)(?P<packed>\.zstd?|\.lz4)?", re.IGNORECASE)


class BagFiles(NamedTuple):
    """The files of a bag that are read, and those of its folder that are not."""

    files: tuple[Path, ...]  # in the order in which they are read
    left_out: dict[str, str]  # why a file of the folder is not read, by its name
    doubts: tuple[str, ...] = ()  # a line for each that is read, but not listed


def is_bag_file(name: str) -> bool:
    """Return True if a file name ends with .mcap or .db3, or these and .zst, .zstd or .lz4."""
    return _NAME.fullmatch(name) is not None


def is_bag(folder: Path) -> bool:
    """Return True if a path is a folder that contains a bag's file or ``metadata.yaml``."""
    if not folder.is_dir():
        return False
    return (folder / FILE_NAME).is_file() or any(map(_is_part, folder.iterdir()))


def stem_of(path: Path) -> str:
    """Return the name of a recording's file or folder without suffixes such as ``.db3.zstd``."""
    found = _NAME.fullmatch(path.name)
    return path.name if found is None else found.group("stem")


def bag_files(path: Path) -> BagFiles:
    """Return the files of a bag; for the path of a single file, that file.

    In a folder these are the files that ``metadata.yaml`` lists, whether they exist or not, then
    files of the same name whose numbers follow, because a recorder that was killed has not listed
    its last file.  If ``metadata.yaml`` is absent, unreadable or lists no file, they are all bag
    files of the folder, by number.  A copy of another file, also a compressed one, is left out.
    RecordingError if the folder contains no bag file.
    """
    if not path.is_dir():
        return BagFiles((path,), {})
    there = sorted((p for p in path.iterdir() if _is_part(p)), key=_number)
    left_out: dict[str, str] = {}
    doubts = []
    listed = _listed(path, left_out)
    if listed is None:
        files = there
    else:
        files = list(listed)
        names = {file.name for file in listed}
        for file in there:
            if file.name in names:
                continue
            if _continues(file, files):
                files.append(file)
                doubts.append(f"{file.name}: not listed in {FILE_NAME}; read as the next part")
            else:
                left_out[file.name] = f"not listed in {FILE_NAME}"
    files = _without_copies(files, left_out)
    if not files:
        raise RecordingError(f"{path}: contains no .mcap or .db3 file")
    return BagFiles(tuple(files), left_out, tuple(doubts))


def sha256_of(path: Path) -> str:
    """Return the SHA-256 hash of a recording in hexadecimal digits: of the files that are read.

    They are hashed in the order in which they are read, as if they were one file.
    """
    digest = hashlib.sha256()
    for file in filter(Path.is_file, bag_files(path).files):
        with file.open("rb") as opened:
            while block := opened.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _is_part(path: Path) -> bool:
    return is_bag_file(path.name) and not path.name.startswith(".")


def _listed(path: Path, left_out: dict[str, str]) -> list[Path] | None:
    """Return the files that ``metadata.yaml`` in a folder lists; None if it lists none.

    None, too, if that file is absent or cannot be read; the latter is noted in ``left_out``.
    """
    try:
        text = (path / FILE_NAME).read_text(encoding="utf-8")
    except FileNotFoundError:  # the recorder was killed
        return None
    except (OSError, UnicodeDecodeError):
        text = ""
    try:
        names = yaml.safe_load(text)[IN_FOLDER]["relative_file_paths"]
        if isinstance(names, str):
            raise ValueError
        files = [path / Path(str(name)).name for name in names]  # nothing outside the folder
    except (yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError):
        left_out[FILE_NAME] = "not the metadata of a bag; the files are read by their numbers"
        return None
    return list(dict.fromkeys(files)) or None


def _continues(file: Path, files: Sequence[Path]) -> bool:
    """Return True if a file's name is that of the last of ``files`` with the next number."""
    last, (number, stem, suffix) = files[-1], _parts_of(file)
    last_number, last_stem, last_suffix = _parts_of(last)
    return (stem, suffix, number) == (last_stem, last_suffix, last_number + 1) and number > 0


def _parts_of(path: Path) -> tuple[int, str, str]:
    """Return the number at the end of a file's name, -1 if none, the rest, and the suffix."""
    found = _NAME.fullmatch(path.name)
    name, kind = (path.stem, path.suffix) if found is None else found.group("stem", "kind")
    stem, _, digits = name.rpartition("_")
    number = int(digits) if digits.isdecimal() and len(digits) < 10 else -1
    return number, stem if number >= 0 else name, kind


def _number(path: Path) -> tuple[int, str]:
    return _parts_of(path)[0], path.name


def _without_copies(files: Sequence[Path], left_out: dict[str, str]) -> list[Path]:
    kept: list[Path] = []
    sizes: dict[int, list[Path]] = {}
    names = {file.name for file in files}
    for file in sorted(files, key=lambda file: (file.suffix in _PACKED, len(file.name))):
        if file.suffix in _PACKED and file.stem in names:
            left_out[file.name] = f"{file.stem} is the same, unpacked"
            continue
        size = file.stat().st_size if file.is_file() else 0
        same = [other for other in sizes.get(size, ()) if filecmp.cmp(file, other, shallow=False)]
        if size and same:
            left_out[file.name] = f"a copy of {same[0].name}"
            continue
        sizes.setdefault(size, []).append(file)
        kept.append(file)
    return [file for file in files if file in kept]
