"""What an identification writes is settings that load and run, and that predict as what was found does."""

from __future__ import annotations

from math import pi
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from wfsobs.cli import main
from wfsobs.closed_loop.design import design
from wfsobs.evaluation.bound import bound_rms
from wfsobs.identification import Identification, identify
from wfsobs.identification.identification import identification_toml
from wfsobs.identification.process import IdentifiedProcess, Number, merge_peaks
from wfsobs.observers import OBSERVERS
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.pipeline import observe, run
from wfsobs.prior import Lines
from wfsobs.priors_from.scenario import lines_of, modelled_peak, observer_settings, prior_of
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.statespace import sample_ar3
from wfsobs.simulation.disturbance import turbulence_rms
from wfsobs.telemetry.records import save_record
from wfsobs.typing import Array

pytestmark = pytest.mark.slow

DT = 1e-3
QUICK = ("kf-lgs", "kf-multi", "butterworth-cl")


def drawn(processes: list[Ar2 | Ar3], noise: float, n: int, rng: np.random.Generator) -> Array:
    parts = [sample_ar3(p, n, rng) if isinstance(p, Ar3) else p.sample(n, rng) for p in processes]
    return np.sum(parts, axis=0) + noise * rng.standard_normal(n)


def recorded(*columns: Array, dt: float = DT) -> Record:
    y = np.column_stack(columns)
    return Record(y, np.zeros_like(y), dt)


def hump_and_line(seed: int, n: int = 40_000) -> Record:
    """A hump on tip, a line at the same frequency and turbulence of another corner and noise on tilt, coloured noise besides."""
    rng = np.random.default_rng(seed)
    tip: list[Ar2 | Ar3] = [Ar2(7.0, 0.9, 0.5, DT), Ar2(2 * pi * 30.0, 0.091, 0.05, DT)]
    tilt: list[Ar2 | Ar3] = [
        Ar3(3.0, 0.9, 12.0, 0.3, DT),
        Ar2(2 * pi * 30.0, 0.0011, 0.05, DT),
        Ar2(2 * pi * 120.0, 0.8, 0.01, DT),
    ]
    return recorded(drawn(tip, 0.014, n, rng), drawn(tilt, 0.02, n, rng))


@pytest.fixture(scope="module")
def found() -> Identification:
    return identify(hump_and_line(1))


@pytest.fixture(scope="module")
def saved(found: Identification) -> Scenario:
    base = PRESETS["paper"]()
    return configfile.from_toml(identification_toml(found, found.scenario(base)))


def numbers(p: Lines) -> list[float]:
    """All of a model, processes in their order."""
    smooth = [x for q in p.turbulence for x in (q.omega, q.damping, q.rms, q.corner if isinstance(q, Ar3) else 0.0)]
    return [p.noise, *smooth, *(x for line in p.lines for x in line)]


def test_the_file_tells_the_filters_what_was_found(found: Identification, saved: Scenario) -> None:
    for i, mode in enumerate(found.modes):
        # A product and a quotient each: a few units in the last place.
        assert numbers(lines_of(saved, i, DT)) == pytest.approx(numbers(mode.prior), rel=1e-14)
    assert [len(m.prior.turbulence) for m in found.modes] == [1, 2]  # the second has a background


def poles(p: Ar2 | Ar3) -> Array:
    """Of the sampled process: of two poles, and of a third where there is one."""
    root = np.sqrt(complex(1.0 - p.damping**2))
    two = [np.exp((-p.damping + sign * 1j * root) * p.omega * p.dt) for sign in (1.0, -1.0)]
    return np.array([*two, np.exp(-p.corner * p.dt)] if isinstance(p, Ar3) else two)


@pytest.mark.parametrize("name", ["kf-multi", "gp-lgs", "lqg-kf-multi", "lqg-multirate-multi"])
def test_filters_of_the_file_keep_the_background(found: Identification, saved: Scenario, name: str) -> None:
    """The poles of all that the identification found on tilt, its coloured background too, are those of the filter's model. To
    1e-6: near a double pole, as of turbulence of damping 0.9, rounding is rooted."""
    kept = found.modes[1].prior.turbulence
    assert len(kept) == 2 and kept[1].omega > 20.0 * kept[0].omega
    if name.startswith("lqg"):
        law = design(saved, [name]).laws[name][1].law
        assert law is not None and law.filter is not None
        model = law.filter.model
    else:
        prior, sampling = prior_of(saved, None, OBSERVERS[name].prior), Sampling(2, DT)
        model = OBSERVERS[name].step(prior, observer_settings(OBSERVERS[name], saved), sampling, 0.0).modes[1].model
    has = np.linalg.eigvals(model.A)
    for process in kept:
        for pole in poles(process):
            assert np.abs(has - pole).min() < 1e-6


def test_the_file_predicts_a_new_record_as_what_was_found_does(found: Identification, saved: Scenario) -> None:
    test = hump_and_line(2, 10_000)
    result = observe(test, saved, observers=["kf-multi"], gate=False)
    for i, mode in enumerate(found.modes):
        model = mode.prior.disturbance(saved.multipeak.line_width)
        kalman, _ = steady_filter(model, mode.prior.noise, np.sum(list(model.outputs.values()), axis=0)[None])
        expected = kalman.run(test.z[:, [i]])[:, 0]
        values = sum(e.values[:, i] for e in result.estimates)
        assert np.max(np.abs(values - expected)) < 1e-10 * np.std(expected)  # rounding through the Riccati equation


def test_a_filter_of_one_peak_has_that_of_its_mode(found: Identification, saved: Scenario) -> None:
    for i, mode in enumerate(found.modes):
        strongest = max(mode.peaks, key=lambda p: p.rms.value)
        assert modelled_peak(saved, i) == (strongest.frequency.value, strongest.damping.value)
    assert modelled_peak(saved, 0)[1] > 30.0 * modelled_peak(saved, 1)[1]
    by_hand = saved.replace({"kalman.peak": "manual", "kalman.frequency": 12.0, "kalman.damping": 0.2})
    assert modelled_peak(by_hand, 0) == modelled_peak(by_hand, 1) == (12.0, 0.2)


def test_every_mode_has_its_own_in_a_simulation_and_in_the_bound(found: Identification, saved: Scenario) -> None:
    """A record made from the file is like the one that was identified, and no filter of its own model beats the bound."""
    assert [turbulence_rms(saved, i) for i in (0, 1)] == pytest.approx(
        [np.sqrt(sum(p.rms**2 for p in m.prior.turbulence)) for m in found.modes], rel=1e-12
    )
    assert saved.sensors.lgs_noise_per_mode == pytest.approx([np.sqrt(2.0) * m.noise.value for m in found.modes], rel=1e-12)
    for i, mode in enumerate(found.modes):
        model = mode.prior.disturbance(saved.multipeak.line_width)
        row = np.sum(list(model.outputs.values()), axis=0)
        _, steady = steady_filter(model, mode.prior.noise)
        own = np.sqrt(row @ (steady.P - steady.L @ model.C[None] @ steady.P) @ row)
        made = saved.replace({"vibration.source": "ar2"})
        assert own == pytest.approx(bound_rms(made, i)["total"], rel=2e-3)  # the same model on a grid of frequencies


@pytest.mark.parametrize("name", ["lqg-kf-multi", "lqg-kf-lgs"])
def test_a_controller_takes_the_model_of_its_mode(saved: Scenario, name: str) -> None:
    """Tip as if it were alone, and not as tilt."""
    z = np.random.default_rng(3).standard_normal((200, 1))
    tip, tilt = (one.law.run(z) for one in design(saved, (name,)).laws[name] if one.law is not None)
    assert np.std(tip - tilt) > 0.1 * np.std(tip)


def peak(f: float, xi: float, std: float = 0.01, xi_std: float | None = None) -> IdentifiedProcess:
    return IdentifiedProcess(Number(f, std), Number(xi, 0.1 * xi if xi_std is None else xi_std), Number(0.01, 0.001))


@pytest.mark.parametrize(
    ("tip", "tilt", "one"),
    [
        (peak(30.0, 0.02), peak(30.02, 0.022), True),
        (peak(30.0, 0.02), peak(30.2, 0.02), False),  # ten standard deviations apart
        (peak(30.0, 0.091), peak(30.0, 0.0011), False),  # of another width
        (peak(30.0, 0.0), peak(30.0, 0.002), False),  # of another kind
        (peak(30.0, 0.0), peak(30.01, 0.0), True),
        (peak(300.0, 0.3, 200.0), peak(30.0, 0.3), False),  # could be anywhere
        (peak(30.0, 0.3), peak(300.0, 0.3, 200.0), False),
        (peak(30.0, 0.02, 0.01, 0.05), peak(30.0, 0.02), False),  # could be of any width
    ],
)
def test_peaks_that_agree_are_merged(tip: IdentifiedProcess, tilt: IdentifiedProcess, one: bool) -> None:
    assert len(merge_peaks([(tip,), (tilt,)])) == (1 if one else 2)


Modes = list[list[tuple[float, float, float]]]
RATES = st.sampled_from([100.0, 137.5, 250.0, 500.0, 1000.0, 2000.0, 5000.0])
PLACES = st.floats(0.03, 1.1)  # of half the rate
WIDTH = st.sampled_from([0.0, 1e-3, 0.02, 0.1, 0.4])
PEAKS = st.lists(st.tuples(PLACES, WIDTH, st.floats(0.1, 30.0)), max_size=3)


def made(rate: float, modes: Modes, scale: float, turbulent: bool, seed: int) -> Record:
    """Noise of rms `scale` [um], turbulence with a corner of a thousandth of the rate, and peaks (frequency over half the rate,
    damping, rms over that of the noise)."""
    n, dt, rng = 2000, 1.0 / rate, np.random.default_rng(seed)
    columns = []
    for peaks in modes:
        z = rng.standard_normal(n)
        if turbulent:
            z += Ar2(2e-3 * pi * rate, 0.9, 30.0, dt).sample(n, rng)
        for place, damping, rms in peaks:
            z += Ar2(pi * place * rate, max(damping, 1e-5), rms, dt).sample(n, rng)
        columns.append(scale * z)
    return recorded(*columns, dt=dt)


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(
    rate=RATES,
    modes=st.lists(PEAKS, min_size=1, max_size=2),
    scale=st.sampled_from([1e-3, 0.02, 50.0]),
    turbulent=st.booleans(),
    seed=st.integers(0, 2**16),
    name=st.sampled_from(["paper", "ut4", "peak-jump"]),
)
@example(rate=1000.0, modes=[[(0.97, 0.4, 30.0)]], scale=0.02, turbulent=True, seed=1, name="paper")  # a hump near half the rate
@example(rate=100.0, modes=[[], []], scale=0.02, turbulent=True, seed=1, name="paper")  # bands beyond half the rate
@example(  # a line whose image beyond half the rate is as near
    rate=100.0, modes=[[(1.0006520763472604, 0.0, 0.5016705845531291)],
                       [(0.75, 0.1, 1.0), (1.0006520763472604, 0.0, 22.23014577716402), (0.75, 0.1, 1.0)]],
    scale=0.001, turbulent=False, seed=65536, name="paper",
)  # fmt: skip
@example(  # a broad process that is found beyond half the rate
    rate=137.5, modes=[[(1.095703125, 0.4, 14.125), (0.75, 0.0, 1.0), (0.7234266661676317, 0.02, 11.5)]],
    scale=0.02, turbulent=False, seed=23910, name="paper",
)  # fmt: skip
@example(rate=25.0, modes=[[], []], scale=0.02, turbulent=True, seed=1, name="paper")  # all of them
def test_whatever_is_written_loads_and_runs(
    tmp_path: Path, rate: float, modes: Modes, scale: float, turbulent: bool, seed: int, name: str
) -> None:
    """On a simulation and on the record that it is from, from presets of several kinds."""
    record, base = made(rate, modes, scale, turbulent, seed), PRESETS[name]()
    file, telemetry = tmp_path / "found.toml", tmp_path / "r.npz"
    save_record(telemetry, record)
    command = ["identify", str(telemetry), "--preset", name, "--lowest", str(min(5.0, 0.1 * rate)), "--out", str(file)]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0, done.output
    short = configfile.scenario_from(None, file, ("run.duration=3", "run.warm_up=0.5"))
    assert short.replace({"run.duration": base.run.duration, "run.warm_up": base.run.warm_up}) == configfile.load_scenario(file)
    for result in (observe(record, short, observers=QUICK), run(short, observers=QUICK)):
        assert not result.failures
        assert {e.observer for e in result.estimates} == set(QUICK)
        assert all(np.isfinite(e.values).all() for e in result.estimates)
