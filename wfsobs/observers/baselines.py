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
from wfsobs.record import Estimates, Measurements, Sampling
from wfsobs.signal.spectrum import bandpass_bank, bank_recursion, filter_causal, filter_zero_phase
from wfsobs.typing import Array


def open_loop_reference(bands: Bands, open_loop_y: Array, dt: float) -> Array:
    """Vibration at step k from open-loop measurements around it, (n_steps, n_modes) [um]; NaN at the last step."""
    bank = bandpass_bank(bands.frequencies, bands.bandwidth_offline, bands.order, dt)
    filtered = filter_zero_phase(bank, open_loop_y)
    return np.vstack([filtered[1:], np.full((1, filtered.shape[1]), np.nan)])


def online_bank(bands: Bands, dt: float) -> list[Array]:
    """Return the band-passes on closed-loop data."""
    return bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, dt)


def online_filters(bands: Bands, sampling: Sampling) -> FilterBank:
    """Return these of all modes, one frame at a time."""
    return FilterBank([bank_recursion(online_bank(bands, sampling.dt))] * sampling.n_modes)


def online_reference(bands: Bands, z: Array, dt: float) -> Array:
    """Filter the pseudo-open-loop measurement z by the causal bank, (n_steps, n_modes) [um]."""
    return filter_causal(online_bank(bands, dt), z)


def butterworth_ol(measurements: Measurements, prior: Prior, _settings: None, watch: Watch) -> dict[str, Array]:
    """Zero-phase, on the open-loop twin of the record. Not causal."""
    watch.step(0.0)
    assert measurements.open_loop_y is not None and prior.bands is not None
    return {VIBRATION: open_loop_reference(prior.bands, measurements.open_loop_y, measurements.dt)}


class BankEstimator(HeldEstimate):
    """The causal band-passes of all modes, one frame at a time. They predict nothing."""

    filters: FilterBank

    state_names: tuple[str, ...] = ("filters", "_mean")

    def __init__(self, bands: Bands, sampling: Sampling):
        super().__init__(sampling.n_modes, 0.0, 0.0)
        self._bands, self.filters = bands, online_filters(bands, sampling)
        self.mark_start()

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Filter the pseudo-open-loop measurement of a record."""
        watch.step(0.0)
        return Estimates({VIBRATION: online_reference(self._bands, measurements.z, measurements.dt)})

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self._mean[...] = self.filters.step(z[:, None])[:, 0]


class LastValue(HeldEstimate):
    """The last measurement times a factor, held for any number of frames."""

    def __init__(self, sampling: Sampling, factor: float):
        super().__init__(sampling.n_modes, None, 0.0)
        self._factor = factor
        self.mark_start()

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Return the measurements of a record times the factor, as either target."""
        watch.step(0.0)
        return Estimates(dict.fromkeys(TARGETS, self._factor * measurements.z))

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        np.multiply(z, self._factor, out=self._mean)


def butterworth_cl(prior: Prior, _settings: None, sampling: Sampling, horizon: float) -> BankEstimator:
    """Return the causal band-passes on the pseudo-open-loop measurement. Raises StepError for a horizon."""
    assert prior.bands is not None
    if horizon != 0:
        raise StepError(f"butterworth-cl: band-passes predict nothing: takes horizon = 0, not {horizon:g}")
    return BankEstimator(prior.bands, sampling)


def last_value(factor: float, _prior: Prior, _settings: None, sampling: Sampling, _horizon: float) -> LastValue:
    """Return z times a factor: no model, all of the noise and the vibration, one step late; or zero, the trivial baseline."""
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
    help="band-pass filters run forward only: causal",
    prior=(OnlineBands,),
    linear=True,
    tunable=Tunable(("butterworth.bandwidth_online",), ("butterworth.order",)),
    look=Look("Butterworth CL", "#B40000", "#E4695E", (8, 3)),
    step=butterworth_cl,
)

PERSISTENCE = Observer(
    "persistence",
    "Persistence",
    (TURBULENCE,),
    help="the newest measurement taken for the turbulence",
    linear=True,
    weight=0.1,
    look=Look("Persistence", "#8F8F63", "#A37F9E", (1, 3)),
    step=partial(last_value, 1.0),
)

ZERO = Observer(
    "zero",
    "Zero",
    TARGETS,
    help="estimate of zero: the trivial baseline",
    linear=True,
    weight=0.1,
    look=Look("Zero", "#8A8A8A", "#9A9A9A", (2, 4)),
    step=partial(last_value, 0.0),
)
