"""`control.supervised`: an integrator where a controller would diverge, the controller elsewhere; rows, text and page say so."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from wfsobs.app.display import Display
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.pages.closed_loop import loop_html
from wfsobs.cli import main
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import ClosedLoop, closed_loop, rows
from wfsobs.record import Record
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate

RIGHT = PRESETS["paper"]().replace({"run.duration": 3.0, "control.supervised": True})
WRONG = {"plant.delay_error": 2.0, "plant.gain_error": [0.5, 0.5]}
NAMES = ["integrator", "lqg-kf-lgs", "lqg-multirate-multi"]


@pytest.fixture(scope="module")
def record() -> Record:
    return simulate(RIGHT)


@pytest.fixture(scope="module")
def wrong(record: Record) -> ClosedLoop:
    return closed_loop(record, design(RIGHT.replace(WRONG), NAMES))


def test_on_the_right_plant_it_is_the_controller_from_frame_1000_on(record: Record) -> None:
    safe = closed_loop(record, design(RIGHT, NAMES))
    alone = closed_loop(record, design(RIGHT.replace({"control.supervised": False}), NAMES))
    for one, other in zip(safe.outcomes, alone.outcomes, strict=True):
        assert one.residual is not None and other.residual is not None and one.u is not None
        assert one.alarms == (None if one.controller == "integrator" else ())
        # the difference of both commands dies away as 0.9^k: 1e-9 after 200 frames
        np.testing.assert_allclose(one.residual[1200:], other.residual[1200:], rtol=0, atol=1e-8)
        steps = np.abs(np.diff(one.u[100:], axis=0)).max(axis=1)
        assert steps[895:905].max() <= 3.0 * np.delete(steps, slice(895, 905)).max(), "no bump"


@pytest.mark.slow
def test_where_it_would_diverge_the_integrator_takes_over(record: Record, wrong: ClosedLoop) -> None:
    alone = closed_loop(record, design(RIGHT.replace({**WRONG, "control.supervised": False}), NAMES[1:]))
    assert all(one.residual is None and one.stable == (False, False) for one in alone.outcomes)
    manual = {"control.integrator": "manual", "control.gain": 0.2, "control.supervised": False}
    (integrator,) = closed_loop(record, design(RIGHT.replace({**WRONG, **manual}), ["integrator"])).outcomes
    assert integrator.residual is not None
    for one in wrong.outcomes[1:]:
        assert one.alarms is not None and one.residual is not None and one.stable == (True, True)
        # poles outside the unit circle are noticed within some dozens of frames
        assert 1.0 <= one.alarms[0][0] < 1.2
        if one.controller == "lqg-kf-lgs":  # with the NGS the integrator does not follow the slow error of the LGS
            np.testing.assert_allclose(one.residual[:1000], integrator.residual[:1000], rtol=0, atol=1e-9)
        # in the long run it is the integrator's, which forgets the outburst; the controller is back for some frames
        assert np.median(np.abs(one.residual[1500:])) < 1.5 * np.median(np.abs(integrator.residual[1500:]))


def test_the_rows_the_command_and_the_page_say_when(wrong: ClosedLoop) -> None:
    said = rows(wrong, 1)
    assert all((row["alarms"] is None) == (row["controller"] not in NAMES[1:]) for row in said)
    of = [row for row in said if row["alarms"] is not None]
    assert of and all(row["predicted_rms_nm"] is None and row["phase_margin_deg"] is None for row in of)
    time, reason = of[0]["alarms"][0]
    line = f"Integrator took over at {time:.2f} s: {reason}"
    assert of[0]["note"].startswith(line)
    page = loop_html(LoopResults(wrong, tuple(said)), Display())
    assert line in page and "under supervision" in page
    changes = {"run.duration": 3, "control.supervised": True, **WRONG}
    sets = [word for path, value in changes.items() for word in ("--set", f"{path}={json.dumps(value)}")]
    wanted = ["loop", "--controller", "lqg-kf-lgs", *sets]
    call = CliRunner().invoke(main, [*wanted, "--json"], catch_exceptions=False)
    assert json.loads(call.stdout)[0]["alarms"] == [list(alarm) for alarm in of[0]["alarms"]]
    text = CliRunner().invoke(main, wanted, catch_exceptions=False).stdout
    assert f"LQG, LGS KF: {line}" in text and "under supervision" in text
