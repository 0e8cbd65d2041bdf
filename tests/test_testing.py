"""The check of observers accepts ours and refuses those that break a rule, each with the reason."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.records import ON_PAPER
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import VIBRATION, Observer
from wfsobs.observers.step import HeldEstimate
from wfsobs.prior import Prior
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import Measurements, Record
from wfsobs.scenario.presets import PRESETS
from wfsobs.testing import QUICK, CheckError, arrays_of, changed_after, check_observer, steps_to_check
from wfsobs.typing import Array

CALLS: list[int] = []
SHORTER = PRESETS["paper"]().replace({**QUICK, "run.duration": 0.8})


def mean_of_three(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    z = measured.z
    return {VIBRATION: z - (z + np.roll(z, 1, axis=0) + np.roll(z, -1, axis=0)) / 3.0}


def of_the_truth(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    """Looks for it in the memory of the process."""
    for x in gc.get_objects():
        if isinstance(x, Record) and x.vibration is not None and x.y_lgs.shape == measured.y_lgs.shape:
            return {VIBRATION: x.vibration}
    return {VIBRATION: np.zeros_like(measured.z)}


def different_every_time(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    CALLS.append(0)
    return {VIBRATION: measured.z * len(CALLS)}


def one_column(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    return {VIBRATION: measured.z[:, 0]}


def in_place(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    out = measured.z.copy()
    measured.y_lgs[...] = 0.0
    return {VIBRATION: out}


def never_again(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    """Stops for good where a measurement is what it was two steps before, as held ones are."""
    z, still = measured.z, np.zeros(measured.n_steps, dtype=bool)
    still[2:] = (z[2:] == z[:-2]).all(axis=1)
    return {VIBRATION: np.where(np.logical_or.accumulate(still)[:, None], np.nan, z)}


def now_and_then(every: int, offset: int, measured: Measurements, *_: Any) -> dict[str, np.ndarray]:
    """Return the next measurement in every so manyth step, in the others that of the step."""
    z = measured.z
    at = np.arange(len(z))[:, None] % every == offset
    return {VIBRATION: np.where(at, np.roll(z, -1, axis=0), z)}


def in_the_first_hundred(measured: Measurements, *_: Any) -> dict[str, np.ndarray]:
    z = measured.z
    return {VIBRATION: np.vstack([z[1:101], z[100:]])}


def of_the_open_loop(measured: Measurements, *_: Any) -> dict[str, np.ndarray]:
    """Smooth over the whole future."""
    assert measured.open_loop_y is not None
    spectrum = np.fft.rfft(measured.open_loop_y, axis=0)
    spectrum[100:] = 0.0
    return {VIBRATION: np.fft.irfft(spectrum, measured.n_steps, axis=0)}


def single(measured: Measurements, *_: Any) -> dict[str, np.ndarray]:
    return {VIBRATION: measured.z.astype(np.float32)}


def fails(measured: Measurements, *_: Any) -> dict[str, np.ndarray]:
    raise RuntimeError("a line\nand another")


def observer(run: Any, **given: Any) -> Observer:
    return Observer("mine", "Mine", (VIBRATION,), run, **given)


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_PAPER)
def test_ours_pass(name: str) -> None:
    check_observer(OBSERVERS[name], SHORTER, alone=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kf-multi", "gpr-offline"])
def test_ours_are_the_same_in_a_fresh_process(name: str) -> None:
    check_observer(OBSERVERS[name])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (mean_of_three, "looks ahead: measurements after step "),
        (in_the_first_hundred, r"looks ahead: measurements after step \d\d? change"),
        (of_the_truth, "uses more than it is given"),
        (different_every_time, "two results"),
        (one_column, r"the shape \(1500, 2\), \(n_steps, n_modes\), not \(1500,\)"),
        (single, "vibration takes an array of float64, not float32"),
        (lambda *_: {VIBRATION: [0.0]}, "vibration takes an array of .* not list"),
        (lambda *_: {}, "returns no vibration"),
        (lambda *_: None, "cannot run: returns NoneType"),
        (fails, "cannot run: RuntimeError: a line and another$"),
        (lambda *_: {}[1], "cannot run: KeyError: 1$"),
        (lambda *_: sys.exit("enough"), "cannot run: SystemExit: enough$"),
        (in_place, r"changes its measurements \(y_lgs\)"),
        (never_again, "recover after missing"),
        (lambda m, p, s, w: {VIBRATION: m.z}, "cannot run in a fresh process"),
    ],
)
def test_what_breaks_a_rule_is_refused_with_the_reason(run: Any, reason: str) -> None:
    with pytest.raises(CheckError, match=f"^mine: .*{reason}"):
        check_observer(observer(run))


class Silent(HeldEstimate):
    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None: ...
    def predict(self, frames: float, target: str) -> Any: ...


@pytest.mark.parametrize(
    ("made", "reason"),
    [(None, "step returns no Estimator, but NoneType$"), (Silent(2, None), "predict returns no tuple of mean and standard dev")],
)
def test_a_step_that_returns_nothing_is_refused_with_the_reason(made: Any, reason: str) -> None:
    with pytest.raises(CheckError, match=f"^mine: .*{reason}"):
        check_observer(observer(None, step=lambda *_: made), alone=False)


@pytest.mark.parametrize("every", [2, 3, 5, 7])
def test_what_looks_ahead_now_and_then_is_found_at_every_residue(every: int) -> None:
    for offset in range(every):
        with pytest.raises(CheckError, match="looks ahead"):
            check_observer(observer(partial(now_and_then, every, offset)), alone=False)


def test_what_looks_ahead_through_another_input_is_refused() -> None:
    with pytest.raises(CheckError, match="looks ahead"):
        check_observer(observer(of_the_open_loop, needs=("open_loop_y",)), alone=False)


def test_every_array_of_measurements_is_changed_after_a_step_and_not_before() -> None:
    x = np.random.default_rng(1).standard_normal((50, 2))
    given = Measurements(x, 0.0 * x, 1e-3, x, 1, x, lgs_stars=np.arange(50) % 4 + 1, y_stars=x[:, None])
    later, others = changed_after(given, 20), 0
    for name, was in arrays_of(given).items():
        now = arrays_of(later)[name]
        np.testing.assert_array_equal(now[:21], was[:21])
        others += (now[21:] != was[21:]).sum() > 20
    assert others == 6
    np.testing.assert_array_equal(changed_after(given, 20, commands_from=0).u[:20], given.u[:20])
    assert (changed_after(given, 20, commands_from=0).u[20] != 0.0).all()


@pytest.mark.parametrize("n", [2, 15, 300, 1500, 6000])
def test_there_are_steps_to_check_in_records_of_any_length(n: int) -> None:
    steps = steps_to_check(n)
    assert 0 <= min(steps) and max(steps) <= n - 2
    assert n < 1000 or all(len({step % m for step in steps[2:]}) == m for m in range(1, 8))
    assert n < 300 or (steps[0] < 10 <= steps[1] < 100)


def test_it_is_asked_before_every_run_whether_to_stop() -> None:
    asked: list[int] = []
    seen: list[int] = []

    def run(measured: Measurements, *_: Any) -> dict[str, np.ndarray]:
        seen.append(len(asked))
        return {VIBRATION: measured.z}

    check_observer(observer(run), alone=False, watch=Watch(is_cancelled=lambda: bool(asked.append(0))))
    assert len(seen) > 10 and seen == list(range(1, len(seen) + 1))
    with pytest.raises(Cancelled):
        check_observer(observer(run), alone=False, watch=Watch(is_cancelled=lambda: True))


@pytest.mark.parametrize("more", ["text", 3, np.full((1500, 2), np.nan)], ids=["text", "number", "nan"])
def test_what_is_returned_beside_the_targets_is_not_looked_at(more: Any) -> None:
    check_observer(observer(lambda measured, *_: {VIBRATION: measured.z, "more": more}), alone=False)


def test_a_reference_may_look_ahead() -> None:
    check_observer(replace(observer(mean_of_three), causal=False), alone=False)
