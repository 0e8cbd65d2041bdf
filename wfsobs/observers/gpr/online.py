"""Online GPR of the vibration: trained anew at every step on the last m windows (paper, Algorithm 3).

At step k the newest training pair is (x[k-1], target[k-1]). The target of window j is the vibration at step j: the causal
Butterworth bank on z, of which value j + 1 belongs to step j and is known at step j + 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.baselines import online_filters, online_reference
from wfsobs.observers.gpr.sliding_regression import LateRegression, SlidingRegression, finish, run_lengths, slide
from wfsobs.observers.gpr.windows import (
    Gpr,
    SquaredExponential,
    Windows,
    band,
    check_condition,
    kernel_of,
    over_modes,
    square_from_band,
    tunable,
    turns,
)
from wfsobs.observers.step import HeldEstimate, StepError, run_frames, whole_frames
from wfsobs.observers.stepping import FilterBank, Saved
from wfsobs.prior import Bands, OnlineBands, Part, Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Estimates, Measurements, RecordError, Sampling, Signals, Training
from wfsobs.settings import Real, Section, Whole
from wfsobs.typing import Array


class OnlineGpr(Gpr):
    """Online GPR: retrained at every step on the last windows."""

    training_size: Whole = Whole(
        511, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4)."
    )
    depth: Whole = Whole(170, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std: Real = Real(
        30.0,
        bounds=(1e-3, 1e4),
        softbounds=(0.1, 100.0),
        label="Output scale σ_SE",
        doc="sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).",
    )
    noise_std: Real = Real(
        0.1,
        bounds=(1e-4, 10.0),
        softbounds=(0.01, 1.0),
        label="Noise σ_awgn",
        doc="sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).",
    )


BAND_ENTRIES, BAND_ROWS = 4_000_000, 8192
"""Covariances (32 MB) and windows at a time: enough to share the overlap of the runs, and soon done."""


def online_targets(record: Signals, bands: Bands) -> Array:
    """Return the vibration at every step, from the causal bank one step later, (n, n_modes) [um]; 0 at the last step."""
    f = online_reference(bands, record.z, record.dt)
    return np.vstack([f[1:], np.zeros((1, record.n_modes))])


def predict_sliding(
    signals: Array,
    targets: Array,
    depth: int,
    m: int,
    kernel: SquaredExponential,
    deliver: Callable[[int, int, Array], None] | None = None,
    check: Callable[[], None] = QUIET.check,
) -> tuple[Array, Array]:
    """Predict at every step from the m windows before it.

    signals (n, channels), targets (n,): target of the window ending at each step; step k uses targets k - m ... k - 1.
    deliver : told (start, stop, mean) of each block of steps as it is done
    check   : called between pieces of work; what it raises ends the work
    Returns (mean, variance), each (n,), NaN before step depth + m - 1; variance is that of a noisy target.
    """
    n = signals.shape[0]
    mean, variance = np.full(n, np.nan), np.full(n, np.nan)
    lengths = run_lengths(m)
    run = lengths[0] if lengths else 256
    leaf_window = lengths[-1] - 1 if lengths else m
    # As many runs at a time as the band has room for: their windows overlap.
    chunk = run * max(1, (min(BAND_ENTRIES // (m + 1), BAND_ROWS) - m) // run)
    for start in range(depth + m - 1, n, chunk):
        stop = min(start + chunk, n)
        runs = -(-(stop - start) // run)
        V, points = band(signals, depth, kernel, start - m, m + runs * run, m)
        for r in range(runs):
            check()
            at = start + r * run
            to = min(at + run, n)
            leaves = np.empty((leaf_window + 3, leaf_window + 3, run))
            # The matrix over [m + run points | f | delta] of these steps, and the points' targets.
            row, S, f = r * run, np.zeros((m + run + 2, m + run + 2), order="F"), np.zeros(m + run)
            S[:-2, :-2] = square_from_band(V, row, m + run)
            S[-1, :-2], S[-1, -1] = points.delta[row : row + m + run], -1.0 / kernel.variance
            known = targets[at - m : at + run]
            f[: known.size] = known
            check_condition(S[:m, :m], kernel)
            slide(S, f, m, lengths, leaves, check=check)
            values, spread = finish(leaves, leaf_window)
            mean[at:to], variance[at:to] = values[: to - at], spread[: to - at]
            if deliver:
                deliver(at, to, mean[at:to])
    return mean, variance


class OnlineEstimator(HeldEstimate):
    """Online GPR of all modes one frame at a time, for the vibration now or a number of frames ahead.

    The target of a window is the vibration h frames later as the causal bank on z gives it, one frame late: at step k that of
    window k - 1 - h is known. What it learns from a frame it learns in `settle`, after the estimate.

    Parameters
    ----------
    prior : Prior
        Bands of the bank that gives the targets, and training data for standardised inputs.
    settings : OnlineGpr
        Of windows, training set and covariance.
    sampling : Sampling
        Of the loop.
    weights : Array
        Of the vibration now, one frame ahead and so on in what it learns; fewer than m.
    """

    windows: Windows
    weights: Array
    needs_command: bool

    state_names: tuple[str, ...] = ("windows", "bank", "_mean", "_band_signals", "regression")

    def __init__(self, prior: Prior, settings: OnlineGpr, sampling: Sampling, weights: Array):
        n, late, bands = sampling.n_modes, len(weights) - 1, prior.bands
        assert bands is not None
        super().__init__(n, float(late))
        self.windows, self.weights, self._bands = Windows(settings, sampling, 1, prior.training), weights, bands
        self.needs_command = self.windows.needs_command
        self._band_signals = np.zeros((len(weights), n))  # oldest first
        self._size = settings.depth, settings.training_size, 2 if self.needs_command else 1, kernel_of(settings)
        self.bank: FilterBank = online_filters(bands, sampling)
        self._pending = False
        self.regression: LateRegression | SlidingRegression = (
            LateRegression(*self._size, late, n) if late else SlidingRegression(*self._size, n)
        )

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record, for the vibration now all modes at the same time, in blocks; that to come frame by frame."""
        if len(self.weights) > 1:
            return run_frames(self, (VIBRATION,), measurements, watch)
        (depth, m, _, kernel), n_steps = self._size, measurements.n_steps
        if n_steps < depth + m:
            raise RecordError(f"the record has {n_steps} steps; depth + training size need {depth + m}")
        targets = online_targets(measurements, self._bands)
        values, done = np.full((n_steps, measurements.n_modes), np.nan), np.zeros(measurements.n_modes)

        def one(mode: int, watch: Watch) -> Array:
            def deliver(start: int, stop: int, mean: Array) -> None:
                values[start:stop, mode] = mean
                done[mode] = stop / n_steps
                watch.step(float(done.mean()))
                watch.partial(VIBRATION, values)

            signals = self.windows.channels(measurements, mode)
            return np.column_stack(predict_sliding(signals, targets[:, mode], depth, m, kernel, deliver, watch.check))

        found = over_modes(measurements.n_modes, one, watch)
        latent = np.sqrt(np.maximum(found[:, 1::2] - kernel.noise_std**2, 0.0))  # of the vibration, not of a noisy target
        return Estimates({VIBRATION: found[:, ::2]}, {VIBRATION: latent})

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.settle()
        self._band_signals[:-1] = self._band_signals[1:].copy()
        self._band_signals[-1] = self.bank.step(z[:, None])[:, 0]
        targets = self.weights @ self._band_signals
        samples = self.windows.push(z, u).reshape(len(z), -1)
        self._mean[...] = self.regression.predict(samples, targets)
        self._pending = True

    def settle(self) -> None:
        """Learn from the last frame. Raises ConditionError where the precision is not enough."""
        if self._pending:
            self._pending = False
            self.regression.update()

    def reset(self) -> None:
        """Set the state back to the start."""
        for part in (self.windows, self.bank, self.regression):
            part.reset()
        self._mean[...], self._band_signals[...], self._pending = np.nan, 0.0, False

    def save(self) -> Saved:
        """Return a copy of the state."""
        self.settle()
        return super().save()

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._pending = False

    def take_over(self, old: Any) -> None:
        """Go on from a design with the same windows, training set, kernel and horizon. Raises StepError."""
        if old._size != self._size or not np.array_equal(old.weights, self.weights) or old.bank.x.shape != self.bank.x.shape:
            raise StepError("the designs have other windows, training sets, kernels or horizons: one of them has to learn anew")
        self.load(old.save())


def gpr_online(prior: Prior, settings: OnlineGpr, sampling: Sampling, horizon: float) -> OnlineEstimator:
    """Return the online GPR, which learns the vibration `horizon` frames ahead."""
    return OnlineEstimator(prior, settings, sampling, np.eye(whole_frames(horizon, "gpr-online") + 1)[-1])


def standardised_parts(settings: Gpr) -> tuple[Part, ...]:
    """Standardised inputs are divided by the deviations of a training record."""
    return (Training,) if settings.inputs_filter == "standardised" else ()


def online_seconds(settings: OnlineGpr, n_steps: int, n_modes: int, _dt: float) -> float:
    """One mode [s]: 10 us + 400 us / m + 0.065 ns m^2 for every step with a full training set."""
    m = settings.training_size
    return turns(n_modes) * max(n_steps - settings.depth - m + 1, 0) * (10e-6 + 400e-6 / m + 65e-12 * m**2)


GPR_ONLINE = Observer(
    "gpr-online",
    "Online GPR",
    (VIBRATION,),
    help="Gaussian process regression retrained at every step on the last windows",
    prior=(OnlineBands,),
    settings=Section("gpr_online", "Online GPR", OnlineGpr),
    asks=standardised_parts,
    # Its targets are what the causal band-passes make of turbulence, too.
    tunable=Tunable(
        ("gpr_online.noise_std", "gpr_online.depth", "butterworth.bandwidth_online"),
        ("gpr_online.length_scale", *tunable("gpr_online"), "butterworth.order"),
    ),
    weight=200.0,
    seconds=online_seconds,
    look=Look("Online GPR", "#046D72", "#5B8A77", (10, 2, 2, 2)),
    step=gpr_online,
)
