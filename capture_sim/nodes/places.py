"""Where a suite's nodes meet, so that suites beside each other do not mix."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

#: Domains whose ports are safe on every system.
_DOMAINS = 101


@dataclass(frozen=True)
class Place:
    """A ROS domain, and a namespace in it."""

    domain: int
    namespace: str = "/"

    @property
    def prefix(self) -> str:
        """What stands before a node's name."""
        return "" if self.namespace == "/" else self.namespace

    def __str__(self) -> str:
        text = f"on ROS_DOMAIN_ID {self.domain}"
        if self.prefix:
            text += f" in namespace {self.namespace}: another suite runs in this domain"
        return text


@contextmanager
def claim_place() -> Iterator[Place]:
    """Keep a place for as long as the context lasts.

    With ROS_DOMAIN_ID set that domain is used, else the first that no suite of this machine
    has.  The first suite in a domain has plain names, as a user at another terminal expects;
    one that comes while it runs gets a namespace.
    """
    given = os.environ.get("ROS_DOMAIN_ID", "")
    own = os.getpid()
    wanted = (
        [int(given)] if given.isdigit() else [1 + (own + i) % _DOMAINS for i in range(_DOMAINS)]
    )
    for domain in wanted:
        lock = _lock(domain)
        if lock is not None:
            with lock:
                yield Place(domain)
            return
    yield Place(wanted[0], f"/suite_{own}")


def _lock(domain: int) -> IO[str] | None:
    """Return the locked file that stands for a domain; None when another suite has it."""
    path = Path(tempfile.gettempdir(), f"capture_sim_suite_{domain}.lock")
    try:
        file = path.open("a")
    except OSError:  # another user's
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file
