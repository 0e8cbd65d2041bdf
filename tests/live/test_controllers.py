"""Controllers beside a live loop: what they leave is what the closed loop leaves on the recording."""

import pickle
import queue

import numpy as np
import pytest

import wfsobs
from tests.patience import wait
from wfsobs.closed_loop.design import design as design_laws
from wfsobs.closed_loop.run import closed_loop, residual_rms
from wfsobs.live.checks import make_design
from wfsobs.live.crew import SEATS, ControlCrew, ControlView, row_width
from wfsobs.live.loop import LiveLoop
from wfsobs.live.ring import LiveFrame
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.scenario.presets import paper
from wfsobs.settings.group import SettingError

pytestmark = pytest.mark.slow

NAMES = ("none", "integrator", "lqg-kf-multi", "lqg-multirate-multi", "integrator+gpr-online")
SMALL = {"run.duration": 2.0, "run.warm_up": 0.5, "gpr_online.training_size": 40, "gpr_online.depth": 10}


def frames_of(record):
    truth = [np.full_like(record.z, np.nan) if x is None else x for x in (record.turbulence, record.vibration)]
    for k in range(record.n_steps):
        yield LiveFrame(0.0, record.z[k], record.z_ngs[k], record.u[k], truth[0][k], truth[1][k])


def rows_of(crew, record):
    return np.array([crew.take(frame, k).copy() for k, frame in enumerate(frames_of(record))])


def crew_of(scenario, names, said=None):
    record = wfsobs.simulate(scenario)
    crew = ControlCrew(record.sampling, round(scenario.run.warm_up / record.dt), (said or queue.Queue()).put)
    for name in names:
        crew.follow({"id": name, "design": make_design(name, scenario.to_dict(), record.sampling)}, 0)
    return crew, record


def test_the_residuals_are_those_of_the_closed_loop():
    """By the batch run over the same record: delay, a fraction of a frame, and a limit of the mirror included."""
    scenario = paper().replace(
        {**SMALL, "control.delay": 2.5, "control.rate": 0.02, "control.integrator": "manual", "control.gain": 0.4}
    )
    crew, record = crew_of(scenario, NAMES)
    view = ControlView(0, record.dt, rows_of(crew, record))
    batch = closed_loop(record, design_laws(scenario, NAMES))
    assert len(batch.outcomes) == len(NAMES)
    for outcome in batch.outcomes:
        # frame by frame and at once are one law; the online GPR differs by rounding in its updates
        np.testing.assert_allclose(
            view.residual(outcome.controller), outcome.residual, rtol=0, atol=1e-7, err_msg=outcome.controller
        )
        left = residual_rms(outcome, record, scenario.run.warm_up)
        assert view.rms_since_start(outcome.controller) == pytest.approx(left, rel=1e-5)
    assert np.isnan(view.rms("lqg-kf-lgs")).all() and np.isnan(view.rms_since_start("lqg-kf-lgs")).all()


def test_open_loop_measurements_give_the_commands_of_the_closed_one():
    """A sensor in the loop sees z and what the mirror does; NGS frames see the mean of it since the last one."""
    scenario = paper().replace(SMALL)
    for name in ("integrator", "lqg-multirate-multi"):
        one, other = (wfsobs.design(name, scenario) for _ in range(2))
        z, slow = np.random.default_rng(1).normal(size=(2, 300, 2))
        seen = np.zeros((301, 2))
        for k in range(300):
            due = k > 0 and k % 5 == 0
            mirror = seen[max(0, k - 4) : k + 1].mean(axis=0)
            u = one.update(z[k] + seen[k], slow[k] + mirror if due else None)
            seen[k + 1] = one.correction
            v = other.update_open_loop(z[k], slow[k] if due else None)
            assert v == pytest.approx(u, rel=1e-9, abs=1e-12)


def test_without_truth_the_residual_is_what_the_sensor_would_have_seen():
    scenario = paper().replace(SMALL)
    crew, record = crew_of(scenario, ("integrator",))
    blind = wfsobs.Record(y_lgs=record.y_lgs, u=record.u, dt=record.dt, y_ngs=record.y_ngs, ratio=record.ratio)
    view = ControlView(0, record.dt, rows_of(crew, blind))
    batch = closed_loop(record, design_laws(scenario, ["integrator"])).outcomes[0]
    noise = record.z[1:] - (record.turbulence + record.vibration)[:-1]
    # y[k] = phi_res[k-1] + w[k]
    np.testing.assert_allclose(view.residual("integrator")[1:], batch.residual[:-1] + noise, rtol=0, atol=1e-9)


def test_controllers_survive_the_way_to_another_process():
    """All that run frame by frame, in the middle of a run: the same commands follow."""
    scenario = paper().replace({**SMALL, "gpr_offline.training_size": 40, "gpr_offline.depth": 10})
    z, slow = np.random.default_rng(2).normal(size=(2, 120, 2))
    for name in SEATS:
        one = wfsobs.design(name, scenario)
        for k in range(60):
            one.update_open_loop(z[k], slow[k] if k > 0 and k % 5 == 0 else None)
        other = pickle.loads(pickle.dumps(one))
        for k in range(60, 120):
            due = slow[k] if k % 5 == 0 else None
            np.testing.assert_array_equal(other.update_open_loop(z[k], due), one.update_open_loop(z[k], due), err_msg=name)
        assert one.correction.any() == (name != "none")


def test_controllers_come_and_go_and_take_over():
    said = queue.Queue()
    scenario = paper().replace(SMALL)
    crew, record = crew_of(scenario, ("lqg-kf-multi",), said)
    frames = list(frames_of(record))
    rows = [crew.take(frames[k], k).copy() for k in range(503)]
    crew.follow({"id": "integrator", "design": make_design("integrator", scenario.to_dict(), record.sampling)}, 503)
    crew.follow({"id": "lqg-kf-multi", "design": make_design("lqg-kf-multi", scenario.to_dict(), record.sampling)}, 503)
    rows += [crew.take(frames[k], k).copy() for k in range(503, 900)]
    crew.follow({"id": "lqg-kf-multi", "design": None}, 900)
    rows += [crew.take(frames[k], k).copy() for k in range(900, 1000)]
    view = ControlView(0, record.dt, np.array(rows))
    assert np.isnan(view.residual("integrator")[:505]).all() and not np.isnan(view.residual("integrator")[505:]).any()
    batch = closed_loop(record, design_laws(scenario, ["lqg-kf-multi"])).outcomes[0]
    np.testing.assert_allclose(view.residual("lqg-kf-multi")[:900], batch.residual[:900], rtol=0, atol=1e-9)
    assert np.isnan(view.residual("lqg-kf-multi")[900:]).all()
    assert [event.line for event in said.queue] == [
        "lqg-kf-multi on", "lqg-kf-multi has a new design", "integrator on", "lqg-kf-multi off",
    ]  # fmt: skip
    assert not crew.is_idle and row_width(2) == 1 + 5 * len(SEATS)


def test_controllers_beside_a_loop_that_runs():
    scenario = paper().replace({"run.warm_up": 0.2})
    loop = LiveLoop(SimulatedLoop(scenario), scenario, ["persistence"], speed=2.0)
    try:
        assert loop.control_view(1.0) is None
        with pytest.raises(SettingError, match="no such observer or controller"):
            loop.control("no-such-controller", True)
        loop.play()
        for name in ("integrator", "none"):
            loop.control(name, True)
        wait(lambda: loop.control_view(5.0) is not None and all(known(loop, name) > 700 for name in ("integrator", "none")))
        loop.pause()
        wait(lambda: loop.control_view(5.0).first + len(loop.control_view(5.0).residual("none")) >= loop.newest)
        seen, frames = loop.control_view(600.0), loop.view(600.0)
        n = min(len(seen.residual("none")), frames.n)
        total = (frames.truth("turbulence") + frames.truth("vibration"))[:n]
        on = ~np.isnan(seen.residual("none")[:n, 0])
        # without control the residual is the disturbance
        np.testing.assert_array_equal(seen.residual("none")[:n][on], total[on])
        assert (seen.rms("integrator") < 0.5 * seen.rms("none")).all()
        assert loop.controllers == {"integrator", "none"} and len(loop._processes.processes) == 5
        loop.control("none", False)
        wait(lambda: "none off" in [event.line for event in loop.events])
    finally:
        loop.stop()


def known(loop, name):
    return (~np.isnan(loop.control_view(5.0).residual(name)[:, 0])).sum()


WRONG = {"plant.delay_error": 2.0, "plant.gain_error": [0.5, 0.5]}


def test_supervised_and_on_a_wrong_plant_they_are_those_of_the_closed_loop():
    """With the alarms as events; what would diverge is switched off."""
    scenario = paper().replace({**SMALL, "run.duration": 3.0, "control.supervised": True, **WRONG})
    record = wfsobs.simulate(scenario)
    names = ["integrator", "lqg-kf-multi", "lqg-multirate-multi"]
    said = queue.Queue()
    crew = ControlCrew(record.sampling, 500, said.put)
    for name in names:
        crew.follow({"id": name, "design": make_design(name, scenario.to_dict(), record.sampling)}, 0)
    view = ControlView(0, record.dt, rows_of(crew, record))
    events = [said.get() for _ in range(said.qsize())]
    for outcome in closed_loop(record, design_laws(scenario, names)).outcomes:
        told = [event for event in events if event.about == outcome.controller]
        taken = [(event.frame * record.dt, event.detail) for event in told if event.what.startswith("integrator")]
        assert taken == [(pytest.approx(time), f": {reason}") for time, reason in outcome.alarms or ()]
        if outcome.residual is not None:
            np.testing.assert_allclose(view.residual(outcome.controller), outcome.residual, rtol=0, atol=1e-9)
    assert {event.about for event in events if event.kind == "ALARM"} >= set(names[1:])


def test_what_diverges_is_switched_off_and_a_supervised_one_is_not():
    scenario = paper().replace({**SMALL, **WRONG})
    record, said = wfsobs.simulate(scenario), queue.Queue()
    crew = ControlCrew(record.sampling, 500, said.put)
    crew.follow({"id": "lqg-kf-lgs", "design": make_design("lqg-kf-lgs", scenario.to_dict(), record.sampling)}, 0)
    rows = rows_of(crew, record)
    words = [event.line for event in (said.get() for _ in range(said.qsize()))]
    assert words == ["lqg-kf-lgs on", "lqg-kf-lgs off", "ALARM lqg-kf-lgs diverges"] and crew.is_idle
    assert np.isnan(ControlView(0, record.dt, rows[-1:]).residual("lqg-kf-lgs")).all()


def test_what_ends_in_an_error_is_switched_off_and_the_others_go_on(monkeypatch):
    said = queue.Queue()
    crew, record = crew_of(paper().replace(SMALL), ("integrator", "lqg-kf-lgs"), said)
    law, frames = crew._waiting["lqg-kf-lgs"].controller.law, iter(range(300))
    monkeypatch.setattr(law, "command", lambda *_: {k: np.zeros(2) for k in range(299)}[next(frames)])
    rows = rows_of(crew, record)
    view = ControlView(0, record.dt, rows)
    assert np.isfinite(view.residual("integrator")).all()
    assert np.isnan(view.residual("lqg-kf-lgs")[299:]).all() and np.isfinite(view.residual("lqg-kf-lgs")[:299]).all()
    words = [event.line for event in said.queue][2:]
    assert words == ["lqg-kf-lgs off", "ALARM lqg-kf-lgs: KeyError: 299"]


def test_a_new_design_goes_on_with_the_mirror_where_it_is():
    scenario = paper().replace(
        {**SMALL, "run.duration": 2.5, "control.supervised": True, "plant.resonance": 400.0, "plant.hysteresis": 0.1}
    )
    record = wfsobs.simulate(scenario)
    rows = []
    for swaps in ((), (1200,)):
        crew = ControlCrew(record.sampling, 500, queue.Queue().put)
        for k, frame in enumerate(frames_of(record)):
            if k in (0, *swaps):
                crew.follow({"id": "lqg-kf-lgs", "design": make_design("lqg-kf-lgs", scenario.to_dict(), record.sampling)}, k)
            rows.append(crew.take(frame, k).copy())
    alone, swapped = (ControlView(0, record.dt, np.array(part)).residual("lqg-kf-lgs") for part in np.array_split(rows, 2))
    np.testing.assert_allclose(swapped, alone, rtol=0, atol=1e-12)
