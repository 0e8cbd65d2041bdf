"""The Butterworth references of the paper (section 2.3, Figure 4) and the answer "zero".

The filtered signal at step k is that of phi_dist[k-1], since a measurement is one step late. The reference on
open-loop data looks ahead: it is zero-phase and moved by that step. The one on closed-loop data is
causal, so its estimate of step k is what the filter gives at step k.
"""

from __future__ import annotations

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION
from wfsobs.progress import Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.bandpass import bandpass_bank, filter_causal, filter_zero_phase
from wfsobs.typing import Array


def open_loop_reference(scenario: Scenario, open_loop_y: Array, dt: float) -> Array:
    """Vibration at step k from open-loop measurements around it, (n_steps, n_modes) [um]; NaN at the last step."""
    b = scenario.butterworth
    filtered = filter_zero_phase(bandpass_bank(b.frequencies, b.bandwidth_offline, b.order, dt), open_loop_y)
    return np.vstack([filtered[1:], np.full((1, filtered.shape[1]), np.nan)])


def online_reference(scenario: Scenario, z: Array, dt: float) -> Array:
    """The causal bank on the pseudo-open-loop measurement z, (n_steps, n_modes) [um]."""
    b = scenario.butterworth
    return filter_causal(bandpass_bank(b.frequencies, b.bandwidth_online, b.order, dt), z)


def butterworth_ol(record: Record, scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """Zero-phase, on the open-loop twin of the record. Not causal."""
    watch.step(0.0)
    assert record.open_loop_y is not None
    return {VIBRATION: open_loop_reference(scenario, record.open_loop_y, record.dt)}


def butterworth_cl(record: Record, scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """Causal, on the record's own pseudo-open-loop measurement."""
    watch.step(0.0)
    return {VIBRATION: online_reference(scenario, record.z, record.dt)}


def persistence(record: Record, _scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """The newest measurement taken for the turbulence: no model, all of the noise and the vibration, one step late."""
    watch.step(0.0)
    return {TURBULENCE: record.z}


def zero(record: Record, _scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """The trivial baseline: nothing disturbs."""
    watch.step(0.0)
    return {target: np.zeros_like(record.y_lgs) for target in TARGETS}
