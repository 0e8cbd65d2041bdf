"""How much of the package is typed for those who use it: `python scripts/check_types.py`, at least 98 % of its names.

By `pyright --verifytypes wfsobs --ignoreexternal`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

LEAST = 0.98

command = [sys.executable, "-m", "pyright", "--verifytypes", "wfsobs", "--ignoreexternal", "--outputjson"]
place = {
    **os.environ,
    "PYTHONPATH": str(Path(__file__).parents[1]),  # an editable installation is not found by pyright
    "PATH": os.pathsep.join(
        [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
    ),  # nor are packages but of its first python
}
run = subprocess.run(command, capture_output=True, text=True, check=False, env=place)
names = [s for s in json.loads(run.stdout)["typeCompleteness"]["symbols"] if s["isExported"]]
left = [s for s in names if not s["isTypeKnown"] or s["isTypeAmbiguous"]]
share = 1.0 - len(left) / len(names)
print(f"typed: {share:.1%} of {len(names)} names")
if share < LEAST:
    for symbol in left:
        print(symbol["name"], *(d["message"].replace("\n", " ") for d in symbol["diagnostics"]))
sys.exit(share < LEAST)
