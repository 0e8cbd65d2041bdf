"""The Kalman filter tasks. The gains are the same for all and found beforehand."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator

import numpy as np

from wfsobs.bench import external, textbook
from wfsobs.bench.external import FILTERPY, STATSMODELS
from wfsobs.bench.measure import OURS, Row, max_error, measure_time, row
from wfsobs.bench.sizes import Sizes
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.adaptive import adapt
from wfsobs.observers.kalman.multirate import multirate_filter, multirate_noise
from wfsobs.observers.kalman.single import steady_filter
from wfsobs.priors_from.scenario import model_of, modelled_processes
from wfsobs.record import pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.signal.riccati import steady_state
from wfsobs.signal.statespace import paper_matrices
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

EXACT_STEPS = 3000
"""Steps compared with the textbook's loop in extended precision."""

PHI = np.array([0, 2])
"""Where phi_turb[k] and phi_vib[k] are in the paper's state."""


def kalman_record(sizes: Sizes, libraries: Collection[str]) -> Iterator[Row]:
    """Time the steady-state Kalman filter on LGS, one mode over a long record."""
    scenario = sizes.scenario(sizes.filter_duration)
    record = simulate(scenario)
    y, u, n = record.y_lgs[:, 0], record.u[:, 0], record.n_steps
    task, size = "kalman-record", f"{n} steps, 6 states"
    prior = model_of(scenario, 0)
    noise = prior.lgs_noise
    ours, _ = steady_filter(prior.disturbance(), noise)
    A, B, C, Q = paper_model(scenario, record.dt)
    steady = steady_state(A[:4, :4], C[:4], Q, np.array(noise**2))
    arguments = A, B, C, _with_mirror(steady.L[:, 0]), y, u
    exact = _extend(textbook.kalman_loop, *arguments)[:, PHI]

    seconds, values = measure_time(lambda: ours.run(pseudo_open_loop(y, u)[:, None, None])[:, :, 0], sizes.repeats)
    yield row(task, size, OURS, seconds, n, error=_error(values, exact))
    seconds, states = measure_time(lambda: textbook.kalman_loop(*arguments), sizes.repeats)
    yield row(task, size, "numpy-loop", seconds, n, error=_error(states[:, PHI], exact))
    if FILTERPY in libraries:
        seconds, states = measure_time(lambda: external.filterpy_kalman(*arguments), sizes.repeats)
        yield row(task, size, FILTERPY, seconds, n, error=_error(states[:, PHI], exact))
    if STATSMODELS in libraries:
        seconds, states = measure_time(
            lambda: external.statsmodels_kalman(A[:4, :4], C[:4], Q, noise**2, steady.P, pseudo_open_loop(y, u)), sizes.repeats
        )
        yield row(task, size, STATSMODELS, seconds, n, error=_error(states[:, PHI], exact))


def adaptive_record(sizes: Sizes, _libraries: Collection[str]) -> Iterator[Row]:
    """Time the adaptive Kalman filter, one mode over a long record: identification and filter of every window."""
    scenario = sizes.scenario(sizes.filter_duration)
    z, a = simulate(scenario).z[:, 0], scenario.adaptive
    seconds, _ = measure_time(lambda: adapt(z, scenario.dt, a, lambda _fraction: None), sizes.repeats)
    yield row("adaptive-record", f"{len(z)} steps, {a.window:g} s every {a.interval:g} s", OURS, seconds, len(z))


def multirate_record(sizes: Sizes, libraries: Collection[str]) -> Iterator[Row]:
    """Time the paper's multi-rate filter, one mode over a long record. statsmodels has no filter with given gains."""
    scenario = sizes.scenario(sizes.filter_duration)
    record = simulate(scenario)
    assert record.ratio is not None
    y, u, z_ngs, n = record.y_lgs[:, 0], record.u[:, 0], record.z_ngs[:, 0], record.n_steps
    task, size = "multirate-record", f"{n} steps, 6 states"
    prior = model_of(scenario, 0)
    lgs, ngs = multirate_noise(scenario.multirate, prior)
    ours = multirate_filter(prior.disturbance(), record.ratio, lgs, ngs)
    A, B, C, Q = paper_model(scenario, record.dt)
    C_ngs = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0])  # of z_ngs, from which the mirror's part has been taken
    L = steady_state(A[:4, :4], C[:4], Q, np.array(lgs**2)).L[:, 0]
    L_both = steady_state(A[:4, :4], np.vstack([C[:4], C[:4]]), Q, np.diag([lgs**2, ngs**2])).L
    arguments = A, B, C, C_ngs, _with_mirror(L), _with_mirror(L_both), y, z_ngs, u
    exact = _extend(textbook.multirate_loop, *arguments)[:, PHI]

    def run_ours() -> Array:
        return ours.run(np.column_stack([pseudo_open_loop(y, u), np.nan_to_num(z_ngs)]))

    seconds, values = measure_time(run_ours, sizes.repeats)
    yield row(task, size, OURS, seconds, n, error=_error(values, exact))
    seconds, states = measure_time(lambda: textbook.multirate_loop(*arguments), sizes.repeats)
    yield row(task, size, "numpy-loop", seconds, n, error=_error(states[:, PHI], exact))
    if FILTERPY in libraries:
        seconds, states = measure_time(lambda: external.filterpy_multirate(*arguments), sizes.repeats)
        yield row(task, size, FILTERPY, seconds, n, error=_error(states[:, PHI], exact))


def paper_model(scenario: Scenario, dt: float) -> tuple[Array, Array, Array, Array]:
    """Return A (6, 6), B (6,), C (6,) of the paper's state, and Q (4, 4) [um^2] of its disturbances."""
    turbulence, vibration = modelled_processes(scenario, 0, dt)
    drives = np.array([turbulence.drive_variance, 0.0, vibration.drive_variance, 0.0])
    return *paper_matrices(turbulence, vibration), np.diag(drives)


def _with_mirror(L: Array) -> Array:
    """Extend a gain (4, ...) of the disturbances to the paper's state, (6, ...), whose commands are known."""
    return np.concatenate([L, np.zeros((2, *L.shape[1:]))])


def _extend(loop: Callable[..., Array], *arguments: Array) -> Array:
    """Return the first steps of a loop in extended precision."""
    return loop(*(a.astype(np.longdouble)[:EXACT_STEPS] for a in arguments))


def _error(values: Array, exact: Array) -> float:
    """Largest over the targets, values (n_steps, n_targets)."""
    return max(max_error(values[: len(exact), i], exact[:, i]) for i in range(len(TARGETS)))
