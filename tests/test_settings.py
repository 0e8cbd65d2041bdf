"""The settings tree: strict on every way in, exact on every way out."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import param
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import Peak
from wfsobs.settings.group import Group
from wfsobs.settings.values import Reals, SettingError, allowed_values, unit_of

EXAMPLES = settings(max_examples=30, deadline=None, derandomize=True)
HUGE = 10**400
"""A whole number that no float can hold; a TOML file can."""

NOT_A_NUMBER: tuple[Any, ...] = (math.nan, math.inf, -math.inf, "3", None, True, [1.0], {}, HUGE, 1j)


def groups(of: type[Group] = Group) -> Iterator[type[Group]]:
    for cls in of.__subclasses__():
        yield cls
        yield from groups(cls)


def test_every_setting_has_its_type() -> None:
    """One without, or a generic one that does not say of what, leaves all that takes a scenario untyped for those who use it."""
    for cls in (cls for cls in groups() if cls.__module__.startswith("wfsobs.")):
        for name, p in vars(cls).items():
            if isinstance(p, param.Parameter) and not isinstance(p, param.ClassSelector) and name != "name":
                assert not re.fullmatch(r"|param[.](Selector|List|Parameter|Dict)", cls.__annotations__.get(name, "")), (
                    cls,
                    name,
                )


# ---------------------------------------------------------------------- every setting refuses


def refused(p: param.Parameter) -> Iterator[Any]:
    """Values that a setting must not take: just outside its bounds, not a number, of another type."""
    if isinstance(p, Reals):
        low, high = p.item_bounds
        shortest, longest = p.bounds
        item = low or 1.0
        yield from ("1", None, True, 3.0, {"a": 1})
        yield [item] * (longest + 1)
        if shortest:
            yield [item] * (shortest - 1)
        for bad in (math.nextafter(low, -math.inf), math.nextafter(high, math.inf), *NOT_A_NUMBER):
            yield [item, bad][-max(longest, 1) :]
    elif isinstance(p, param.Integer):
        low, high = p.bounds
        yield from (low - 1, high + 1, low + 0.5, *NOT_A_NUMBER)
    elif isinstance(p, param.Number):
        low, high = p.bounds
        at_low, at_high = p.inclusive_bounds
        yield math.nextafter(low, -math.inf) if at_low else low
        yield math.nextafter(high, math.inf) if at_high else high
        yield from NOT_A_NUMBER
    elif isinstance(p, param.Boolean):
        yield from (0, 1, "true", None, math.nan, [True])
    else:
        assert isinstance(p, param.Selector), p
        yield from ("no such choice", "", 3, None, True, math.nan, [p.objects[0]])


def limits(p: param.Parameter) -> list[str]:
    """What the message of a refusal must hold, written from the declaration."""
    if isinstance(p, Reals):
        return [f"{v:g}" for v in (*p.item_bounds, *p.bounds)]
    if isinstance(p, param.Number):
        return [f"{p.bounds[0]:g}", f"{p.bounds[1]:.10g}"]
    if isinstance(p, param.Boolean):
        return ["true", "false"]
    return list(p.objects)


def full() -> Scenario:
    """A scenario in which no list of groups is empty."""
    return Scenario.from_dict({"events": [{}]})


ALL = {path: p for path, _, p in full().walk()}


def test_the_walk_reaches_every_group() -> None:
    groups = {path.split(".")[0] for path in ALL}
    assert groups == set(Scenario.settings())
    assert "vibration.peaks.0.rms" in ALL and "vibration.psd.tilt" in ALL


@pytest.mark.slow
def test_every_setting_refuses_what_it_does_not_take(subtests: pytest.Subtests) -> None:
    """One value by its whole path, and all of them at the group that owns the setting."""
    scenario = full()
    before = scenario.to_dict()
    for path, owner, p in scenario.walk():
        with subtests.test(path):
            bad = list(refused(p))
            assert len(bad) >= 6
            with pytest.raises(SettingError, match=rf"^{re.escape(path)} = "):
                scenario.set(path, bad[0])
            for value in bad:
                with pytest.raises(SettingError) as caught:
                    owner.update({p.name: value}, path.removesuffix(p.name))
                message = str(caught.value)
                assert message.startswith(f"{path} = "), message
                assert "\n" not in message and len(message) < 400
                shown = repr(value)
                assert (shown if len(shown) <= 80 else shown[:60]) in message
                after = message.split(": ", 1)[1]
                for limit in limits(p):
                    assert limit in after, (limit, message)
            assert scenario.to_dict() == before, "a refused value leaves no trace"


def bounds_of(p: param.Parameter) -> list[Any]:
    """The first and the last value that a setting takes, or all of them."""
    if isinstance(p, Reals):
        return [[v] * max(p.bounds[0], 1) for v in p.item_bounds]
    if isinstance(p, param.Number):
        step = 1 if isinstance(p, param.Integer) else 0
        low, high = p.bounds
        at_low, at_high = p.inclusive_bounds
        return [
            low if at_low or step else math.nextafter(low, math.inf),
            high if at_high or step else math.nextafter(high, -math.inf),
        ]
    return [True, False] if isinstance(p, param.Boolean) else list(p.objects)


@pytest.mark.slow
def test_every_setting_takes_its_own_bounds(subtests: pytest.Subtests) -> None:
    """All at once: at their first bound, at their last, and at the choices that are left."""
    base = full()
    bounds = {path: bounds_of(p) for path, p in ALL.items()}
    for i in range(max(map(len, bounds.values()))):
        values = {path: found[min(i, len(found) - 1)] for path, found in bounds.items()}
        taken = _flat(base.replace(values))
        for path, p in ALL.items():
            with subtests.test(path, value=values[path]):
                assert taken[path] == values[path]
                is_real = isinstance(p, param.Number) and not isinstance(p, param.Integer)
                assert type(taken[path]) is (float if is_real else type(values[path]))


def test_every_number_states_its_unit_or_has_none(subtests: pytest.Subtests) -> None:
    """A quantity's documentation starts or goes on with its unit in [brackets]; pure numbers have none."""
    pure = {
        "damping",
        "fraction",
        "wind_factor",
        "radial_order",
        "gain",
        "leak",
        "order",
        "seed",
        "training_size",
        "depth",
        "lgs_count",
        "exposure_ratio",
        "lgs_subapertures",
        "ngs_subapertures",
        "fitted_order",
        "illumination",
        "obscuration",
        "pixels",
        "turbulence_order",
        "peak",
        "peak_count",
        "strength",
        "lasers",
        "share",
        "third_corner",
        "gate_level",
        "gain_error",
        "coupling",
        "lost_commands",
        "hysteresis",
        "optical_gain_rms",
        "caution",
        "fallback_gain",
    }
    for path, p in ALL.items():
        with subtests.test(path):
            assert p.doc and p.label
            is_quantity = isinstance(p, (param.Number, Reals)) and path.rsplit(".", 1)[-1] not in pure
            assert bool(unit_of(p)) == is_quantity
            if is_quantity:
                assert allowed_values(p).endswith(unit_of(p))


@pytest.mark.parametrize(("path", "value"), [("telescope.diameter", 0.01), ("loop.closed", 1), ("run.seed", True)])
def test_all_ways_in_are_equally_strict(path: str, value: Any) -> None:
    group, name = path.split(".")
    with pytest.raises(SettingError, match=re.escape(path)):
        Scenario.from_dict({group: {name: value}})
    with pytest.raises(SettingError, match=re.escape(path)):
        Scenario().update({group: {name: value}})
    with pytest.raises(SettingError, match=re.escape(path)):
        Scenario().replace({path: value})
    with pytest.raises(ValueError, match=name):
        setattr(getattr(Scenario(), group), name, value)


@pytest.mark.parametrize(
    "path",
    [
        "x",
        "telescope.x",
        "telescope.diameter.x",
        "vibration.peaks.0.x",
        "vibration.peaks.2.frequency",
        "",
        ".",
        "name",
        "vibration.peaks.-1.frequency",
        "vibration.peaks.first",
        "telescope.name",
        "vibration.peaks.0.rms.0.x",
        "run.to_dict",
    ],
)
def test_unknown_names_are_refused(path: str) -> None:
    scenario = Scenario()
    with pytest.raises(SettingError) as caught:
        scenario.set(path, 1.0)
    assert str(caught.value).startswith(path.split(".x")[0])
    assert scenario == Scenario()


def test_unknown_names_are_refused_on_every_other_way_in() -> None:
    with pytest.raises(SettingError, match=r"^telescope\.diametre: no such setting.*diameter"):
        Scenario.from_dict({"telescope": {"diametre": 8.0}})
    with pytest.raises(SettingError, match=r"^vibration\.peaks\.0\.freq: no such setting.*frequency"):
        Scenario.from_dict({"vibration": {"peaks": [{"freq": 8.0}]}})
    with pytest.raises(AttributeError, match="diametre"):
        Scenario().telescope.diametre = 8.0
    with pytest.raises(TypeError):
        Peak(freq=3.0)


@pytest.mark.parametrize("value", [None, 3, "peaks", {}, [3], ["a"], [None], {"frequency": 3.0}])
def test_a_list_of_groups_takes_only_tables(value: Any) -> None:
    with pytest.raises(SettingError, match=r"^vibration\.peaks"):
        Scenario().set("vibration.peaks", value)


@pytest.mark.parametrize("value", [None, 3, "x", []])
def test_a_group_is_not_a_value(value: Any) -> None:
    with pytest.raises(SettingError, match=r"^telescope = .*group"):
        Scenario().set("telescope", value)


# ---------------------------------------------------------------------- numbers of NumPy


def of_numpy(p: param.Parameter) -> list[Any]:
    """The default of a setting in every NumPy type that holds it."""
    value: Any = p.default
    if isinstance(p, Reals):
        return [[np.float64(v) for v in value], tuple(np.float64(v) for v in value)]
    if isinstance(p, param.Boolean):
        return [np.bool_(value)]
    if isinstance(p, param.Integer):
        return [np.int64(value), np.int32(value)]
    if isinstance(p, param.Number):
        return [np.float64(value)]
    return [np.str_(value)]


def types_in(value: Any) -> set[type]:
    if isinstance(value, dict):
        return set().union(*map(types_in, value.values()))
    return set().union(*map(types_in, value)) if isinstance(value, list) else {type(value)}


@pytest.mark.slow
def test_numbers_of_numpy_become_plain_on_every_way_in(subtests: pytest.Subtests) -> None:
    base = full()
    by_path, by_attribute = base.copy(), base.copy()
    given = {path: of_numpy(p) for path, p in ALL.items()}
    for path, owner, p in by_attribute.walk():
        with subtests.test(path):
            for value in given[path]:
                setattr(owner, p.name, value)
                assert types_in(owner.to_dict()) <= {float, int, bool, str}
    for i in range(2):
        values = {path: found[i % len(found)] for path, found in given.items()}
        for path, value in values.items():
            if i < len(given[path]):
                by_path.set(path, value)
        for scenario in (by_path, by_attribute, base.replace(values)):
            assert scenario == base
            assert types_in(scenario.to_dict()) <= {float, int, bool, str}


def test_numbers_of_numpy_in_peaks_and_events() -> None:
    peak = {"frequency": np.float64(45), "damping": np.float32(0.5), "rms": [np.float64(0.01), np.float64(0.02)]}
    event = {"kind": np.str_("peak"), "start": np.float64(1), "peak": np.int64(0)}
    scenario = Scenario().replace({"vibration.peaks": [peak], "events": [event]})
    assert scenario == Scenario().replace(
        {"vibration.peaks": [{"frequency": 45.0, "damping": 0.5, "rms": [0.01, 0.02]}], "events": [{"start": 1.0}]}
    )
    assert types_in(scenario.to_dict()) <= {float, int, bool, str}
    assert types_in(Peak(frequency=np.float64(45), rms=[np.float64(1)]).to_dict()) == {float}


# ---------------------------------------------------------------------- plain values


def setting_values(p: param.Parameter) -> st.SearchStrategy[Any]:
    """All that one setting takes, as plain values."""
    if isinstance(p, Reals):
        low, high = p.item_bounds
        return st.lists(st.floats(low, high), min_size=p.bounds[0], max_size=min(p.bounds[1], 5))
    if isinstance(p, param.Integer):
        return st.integers(*p.bounds)
    if isinstance(p, param.Number):
        at_low, at_high = p.inclusive_bounds
        return st.floats(*p.bounds, exclude_min=not at_low, exclude_max=not at_high)
    return st.booleans() if isinstance(p, param.Boolean) else st.sampled_from(p.objects)


def trees(group: type[Group]) -> st.SearchStrategy[dict[str, Any]]:
    """Plain dictionaries of a group with every setting anywhere within its bounds."""
    parts: dict[str, st.SearchStrategy[Any]] = {}
    for name, p in group.settings().items():
        if isinstance(p, param.List) and not isinstance(p, Reals):
            parts[name] = st.lists(trees(p.item_type), max_size=4)
        elif isinstance(p, param.ClassSelector) and not isinstance(p, Reals):
            parts[name] = trees(p.class_)
        else:
            parts[name] = setting_values(p)
    return st.fixed_dictionaries(parts)


SCENARIOS = trees(Scenario)


@pytest.mark.slow
@EXAMPLES
@given(SCENARIOS)
def test_plain_values_come_back_exactly(values: dict[str, Any]) -> None:
    scenario = Scenario.from_dict(values)
    assert scenario.to_dict() == values
    # through text: shortest-repr decimals, as JSON and TOML write them, give the same bits back
    assert Scenario.from_dict(json.loads(json.dumps(scenario.to_dict()))) == scenario
    assert hash(scenario.copy()) == hash(scenario)


@pytest.mark.slow
@EXAMPLES
@given(SCENARIOS, SCENARIOS)
def test_base_plus_difference_is_the_scenario(one: dict[str, Any], other: dict[str, Any]) -> None:
    scenario, base = Scenario.from_dict(one), Scenario.from_dict(other)
    again = base.copy()
    again.update(scenario.difference(base))
    assert again == scenario
    assert scenario.difference(scenario.copy()) == {}


def test_a_difference_holds_only_what_differs() -> None:
    scenario = Scenario().replace({"telescope.diameter": 39.0, "vibration.peaks.0.damping": 0.01})
    peak = Peak().to_dict() | {"damping": 0.01}
    assert scenario.difference(Scenario()) == {"telescope": {"diameter": 39.0}, "vibration": {"peaks": [peak]}}


@pytest.mark.slow
@EXAMPLES
@given(SCENARIOS, st.sampled_from(list(ALL)), st.data())
def test_setting_one_leaves_the_others(values: dict[str, Any], path: str, data: st.DataObject) -> None:
    scenario = Scenario.from_dict(values)
    known = {found: p for found, _, p in scenario.walk()}
    if path not in known:  # a peak that this tree has not got
        path = "run.duration"
    value = data.draw(setting_values(known[path]))
    changed = scenario.replace({path: value})
    flat, base = _flat(changed), _flat(scenario)
    assert flat.pop(path) == value
    base.pop(path)
    assert flat == base


def _with(base: Scenario, path: str, value: Any) -> Scenario:
    scenario = base.copy()
    scenario.set(path, value)
    return scenario


def _flat(scenario: Scenario) -> dict[str, Any]:
    return {path: getattr(owner, p.name) for path, owner, p in scenario.walk()}


# ---------------------------------------------------------------------- lists of peaks, identity


def test_peaks_grow_and_shrink() -> None:
    scenario = Scenario()
    scenario.set("vibration.peaks.1.frequency", 20)
    scenario.set("vibration.peaks.2", {"frequency": 30.0, "rms": [1.0]})
    assert [p.frequency for p in scenario.vibration.peaks] == [Peak().frequency, 20.0, 30.0]
    assert scenario.vibration.peaks[1] == Peak(frequency=20.0)
    with pytest.raises(SettingError, match="has 3 entries"):
        scenario.set("vibration.peaks.4.frequency", 20)
    scenario.update({"vibration": {"peaks": [{"frequency": 5.0}]}})
    assert scenario.vibration.peaks == [Peak(frequency=5.0)]
    scenario.set("vibration.peaks", [])
    assert scenario.vibration.peaks == [] and "vibration.peaks.0.rms" not in _flat(scenario)
    scenario.set("vibration.peaks.0", {})
    scenario.set("vibration.peaks.0.rms.1", 0.5)
    scenario.set("vibration.peaks.0.rms.2", 0.25)
    assert scenario.vibration.peaks[0].rms == [Peak().rms[0], 0.5, 0.25]


def test_no_more_peaks_than_allowed() -> None:
    scenario = Scenario()
    most = Scenario().vibration.param.peaks.bounds[1]
    scenario.set("vibration.peaks", [{}] * most)
    with pytest.raises(SettingError, match=rf"^vibration\.peaks.*{most}"):
        scenario.set(f"vibration.peaks.{most}.frequency", 3.0)
    assert len(scenario.vibration.peaks) == most


def test_instances_and_copies_share_nothing() -> None:
    one, other = Scenario(), Scenario()
    one.vibration.peaks[0].frequency = 1.0
    one.vibration.peaks[0].rms[0] = 7.0
    one.vibration.peaks.append(Peak())
    one.vibration.psd.tip.append(3.0)
    one.butterworth.frequencies.append(70.0)
    one.telescope.diameter = 39.0
    assert other == Scenario()
    twin = one.copy()
    assert twin == one and twin is not one
    twin.vibration.peaks[0].rms[0] = 8.0
    twin.telescope.diameter = 2.0
    assert one.vibration.peaks[0].rms[0] == 7.0 and one.telescope.diameter == 39.0


def test_groups_handed_over_are_copied() -> None:
    donor, scenario = Scenario(), Scenario()
    scenario.set("vibration.peaks", donor.vibration.peaks)
    scenario.update({"telescope": donor.telescope, "vibration": {"peaks": [donor.vibration.peaks[0]]}})
    scenario.vibration.peaks[0].frequency = 1.0
    scenario.telescope.diameter = 1.0
    assert donor == Scenario()


def test_refused_dictionaries_change_nothing_by_path() -> None:
    scenario = Scenario()
    with pytest.raises(SettingError, match=r"^telescope\.diameter"):
        scenario.set("telescope", {"diameter": -1})
    with pytest.raises(SettingError, match=r"^vibration\.peaks\.1\.damping"):
        scenario.set("vibration.peaks", [{"frequency": 3.0}, {"damping": 2.0}])
    assert scenario == Scenario()


def test_arrays_of_numpy_are_not_lists() -> None:
    scenario = Scenario()
    scenario.set("telescope.diameter", np.float64(3.5))
    assert scenario.telescope.diameter == 3.5
    with pytest.raises(SettingError):
        scenario.set("butterworth.frequencies", np.array([10.0, 20.0]))
    with pytest.raises(SettingError):
        scenario.set("telescope.diameter", np.array(3.5))


def test_a_new_item_has_all_its_settings_for_the_changes_that_follow() -> None:
    n = len(Scenario().vibration.peaks)
    fresh = Scenario().replace({f"vibration.peaks.{n}.frequency": 45, f"vibration.peaks.{n}.rms.1": 0.05})
    assert fresh.vibration.peaks[n].to_dict() == {**Peak().to_dict(), "frequency": 45.0, "rms": [Peak().rms[0], 0.05]}
