"""Draw the spectra of residuals in SPECULA beside those of theory, seed by seed: the figure of docs/specula.md.

    python docs/scripts/specula_spectra.py series.npz [docs/pictures/specula-spectra.png]

`series.npz` is what `examples/specula/run.py` writes.
"""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
from scipy.signal import welch

mpl.use("Agg")
import matplotlib.pyplot as plt

RATE = 1000.0
LOOPS = {"integrator": "#003DE6", "lqg-kf-multi": "#00707F"}
PICTURE = Path(__file__).parents[1] / "pictures" / "specula-spectra.png"


def spectrum(residual):
    """Return frequencies [Hz] and the spectrum of tip and tilt together [nm^2/Hz] of a residual, (frames, 2) [nm]."""
    f, density = welch(residual, RATE, nperseg=1024, axis=0, detrend=False)
    return f[1:], density.sum(axis=1)[1:]


def smooth(frequency, density):
    """Return theory as `spectrum` would see it: the mean over the width of its window."""
    step = round(RATE / 1024 / frequency[1])
    f, n = frequency[step::step], len(frequency) // step - 1
    window = np.convolve(density, np.ones(2 * step) / (2 * step), mode="same")
    return f[:n], window[step::step][:n]


def main():
    """Draw, and print how far apart theory and mean are."""
    found = np.load(sys.argv[1])
    fig, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharex=True, sharey=True, layout="constrained")
    for ax, (name, colour) in zip(axes, LOOPS.items(), strict=True):
        spectra = [spectrum(one) for one in found[name]]
        for number, (f, density) in enumerate(spectra, start=1):
            ax.loglog(f, density, color=colour, lw=0.6, alpha=0.5, label="seeds, each" if number == 1 else None)
        f, mean = spectra[0][0], np.mean([density for _, density in spectra], axis=0)
        ax.loglog(f, mean, color=colour, lw=1.6, label=f"mean of {len(spectra)} seeds")
        ax.loglog(*smooth(found["theory frequency"], found[f"theory {name}"]), "k--", lw=1.2, label="theory")
        rms = np.sqrt([np.mean(np.sum(one**2, axis=1)) for one in found[name]])
        seeds = ", ".join(f"{one:.1f}" for one in rms)
        ax.set_title(f"{name}: {seeds} nm; theory {float(found[f'theory rms {name}']):.1f} nm", fontsize=10)
        ax.set_xlabel("Frequency, Hz")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=9)
    axes[0].set_ylabel("Residual of tip and tilt, nm$^2$/Hz")
    axes[0].set_xlim(1, RATE / 2)
    fig.savefig(sys.argv[2] if len(sys.argv) > 2 else PICTURE, dpi=110)


if __name__ == "__main__":
    main()
