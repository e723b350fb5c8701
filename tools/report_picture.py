"""Take a picture of the top of a report as a browser shows it.

    .venv/bin/python -m tools.report_picture runs/report.html docs/report.png

Needs Debian's chromium.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

_TIMEOUT = 300.0  # s


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("report", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--size", default="1240,1500", help="pixels (1240,1500)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder, "page.png")
        command = [
            *("chromium", "--headless", "--disable-gpu", "--no-first-run", "--hide-scrollbars"),
            *(("--no-sandbox",) if os.geteuid() == 0 else ()),
            *(f"--user-data-dir={folder}/profile", "--disable-background-networking"),
            *("--host-resolver-rules=MAP * ~NOTFOUND", f"--window-size={options.size}"),
            *(f"--screenshot={shot}", options.report.resolve().as_uri()),
        ]
        subprocess.run(command, check=True, capture_output=True, timeout=_TIMEOUT)
        with Image.open(shot) as image:
            few = image.convert("RGB").quantize(96, dither=Image.Dither.NONE)
            few.save(options.picture, optimize=True)
    print(f"picture in {options.picture}")


if __name__ == "__main__":
    main()
