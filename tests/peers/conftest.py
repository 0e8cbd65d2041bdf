"""What the tests in simulators share. Each runs in an environment that has the simulator, and neither app nor browser."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
Residuals = tuple[float, float]
"""With the integrator and with the controller [nm]."""


@pytest.fixture
def loop_of_the_page() -> Callable[[str], tuple[Residuals, Residuals]]:
    """Run the example of a simulator as a user does; return what it prints, and what the page says."""

    def run(title: str) -> tuple[Residuals, Residuals]:
        page = (ROOT / "docs" / "other-loops.md").read_text(encoding="utf-8")
        script = ROOT / "examples" / "simulators" / f"{title.lower()}_loop.py"
        (lines,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.M | re.S)
        assert lines in script.read_text(encoding="utf-8")
        row = next(line for line in page.splitlines() if line.startswith(f"| {title} ") and "make " in line)
        environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_NUM_THREADS": "1"}
        done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
        printed = re.findall(r"^measured: .*", done.stdout, flags=re.M)
        return nanometres(printed[-1]), nanometres(row)

    return run


def nanometres(text: str) -> Residuals:
    before, after = re.findall(r"([\d.]+) nm", text)
    return float(before), float(after)
