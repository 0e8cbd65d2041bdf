"""What an observer can reach from its arguments: no scenario, no seed, no truth, and no array that holds one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from tests.records import ON_PAPER
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import run_design
from wfsobs.priors_from import scenario as door
from wfsobs.progress import Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.testing import SEED, given_away, walk_references


def scenario(inputs_filter: str = "raw") -> Scenario:
    own = {"training_size": 60, "depth": 25, "inputs_filter": inputs_filter}
    return PRESETS["paper"]().replace(
        {
            "run.duration": 0.7,
            "run.warm_up": 0.2,
            "run.seed": SEED,
            "adaptive.window": 0.25,
            **{f"{gpr}.{name}": value for gpr in ("gpr_offline", "gpr_online") for name, value in own.items()},
        }
    )


def together(record: Record) -> Record:
    """The record with every signal a view of one array that also holds the truth, as a file that was read at once has it."""
    assert record.y_ngs is not None and record.open_loop_y is not None
    names = ("y_lgs", "u", "y_ngs", "open_loop_y", "turbulence", "vibration")
    block = np.stack([getattr(record, name) for name in names])
    return replace(record, **{name: block[i] for i, name in enumerate(names)})  # type: ignore[arg-type]


def leaks(record: Record, s: Scenario, monkeypatch: pytest.MonkeyPatch, only: str) -> set[str]:
    """What the arguments of an observer give away when it runs in the pipeline, heard by someone who knows the truth."""
    found: set[str] = set()

    def run(*arguments: Any) -> dict[str, np.ndarray]:
        found.update(given_away(record, *arguments))
        return real(*arguments)

    real = OBSERVERS[only].run or partial(run_design, OBSERVERS[only])
    monkeypatch.setitem(OBSERVERS, only, replace(OBSERVERS[only], run=run))
    heard: list[Any] = [record, s]
    watch = Watch(lambda fraction: heard.append(fraction), lambda: not heard, lambda *args: heard.append(args))
    (item, *_) = each_estimate(record, s, watch, [only], lambda *args: heard.append(args))
    assert getattr(item, "values", None) is not None, item
    return found


@pytest.fixture(scope="module", name="record")
def _record() -> Record:
    return together(simulate(scenario()))


@pytest.mark.slow
@pytest.mark.parametrize("inputs_filter", ["raw", "standardised"])
@pytest.mark.parametrize("name", ON_PAPER)
def test_nothing_that_an_observer_reaches_is_truth(
    name: str, inputs_filter: str, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert leaks(record, scenario(inputs_filter), monkeypatch, name) == set()


def test_what_reached_the_truth_would_be_found(record: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search itself: a view, a closure, a partial, the scenario."""
    s = scenario()
    assert given_away(record, record.y_lgs) >= {"turbulence", "vibration"}
    assert given_away(record, lambda: record) >= {"Record"}
    assert given_away(record, partial(print, s)) >= {"Scenario", "Run", "seed"}
    monkeypatch.setattr("wfsobs.execution.arguments", lambda *given: (record, *door.arguments(*given)[1:]))
    assert "turbulence" in leaks(record, s, monkeypatch, "persistence")


@pytest.mark.parametrize("name", ON_PAPER)
def test_arguments_have_memory_of_their_own(name: str, record: Record) -> None:
    observer = OBSERVERS[name]
    measured, prior, settings = door.arguments(observer, record, scenario())
    arrays = [x for x in walk_references(measured, prior, settings) if isinstance(x, np.ndarray)]
    assert len(arrays) >= 2  # measurements of a sensor, and commands
    assert all(x.base is None and x.flags.owndata and x.flags.c_contiguous for x in arrays)
    assert (measured.open_loop_y is None) == ("open_loop_y" not in observer.needs)
    assert (prior.training is None) == ("training" not in observer.needs)
