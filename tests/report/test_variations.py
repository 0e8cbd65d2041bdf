"""Lists of values for settings, and the scenarios that they make."""

from __future__ import annotations

from itertools import product
from math import prod
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import MOST, Variation, parse_variation, scenarios
from wfsobs.settings.values import SettingError

NUMBERS = st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**53), 2**53)
VALUES = st.one_of(
    *(
        st.lists(of, min_size=1, max_size=6)
        for of in (NUMBERS, st.sampled_from(["peaks", "ar2", "none"]), st.lists(st.floats(0, 100), max_size=3))
    )
)


def distinct(values: list[Any]) -> bool:
    return all(value not in values[:i] for i, value in enumerate(values))


@given(VALUES.filter(distinct))
def test_what_is_written_is_read_again(values: list[Any]) -> None:
    variation = Variation("a.b", tuple(values))
    assert parse_variation(str(variation)) == variation


def test_switches_and_tables_are_read() -> None:
    assert parse_variation("loop.closed=true,false").values == (True, False)
    peaks = parse_variation("vibration.peaks=[],[{frequency = 18.1, rms = [0.01]}]").values
    assert peaks == ([], [{"frequency": 18.1, "rms": [0.01]}])


@pytest.mark.parametrize("text", ["", "a", "a=", "=1", "a.b= "])
def test_what_is_no_list_is_refused(text: str) -> None:
    with pytest.raises(SettingError, match=r"takes name=value,value"):
        parse_variation(text)


@pytest.mark.parametrize("text", ["run.seed=1,1", "turbulence.wind_speed=5,5.0", "vibration.source=ar2,peaks,ar2"])
def test_a_value_given_twice_is_refused(text: str) -> None:
    with pytest.raises(SettingError, match="twice"):
        parse_variation(text)


def test_a_line_break_cannot_bring_other_settings() -> None:
    text = "run.seed=1]\nother = [2"
    assert all(isinstance(value, str) for value in parse_variation(text).values)
    with pytest.raises(SettingError, match=r"run\.seed = "):
        scenarios(Scenario(), [parse_variation(text)])


@settings(deadline=None, max_examples=8)
@given(st.lists(st.integers(1, 9), min_size=0, max_size=3))
def test_every_combination_or_a_refusal(counts: list[int]) -> None:
    paths = ("turbulence.wind_speed", "loop.gain", "run.seed")
    values = ([1.0 + i for i in range(9)], [0.1 + 0.05 * i for i in range(9)], list(range(9)))
    variations = [Variation(path, tuple(v[:n])) for path, v, n in zip(paths, values, counts, strict=False)]
    if prod(counts) > MOST:
        with pytest.raises(SettingError, match=f"= {prod(counts)} combinations, at most {MOST}"):
            scenarios(Scenario(), variations)
        return
    got = [(s.turbulence.wind_speed, s.loop.gain, s.run.seed) for s in scenarios(Scenario(), variations)]
    defaults = [(15.0,), (0.3,), (1,)]
    of = [v.values for v in variations] + defaults[len(variations) :]
    assert got == list(product(*of)), "the last one runs fastest"


def test_counts_are_checked_before_anything_is_made() -> None:
    many = [Variation(path, tuple(range(1, 10_000))) for path in ("turbulence.wind_speed", "run.seed", "run.duration")]
    with pytest.raises(SettingError, match="at most 60"):
        scenarios(Scenario(), many)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        (["turbulence.wind_speed=5,200"], r"turbulence\.wind_speed = 200: takes a number from 0\.1 to 100"),
        (["turbulence.wind=5"], r"turbulence\.wind: no such setting"),
        (["run.warm_up=1,10"], r"run\.warm_up = 10: must be below"),
        (["run.seed=1,,2"], r"run\.seed = ''"),
        (["run.seed=1,2", "run.seed=3,4"], r"--vary run\.seed: is given twice"),
        (["vibration.peaks.0.frequency=20,30", "vibration.peaks=[],[{frequency = 9.0}]"], "the same settings"),
    ],
)
def test_what_cannot_run_is_refused(lists: list[str], message: str) -> None:
    with pytest.raises(SettingError, match=message) as caught:
        scenarios(Scenario(), [parse_variation(text) for text in lists])
    assert "\n" not in str(caught.value)


def test_the_base_stays_as_it_was() -> None:
    base = Scenario()
    scenarios(base, [parse_variation("turbulence.wind_speed=5,10")])
    assert base == Scenario()
