"""The Butterworth references of the paper (section 2.3, Figure 4) and the answer "zero".

The filtered signal at step k is that of phi_dist[k-1], since a measurement is one step late. The reference on
open-loop data looks ahead: it is zero-phase and moved by that step. The one on closed-loop data is
causal, so its estimate of step k is what the filter gives at step k.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION, Look, Observer, Tunable
from wfsobs.observers.step import HeldEstimate, StepError
from wfsobs.observers.stepping import FilterBank
from wfsobs.prior import Bands, OfflineBands, OnlineBands, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.signal.bandpass import bandpass_bank, bank_recursion, filter_causal, filter_zero_phase
from wfsobs.typing import Array


def open_loop_reference(bands: Bands, open_loop_y: Array, dt: float) -> Array:
    """Vibration at step k from open-loop measurements around it, (n_steps, n_modes) [um]; NaN at the last step."""
    bank = bandpass_bank(bands.frequencies, bands.bandwidth_offline, bands.order, dt)
    filtered = filter_zero_phase(bank, open_loop_y)
    return np.vstack([filtered[1:], np.full((1, filtered.shape[1]), np.nan)])


def online_reference(bands: Bands, z: Array, dt: float) -> Array:
    """Filter the pseudo-open-loop measurement z by the causal bank, (n_steps, n_modes) [um]."""
    return filter_causal(bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, dt), z)


def butterworth_ol(measurements: Measurements, prior: Prior, _settings: None, watch: Watch) -> dict[str, Array]:
    """Zero-phase, on the open-loop twin of the record. Not causal."""
    watch.step(0.0)
    assert measurements.open_loop_y is not None and prior.bands is not None
    return {VIBRATION: open_loop_reference(prior.bands, measurements.open_loop_y, measurements.dt)}


def butterworth_cl(measurements: Measurements, prior: Prior, _settings: None, watch: Watch) -> dict[str, Array]:
    """Causal, on the record's own pseudo-open-loop measurement."""
    watch.step(0.0)
    assert prior.bands is not None
    return {VIBRATION: online_reference(prior.bands, measurements.z, measurements.dt)}


def persistence(measurements: Measurements, _prior: Prior, _settings: None, watch: Watch) -> dict[str, Array]:
    """Return the newest measurement as the turbulence: no model, all of the noise and the vibration, one step late."""
    watch.step(0.0)
    return {TURBULENCE: measurements.z}


def zero(measurements: Measurements, _prior: Prior, _settings: None, watch: Watch) -> dict[str, Array]:
    """Return zero, the trivial baseline."""
    watch.step(0.0)
    return {target: np.zeros_like(measurements.y_lgs) for target in TARGETS}


class BankEstimator(HeldEstimate):
    """The causal band-passes of all modes, one frame at a time. They predict nothing."""

    state_names: tuple[str, ...] = ("filters", "_mean")

    def __init__(self, bands: Bands, sampling: Sampling):
        super().__init__(sampling.n_modes, 0.0, 0.0)
        bank = bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, sampling.dt)
        self.filters: FilterBank = FilterBank([bank_recursion(bank)] * sampling.n_modes)
        self.mark_start()

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self._mean[...] = self.filters.step(z[:, None])[:, 0]


class LastValue(HeldEstimate):
    """The last measurement times a factor, held for any number of frames."""

    def __init__(self, sampling: Sampling, factor: float):
        super().__init__(sampling.n_modes, None, 0.0)
        self._factor = factor
        self.mark_start()

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        np.multiply(z, self._factor, out=self._mean)


def step_butterworth_cl(prior: Prior, _settings: None, sampling: Sampling, horizon: float) -> BankEstimator:
    """Return `butterworth_cl`, one frame at a time. Raises StepError for a horizon."""
    assert prior.bands is not None
    if horizon != 0:
        raise StepError(f"butterworth-cl: band-passes predict nothing: takes horizon = 0, not {horizon:g}")
    return BankEstimator(prior.bands, sampling)


def step_last_value(factor: float, _prior: Prior, _settings: None, sampling: Sampling, _horizon: float) -> LastValue:
    """Return z times a factor, one frame at a time: `persistence` or `zero`."""
    return LastValue(sampling, factor)


BUTTERWORTH_OL = Observer(
    "butterworth-ol",
    "Butterworth, open loop",
    (VIBRATION,),
    butterworth_ol,
    help="band-pass filters run forward and backward: a reference that looks ahead",
    prior=(OfflineBands,),
    needs=("open_loop_y",),
    causal=False,
    linear=True,
    tunable=Tunable(("butterworth.bandwidth_offline",), ("butterworth.order",)),
    look=Look("Butterworth OL", "#B40000", "#E4695E", (2, 2)),
)

BUTTERWORTH_CL = Observer(
    "butterworth-cl",
    "Butterworth, closed loop",
    (VIBRATION,),
    butterworth_cl,
    help="band-pass filters run forward only: causal",
    prior=(OnlineBands,),
    linear=True,
    tunable=Tunable(("butterworth.bandwidth_online",), ("butterworth.order",)),
    look=Look("Butterworth CL", "#B40000", "#E4695E", (8, 3)),
    step=step_butterworth_cl,
)

PERSISTENCE = Observer(
    "persistence",
    "Persistence",
    (TURBULENCE,),
    persistence,
    help="the newest measurement taken for the turbulence",
    linear=True,
    weight=0.1,
    look=Look("Persistence", "#8F8F63", "#A37F9E", (1, 3)),
    step=partial(step_last_value, 1.0),
)

ZERO = Observer(
    "zero",
    "Zero",
    TARGETS,
    zero,
    help="estimate of zero: the trivial baseline",
    linear=True,
    weight=0.1,
    look=Look("Zero", "#8A8A8A", "#9A9A9A", (2, 4)),
    step=partial(step_last_value, 0.0),
)
