"""Each sentence that promises something has a test that tries to break it, or says what it is."""

import ast
from functools import cache
from pathlib import Path

import yaml

from tests.docs.promises import pages, sentences

ROOT = Path(__file__).resolve().parents[2]
LISTED = yaml.safe_load((Path(__file__).parent / "promises.yaml").read_text(encoding="utf-8"))
#: Sentences that cannot be tried here.
MOST_UNTRIED = 1


@cache
def functions(path):
    tree = ast.parse((ROOT / "tests" / path).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_every_promise_of_a_page_is_listed_and_every_listed_one_is_on_its_page():
    written = {page: sentences(text) for page, text in pages(ROOT).items()}
    listed = {page: [entry["says"] for entry in entries] for page, entries in LISTED.items()}
    for page in sorted(written.keys() | listed.keys()):
        new = [s for s in written.get(page, []) if s not in listed.get(page, [])]
        gone = [s for s in listed.get(page, []) if s not in written.get(page, [])]
        assert (new, gone) == ([], []), f"{page}: see tests/docs/promises.yaml"


def test_each_promise_has_a_test_or_a_reason():
    untried = 0
    for entry in (entry for entries in LISTED.values() for entry in entries):
        assert entry.keys() & {"test", "measured", "means", "untried"}, entry["says"]
        if test := entry.get("test"):
            path, _, name = test.partition("::")
            assert name in functions(path), test
        if measured := entry.get("measured"):
            assert (ROOT / "benchmarks" / f"{measured}.py").is_file(), measured
        untried += "untried" in entry
    assert untried <= MOST_UNTRIED


def test_sentences_are_found_in_paragraphs_lists_and_tables_and_not_in_code():
    page = """# A page

It never ends. It may
always begin. Nothing else.

- every item
- no promise

| a | at most 3 |
| b | 4 |

```sh
never
```
"""
    assert sentences(page) == [
        "It never ends.",
        "It may always begin.",
        "- every item",
        "| a | at most 3 |",
    ]
