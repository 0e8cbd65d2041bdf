"""What can be registered, and what cannot, with the reason in one line."""

from __future__ import annotations

import subprocess
import sys
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import wfsobs
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import BUILT_IN, OBSERVERS
from wfsobs.observers.base import Look, Observer, Tunable
from wfsobs.prior import Model
from wfsobs.registry import RegistrationError, Registry, sections
from wfsobs.scenario import Scenario
from wfsobs.settings import Group, Real, Section

ZERO = OBSERVERS["zero"]
WORD: Any = ("Model",)


class Own(Group):
    """A group."""

    speed = Real(1.0, bounds=(0.0, 2.0), label="Speed", doc="How fast [m/s].")


class Endless(Group):
    """One without an end."""

    speed = Real(1.0, bounds=(0.0, None), label="Speed", doc="How fast [m/s].")


def mine(**changes: Any) -> Observer:
    return replace(ZERO, **{"id": "mine", "label": "Mine", **changes})


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (replace(ZERO, label="Another"), "observer 'zero': the id is taken, by Zero"),
        (mine(label="Zero"), "observer 'mine': the label 'Zero' is taken"),
        (mine(id="bound-both"), "observer 'bound-both': the id is taken, by a row of the tables"),
        (mine(id="bound"), "observer 'bound': the id is taken, by a row of the tables"),
        (mine(id="My one"), "observer 'My one': an id takes lower-case letters, digits and hyphens between them"),
        (mine(id="mine-"), "observer 'mine-': an id takes"),
        (mine(id=7), "observer 7: an id takes"),
        (mine(settings=Section("loop", "Loop", Own)), "observer 'mine': settings 'loop': the name is taken"),
        (mine(settings=Section("replace", "Replace", Own)), "observer 'mine': settings 'replace': the name is taken"),
        (mine(settings=Section("adaptive", "Adaptive", Own)), "observer 'mine': settings 'adaptive': the name is taken"),
        (
            mine(settings=Section("my-own", "Own", Own)),
            "settings 'my-own': a name takes lower-case letters",
        ),
        (mine(settings=Section("own", "Own", dict)), "observer 'mine': settings takes a Section of a Group"),
        (mine(settings=Own), "observer 'mine': settings takes a Section of a Group, not the class Own"),
        (mine(settings="nothing"), "observer 'mine': settings 'nothing': no scenario has such a group"),
        (mine(settings=Section("own", "Own", Endless)), "settings own.speed: a number takes bounds, lowest and highest"),
        (mine(targets="turbulence"), "observer 'mine': targets = 'turbulence': takes a tuple out of turbulence, vibration"),
        (mine(targets=("foo",)), "observer 'mine': targets = ('foo',): takes a tuple out of turbulence, vibration"),
        (mine(targets=()), "observer 'mine': targets = (): takes one at least, of turbulence, vibration"),
        (mine(needs="y_ngs"), "observer 'mine': needs = 'y_ngs': takes a tuple out of y_lgs, u, dt, y_ngs, "),
        (mine(needs=("foo",)), "observer 'mine': needs = ('foo',): takes a tuple out of y_lgs, "),
        (mine(sensors=("foo",)), "observer 'mine': sensors = ('foo',): takes a tuple out of lgs, ngs"),
        (mine(prior=Model), "observer 'mine': prior = <class 'wfsobs.prior.Model'>: takes a tuple out of Model, "),
        (mine(prior=WORD), "observer 'mine': prior = ('Model',): takes a tuple out of Model, "),
        (mine(run=None, step=None), "observer 'mine': has neither a run nor a step"),
        (mine(run=5), "observer 'mine': run = 5: takes a function"),
        (mine(step="later"), "observer 'mine': step = 'later': takes a function"),
        (mine(seconds=3), "observer 'mine': seconds = 3: takes a function"),
        (mine(counts=3), "observer 'mine': counts = 3: takes a function"),
        (mine(asks=None), "observer 'mine': asks = None: takes a function"),
        (mine(help=None), "observer 'mine': help = None: takes a text"),
        (mine(targets=("vibration", "vibration")), "targets = ('vibration', 'vibration'): takes each of them once"),
        (mine(label=" "), "observer 'mine': label = ' ': takes a text"),
        (mine(weight=0), "observer 'mine': weight = 0: takes a number above 0"),
        (mine(weight=float("inf")), "observer 'mine': weight = inf: takes a number above 0"),
        (mine(weight="1"), "observer 'mine': weight = '1': takes a number above 0"),
        (mine(look=Look(light="#8A4BC")), "observer 'mine': look.light = '#8A4BC': takes a colour of CSS, such as"),
        (mine(look="red"), "observer 'mine': look = 'red': takes a Look"),
        (mine(tunable=Tunable(("nothing.speed",))), "observer 'mine': tunable 'nothing.speed': no scenario has such a setting"),
        (mine(tunable=Tunable((), ("kalman",))), "observer 'mine': tunable 'kalman': no scenario has such a setting"),
        (
            mine(settings=Section("own", "Own", Own), tunable=Tunable(("own.speed", "own.pace"))),
            "observer 'mine': tunable 'own.pace': no scenario has such a setting",
        ),
        (replace(CONTROLLERS["none"], id="mine", label="Mine", weight=-1.0), "controller 'mine': weight = -1.0: takes a number"),
        (
            replace(CONTROLLERS["none"], id="mine", label="Mine", prior=WORD),
            "controller 'mine': prior = ('Model',): takes a tuple out of Model, ",
        ),
        (Observer, "register: takes an Observer or a Controller, not the class Observer"),
        (len, "register: takes an Observer or a Controller, not a builtin_function_or_method"),
    ],
)
def test_what_is_refused(entry: Any, reason: str) -> None:
    before = list(OBSERVERS), dict(sections())
    with pytest.raises(RegistrationError) as error:
        wfsobs.register(entry)
    assert reason in str(error.value) and "\n" not in str(error.value)
    assert (list(OBSERVERS), dict(sections())) == before


@pytest.mark.parametrize("colour", ["#f60", "#f60c", "#ff6600", "#ff6600cc", "rgb(255, 102, 0)", "rgba(255,102,0,.5)", "tomato"])
def test_any_colour_of_css_is_taken(colour: str) -> None:
    mine(look=Look(light=colour, dark=colour)).check_fields()


@pytest.mark.parametrize("weight", [2, 0.5, np.int64(3), np.float32(3.0)], ids=repr)
def test_any_number_above_0_is_a_weight(weight: Any) -> None:
    mine(weight=weight).check_fields()


def test_the_same_again_changes_nothing() -> None:
    before = dict(OBSERVERS)
    wfsobs.register(ZERO)
    assert dict(OBSERVERS) == before


def test_one_that_is_registered_comes_last() -> None:
    registry = Registry(Observer, "wfsobs.nothing", BUILT_IN)
    registry.add(mine())
    assert list(registry) == [*(o.id for o in BUILT_IN), "mine"] and registry["mine"].label == "Mine"


class Installed:
    """Stands for an entry point whose module takes until `go` to import."""

    value, dist = "slow:MINE", None

    def __init__(self) -> None:
        self.loading, self.go = threading.Event(), threading.Event()

    def load(self) -> Observer:
        self.loading.set()
        assert self.go.wait(20)
        return mine()


def test_every_thread_finds_the_registry_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """While one reads what is installed, the others wait."""
    point, found = Installed(), list[int]()
    monkeypatch.setattr("wfsobs.registry.entry_points", lambda group: [point] if group == "wfsobs.nothing" else [])
    registry = Registry(Observer, "wfsobs.nothing", BUILT_IN)
    first, second = (threading.Thread(target=lambda: found.append(len(registry))) for _ in range(2))
    first.start()
    assert point.loading.wait(20)
    second.start()
    second.join(0.1)
    point.go.set()
    first.join()
    second.join()
    assert found == [len(BUILT_IN) + 1] * 2


LATE = """
from dataclasses import replace
import wfsobs
from wfsobs.observers import OBSERVERS
from wfsobs.settings import Group, Real, Section

class Own(Group):
    "A group."
    speed = Real(1.0, bounds=(0.0, 2.0), label="Speed", doc="How fast [m/s].")

before = wfsobs.Scenario()
wfsobs.register(replace(OBSERVERS["zero"], id="mine", label="Mine", settings=Section("own", "Own", Own)))
assert before.own.speed == 1.0 and before == wfsobs.Scenario()
assert before.replace({"own.speed": 2}).difference(before) == {"own": {"speed": 2.0}}
before.own.speed = 0.5
assert wfsobs.Scenario().own.speed == 1.0 and before.copy().own.speed == 0.5
print(list(before.to_dict())[-5:])
print({s.observer for s in wfsobs.run(wfsobs.PRESETS["paper"]().replace({"run.duration": 1.5}), observers=["mine"]).scores})
"""


@pytest.mark.slow
def test_a_scenario_made_before_has_the_settings_too() -> None:
    done = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "['own', 'control', 'plant', 'run', 'events']"
    assert "'mine'" in done.stdout.splitlines()[1]


EARLY = """
import logging
from dataclasses import replace
from wfsobs.observers import OBSERVERS
from wfsobs.settings import Group, Section

class Own(Group):
    "A group."

OBSERVERS.add(replace(OBSERVERS["zero"], id="mine", label="Mine", settings={settings}))
from wfsobs.scenario import Scenario
print("mine" in OBSERVERS, list(Scenario.settings())[:2])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "is_kept"), [('"kalman"', True), ('"no_group"', False), ('Section("turbulence", "Turbulence", Own)', False)]
)
def test_what_is_registered_before_the_scenario_is_there_is_checked_when_it_is(settings: str, is_kept: bool) -> None:
    done = subprocess.run([sys.executable, "-c", EARLY.format(settings=settings)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"{is_kept} {list(Scenario.settings())[:2]}"
    assert ("is left out" in done.stderr) != is_kept


def test_groups_of_our_own_stand_in_the_order_of_the_registry() -> None:
    names = [s.name for s in sections().values()]
    assert names == ["multipeak", "adaptive", "multirate", "gp", "gpr_offline", "gpr_online"]
    assert [name for name in Scenario.settings() if name in names] == names
