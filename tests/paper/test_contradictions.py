"""Where the printed paper contradicts itself: each reading that is built, and what the other one would give.

"Printed" below is the paper's formula to the letter, evaluated in the test.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.records import kalman_model
from wfsobs.execution import run_observer
from wfsobs.observers.kalman.filters import multirate_noise, steady_filter
from wfsobs.priors_from.scenario import model_of, modelled_processes
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import steady_state
from wfsobs.signal.spectrum import bandpass_bank, filter_causal, random_phase_signal
from wfsobs.signal.statespace import paper_matrices
from wfsobs.simulation.loop import simulate

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", name="case")
def _case() -> tuple[Scenario, Record]:
    """The paper's parameters where the truth is the filters' model: a fault is not hidden under other errors."""
    s = paper()
    s.update(
        {
            "run": {"duration": 12.0},
            "gpr_offline": {"training_size": 2, "depth": 1},
            "vibration": {"source": "ar2", "peaks": [{"rms": [0.06, 0.06]}]},
            "sensors": {"lgs_low_frequency_rms": 0.0},
        }
    )
    return s, simulate(s)


def peak_hz(p: Ar2) -> float:
    f = np.linspace(1.0, 100.0, 99_001)
    return float(f[np.argmax(p.psd(f))])


def test_natural_frequency_needs_two_pi() -> None:
    """Table 2 gives w_f = 47.4969 Hz and eq. 2 takes it in rad/s. Without 2 pi the line would be at 7.6 Hz."""
    built = modelled_processes(paper(), 0, 1e-3)[1]
    # a damped line peaks at f sqrt(1 - 2 xi^2), 0.1 % below f
    assert peak_hz(built) == pytest.approx(47.4969, rel=2e-3)
    printed = Ar2(47.4969, 0.03, 1.0, 1e-3)
    assert peak_hz(printed) == pytest.approx(47.4969 / (2 * np.pi), rel=2e-3)


def test_d_and_xi_f_are_one_damping() -> None:
    """Eq. 2 has d in the exponents and xi_f under the root, Table 2 xi_f alone; only one number makes the poles those of
    a mass on a spring, w (-xi +- i sqrt(1 - xi^2))."""
    p = modelled_processes(paper(), 0, 1e-3)[1]
    pole = np.exp(p.omega * p.dt * complex(-0.03, np.sqrt(1 - 0.03**2)))
    assert np.allclose(np.roots([1.0, -p.a1, -p.a2]), [pole, pole.conjugate()], rtol=1e-12)


def test_exposures_are_those_of_the_text() -> None:
    """Table 3 swaps them, 1 ms for 200 Hz; text and Tables 1 and 2 have 5 ms for the NGS and 1 ms for the LGS."""
    s = paper()
    assert s.sensors.exposure_ratio / s.sensors.lgs_rate == 5e-3 and s.dt == 1e-3
    assert s.sensors.lgs_rate / s.sensors.exposure_ratio == 200.0


def test_printed_input_matrix_makes_the_filter_worse(case: tuple[Scenario, Record]) -> None:
    """B_u = (0, 1) puts u[k-1] where sensor and mirror have u[k-2] (eq. 3 to 5): the filter takes the wrong command off."""
    s, record = case
    turbulence, vibration = modelled_processes(s, 0, record.dt)
    A, B, C = paper_matrices(turbulence, vibration)
    model = kalman_model(s, 0, record.dt)
    L = np.append(model.pairs @ steady_filter(model, 0.02 / np.sqrt(2))[1].L[:, 0], [0.0, 0.0])
    errors = []
    for B_u in (B, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])):
        x, out = np.zeros(6), np.zeros(record.n_steps)
        for k in range(record.n_steps):
            x = x + L * (record.y_lgs[k, 0] - C @ x)
            out[k] = x[0]
            x = A @ x + B_u * record.u[k, 0]
        assert record.turbulence is not None
        errors.append(np.std((out - record.turbulence[:, 0])[1000:]))
    built = np.std((run_observer("kf-lgs", record, s)["turbulence"] - record.turbulence)[1000:, 0])
    assert errors[0] == pytest.approx(built, rel=1e-6)
    assert errors[1] > 1.02 * errors[0]


def test_the_predictor_form_is_one_step_behind(case: tuple[Scenario, Record]) -> None:
    """Eq. 9 estimates step k from y up to k - 1, the GPR from y[k]: built is the form with y[k]. One prediction, A x_hat[k]
    + B u[k], takes it to the printed one."""
    s, record = case
    turbulence, vibration = modelled_processes(s, 0, record.dt)
    A, B, C = paper_matrices(turbulence, vibration)
    model = kalman_model(s, 0, record.dt)
    steady = steady_filter(model, 0.02 / np.sqrt(2))[1]
    K = A @ np.append(model.pairs @ steady.L[:, 0], [0.0, 0.0])
    x, printed = np.zeros(6), np.zeros((record.n_steps + 1, 2))
    for k in range(record.n_steps):
        x = A @ x + B * record.u[k, 0] + K * (record.y_lgs[k, 0] - C @ x)
        printed[k + 1] = x[0], x[2]
    filtered = steady_filter(model, 0.02 / np.sqrt(2), model.pairs)[0]
    states = filtered.run(record.z[:, [0]])
    assert np.abs(states @ A[:4, :4].T[:, [0, 2]] - printed[1:]).max() < 1e-10
    assert np.trace(steady.posterior) < np.trace(steady.P)


def test_a_predicted_state_is_corrected_with_the_filter_gain(case: tuple[Scenario, Record]) -> None:
    """Eq. 11 corrects x_pred[k+1] with the K of eq. 8c, A L, which predicts once more. Same gains, L in place of K, are
    what is built; with K the error of turbulence grows."""
    s, record = case
    model = kalman_model(s, 0, record.dt)
    lgs, ngs = multirate_noise(s.multirate, model_of(s, 0))
    C = np.vstack([model.C, model.C])
    one = steady_state(model.A, model.C, model.Q, np.array(lgs**2))
    both = steady_state(model.A, C, model.Q, np.diag([lgs**2, ngs**2]))
    z, z_ngs = record.z[:, 0], record.z_ngs[:, 0]
    assert record.turbulence is not None

    def run(gain_one: np.ndarray, gain_both: np.ndarray) -> np.ndarray:
        x, out = np.zeros(4), np.zeros(record.n_steps)
        for k in range(record.n_steps):
            if np.isnan(z_ngs[k]):
                x = x + gain_one[:, 0] * (z[k] - model.C @ x)
            else:
                x = x + gain_both @ (np.array([z[k], z_ngs[k]]) - C @ x)
            out[k] = model.outputs["turbulence"] @ x
            x = model.A @ x
        return out

    built = run(one.L, both.L)
    assert np.abs(built - run_observer("multirate", record, s)["turbulence"][:, 0]).max() < 1e-9
    printed = run(one.K, both.K)
    errors = [np.std((out - record.turbulence[:, 0])[1000:]) for out in (built, printed)]
    assert errors[1] > 1.01 * errors[0]


def test_ngs_weighs_more_than_lgs() -> None:
    """r_NGS < r_LGS (section 2.2.1)."""
    lgs, ngs = multirate_noise(paper().multirate, model_of(paper(), 0))
    assert ngs < lgs


def printed_idft(S: np.ndarray, rng: np.random.Generator, imaginary_unit: bool) -> np.ndarray:
    """Algorithm 4: X = S exp(phase), mirrored, inverse DFT, times len(X) / 2."""
    phase = np.concatenate([[0.0], 2 * np.pi * rng.random(S.size - 2), [0.0]])
    X = S * np.exp(1j * phase if imaginary_unit else phase)
    X = np.concatenate([X, X[:0:-1].conj()])
    return np.fft.ifft(X).real * X.size / 2


def test_inverse_dft_needs_the_imaginary_unit_and_the_root() -> None:
    """The variance of the signal is the integral of S. Printed without the imaginary unit its amplitudes grow up to
    exp(2 pi) fold and every phase is zero; with it, S itself as amplitude, the variance is sum S^2 / 2, of another unit."""
    n, df = 20_000, 0.05
    f = np.arange(n // 2 + 1) * df
    S = 1e-5 / (1 + ((f - 47.5) / 1.4) ** 2) * ((f > 0) & (f <= 80))
    variance = S.sum() * df
    built = random_phase_signal(S * df, n, np.random.default_rng(0))
    assert built.var() == pytest.approx(variance, rel=1e-9)
    with_unit = printed_idft(S, np.random.default_rng(0), True)
    # n + 1 points once mirrored: 1e-4
    assert with_unit.var() == pytest.approx(np.sum(S**2) / 2, rel=2e-3)
    assert not 0.5 < with_unit.var() / variance < 2.0
    without = printed_idft(S, np.random.default_rng(0), False)
    # all cosines with phase zero: a pulse at the start, the largest sample many times the rms; a random signal has 4 to 5
    assert without[0] == np.abs(without).max() and without[0] > 10 * without.std()
    assert np.abs(built).max() < 6 * built.std()


@pytest.mark.parametrize(("d", "m"), [(170, 511), (2, 3)])
def test_window_indices_of_the_online_gpr(d: int, m: int) -> None:
    """Algorithm 3 prints x[k-i+d+1 : k-i], of length -d; x[k-i-d+1 : k-i] has d samples and ends i steps back."""
    k, i = d + m, m
    assert (k - i) - (k - i + d + 1) + 1 == -d
    assert (k - i) - (k - i - d + 1) + 1 == d
    assert k - i - d + 1 == 1  # with the first step counted as 1, the loop of Algorithm 3 starts where the record does


def test_targets_of_the_offline_gpr_are_as_many_as_windows() -> None:
    """Algorithm 1 makes windows for k = d ... m + d - 1, that is m; Algorithm 2 multiplies targets d ... m + d, one more."""
    m, d = 1000, 407
    assert len(range(d, m + d)) == m and len(range(d, m + d + 1)) == m + 1


def test_the_band_at_47_7_hz_holds_the_peak_at_47_4969() -> None:
    b = paper().butterworth
    assert 47.7 in b.frequencies and 47.4969 not in b.frequencies
    for bandwidth in (b.bandwidth_offline, b.bandwidth_online):
        assert abs(47.7 - 47.4969) < bandwidth / 2


def test_the_mirror_is_taken_off_with_its_delay() -> None:
    """Section 2.3 writes phi_dist = y_CL - u; eq. 3 to 5 make that y[k] - u[k-2]. With the printed one, noise of two more
    steps of commands passes the bands: a larger error of the causal reference."""
    s = paper().replace({"run.duration": 12.0})
    record = simulate(s)
    quiet = replace(record, y_lgs=record.y_lgs - record.z + np.vstack([np.zeros((1, 2)), _phi(record)[:-1]]))
    assert np.abs(quiet.z[1:] - _phi(record)[:-1]).max() < 1e-12
    assert np.abs((quiet.y_lgs - quiet.u)[1:] - _phi(record)[:-1]).max() > 0.01
    b = s.butterworth
    bank = bandpass_bank(b.frequencies, b.bandwidth_online, b.order, record.dt)
    assert record.vibration is not None
    built, printed = (np.std((filter_causal(bank, x) - record.vibration)[1000:, 0]) for x in (record.z, record.y_lgs - record.u))
    assert printed > 1.03 * built


def _phi(record: Record) -> np.ndarray:
    assert record.turbulence is not None and record.vibration is not None
    return record.turbulence + record.vibration


def test_autoregressive_turbulence_is_eq_1_to_the_letter() -> None:
    """phi[k+1] = a1 phi[k] + a2 phi[k-1] + v[k] with the printed a1 and a2, here driven by a known v."""
    p = modelled_processes(paper(), 0, 1e-3)[0]
    v = np.random.default_rng(0).standard_normal(100)
    phi = np.zeros(102)
    for k in range(100):
        phi[k + 2] = p.a1 * phi[k + 1] + p.a2 * phi[k] + v[k]
    assert np.allclose(lfilter([1.0], [1.0, -p.a1, -p.a2], v), phi[2:], rtol=1e-12, atol=1e-12)
    A = p.transition
    assert np.allclose(A @ phi[50:48:-1] + [v[49], 0.0], phi[51:49:-1], rtol=1e-12)
