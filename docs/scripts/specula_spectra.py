"""Draw the spectra of residuals in SPECULA beside those of theory, seed by seed: the figure of docs/specula.md.

    python docs/scripts/specula_spectra.py series.npz [docs/pictures/specula-spectra.png]

`series.npz` is what `examples/specula/run.py` writes.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from wfsobs.observers.base import Look
from wfsobs.plot.elements import FREQUENCY, PAGE, draw_line, overlay, quantity, save_figure, stack
from wfsobs.plot.looks import look
from wfsobs.signal.spectrum import psd

RATE = 1000.0
LOOPS = ("integrator", "lqg-kf-multi")
PICTURE = Path(__file__).parents[1] / "pictures" / "specula-spectra.png"


def smooth(frequency, density, at):
    """Return theory as a spectrum by windows sees it at the frequencies `at` [Hz]: the mean over the width of a window."""
    width = round(2.0 * at[0] / frequency[1])
    return np.interp(at, frequency, np.convolve(density, np.full(width, 1.0 / width), mode="same"))


def draw(name, found):
    """Draw the spectra of tip and tilt together under one controller."""
    its, density = look(name), quantity("PSD of tip and tilt", "nm²/Hz")
    seeds = []
    for residual in found[name]:
        frequency, of_modes = psd(residual, 1.0 / RATE, resolution=RATE / 1024)
        seeds.append(of_modes.sum(axis=1)[1:])
    f = frequency[1:]
    theory = smooth(found["theory frequency"], found[f"theory {name}"], f)
    lines = [(one, replace(its, light="#B0B0B0", dash=(), width=1.0, label="Each seed")) for one in seeds]
    lines += [
        (np.mean(seeds, axis=0), replace(its, dash=(), width=2.4, label="Mean")),
        (theory, Look("Theory", "#202020", dash=(6, 3))),
    ]
    rms = ", ".join(f"{np.sqrt(np.mean(np.sum(one**2, axis=1))):.1f}" for one in found[name])
    title = f"{its.label}: {rms} nm; theory {float(found[f'theory rms {name}']):.1f} nm"
    of = FREQUENCY, density
    return overlay([draw_line(f, x, of, line) for x, line in lines], log="xy", title=title, xlim=(1.0, RATE / 2.0))


if __name__ == "__main__":
    with np.load(sys.argv[1]) as series:
        save_figure(stack([draw(name, series) for name in LOOPS]), sys.argv[2] if len(sys.argv) > 2 else PICTURE, width=PAGE)
