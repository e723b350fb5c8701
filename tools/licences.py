"""Lists the licences of the installed packages; fails if one is not in the list below.

    python tools/licences.py [--table]

A package's licence is what its metadata say: the expression, the classifiers or the text's name.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import Distribution, distributions

#: Licences under which this package's dependencies may be used: words of their names.
ALLOWED = {
    *("apache", "bsd", "mit", "isc", "psf", "python software foundation", "zlib", "unlicense"),
    *("mozilla", "mpl", "public domain", "cc0", "hpnd", "bsl", "boost", "0bsd", "blueoak"),
}
#: Packages under a licence that asks for more, and why that is met.
NAMED = {
    "moocore": "LGPL: a part of pymoo, imported unchanged and installed by the user",
    "apsw": "any OSI licence, at the user's choice",
    "docutils": "public domain and BSD; one file under the GPL is not used; tests only",
    "graphemeu": "MIT, whose text its metadata have in place of a name",
}
_UNKNOWN = "not named in its metadata"


def licence_of(package: Distribution) -> str:
    """Return the licence of an installed package in a line."""
    data = package.metadata
    if expression := data.get("License-Expression"):
        return str(expression)
    classifiers = [
        each.rpartition(" :: ")[2]
        for each in data.get_all("Classifier") or []
        if each.startswith("License ::")
    ]
    text = str(data.get("License") or "").strip().splitlines()
    named = [each for each in classifiers if each != "OSI Approved"] or text[:1]
    return ", ".join(named) or _UNKNOWN


def problem(name: str, licence: str) -> str:
    """Return why a package needs a look; empty if its licence is allowed or it is named."""
    words = licence.lower()
    is_allowed = any(re.search(rf"\b{re.escape(each)}", words) for each in ALLOWED)
    is_copyleft = "gpl" in words and not is_allowed
    if name.lower() in NAMED or name.startswith(("ros-", "ros_")):  # ROS: Apache and BSD
        return ""
    if is_copyleft or ("gpl" in words and "or" not in words):
        return "copyleft"
    return "" if is_allowed or licence == _UNKNOWN else "unknown"


def main() -> int:
    """Print the licences, or only those that need a look; return the exit status."""
    rows = sorted(
        {(d.metadata["Name"], d.version, licence_of(d)) for d in distributions()},
        key=lambda row: str(row[0]).lower(),
    )
    problems = [(*row, found) for row in rows if (found := problem(row[0], row[2]))]
    if "--table" in sys.argv[1:]:
        print("\n".join(f"{name} {version}: {licence}" for name, version, licence in rows))
    for name, version, licence, found in problems:
        print(f"{name} {version}: {licence}: {found}: add it to tools/licences.py or leave it out")
    return 1 if problems else 0


if __name__ == "__main__":
    raise SystemExit(main())
