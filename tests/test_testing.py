"""The check of observers accepts ours and refuses those that break a rule, each with the reason."""

from __future__ import annotations

import gc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.records import ON_PAPER
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import VIBRATION, Observer
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Record
from wfsobs.testing import CheckError, check_observer

CALLS: list[int] = []


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


def observer(run: Any) -> Observer:
    return Observer("mine", "Mine", (VIBRATION,), run)


@pytest.mark.parametrize("name", ON_PAPER)
def test_ours_pass(name: str) -> None:
    check_observer(OBSERVERS[name], alone=False)


@pytest.mark.parametrize("name", ["kf-multi", "gpr-offline"])
def test_ours_are_the_same_in_a_fresh_process(name: str) -> None:
    check_observer(OBSERVERS[name])


@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (mean_of_three, "looks ahead: measurements after step 750"),
        (of_the_truth, "uses more than it is given"),
        (different_every_time, "two results"),
        (one_column, r"shape \(1500, 2\)"),
        (in_place, r"changes its measurements \(y_lgs\)"),
        (never_again, "recover after missing"),
        (lambda m, p, s, w: {VIBRATION: m.z}, "cannot run in a fresh process"),
    ],
)
def test_what_breaks_a_rule_is_refused_with_the_reason(run: Any, reason: str) -> None:
    with pytest.raises(CheckError, match=f"^mine: .*{reason}"):
        check_observer(observer(run))


def test_a_reference_may_look_ahead() -> None:
    check_observer(replace(observer(mean_of_three), causal=False), alone=False)
