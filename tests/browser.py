"""Debian's Chromium without a window, that reaches nothing beyond this machine."""

import os
import shutil
import subprocess

import pytest

needs_chromium = pytest.mark.skipif(
    shutil.which("chromium") is None, reason="needs Debian's chromium to open pages"
)


def chromium_command(address, folder, *options):
    """Return the command that opens a page; `folder` is for the browser's profile."""
    return [
        *("chromium", "--headless", "--disable-gpu", "--no-first-run", "--hide-scrollbars"),
        f"--user-data-dir={folder / 'profile'}",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
        "--disable-background-networking",
        "--enable-logging=stderr",
        *(("--no-sandbox",) if os.geteuid() == 0 else ()),
        *options,
        address,
    ]


def console_lines(log):
    """Return what pages reported to the console."""
    return [line for line in log.splitlines() if ":CONSOLE" in line]


def open_page(page, folder, *options):
    """Open the file of a page; return what it reported to the console."""
    command = chromium_command(page.as_uri(), folder, *options)
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return console_lines(done.stderr)
