"""The optimal multi-rate filter: white innovations, the covariance it predicts, and its limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import chi2

from tests.records import kalman_model
from wfsobs.execution import run_observer
from wfsobs.observers.kalman.filters import optimal_cycle, optimal_filter, optimal_model
from wfsobs.prior import LgsError, Model, Prior
from wfsobs.priors_from.scenario import lgs_error_of, model_of, modelled_processes, prior_of
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import periodic_steady_state, steady_state
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import disturbance_model, process_model
from wfsobs.simulation.loop import simulate

DT = 1e-3
TURBULENCE = Ar2(7.0686, 0.9, 0.5, DT)
VIBRATION = Ar2(2 * np.pi * 47.4969, 0.03, 0.015, DT)
MODEL = disturbance_model([TURBULENCE], [VIBRATION])
OUTPUTS = MODEL.output_rows(["turbulence", "vibration"])

PARTS = (Model, LgsError)


def padded(rows, cycle):
    return np.hstack([rows, np.zeros((len(rows), len(cycle[0][0]) - rows.shape[1]))])


def simulated(cycle, processes, n_cycles, rng):
    """The cycle's own model, run for many cycles; processes: turbulence, vibration and, if modelled, the LGS error.

    Returns states (n, n_states) and measurements (n, 2) for steps k = 1, 2, ...
    """
    ratio, size = len(cycle), len(cycle[0][0])
    n = ratio * n_cycles
    noise = np.sqrt(np.diag(cycle[0][3]))
    x = np.zeros((n, size))
    disturbance = np.zeros(n + 1)
    for i, p in enumerate(processes):
        drive = np.sqrt(p.drive_variance) * rng.standard_normal(n + 20_000)
        phi = lfilter([1.0], [1.0, -p.a1, -p.a2], drive)[-n - 1 :]
        rows = process_model(p)  # how the state gives phi[k] and phi[k-1]
        x[:, 2 * i : 2 * i + 2] = np.linalg.solve([rows.now, rows.before], [phi[1:], phi[:-1]]).T
        disturbance += phi if i < 2 else 0.0
    total = np.cumsum(np.concatenate([[0.0], disturbance[1:-1]])) / ratio  # the frame starts at k = 0, unseen here
    read = np.arange(1, n + 1) % ratio == 0
    at_last_read = np.concatenate([[0.0], total[read]])[np.cumsum(read) - read]
    x[:, size - 1] = total - at_last_read
    C = np.array([step[1] for step in cycle])[np.arange(n) % ratio]
    return x, np.einsum("kij,kj->ki", C, x) + noise * rng.standard_normal((n, 2))


def run_cycle(cycle, z, outputs):
    """(estimates, innovations over their predicted std) of the filter of a cycle on measurements from k = 1 on."""
    filters, states = optimal_filter(cycle, outputs)
    n = len(z)
    estimates = PeriodicFilter(filters.steps).run(z)
    # Innovations need the predicted state: the same filter with the identity as output, one step back.
    everything = np.eye(len(cycle[0][0]))
    whole = PeriodicFilter(optimal_filter(cycle, everything)[0].steps).run(z)
    phase = np.arange(n) % len(cycle)
    A = np.array([step[0] for step in cycle])
    predicted = np.vstack([np.zeros(whole.shape[1]), np.einsum("kij,kj->ki", A[phase], whole)[:-1]])
    C = np.array([step[1] for step in cycle])[phase]
    S = np.array([step[1] @ s.P @ step[1].T + step[3] for step, s in zip(cycle, states, strict=True)])[phase]
    return estimates, z - np.einsum("kij,kj->ki", C, predicted), S, states


@pytest.mark.slow
@pytest.mark.parametrize("with_error", [False, True])
def test_innovations_are_white_and_errors_as_predicted(with_error):
    """Ljung-Box over 20 lags at 1 % on 1e6 steps; covariances against Monte Carlo within 3 standard errors."""
    error = Ar2(7.0686, 0.9, 0.05, DT) if with_error else None
    cycle = optimal_cycle(MODEL, 5, 0.014, 0.01, [error] if error else [])
    processes = [TURBULENCE, VIBRATION, *([error] if error else [])]
    x, z = simulated(cycle, processes, 200_000, np.random.default_rng(11))
    outputs = padded(OUTPUTS, cycle)
    estimates, innovations, S, states = run_cycle(cycle, z, outputs)
    settled = slice(20_000, None)
    white = (innovations[:, 0] / np.sqrt(S[:, 0, 0]))[settled]
    n, lags = white.size, 20
    r = np.array([white[j:] @ white[: n - j] for j in range(1, lags + 1)]) / (white @ white)
    ljung_box = n * (n + 2) * np.sum(r**2 / (n - np.arange(1, lags + 1)))
    # Two-sided at 1 %: neither correlated nor suspiciously flat.
    assert chi2.ppf(0.005, lags) < ljung_box < chi2.ppf(0.995, lags)
    errors = (estimates - x @ outputs.T)[settled]
    for phase, state in enumerate(states):
        expected = np.diag(outputs @ state.posterior @ outputs.T)
        squares = errors[(np.arange(settled.start, len(x)) % 5) == phase] ** 2
        # Errors are correlated over tens of steps: the standard error from means of long batches.
        batches = np.array([b.mean(axis=0) for b in np.array_split(squares, 100)])
        standard_error = batches.std(axis=0, ddof=1) / 10
        assert (np.abs(squares.mean(axis=0) - expected) < 3 * standard_error).all()
        assert (standard_error < 0.02 * expected).all()


def test_with_ratio_one_it_is_the_filter_of_two_sensors():
    cycle = optimal_cycle(MODEL, 1, 0.02, 0.01)
    (state,) = periodic_steady_state(cycle)
    C = np.vstack([MODEL.C, MODEL.C])
    both = steady_state(MODEL.A, C, MODEL.Q, np.diag([0.02**2, 0.01**2]))
    # The frame state equals phi_dist[k-1], so the covariance of the rest is the two-sensor one; rounding only.
    np.testing.assert_allclose(OUTPUTS @ state.posterior[:4, :4] @ OUTPUTS.T, OUTPUTS @ both.posterior @ OUTPUTS.T, rtol=1e-9)
    z = np.random.default_rng(3).standard_normal((500, 2))
    got = optimal_filter(cycle, padded(OUTPUTS, cycle))[0].run(z)
    x, expected = np.zeros(4), []
    for k, measured in enumerate(z):
        gain = both.L if k else steady_state(MODEL.A, MODEL.C, MODEL.Q, np.array(0.02**2)).L
        rows = C if k else C[:1]
        x = x + gain @ (measured[: len(rows)] - rows @ x)
        expected.append(OUTPUTS @ x)
        x = MODEL.A @ x
    # Step 0 has no frame and another gain in the filter under test; from a few hundred steps on nothing is left of it.
    np.testing.assert_allclose(got[300:], np.array(expected)[300:], atol=1e-9)


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    ratio=st.integers(1, 20),
    lgs=st.floats(-4, 0),
    ngs=st.floats(-4, 0),
    wind=st.floats(1, 60),
    rms=st.floats(-3, 0),
    error=st.one_of(st.none(), st.floats(-3, -0.5)),
    frequency=st.floats(5, 200),
    damping=st.floats(-3, -0.5),
)
def test_never_worse_than_the_better_single_sensor_filter(ratio, lgs, ngs, wind, rms, error, frequency, damping):
    """In the covariance it predicts for its own model, mean over the cycle, for both targets."""
    model = disturbance_model(
        [Ar2(0.6 * np.pi * 2 * wind / 8, 0.9, 0.5, DT)], [Ar2(2 * np.pi * frequency, 10**damping, 10**rms, DT)]
    )
    slow = None if error is None else Ar2(0.6 * np.pi * 2 * wind / 8, 0.9, 10**error, DT)
    cycle = optimal_cycle(model, ratio, 10**lgs, 10**ngs, [slow] if slow else [])
    rows = padded(OUTPUTS, cycle)

    def mean_error(rows_kept):
        steps = [(A, C * rows_kept[:, None], Q, R) for A, C, Q, R in cycle]
        return np.mean([np.diag(rows @ s.posterior @ rows.T) for s in periodic_steady_state(steps)], axis=0)

    both, lgs_only, ngs_only = (mean_error(np.array(keep)) for keep in ([1.0, 1.0], [1.0, 0.0], [0.0, 1.0]))
    # 1e-7: the Riccati residual times the condition of a slow process' state.
    assert (both <= np.minimum(lgs_only, ngs_only) * (1 + 1e-7)).all()


def test_over_a_record_it_matches_its_textbook_recursion():
    scenario = paper().replace({"run.duration": 1.5})
    record = simulate(scenario)
    got = run_observer("multirate-optimal", record, scenario)
    for mode in range(2):
        found = optimal_model(scenario.multirate, prior_of(scenario, record, PARTS), mode, 5)
        cycle, rows = found.steps, found.filter().rows(("turbulence", "vibration"))
        states = periodic_steady_state(cycle)
        x, expected = np.zeros(len(cycle[0][0])), []
        for k in range(record.n_steps):
            A, C, _, R = cycle[(k - 1) % 5]
            P, measured = states[(k - 1) % 5].P, np.array([record.z[k, mode], record.z_ngs[k, mode]])
            if np.isnan(measured[1]):
                C, R, measured = C[:1], R[:1, :1], measured[:1]
            x = x + P @ C.T @ np.linalg.solve(C @ P @ C.T + R, measured - C @ x)
            expected.append(rows @ x)
            x = A @ x
        for i, target in enumerate(("turbulence", "vibration")):
            # Same arithmetic in another order; signals of order 1.
            np.testing.assert_allclose(got[target][:, mode], np.array(expected)[:, i], atol=1e-11)


def test_the_error_state_is_what_makes_it_useful_with_a_slow_lgs_error():
    """Without the state it trusts the LGS: the realised error is several times the predicted one, and worse than with it."""
    base = Scenario().replace({"vibration.source": "ar2", "run.duration": 60.0, "sensors.lgs_low_frequency_rms": 0.05})
    realised, predicted = {}, {}
    for known in (True, False):
        scenario = base.replace({"multirate.model_lgs_error": known})
        record = simulate(scenario)
        error = (run_observer("multirate-optimal", record, scenario)["turbulence"] - record.turbulence)[1000:]
        realised[known] = np.sqrt(np.mean(error**2))
        found = optimal_model(scenario.multirate, prior_of(scenario, record, PARTS), 0, 5)
        cycle, rows = found.steps, found.filter().rows(("turbulence", "vibration"))
        predicted[known] = np.sqrt(np.mean([(rows @ s.posterior @ rows.T)[0, 0] for s in periodic_steady_state(cycle)]))
    # A minute of a process with a correlation time of 0.1 s: the rms is good to about 5 %.
    assert realised[True] == pytest.approx(predicted[True], rel=0.1)
    assert realised[False] > 2 * predicted[False]
    assert realised[False] > 1.3 * realised[True]


def test_the_model_is_the_scenarios():
    scenario = paper()
    cycle, *_ = optimal_model(scenario.multirate, Prior((model_of(scenario, 0),), (lgs_error_of(scenario, 0),)), 0, 5)
    turbulence, vibration = modelled_processes(scenario, 0, 1e-3)
    assert len(cycle) == 5
    A, C, Q, R = cycle[4]
    np.testing.assert_array_equal(A[:4, :4], kalman_model(scenario, 0, 1e-3).A)
    assert (C[1] == np.eye(7)[6]).all()
    assert [float(step[1][1, 6]) for step in cycle] == [0, 0, 0, 0, 1]
    np.testing.assert_array_equal(Q[:2, :2], process_model(turbulence).Q)
    np.testing.assert_array_equal(Q[2:4, 2:4], process_model(vibration).Q)
    # mean of two LGS of 20 nm, NGS of 10 nm
    np.testing.assert_allclose(np.sqrt(np.diag(R)), [0.02 / np.sqrt(2), 0.01], rtol=1e-12)
