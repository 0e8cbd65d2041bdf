"""The multi-rate filters against the textbook recursion on the paper's six states and a time-varying filter."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.records import kalman_model
from wfsobs.execution import run_observer
from wfsobs.observers.kalman.filters import UnstableCycle, multirate_filter, multirate_noise
from wfsobs.pipeline import run
from wfsobs.priors_from.scenario import model_of, modelled_processes
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import RiccatiError, steady_state
from wfsobs.signal.statespace import disturbance_model, paper_matrices
from wfsobs.simulation.loop import simulate


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = PRESETS["paper"]()
    base.update({"run": {"duration": 1.2, "warm_up": 0.2}, "gpr_offline": {"training_size": 2, "depth": 1}})
    return base.replace(changes or {})


def six_state_gain(A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Filter gain from the Riccati recursion, iterated until it stands still."""
    P = Q.copy()
    for _ in range(3_000):
        L = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
        P = A @ (P - L @ C @ P) @ A.T + Q
        P = 0.5 * (P + P.T)
    return P @ C.T @ np.linalg.inv(C @ P @ C.T + R)


def textbook(record: Record, s: Scenario, mode: int, lgs: float, ngs: float) -> np.ndarray:
    """Paper, eq. 10 to 12, with the filter gain in place of the printed predictor gain. What the mirror did during an
    NGS frame, mean of u[k-2] ... u[k-n-1], stands in for the u[k-2] that C puts there. Turbulence, (n_steps,)."""
    turbulence, vibration = modelled_processes(s, mode, record.dt)
    A, B, C = paper_matrices(turbulence, vibration)
    Q = np.diag([turbulence.drive_variance, 0, vibration.drive_variance, 0, 0, 0])
    C_both = np.array([C, C])
    L_lgs = six_state_gain(A, C[None], Q, np.array([[lgs**2]]))
    L_both = six_state_gain(A, C_both, Q, np.diag([lgs**2, ngs**2]))
    n, x, out = record.ratio, np.zeros(6), np.zeros(record.n_steps)
    assert n is not None and record.y_ngs is not None
    u = np.concatenate([np.zeros(n + 1), record.u[:, mode]])  # u[k] is u[k + n + 1] here
    for k in range(record.n_steps):
        if k % n == 0 and k > 0:
            frame = record.y_ngs[k, mode] - u[k : k + n].mean() + u[k + n - 1]
            x = x + L_both @ (np.array([record.y_lgs[k, mode], frame]) - C_both @ x)
        else:
            x = x + L_lgs[:, 0] * (record.y_lgs[k, mode] - C @ x)
        out[k] = x[0]
        x = A @ x + B * record.u[k, mode]
    return out


VARIANTS: list[dict[str, Any]] = [
    {},
    {"sensors.exposure_ratio": 2},
    {"sensors.exposure_ratio": 1},
    {"sensors.exposure_ratio": 8},
    {"multirate.measurement_noise": "manual", "multirate.lgs_noise": 0.03, "multirate.ngs_noise": 0.01},
]


@pytest.mark.slow
@pytest.mark.parametrize("changes", VARIANTS)
def test_every_step_is_the_textbook_recursion(changes: dict[str, Any]) -> None:
    s = scenario(changes)
    record = simulate(s)
    matched = (s.sensors.lgs_noise / np.sqrt(2), s.sensors.ngs_noise)
    noise = (0.03, 0.01) if "multirate.lgs_noise" in changes else matched
    assert multirate_noise(s.multirate, model_of(s, 0)) == pytest.approx(noise)
    got = run_observer("multirate", record, s)
    assert list(got) == ["turbulence"] and got["turbulence"].shape == record.y_lgs.shape
    for mode in range(2):
        wanted = textbook(record, s, mode, *noise)
        # both gains from iterations good to 1e-10
        assert np.abs(got["turbulence"][:, mode] - wanted).max() < 1e-8 * wanted.std()


def test_the_paper_weighs_ngs_over_lgs() -> None:
    lgs, ngs = multirate_noise(scenario().multirate, model_of(scenario(), 0))
    assert ngs < lgs


def paper_model(s: Scenario | None = None) -> Any:
    """The model of the paper's tables, as the filter builds it: turbulence 0.5 um, vibration 0.06 um."""
    return kalman_model(s or scenario(), 0, 1e-3)


def radius(lgs: float, ngs: float, ratio: int = 5) -> float:
    """Spectral radius of one cycle from gains made here."""
    model = paper_model()
    C = np.vstack([model.C, model.C])
    one = steady_state(model.A, model.C, model.Q, np.array(lgs**2)).L @ C[:1]
    both = steady_state(model.A, C, model.Q, np.diag([lgs**2, ngs**2])).L @ C
    cycle = np.eye(len(model.A))
    for L_C in [one] * (ratio - 1) + [both]:
        cycle = model.A @ (np.eye(len(model.A)) - L_C) @ cycle
    return float(np.abs(np.linalg.eigvals(cycle)).max())


def test_two_stable_gains_can_make_an_unstable_cycle() -> None:
    """40 nm and 1 nm: the cycle of five steps grows; it is refused, naming both numbers. 20 nm and 1 nm is fine."""
    assert radius(0.040, 0.001) > 1.0 > radius(0.020, 0.001)
    with pytest.raises(UnstableCycle) as caught:
        multirate_filter(paper_model(), 5, 0.040, 0.001)
    message = str(caught.value)
    assert "40 nm" in message and "1 nm" in message and "\n" not in message
    assert f"{radius(0.040, 0.001):.3g}" in message
    stable = multirate_filter(paper_model(), 5, 0.020, 0.001)
    found = np.abs(np.linalg.eigvals(stable.cycle_matrix())).max()
    assert found == pytest.approx(radius(0.020, 0.001), rel=1e-9)


def test_an_unstable_cycle_is_a_failure_of_that_observer_alone() -> None:
    s = scenario(
        {
            "multirate.measurement_noise": "manual",
            "multirate.lgs_noise": 0.04,
            "multirate.ngs_noise": 0.001,
        }
    )
    result = run(s, observers=["kf-lgs", "multirate"])
    assert [f.observer for f in result.failures] == ["multirate"] and "40 nm" in result.failures[0].reason
    assert {e.observer for e in result.estimates} == {"kf-lgs"}


# ---------------------------------------------------------------------- the optimal filter


def time_varying(record: Record, s: Scenario, mode: int, lgs: float, ngs: float, with_error: bool) -> np.ndarray:
    """The textbook filter with its covariance carried along, on a state that holds the last n + 2 values of each
    process: y_lgs[k] = phi[k-1] + slow error[k] + w, frames the mean of phi[k-1] ... phi[k-n]; (n_steps, 2)."""
    n = record.ratio
    assert n is not None
    processes = list(modelled_processes(s, mode, record.dt))
    size = n + 2
    A, Q = np.zeros((2 * size + 2, 2 * size + 2)), np.zeros((2 * size + 2, 2 * size + 2))
    lgs_row, ngs_row = np.zeros(2 * size + 2), np.zeros(2 * size + 2)
    for i, p in enumerate(processes):
        at = i * size
        A[at, at : at + 2] = p.a1, p.a2
        A[range(at + 1, at + size), range(at, at + size - 1)] = 1.0
        Q[at, at] = p.drive_variance
        lgs_row[at + 1] = 1.0
        ngs_row[at + 1 : at + n + 1] = 1.0 / n
    if with_error:
        t = s.turbulence
        corner = 0.6 * np.pi * 2 * t.wind_speed / s.telescope.diameter
        error = Ar2(corner, t.damping, s.sensors.lgs_low_frequency_rms / np.sqrt(s.sensors.lgs_count), record.dt)
        A[-2, -2:] = error.a1, error.a2
        A[-1, -2] = 1.0
        Q[-2, -2] = error.drive_variance
        lgs_row[-2] = 1.0
    P, x, out = np.zeros_like(Q), np.zeros(len(Q)), np.zeros((record.n_steps, 2))
    z, z_ngs = record.z[:, mode], record.z_ngs[:, mode]
    for k in range(record.n_steps):
        rows, values, r = [lgs_row], [z[k]], [lgs**2]
        if not np.isnan(z_ngs[k]):
            rows, values, r = [*rows, ngs_row], [*values, z_ngs[k]], [*r, ngs**2]
        C = np.array(rows)
        L = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag(r))
        x, P = x + L @ (values - C @ x), P - L @ C @ P
        out[k] = x[0], x[size]
        x, P = A @ x, A @ P @ A.T + Q
        P = 0.5 * (P + P.T)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("with_error", [True, False])
@pytest.mark.parametrize("ratio", [1, 2, 5])
def test_the_optimal_filter_is_the_time_varying_one_once_that_has_settled(ratio: int, with_error: bool) -> None:
    s = scenario(
        {
            "sensors.exposure_ratio": ratio,
            "multirate.model_lgs_error": with_error,
            "run.duration": 4.0,
            "kalman.damping": 0.1,
            "turbulence.wind_speed": 40.0,
        }
    )
    record = simulate(s)
    got = run_observer("multirate-optimal", record, s)
    wanted = time_varying(record, s, 0, *multirate_noise(s.multirate, model_of(s, 0)), with_error)
    for i, target in enumerate(("turbulence", "vibration")):
        # the start (covariance 0 instead of the steady one) is forgotten after 2.5 s of a loop with 20 ms memory and,
        # with the slow error, 0.1 s: exp(-25)
        difference = np.abs(got[target][2500:, 0] - wanted[2500:, i]).max()
        assert difference < 1e-6 * wanted[:, i].std()


def test_with_a_frame_at_every_step_both_multirate_filters_are_the_two_sensor_filter() -> None:
    s = scenario({"sensors.exposure_ratio": 1, "multirate.model_lgs_error": False})
    record = simulate(s)
    lgs, ngs = multirate_noise(s.multirate, model_of(s, 0))
    one, other = (run_observer(name, record, s)["turbulence"] for name in ("multirate", "multirate-optimal"))
    # step 0 has no frame; the two differ in the gain there, forgotten after 0.5 s
    assert np.abs(one - other)[500:].max() < 1e-8 * one.std()
    model = kalman_model(s, 0, record.dt)
    C = np.vstack([model.C, model.C])
    L = steady_state(model.A, C, model.Q, np.diag([lgs**2, ngs**2])).L
    x, z_ngs = np.zeros(4), np.nan_to_num(record.z_ngs[:, 0])
    for k in range(record.n_steps):
        gain = L if k > 0 else steady_state(model.A, model.C, model.Q, np.array(lgs**2)).L @ [[1.0, 0.0]]
        x = x + gain @ (np.array([record.z[k, 0], z_ngs[k]]) - C @ x)
        assert abs(one[k, 0] - model.outputs["turbulence"] @ x) < 1e-9
        x = model.A @ x


def test_the_optimal_filter_is_at_least_as_good_as_any_other_on_its_model() -> None:
    s = scenario(
        {
            "run.duration": 20.0,
            "run.warm_up": 1.0,
            "kalman.process_noise": "matched",
            "vibration.source": "ar2",
            "vibration.peaks": [{"rms": [0.03, 0.03]}],
        }
    )
    record = simulate(s)
    assert record.turbulence is not None
    errors = {
        name: np.std((run_observer(name, record, s)["turbulence"] - record.turbulence)[1000:])
        for name in ("multirate-optimal", "multirate", "kf-lgs", "kf-ngs")
    }
    assert min(errors, key=lambda name: errors[name]) == "multirate-optimal"


def test_no_noise_at_all_still_has_a_filter() -> None:
    s = scenario({"sensors.lgs_noise": 0.0, "sensors.ngs_noise": 0.0})
    record = simulate(s)
    got = run_observer("multirate", record, s)["turbulence"]
    assert np.isfinite(got).all()


def test_a_model_without_any_noise_is_refused() -> None:
    model = disturbance_model([Ar2(7.0, 0.9, 0.5, 1e-3)], [Ar2(300.0, 0.03, 0.02, 1e-3)])
    with pytest.raises(RiccatiError, match="noise"):
        multirate_filter(model, 5, 0.0, 0.01)


@pytest.mark.parametrize("n_steps", [1, 2, 4, 5, 6, 11])
def test_short_records(n_steps: int) -> None:
    s = scenario()
    record = simulate(s)
    assert record.y_ngs is not None
    short = Record(record.y_lgs[:n_steps], record.u[:n_steps], record.dt, record.y_ngs[:n_steps], record.ratio)
    for name in ("multirate", "multirate-optimal"):
        whole, part = run_observer(name, record, s), run_observer(name, short, s)
        for target, value in part.items():
            assert np.allclose(value, whole[target][:n_steps], rtol=1e-9, atol=1e-13)
