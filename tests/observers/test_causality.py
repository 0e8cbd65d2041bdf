"""What every observer may use: y[0..k] and u[0..k-1] for the estimate of step k, and never the truth.

The one exception is the zero-phase reference, marked as not causal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.records import ON_PAPER
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.record import Estimates, Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate

GPR = ("gpr-offline", "gpr-online")
WINDOWS = (*GPR, "ridge")
CAUSAL = [name for name in ON_PAPER if OBSERVERS[name].causal]


def scenario(inputs: str = "u-y") -> Scenario:
    s = PRESETS["paper"]()
    s.update(
        {
            "run": {"duration": 0.7, "warm_up": 0.2},
            "gpr_offline": {"training_size": 60, "depth": 25, "inputs": inputs},
            "gpr_online": {"training_size": 60, "depth": 25, "inputs": inputs},
            "adaptive": {"window": 0.2, "interval": 0.17},  # which holds 18 periods of a peak; the GPR learns at 100, 355, 610
            "vibration": {"source": "ar2", "peaks": [{"frequency": 90.0, "damping": 0.01, "rms": [0.1, 0.1]}]},
        }
    )
    return s


@cache
def whole() -> Record:
    return simulate(scenario())


@pytest.fixture(name="record")
def _record() -> Record:
    return whole()


@cache
def of_whole(name: str, inputs: str = "u-y") -> Estimates:
    """The estimates of an observer on the record as it is."""
    return run_observer(name, whole(), scenario(inputs))


def changed_after(record: Record, k: int) -> Record:
    """Every signal different from what step k may know on: measurements from k + 1, commands from k; the truth and the
    open-loop twin all over."""
    rng = np.random.default_rng(k)

    def other(x: np.ndarray | None, start: int) -> np.ndarray:
        assert x is not None
        out = x.copy()
        out[start:] += 3.0 * rng.standard_normal(out[start:].shape)
        return out

    return replace(
        record,
        y_lgs=other(record.y_lgs, k + 1),
        u=other(record.u, k),
        y_ngs=other(record.y_ngs, k + 1),
        turbulence=other(record.turbulence, 0),
        vibration=other(record.vibration, 0),
        open_loop_y=other(record.open_loop_y, 0),
    )


def test_only_the_reference_looks_ahead() -> None:
    assert [name for name in ON_PAPER if name not in CAUSAL] == ["butterworth-ol"]


@pytest.mark.slow
@pytest.mark.parametrize("name", CAUSAL)
def test_nothing_after_a_step_changes_its_estimate(name: str, record: Record, subtests: pytest.Subtests) -> None:
    """48 is a border of the filters' blocks, 5 and 300 are NGS frames."""
    s, base = scenario(), of_whole(name)
    assert set(base) >= set(OBSERVERS[name].targets)
    for k in (0, 1, 2, 4, 5, 47, 48, 299, 300, 463, 698):
        # u[k] enters the window of step k (paper, eq. 14): of commands, those from k + 1 on are later
        later = changed_after(record, k)
        if name in WINDOWS:
            u = later.u.copy()
            u[k] = record.u[k]
            later = replace(later, u=u)
        other = run_observer(name, later, s)
        for target, values in base.items():
            with subtests.test(target, k=k):
                if name in GPR:
                    # Steps are computed in blocks, later ones in the same factorisation: their rounding may differ, 100 eps
                    # times a condition number of 1e5.
                    difference = np.abs(other[target] - values)[: k + 1]
                    assert np.nanmax(difference, initial=0.0) <= 1e-9 * np.nanstd(values)
                    assert np.array_equal(np.isnan(other[target]), np.isnan(values))
                else:
                    # exactly: in the filters' blocks a later sample meets a zero
                    assert np.array_equal(other[target][: k + 1], values[: k + 1], equal_nan=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in CAUSAL if n != "zero"])
def test_the_change_is_seen_afterwards(name: str, record: Record) -> None:
    """So that the test above can fail: some 60 steps later every estimate has moved."""
    s, later = scenario(), changed_after(record, 400)
    base, other = of_whole(name), run_observer(name, later, s)
    for target, values in base.items():
        assert (np.abs(other[target] - values)[405:460] > 1e-6).mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("inputs", ["u-y", "z"])
@pytest.mark.parametrize("name", CAUSAL)
def test_the_command_of_the_step_itself_is_used_only_where_the_paper_has_it(name: str, inputs: str, record: Record) -> None:
    """u[k] is computed once y[k] is known: the estimate of step k is without it, but for GPR windows of (u, y)."""
    s, k = scenario(inputs), 500
    u = record.u.copy()
    u[k] += 3.0
    base = of_whole(name, inputs)
    other = run_observer(name, replace(record, u=u), s)
    for target, values in base.items():
        moved = np.abs(other[target][k] - values[k]).max() > 1e-9 * np.nanstd(values)
        assert moved == (name in WINDOWS and inputs == "u-y")


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_PAPER)
def test_no_observer_reads_the_truth(name: str, record: Record) -> None:
    """Poisoned with NaN, or absent, it makes no difference at all."""
    s = scenario()
    base = of_whole(name)
    poison = np.full_like(record.y_lgs, np.nan)
    for other in (
        replace(record, turbulence=poison, vibration=poison),
        replace(record, turbulence=None, vibration=None),
    ):
        found = run_observer(name, other, s)
        assert all(np.array_equal(found[target], values, equal_nan=True) for target, values in base.items())


NEEDED: dict[str, Callable[[Record], Record]] = {
    "y_ngs": lambda r: replace(r, y_ngs=None),
    "ratio": lambda r: replace(r, y_ngs=None, ratio=None),
    "open_loop_y": lambda r: replace(r, open_loop_y=None),
    "training": lambda r: replace(r, training=None),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_PAPER)
@pytest.mark.parametrize("field", NEEDED)
def test_what_an_observer_does_not_need_it_does_not_read(name: str, field: str, record: Record) -> None:
    observer, bare = OBSERVERS[name], NEEDED[field](record)
    gone = [name for name in observer.needs if getattr(bare, name) is None]
    assert len(observer.missing(bare)) == min(len(gone), 1)
    if not gone:
        base, found = of_whole(name), run_observer(name, bare, scenario())
        assert all(np.array_equal(found[target], values, equal_nan=True) for target, values in base.items())


@pytest.mark.parametrize("name", CAUSAL)
def test_a_record_that_ends_early_gives_the_same_beginning(name: str, record: Record) -> None:
    s = scenario()
    assert record.y_ngs is not None and record.open_loop_y is not None
    n = 333
    short = replace(
        record,
        y_lgs=record.y_lgs[:n],
        u=record.u[:n],
        y_ngs=record.y_ngs[:n],
        open_loop_y=record.open_loop_y[:n],
        turbulence=None,
        vibration=None,
    )
    base, found = of_whole(name), run_observer(name, short, s)
    for target, values in base.items():
        # matrix products of another width round in another order: 1e-9 as above for the GPR, 1e-12 for the filters
        bound = (1e-9 if name in GPR else 1e-12) * max(np.nanstd(values), 1e-30)
        assert np.nanmax(np.abs(found[target] - values[:n])) <= bound
        assert np.array_equal(np.isnan(found[target]), np.isnan(values[:n]))


@pytest.mark.parametrize("name", ON_PAPER)
def test_modes_do_not_mix(name: str, record: Record) -> None:
    """Each mode alone is what it is beside the other, and a loud neighbour changes nothing."""
    s = scenario()
    loud = replace(record, y_lgs=record.y_lgs * [1.0, 10.0], u=record.u * [1.0, 10.0])
    base, found = of_whole(name), run_observer(name, loud, s)
    for target, values in base.items():
        assert np.array_equal(found[target][:, 0], values[:, 0], equal_nan=True)
