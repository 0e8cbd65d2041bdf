"""Make wfsobs/assets/eris_ut4.csv anew from the wheel that carries the spectrum: `python scripts/make_eris_table.py`.

The wheel is `astro-tiptop==1.6.0` (MIT); pip fetches it into a folder that goes afterwards. Needs astropy (wfsobs[fits]).

Of the 3393 bins all but the few listed lie on a synthetic floor, so that bins off the floor, the floor and the grid of the
frequencies are the whole spectrum.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import numpy as np
from astropy.io import fits

WHEEL = "astro-tiptop==1.6.0"
INSIDE = "tiptop/data/eris_vibrations_psd.fits"
SHA256 = "3794047467ff7de2ad0aee51b7b4da1d704903c75f532468854b9275c566edb0"
ASSETS = Path(__file__).parents[1] / "assets"

FLOOR = 4e4
"""The floor is FLOOR / f^2 [nm^2/Hz]."""
FIRST, STEP = 5.012, 0.028
LINES_FROM = 7.5
"""Below this [Hz] the bins scatter about the floor to either side, and nothing tells a line."""
ON_FLOOR = 1e-3
"""Relative distance from the floor that counts as on it: rounding has 1e-5 at most."""

HEAD = """\
# Vibration of VLT UT4 measured with ERIS: one-sided power spectral densities of Noll-normalised tip and tilt.
# From astro-tiptop/TIPTOP, {inside}, in the wheel {wheel}; MIT licence, eris_ut4.LICENSE.txt.
# The file gives no unit; nm^2/Hz is inferred. Made by scripts/make_eris_table.py: bins that lie off the floor.
# first: {first}
# step: {step}
# bins: {bins}
# floor: {floor:g}
# lines from: {lines}
frequency [Hz],tip [nm^2/Hz],tilt [nm^2/Hz]
"""


def fetch() -> tuple[bytes, bytes]:
    """The spectrum's file and the licence, out of the wheel."""
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", folder, WHEEL]
        subprocess.run(command, check=True)
        with ZipFile(next(Path(folder).glob("*.whl"))) as wheel:
            licence = next(name for name in wheel.namelist() if name.endswith("/LICENSE"))
            return wheel.read(INSIDE), wheel.read(licence)


def table(content: bytes) -> str:
    """The compact table. Raises ValueError where the file is not the one that this was written for."""
    if hashlib.sha256(content).hexdigest() != SHA256:
        raise ValueError(f"{INSIDE}: not the file that this script was written for")
    with fits.open(BytesIO(content)) as hdus:
        frequency, tip, tilt = np.asarray(hdus[0].data, dtype=float)
    grid = FIRST + STEP * np.arange(frequency.size)
    if np.abs(frequency - grid).max() > 1e-4:
        raise ValueError(f"{INSIDE}: its frequencies are not {FIRST} + {STEP} i")
    floor = FLOOR / frequency**2
    off = (np.abs(tip / floor - 1.0) > ON_FLOOR) | (np.abs(tilt / floor - 1.0) > ON_FLOOR)
    head = HEAD.format(inside=INSIDE, wheel=WHEEL, first=FIRST, step=STEP, bins=frequency.size, floor=FLOOR, lines=LINES_FROM)
    rows = zip(grid[off], tip[off], tilt[off], strict=True)
    return head + "".join(f"{f:.3f},{a:.6g},{b:.6g}\n" for f, a, b in rows)


if __name__ == "__main__":
    spectrum, licence = fetch()
    (ASSETS / "eris_ut4.csv").write_text(table(spectrum), encoding="utf-8")
    (ASSETS / "eris_ut4.LICENSE.txt").write_bytes(licence)
