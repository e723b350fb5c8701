"""The journal of a study: nothing that was added is lost, and no two processes share one."""

import json
import math
import os

import pytest

from capture_sim.base.journal import Journal, JournalError, read_journal

HEAD = {"study": "test", "seed": 1}


def entries_of(path, **kwargs):
    with Journal(path, HEAD, resume=True, **kwargs) as journal:
        return journal.entries


def test_entries_come_back_as_they_were(tmp_path):
    path = tmp_path / "deep" / "a.journal"
    given = [[0.1 + 0.2, 1e-300, math.inf, "text\nwith\rlines", None, True], {"a": [1, 2.5]}]
    with Journal(path, HEAD) as journal:
        for entry in given:
            journal.add(entry)
    assert entries_of(path) == given
    assert read_journal(path) == (HEAD, given)


@pytest.mark.parametrize("cut", range(1, 40, 3))
def test_a_torn_end_costs_the_torn_entry_alone(tmp_path, cut):
    path = tmp_path / "a.journal"
    with Journal(path, HEAD) as journal:
        journal.add([1, 2, 3])
        journal.add(["x" * 50])
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    with Journal(path, HEAD, resume=True) as journal:
        assert journal.entries == [[1, 2, 3]]
        journal.add("after")
    assert entries_of(path) == [[1, 2, 3], "after"]


def test_blocks_that_a_power_cut_left_empty_end_the_journal(tmp_path):
    path = tmp_path / "a.journal"
    with Journal(path, HEAD) as journal:
        journal.add(1)
    with path.open("ab") as file:
        file.write(b"\0" * 100 + b"\n[2]\n")
    assert entries_of(path) == [1]


def test_a_second_process_is_refused(tmp_path):
    path = tmp_path / "a.journal"
    with Journal(path, HEAD) as journal:
        journal.add(1)
        for resume in (True, False):
            with pytest.raises(JournalError, match="another process works on this study"):
                Journal(path, HEAD, resume=resume)
    assert entries_of(path) == [1]


def test_another_study_is_refused_and_a_new_one_keeps_the_unfinished(tmp_path):
    path = tmp_path / "a.journal"
    with Journal(path, HEAD, resume=True) as journal:  # a job that is queued again begins
        journal.add(1)
    with pytest.raises(JournalError, match="is of another study: seed must be the same"):
        Journal(path, {**HEAD, "seed": 2}, resume=True)
    with Journal(path, {**HEAD, "seed": 2}) as journal:
        assert not journal.entries
        assert read_journal(journal.replaced) == (HEAD, [1])
        journal.add(2)
        journal.finish()
    with Journal(path, {**HEAD, "seed": 2}, resume=True) as journal:
        assert journal.entries == [2]
        journal.finish()
    with Journal(path, HEAD) as journal:
        assert journal.replaced is None  # it was complete


def test_what_only_one_of_two_studies_names_differs_too(tmp_path):
    """A design under dispersions, continued without them, would take their runs for its own."""
    path = tmp_path / "a.journal"
    for first, second in (({**HEAD, "under": "x"}, HEAD), (HEAD, {**HEAD, "under": "x"})):
        with Journal(path, first) as journal:
            journal.add(1)
        with pytest.raises(JournalError, match="is of another study: under must be the same"):
            Journal(path, second, resume=True)
        with Journal(path, first, resume=True) as journal:
            assert journal.entries == [1]


def test_a_full_disk_is_an_error_of_one_line_and_what_was_written_stays(tmp_path, monkeypatch):
    path = tmp_path / "a.journal"
    with Journal(path, HEAD) as journal:
        journal.add(1)
        real = journal._file.write
        rest = [5]

        class Full:
            """A file on a disk that takes five more bytes."""

            def write(self, data):
                if not rest:
                    raise OSError(28, os.strerror(28))
                return real(data[: rest.pop()])

            def close(self):
                file.close()

        file, journal._file = journal._file, Full()
        with pytest.raises(JournalError, match="No space left on device; --resume continues"):
            journal.add("a longer entry")
    assert entries_of(path) == [1]


def test_a_file_that_is_no_journal_says_so(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps([1]) + "\nx\n")
    with pytest.raises(JournalError, match="is no journal of a study"):
        read_journal(path)
