"""Events in a live loop: when what changes, over and over, and numbers that are those of the recording."""

import queue

import numpy as np
import pytest

import wfsobs
from wfsobs.live.board import Board
from wfsobs.live.crew import Site
from wfsobs.live.processes import made_crew
from wfsobs.live.ring import LiveFrame, record_of
from wfsobs.live.simulated import STAIR, Programme, SimulatedFrames, endless_blocks
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS, paper
from wfsobs.settings.group import SettingError

TIME = 20.0


def told(scenario, times):
    """Return (time, command) of all that a programme tells, and the programme."""
    out = []
    programme = Programme(scenario, out.append)
    said = []
    for t in times:
        n = len(out)
        programme.play(t)
        said += [(t, command) for command in out[n:]]
    return said, programme


def scenario_of(*events, **changes):
    return paper().replace({"run.duration": TIME, "vibration.synthesis": "gaussian", "events": list(events), **changes})


def test_a_ramp_is_stairs_of_what_the_simulation_has_then_and_comes_again():
    scenario = scenario_of(
        {"kind": "wind", "start": 2.0, "duration": 6.0, "wind_factor": 3.0},
        {"kind": "peak", "start": 4.0, "duration": 8.0, "peak": 14, "frequency_shift": 4.0, "strength": 2.0},
    )
    said, _ = told(scenario, np.arange(0.0, 2.1 * TIME, 0.25))
    wind = {t: Scenario.from_dict(c["settings"]).turbulence.wind_speed for t, c in said}
    # factor 1 + 2 (t - 2) / 6 on the wind of the scenario; at the end of the record all is as it was
    v = scenario.turbulence.wind_speed
    assert [wind[t] / v for t in (4.0, 6.0, 8.0)] == pytest.approx([1 + 2 / 3, 1 + 4 / 3, 3.0])
    assert wind[TIME] == v and wind[TIME + 4.0] == wind[4.0]
    peaks = {t: Scenario.from_dict(c["settings"]).vibration.peaks[14] for t, c in said}
    before = scenario.vibration.peaks[14]
    for t in (6.0, 8.0, 10.0, 12.0):
        part = (t - 4.0) / 8.0
        assert peaks[t].frequency == pytest.approx(before.frequency + 4.0 * part)
        assert peaks[t].rms == pytest.approx([(1 + part) * one for one in before.rms])
        assert peaks[t].damping * peaks[t].frequency == pytest.approx(before.damping * before.frequency)  # the width
    assert min(np.diff(sorted({t for t, _ in said if t < TIME}))) >= STAIR and all(c["is_new"] for _, c in said)
    lines = {t: c["line"] for t, c in said}
    assert lines[2 + 2.0] == f"wind {v * 5 / 3:.3g} m/s" and (
        lines[12.0] == f"peak from {before.frequency:.2f} to {before.frequency + 4:.2f} Hz, {2e3 * max(before.rms):.1f} nm"
    )


def test_lasers_and_frames_fail_and_are_back():
    scenario = scenario_of(
        {"kind": "laser", "start": 1.0, "duration": 4.0, "lasers": 1},
        {"kind": "laser", "start": 2.0, "duration": 1.0, "lasers": 1},
        {"kind": "frames", "start": 8.0, "duration": 4.0, "sensor": "lgs", "share": 0.5},
        {"kind": "frames", "start": 9.0, "duration": 1.0, "sensor": "lgs", "share": 0.5},
        {"kind": "frames", "start": 9.0, "duration": 1.0, "sensor": "ngs", "share": 0.25},
    )
    said, programme = told(scenario, np.arange(0.0, TIME, 0.5))
    seen = [(t, c["settings"]["sensors"]["lgs_count"], c["losses"]["lgs"], c["losses"]["ngs"], c["line"]) for t, c in said]
    assert seen == [
        (1.0, 1, 0.0, 0.0, "1 of 2 lasers"),
        (2.0, 2, 1.0, 0.0, "0 of 2 lasers"),  # nothing is measured: no noise to simulate
        (3.0, 1, 0.0, 0.0, "1 of 2 lasers"),
        (5.0, 2, 0.0, 0.0, "2 of 2 lasers"),
        (8.0, 2, 0.5, 0.0, "50 % of LGS frames lost"),
        (9.0, 2, 0.75, 0.25, "75 % of LGS frames lost, 25 % of NGS frames lost"),
        (10.0, 2, 0.5, 0.0, "50 % of LGS frames lost, all NGS frames"),
        (12.0, 2, 0.0, 0.0, "all LGS frames"),
    ]
    assert programme.present == scenario.before_events


def test_what_is_changed_by_hand_stays_beside_the_events():
    said = []
    scenario = scenario_of({"kind": "frames", "start": 2.0, "duration": 2.0, "sensor": "ngs", "share": 0.5})
    programme = Programme(scenario, said.append)
    programme.lose(True, True, 0.2)
    for t in (1.0, 3.0):
        programme.play(t)
    programme.become(scenario.replace({"turbulence.wind_speed": 30.0}), "by hand")
    programme.play(5.0)
    assert [c["losses"]["ngs"] for c in said] == pytest.approx([0.2, 1 - 0.8 * 0.5, 1 - 0.8 * 0.5, 0.2])
    assert [c["line"] for c in said] == ["20 % of frames lost", "50 % of NGS frames lost", "by hand", "all NGS frames"]
    assert programme.present == scenario.replace({"turbulence.wind_speed": 30.0}).before_events
    with pytest.raises(SettingError, match="at 9 s"):
        programme.become(scenario_of({"kind": "wind", "start": 9.0, "wind_factor": 10.0}), "too much")
    assert len(said) == 4


@pytest.mark.parametrize("preset", list(PRESETS))
def test_every_preset_plays_and_nothing_is_told_without_events(preset):
    scenario = PRESETS[preset]()
    said, programme = told(scenario, np.arange(0.0, scenario.run.duration, 0.2))
    assert bool(said) == bool(scenario.events) and all(c["line"] for _, c in said)
    assert not programme.present.events


def test_wind_needs_turbulence_that_knows_it():
    event = {"kind": "wind", "start": 9.0, "wind_factor": 2.0}
    with pytest.raises(SettingError, match=r"events\.0\.kind = wind: .* no wind of turbulence\.source = processes"):
        Programme(scenario_of(event, **{"turbulence.source": "processes"}), print)


class Maker:
    """What makes the blocks of a simulation, when they are asked for."""

    def __init__(self, scenario):
        self.rng, self.generation = np.random.default_rng(1), 0
        self.blocks = endless_blocks(scenario, self.rng, 4.0)

    def tell(self, command):
        if command["is_new"]:
            self.generation, scenario = self.generation + 1, Scenario.from_dict(command["settings"])
            self.blocks = endless_blocks(scenario, self.rng, 4.0)
        return command

    def get(self):
        return self.generation, next(self.blocks)

    get_nowait = get


@pytest.mark.slow
def test_live_numbers_are_those_of_the_recording():
    scenario = scenario_of(
        {"kind": "wind", "start": 0.5, "wind_factor": 2.0},
        {"kind": "peak", "start": 0.9, "peak": 14, "frequency_shift": 3.0},
        {"kind": "laser", "start": 1.2, "duration": 0.2, "lasers": 2},
        {"kind": "frames", "start": 1.6, "duration": 0.3, "sensor": "lgs", "share": 0.3},
        {"kind": "frames", "start": 2.0, "duration": 0.4, "sensor": "ngs", "share": 0.5},
        **{"run.duration": 2.5, "run.warm_up": 0.3},
    )
    names, told = ("kf-multi", "multirate-multi", "gp-both", "kf-ngs"), scenario.before_events
    maker, board, out = Maker(scenario), Board(2), []
    frames = SimulatedFrames(told, maker)
    programme = Programme(scenario, lambda command: frames.take(maker.tell(command)))
    try:
        site = Site(told.to_dict(), wfsobs.stepping.sampling_of(told), "", "", queue.Queue())
        crew = made_crew(site, board, 0, names)
        for k in range(4000):
            if k % 200 == 0:
                programme.play(k * told.dt)
            row = np.split(frames.next_row(k), 5)
            out.append(LiveFrame(0.0, *row))
            crew.take(out[-1], k)
            crew.settle()
        crew.count()
        record = record_of(LiveFrame(*(np.array(part) for part in zip(*out, strict=True))), told)
        missing = np.isnan(record.z[:, 0])
        # 0.2 s without lasers, then 0.3 of 0.3 s, within 5 standard deviations of the draws; twice but for the NGS
        assert missing[1200:1400].all() and missing[1600:2000].sum() == pytest.approx(120, abs=5 * np.sqrt(400 * 0.21))
        assert not missing[2400:3700].any() and missing[3800:3900].all()
        for score in wfsobs.observe(record, told, observers=list(names), gate=False).scores:
            if score.observer in names:
                live = board[score.observer].rms(score.target)[["tip", "tilt"].index(score.mode)]
                # frame by frame and at once are one algorithm; commands of the recording are summed in another order
                assert live == pytest.approx(score.rms, rel=1e-6), score
    finally:
        board.release()
