"""The preset night, three times as fast: every event is told, and the alarms of each come when they should."""

import numpy as np
import pytest

from tests.live.in_process import LoopInProcess
from tests.live.test_programme import Maker
from wfsobs.live.loop import Shadow
from wfsobs.live.simulated import Programme, SimulatedFrames
from wfsobs.live.source import LiveEvent
from wfsobs.scenario.presets import PRESETS
from wfsobs.stepping import sampling_of

pytestmark = pytest.mark.slow

FASTER = 3.0


def fast_night():
    """Return the night; what it takes to go on to the next second of it is not scaled."""
    night = PRESETS["night"]()
    events = [{**event.to_dict(), "start": event.start / FASTER, "duration": event.duration / FASTER} for event in night.events]
    return night.replace({"run.duration": night.run.duration / FASTER, "events": events})


class Night(LoopInProcess):
    """A live loop on the night."""

    def __init__(self):
        told, self.lines = fast_night(), []
        super().__init__(told.before_events, sampling_of(told), True)
        maker = Maker(self.scenario)
        source = SimulatedFrames(self.scenario, maker)
        programme = Programme(told, lambda command: self.say(source.take(maker.tell(command))))
        shadow = Shadow(self.say, self)
        for k in range(round((told.run.duration + 2.0) / self.sampling.dt)):
            if k % 200 == 0:
                programme.play(k * self.sampling.dt)
                shadow(self)
            self.ring.write(np.concatenate(([0.0], source.next_row(k))))
            self.observe()

    def say(self, what, **fields):
        if what:
            self.lines.append((self.newest * self.sampling.dt, LiveEvent(self.newest, what, **fields).line))


@pytest.fixture
def night(monkeypatch):
    monkeypatch.setattr("wfsobs.live.loop.MINUTE", 60.0 / FASTER)
    night = Night()
    yield night
    night.release()


def is_of_a_weak_peak(line):
    """Whether a line is of the resonances of 2 to 3 nm at 17 and 24 Hz, of which 20 s say little."""
    return "peak" in line and any(10.0 < float(word) < 30.0 for word in line.split() if word[0].isdigit())


def test_what_is_told_of_a_night(night):
    told = [(when, line) for when, line in night.lines if not line.startswith(("ALARM", "over"))]
    assert [line for _, line in told] == [
        "wind 30 m/s",  # a ramp of 2 s is one stair
        "0 of 2 lasers",
        "2 of 2 lasers",
        "wind 15 m/s",
        "10 % of LGS frames lost",
        "all LGS frames",
        "peak from 47.50 to 50.50 Hz, 30.0 nm",
        "50 % of NGS frames lost",
        "all NGS frames",
        "peak at 47.50 Hz, 30.0 nm",
    ]
    starts = [FASTER * when for when, _ in told]
    assert starts == pytest.approx([21, 30, 32, 42, 48, 53, 60, 90, 95, 120], abs=0.2 * FASTER)
    alarms = {}
    for when, line in night.lines:
        if line.startswith(("ALARM", "over")) and not is_of_a_weak_peak(line):
            kind = next(kind for kind in ("LGS", "NGS", "kf-multi", "peak moved") if kind in line)
            alarms.setdefault((line.startswith("ALARM"), kind), []).append(when)
    # a second is judged at its end: that of a gap of 0.7 s or 1.7 s, and the first one that is whole again
    for kind, starts, ends in (("LGS", [11, 17], [12, 19]), ("NGS", [31], [33])):
        assert alarms.pop((True, kind)) == pytest.approx(starts, abs=1.3)
        assert alarms.pop((False, kind)) == pytest.approx(ends, abs=1.3)
    # the line of 30 nm leaves the filter that has it in its model, until it is back
    assert alarms.pop((True, "kf-multi"))[0] == pytest.approx(21.5, abs=1.5)
    alarms.pop((False, "kf-multi"), None)
    assert alarms.pop((True, "peak moved")) == pytest.approx([40], abs=0.3)
    assert not alarms
    (line,) = [line for _, line in night.lines if "peak moved" in line and not is_of_a_weak_peak(line)]
    before, now = (float(word) for word in line.split() if word[0].isdigit())
    # 20 s resolve 0.05 Hz
    assert (before, now) == pytest.approx((47.5, 50.5), abs=0.05)
