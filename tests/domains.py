"""ROS domains that no other test has, of this session or another one."""

import fcntl
import os
import tempfile
from pathlib import Path

N_DOMAINS = 101  # from 1 on; the ports of higher ones are given to programs by Linux

_last = os.getpid()


def claim_domain():
    """Return a domain that nobody else has, and its lock file, to be closed after use.

    One that was given back is the last to be taken again.
    """
    global _last
    for _ in range(N_DOMAINS):
        _last += 1
        domain = 1 + _last % N_DOMAINS
        path = Path(tempfile.gettempdir(), f"capture_sim_domain_{domain}.lock")
        lock = path.open("a")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
        else:
            return domain, lock
    raise RuntimeError(f"all ROS domains from 1 to {N_DOMAINS} are taken by other tests")
