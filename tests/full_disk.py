"""A disk that is full after a given number of bytes."""

import contextlib
import resource


@contextlib.contextmanager
def file_size_limit(size):
    """Let no file of this process grow beyond a size, bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))  # Python ignores SIGXFSZ
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
