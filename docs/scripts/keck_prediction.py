"""One-step prediction of Keck II telemetry, learnt on its first half: `python docs/scripts/keck_prediction.py FOLDER`.

FOLDER holds the files of `keck_record.py`. The first half is learnt from; the next measurement is predicted over the second, all
of it. Prints the rows of docs/data.md: rms of the error and, in brackets, the one that the filter states, tip / tilt [nm].
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from wfsobs import PRESETS, Record, observe
from wfsobs.identification import identify
from wfsobs.identification.result import Identification

TAPS = (20, 100, 200)
"""Lengths of the least-squares predictors."""
GAP = 60_000
"""Missing samples before the second half, after which a filter knows its prior and no more."""
WINDOWS = (4.0, 8.0, 15.0)
"""Windows of `kf-adaptive`, the first one its default [s]."""
DT = 1e-3
"""Step, about [s]."""
NM = 1e9 * np.pi / 180.0 / 3600.0 * 10.0 / 4.0
"""Noll tip of a 10 m aperture over its angle [nm / arcsec]."""


def measurements(folder: Path) -> np.ndarray:
    """Return the pseudo-open-loop measurement Commands[k] + Centroid[k + 1], (n, 2) [um]."""
    centroid, commands = (np.load(*folder.glob(f"{name}*.npy"), allow_pickle=False) for name in ("Centroid", "Commands"))
    return 1e-3 * NM * (commands[:-1].astype(float) + centroid[1:])


def record_of(z: np.ndarray) -> Record:
    """Return the record of an open loop."""
    return Record(y_lgs=z, u=np.zeros_like(z), dt=DT, delay=1)


def taps_errors(z: np.ndarray, half: int, taps: int, knows_first: bool) -> np.ndarray:
    """Return errors in the second half of plain least squares on so many samples, (n, 2).

    knows_first : whether its first samples are predicted from the last ones of the first half, or from zeros
    """
    errors = []
    for x in z.T:
        past = np.lib.stride_tricks.sliding_window_view(x[:half], taps)[:-1]
        weights = np.linalg.lstsq(past, x[taps:half], rcond=None)[0]
        before = x[half - taps : half] if knows_first else np.zeros(taps)
        recent = np.lib.stride_tricks.sliding_window_view(np.concatenate([before, x[half:-1]]), taps)
        errors.append(x[half:] - recent @ weights)
    return np.transpose(errors)


def observer_errors(
    name: str, z: np.ndarray, first: int, prior: Identification | None = None, window: float = WINDOWS[0]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return errors of an observer that runs over z, from row `first` on, and the standard deviations that it states."""
    scenario = PRESETS["paper"]().replace({"adaptive.window": window})
    found = observe(record_of(z), scenario, observers=[name], prior=prior).estimates
    ahead = sum(one.values for one in found)
    errors, sd = z - np.vstack([0.0 * z[:1], ahead[:-1]]), found[0].sd_of_sum.get("next z")
    return errors[first:], None if sd is None else sd[first:]


def row(name: str, start: str, errors: np.ndarray, sd: np.ndarray | None = None) -> None:
    """Print a row of the table."""
    rms = 1e3 * np.sqrt(np.mean(errors**2, axis=0))
    stated = [""] * len(rms) if sd is None else [f" ({1e3 * x:.1f})" for x in np.sqrt(np.mean(sd**2, axis=0))]
    print(f"| {name} | {start} | {' / '.join(f'{x:.1f}{s}' for x, s in zip(rms, stated, strict=True))} |", flush=True)


def table(z: np.ndarray) -> None:
    """Print the table."""
    half = len(z) // 2
    rest, on = "at rest", "goes on"
    for taps in TAPS:
        row(f"{taps} taps, least squares", rest, taps_errors(z, half, taps, knows_first=False))
    for taps in TAPS:
        row(f"{taps} taps, least squares", on, taps_errors(z, half, taps, knows_first=True))
    found = identify(record_of(z[:half]))
    second = np.vstack([np.full((GAP, 2), np.nan), z[half:]])
    for name in ("kf-multi", "gp-lgs"):
        row(f"`{name}`, identified", rest, *observer_errors(name, z[half:], 0, found))
        row(f"`{name}`, identified", "from its prior", *observer_errors(name, second, GAP, found))
        row(f"`{name}`, identified", on, *observer_errors(name, z, half, found))
    for window in WINDOWS:
        row(f"`kf-adaptive`, window {window:g} s", on, *observer_errors("kf-adaptive", z, half, window=window))


if __name__ == "__main__":
    try:
        table(measurements(Path(sys.argv[1])))
    except (IndexError, OSError, TypeError, ValueError) as error:
        sys.exit(f"keck_prediction: {error}" if len(sys.argv) == 2 else __doc__)
