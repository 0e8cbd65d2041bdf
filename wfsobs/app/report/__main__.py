"""`python -m wfsobs.app.report`: a packed report on standard input, its page on standard output."""

from __future__ import annotations

import os
import sys
from datetime import datetime

from wfsobs.app.report.packing import unpack
from wfsobs.app.report.page import page


def main() -> None:
    """Behind everything else in priority: who waits for a report can wait."""
    os.nice(10)
    report = unpack(sys.stdin.buffer.read())
    sys.stdout.buffer.write(page(report, datetime.now().astimezone()).encode())


if __name__ == "__main__":
    main()
