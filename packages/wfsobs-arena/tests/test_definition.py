"""The definition: two dozen scenarios, records that do not repeat, identities that follow what they are made of."""

from __future__ import annotations

from pathlib import Path

import pytest
from wfsobs_arena.cases import SimulatedCase
from wfsobs_arena.definition import FILE, load_arena
from wfsobs_arena.tracks import TRACKS, Track, add_track

from wfsobs.settings.values import SettingError
from wfsobs.simulation.disturbance import period_steps

WHOLE = load_arena()


def test_every_record_is_a_short_part_of_its_synthesis() -> None:
    assert 24 <= len(WHOLE.cases) <= 30
    for case in WHOLE.cases:
        n = case.scenario.n_steps
        assert case.scenario.vibration.synthesis == "gaussian" and period_steps(case.scenario, n) >= 8 * n, case.name


def test_every_track_but_that_of_telemetry_has_scenarios() -> None:
    assert [track for track in TRACKS if not any(c.track == track for c in WHOLE.cases)] == ["next"]


def test_records_are_known_by_settings_and_seed() -> None:
    case = WHOLE.cases[0]
    assert isinstance(case, SimulatedCase)
    ids = [case.record_id(seed) for seed in case.seeds]
    assert len(set(ids)) == len(ids) == 8
    other = SimulatedCase(case.track, case.name, "", case.seeds, case.scenario.replace({"sensors.lgs_noise": 0.021}))
    assert other.record_id(case.seeds[0]) != ids[0] and other.digest != case.digest


def test_what_entries_are_told_counts_as_well() -> None:
    of = {case.name: case for case in WHOLE.cases if case.track == "closed-loop"}
    assert of["ut4"].digest != of["late"].digest  # the records are the same, the mirror is not


@pytest.mark.slow
def test_fewer_seeds_are_the_first_ones_of_the_same_arena() -> None:
    few, all_ = load_arena(seeds=3), WHOLE
    assert few.digest == all_.digest and list(few.cases[0].seeds) == list(all_.cases[0].seeds)[:3]


@pytest.mark.parametrize(
    ("text", "instead", "said"),
    [
        ('track = "events"', 'track = "event"', "track 'event' is not one of vibration, turbulence"),
        ("memory = 4.0", "memory = 4.0\nprize = 1", "arena.prize: takes version, seeds"),
        ('name = "ut4-floor"', 'name = "ut4"', "two scenarios of a track have one name"),
        ('"vibration.synthesis" = "gaussian"', '"vibration.synthesis" = "random-phase"', "a synthesis 8 times as long"),
    ],
)
def test_a_definition_that_cannot_be_is_refused(tmp_path: Path, text: str, instead: str, said: str) -> None:
    path = tmp_path / "arena.toml"
    path.write_text(FILE.read_text().replace(text, instead))
    with pytest.raises(SettingError, match=said):
        load_arena(path)


def test_a_track_is_added_once() -> None:
    with pytest.raises(ValueError, match="the id is taken"):
        add_track(Track("vibration", "Again", "vibration", ("lgs",), ""))
