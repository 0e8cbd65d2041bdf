"""A record from the public tip-tilt telemetry of Keck II: `python docs/scripts/keck_record.py FOLDER keck.npz`.

FOLDER holds Centroid_nXXXX.npy and Commands_nXXXX.npy of the data set of A. Sengupta, doi:10.5281/zenodo.4321008 (MIT):
(n, 2) each, in arcsec on the sky, about 1000 Hz. Its open-loop file says how the two go together,

    OpenLoop[k] = Commands[k] + Centroid[k+1],

so that a centroid sees the command of the row before, with a minus sign: sign -1, delay 1 here. Commands[k] is worked out from
Centroid[k] (a regression finds 0.1 of it), so that a row has the command that follows from its measurement, as everywhere here.
Where FOLDER has the open-loop file the identity is checked. The first seconds become the training record.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from wfsobs.telemetry.records import save_arrays

RATE = 1000.0
"""Frames per second, about [Hz]."""

TRAINING = 5.0
"""Seconds at the start that the offline GPR is trained on."""


def convert(folder: Path, out: Path) -> None:
    """Write the record. Raises ValueError where the files do not go together."""
    centroid, commands = (np.load(_only(folder, name), allow_pickle=False).astype(float) for name in ("Centroid", "Commands"))
    if centroid.shape != commands.shape or centroid.ndim != 2:
        raise ValueError(f"Centroid has shape {centroid.shape}, Commands {commands.shape}")
    for path in folder.glob("OpenLoop*.npy"):
        difference = np.abs(np.load(path, allow_pickle=False) - commands[:-1] - centroid[1:]).max()
        print(f"{path.name}: Commands[k] + Centroid[k+1] to {difference:.1e} arcsec")
    n = round(TRAINING * RATE)
    save_arrays(
        out,
        {
            "y_lgs": centroid[n:],
            "u": commands[n:],
            "training_y": centroid[:n],
            "training_u": commands[:n],
            "dt": np.array(1.0 / RATE),
            "unit": np.array("arcsec"),
            "command_sign": np.array(-1),
            "delay": np.array(1),
        },
    )
    print(f"{out}: {len(centroid) - n} steps, and {n} for training")


def _only(folder: Path, name: str) -> Path:
    found = sorted(folder.glob(f"{name}*.npy"))
    if len(found) != 1:
        raise ValueError(f"{folder}: has {len(found)} files {name}*.npy, not one")
    return found[0]


if __name__ == "__main__":
    try:
        convert(Path(sys.argv[1]), Path(sys.argv[2]))
    except (IndexError, OSError, ValueError) as error:
        sys.exit(f"keck_record: {error}" if len(sys.argv) == 3 else __doc__)
