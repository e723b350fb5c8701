"""The page for users has the rules as they are in the code."""

from __future__ import annotations

from pathlib import Path

from capture_sim.plausibility.rules import RULES, Grade
from tools.reference import table_of_rules

PAGE = Path(__file__).resolve().parents[2] / "docs" / "what_your_recording_must_hold.md"


def test_the_table_of_the_page_is_that_of_the_code():
    assert table_of_rules() in PAGE.read_text(encoding="utf-8")


def test_the_page_names_each_grade():
    text = PAGE.read_text(encoding="utf-8")
    assert all(f"\n| {grade} |" in text for grade in Grade)
    assert len(RULES) == table_of_rules().count("\n| `")
