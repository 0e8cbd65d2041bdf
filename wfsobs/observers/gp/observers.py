"""Gaussian process regression in time, a sum of kernels: in the steady-state filter of the LGS and the optimal one of both.

Turbulence is one kernel, every line of the vibration an oscillator, and the sensor's error may have a colour: a Matern 1/2
background of its own, part of the measurement and of no target. The state has one element more, the sum one step ago, which is
what a measurement sees:

    z[k] = f[k-1] + noise,    (x, f)[k+1] = (A x[k] + v, h x[k]).

On both sensors the slow error of the LGS and the NGS frame as the mean that it is are states, as in `kalman.multirate`; a
coloured background is an error of the LGS, and no part of what a frame is the mean of.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from math import pi, sqrt

import numpy as np
import param
from scipy.linalg import block_diag

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.gp.kernels import Kernel, Matern, Poles, Sho, SquaredExponentialInTime, Sum
from wfsobs.observers.kalman.mode_filter import ModeFilter, lgs_mean
from wfsobs.observers.kalman.multirate import MultiRate, optimal_model
from wfsobs.observers.kalman.single import NGS, steady_mode
from wfsobs.observers.kalman.step import kalman_filters
from wfsobs.observers.missing import LINE_WIDTH
from wfsobs.prior import LgsError, LgsStars, Lines, Noise, Prior
from wfsobs.settings import Group, Real, Section
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.statespace import DisturbanceModel

POLES, MATERN, SMOOTH = "as told", {"matern-1/2": 1, "matern-3/2": 3, "matern-5/2": 5}, "squared-exponential"


NOTHING = (Matern(0.0, 1.0, 1),)
"""A sum of no kernel."""


class GaussianProcess(Group):
    """Gaussian process regression in time, with a sum of kernels."""

    turbulence: param.Selector[str] = param.Selector(
        default=POLES,
        objects=[POLES, *MATERN, SMOOTH],
        label="Kernel of the turbulence",
        doc="as told: the poles of the model; the others have its rms and its corner frequency.",
    )
    background_rms: Real = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 0.1),
        label="Coloured background",
        doc="RMS of a Matern 1/2 background of the measurement [um]; 0 for none.",
    )
    background_scale: Real = Real(
        1.5,
        bounds=(0.01, 1e4),
        softbounds=(0.1, 100.0),
        label="Time of the background",
        doc="Length scale of the background [ms].",
    )

    def idle(self) -> dict[str, str]:
        """Return the settings without effect: without a background it has no scale."""
        return {} if self.background_rms > 0 else {"background_scale": "Used only where Coloured background is above 0"}


GP = Section("gp", "Gaussian process in time", GaussianProcess)


def kernels_of(lines: Lines, settings: GaussianProcess) -> tuple[Kernel, Kernel, Kernel]:
    """Return the kernels of turbulence, vibration and background of one mode."""
    turbulence = tuple(_turbulence(process, settings.turbulence) for process in lines.turbulence)
    peaks = []
    for frequency, damping, rms in lines.lines:
        omega = 2.0 * pi * frequency
        peaks.append(Sho(rms, omega, min(max(damping, pi * LINE_WIDTH / omega), 1.0)))
    peaks += [Sho(process.rms, process.omega, process.damping) for process in lines.continuum]
    colour = (Matern(settings.background_rms, settings.background_scale * 1e-3, 1),) if settings.background_rms else ()
    return Sum(turbulence or NOTHING), Sum(tuple(peaks) or NOTHING), Sum(colour or NOTHING)


def _turbulence(process: Ar2 | Ar3, kind: str) -> Kernel:
    """Return the kernel of a told process: its own, or one with its rms and corner."""
    if kind in MATERN:
        return Matern(process.rms, sqrt(MATERN[kind]) / process.omega, MATERN[kind])
    if kind == SMOOTH:
        return SquaredExponentialInTime(process.rms, 1.0 / process.omega)
    if isinstance(process, Ar2):
        return Sho(process.rms, process.omega, process.damping)
    return Poles(process.rms, tuple(-process.decays / process.dt))


def sampled_model(kernels: Sequence[Kernel], dt: float) -> DisturbanceModel:
    """Return the model of kernels at steps dt [s]: of turbulence and vibration, then of what is of neither; C is the sum now."""
    found = [(one, *one.discretise(dt)) for one in (kernel.state_space() for kernel in kernels)]
    A, Q, P = (block_diag(*parts) for parts in ([A for _, A, _ in found], [Q for _, _, Q in found], [o.P for o, _, _ in found]))
    h = np.concatenate([one.h for one, _, _ in found])
    ends = np.cumsum([len(one.h) for one, _, _ in found])
    place = np.arange(len(h))
    now = np.array([np.where(place < ends[0], h, 0.0), np.where((place >= ends[0]) & (place < ends[1]), h, 0.0)])
    before = np.linalg.lstsq(P, (now @ P @ A.T).T, rcond=1e-14)[0].T  # the likeliest value one step ago
    pairs = np.stack([now, before], axis=1).reshape(4, -1)
    return DisturbanceModel(A, h, Q, dict(zip(TARGETS, now, strict=True)), pairs)


def measured_late(model: DisturbanceModel) -> DisturbanceModel:
    """Return the model with one state more, the sum one step ago: what a measurement sees."""
    n = len(model.A)
    A = np.zeros((n + 1, n + 1))
    A[:n, :n], A[n, :n] = model.A, model.C
    outputs = {target: np.append(row, 0.0) for target, row in model.outputs.items()}
    return DisturbanceModel(A, np.eye(n + 1)[-1], block_diag(model.Q, [[0.0]]), outputs, np.pad(model.pairs, ((0, 0), (0, 1))))


def on_lgs(settings: GaussianProcess, prior: Prior, mode: int, _ratio: int | None) -> ModeFilter:
    """Return the regression of a mode on the LGS measurement, at every fast step."""
    lines = prior.lines[mode]
    model = sampled_model(kernels_of(lines, settings), lines.dt)
    return steady_mode(model, lines.noise, lgs_mean(prior, mode), measured_late(model))


def on_both(settings: GaussianProcess, prior: Prior, mode: int, ratio: int) -> ModeFilter:
    """Return the regression of a mode on both sensors."""
    lines = prior.lines[mode]
    model = sampled_model(kernels_of(lines, settings), lines.dt)
    cycle = optimal_model(MultiRate(), prior, mode, ratio, measured_late(model))
    return cycle._replace(model=model).filter_of(prior, mode)


GP_LGS = Observer(
    "gp-lgs",
    "GP in time",
    TARGETS,
    help="Gaussian process in time, a kernel for the turbulence and one per line, as a filter; not in the paper",
    prior=(Lines, LgsStars),
    settings=GP,
    linear=True,
    weight=2.0,
    takes_missing=True,
    tunable=Tunable(("gp.background_rms", "gp.background_scale"), ("kalman.lgs_noise", "kalman.turbulence_rms")),
    look=Look("GP in time", "#478B83", "#8EFAF0", (6, 2, 2, 2)),
    step=partial(kalman_filters, on_lgs),
)

GP_BOTH = Observer(
    "gp-both",
    "GP on both sensors",
    TARGETS,
    help="Gaussian process in time on both sensors; not in the paper",
    prior=(Noise, LgsError, LgsStars, Lines),
    settings=GP,
    needs=NGS,
    linear=True,
    weight=2.0,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(("gp.background_rms", "gp.background_scale"), ("kalman.lgs_noise", "kalman.ngs_noise")),
    look=Look("GP, both", "#55A17F", "#03E49C", (6, 2, 2, 2, 2, 2)),
    step=partial(kalman_filters, on_both),
)
