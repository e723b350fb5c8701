"""Finds the sentences of the written pages that promise something."""

import re
from pathlib import Path

#: Words that promise.
PROMISES = re.compile(
    r"\b(never|always|identical(ly)?|every|at most|exits?|refuses?|complete(ly)?)\b", re.IGNORECASE
)
_NOT_WRITTEN = (
    re.compile(r"<!-- (generated|measured)\b.*?<!-- end of \1 -->", re.DOTALL),
    re.compile(r"^(```|~~~).*?^\1$", re.DOTALL | re.MULTILINE),
)
#: Generated as a whole.
LEFT_OUT = ("scenes.md",)
_END = re.compile(r"(?<=[.:;!?])\s+(?=[A-Z`*\[|])")
_ITEM = re.compile(r"\n(?=\s*(?:[-*|]|\d+\.)\s)")


def sentences(text: str) -> list[str]:
    """Return the sentences of a page that promise something, each in one line."""
    for part in _NOT_WRITTEN:
        text = part.sub("", text)
    found = []
    for paragraph in re.split(r"\n\s*\n", text):
        for item in _ITEM.split(f"\n{paragraph}"):
            line = " ".join(item.split())
            for sentence in _END.split(line):
                if PROMISES.search(re.sub(r"`[^`]*`|\([^()]*\.md[^()]*\)", "", sentence)):
                    found.append(sentence)
    return found


def pages(root: Path) -> dict[str, str]:
    """Return the written pages by name: README and docs, without the folder of evidence."""
    found = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
    return {p.name: p.read_text(encoding="utf-8") for p in found if p.name not in LEFT_OUT}
