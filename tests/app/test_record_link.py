"""Links of a loaded record: the record by name, SHA-256 and what was said of it; the file from whoever opens the link."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.service import Session
from wfsobs.app.session_file import read_declaration
from wfsobs.app.share import from_query, to_query
from wfsobs.app.sources import NamedRecord
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.columns import ROLES
from wfsobs.telemetry.formats import format_of
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.records import record_arrays
from wfsobs.units import UNITS

SHA256 = 32 * "0a"
DECLARATIONS = st.builds(
    DeclaredFormat,
    st.none() | st.sampled_from(list(UNITS)),
    st.sampled_from([None, 1, -1]),
    st.none() | st.floats(1, 50),
    st.none() | st.floats(1e-3, 9e5),
    st.dictionaries(st.sampled_from([*ROLES, "u"]), st.text(max_size=20).filter(lambda text: text.isprintable()), max_size=4),
    st.booleans(),
    st.none() | st.lists(st.floats(0.1, 3), min_size=1, max_size=3).map(tuple),
    st.none() | st.floats(1e-3, 1e6),
    st.booleans(),
)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(declaration=DECLARATIONS)
def test_what_is_said_of_a_record_survives_a_link(declaration: DeclaredFormat) -> None:
    record = NamedRecord("a night+1.csv", SHA256, declaration)
    query = to_query(PRESETS["ut4"](), "ut4", record=record)
    assert query is not None
    link = from_query(f"?{query}")
    assert (link.record, link.errors, link.scenario) == (record, (), PRESETS["ut4"]())
    assert read_declaration(json.loads(json.dumps(vars(declaration)))) == declaration, "and a session"


@pytest.mark.parametrize(
    ("field", "line"),
    [
        ("record.unit=furlong", "record.unit = furlong: takes one of "),
        ("record.sign=2", "record.sign = 2: takes 1 or -1"),
        ("record.delay=0", "record.delay = 0: takes a number of steps from 1"),
        ("record.delay=one", "record.delay = one: takes a number of steps from 1"),
        ("record.rate=nan", "record.rate = nan: takes a rate above 0 Hz"),
        ("record.column.y_lgs/piston=a", "record.column.y_lgs/piston = a: there is no such part of a record"),
        (f"record.column.u/tip={'a' * 2001}", "record.column.u/tip = aaa"),
        ("record.path=/etc/passwd", "record.path = /etc/passwd: there is no such part of a record"),
        ("record.name=../../etc/passwd", "record.name = ../../etc/passwd: takes the name of a file"),
    ],
)
def test_a_field_that_cannot_be_used_is_named(field: str, line: str) -> None:
    name = "" if field.startswith("record.name") else "record.name=night.csv&"
    link = from_query(f"?{name}record.sha256={SHA256}&{field}&run.seed=7")
    assert len(link.errors) == 1 and link.errors[0].startswith(line)
    expected = "passwd" if not name else "night.csv"
    assert link.record == NamedRecord(expected, SHA256, DeclaredFormat()) and link.scenario.run.seed == 7


@pytest.mark.parametrize("digits", ["", "0a", 64 * "g", 65 * "0"])
def test_without_a_sha256_there_is_no_record(digits: str) -> None:
    link = from_query(f"?record.name=night.csv&record.sha256={digits}")
    assert link.record is None and link.errors == (f"record.sha256 = {digits}: takes 64 hexadecimal digits",)


# ---------------------------------------------------------------------- sessions


def csv_of(scenario: Scenario, seed: int) -> bytes:
    """A file of columns whose names say nothing, with the opposite sign of commands and in nm."""
    record = simulate(scenario.replace({"run.seed": seed, "run.duration": 1.5, "sensors.lgs_rate": 500.0}))
    file = io.StringIO()
    np.savetxt(file, 1e3 * np.column_stack([record.y_lgs, -record.u]), delimiter=",", header="a,b,c,d", comments="")
    return file.getvalue().encode()


def give(dashboard: Dashboard, loop: Any, content: bytes, name: str) -> None:
    dashboard.upload.handle({"action": "part", "name": name, "index": 0, "count": 1, "data": content})
    loop.until(lambda: not dashboard.upload.picker.message.startswith(("Reading", "Waiting")))


@pytest.fixture
def open_dashboard(loop: Any, short: Scenario, enter: Callable[..., Session]) -> Callable[[], Dashboard]:
    def open_it() -> Dashboard:
        dashboard = Dashboard(loop.queue.put, enter(), short)
        loop.closing.append(dashboard)
        dashboard.page()
        return dashboard

    return open_it


def test_a_link_and_its_file_show_what_was_on_screen(open_dashboard: Any, loop: Any, short: Scenario) -> None:
    content, other_content = csv_of(short, 9), csv_of(short, 10)
    one = open_dashboard()
    give(one, loop, content, "night.csv")
    upload = one.upload
    assert upload.form is not None
    upload.fields.unit.value, upload.fields.sign.value = "nm", -1
    upload.fields.rate.value, upload.fields.delay.value = "500", "1"
    roles = dict(zip("abcd", ("y_lgs/tip", "y_lgs/tilt", "u/tip", "u/tilt"), strict=True))
    upload.form.show(dict.fromkeys(roles, ""), {role: name for name, role in roles.items()})
    upload.look()
    loop.until(lambda: not upload.picker.message.startswith(("Reading", "Waiting")))
    upload.confirm()
    assert one.store.change("run.warm_up", 0.4)  # which followed the record
    loop.finish(one.store)
    shown = one.store.run.result
    assert shown is not None and shown.is_recorded
    one.actions._refresh()
    query = one.actions.toolbar.query
    assert "record.name=night.csv" in query and hashlib.sha256(content).hexdigest() in query and one.actions.toolbar.record == ""

    other = open_dashboard()
    other.actions.open_link(f"?{query}")
    picker = other.upload.picker
    assert not other.actions.toolbar.notes and other.store.source is None
    assert picker.source_title.startswith("This link is of the record night.csv (SHA-256 ") and picker.back.startswith("Stay")
    other.actions._refresh()
    assert other.actions.toolbar.query == query, "the address stays the link's"
    give(other, loop, other_content, "another.csv")
    assert f"another.csv is another file: its SHA-256 is {hashlib.sha256(other_content).hexdigest()[:12]}" in picker.source_title
    assert other.store.source is None
    give(other, loop, content, "whatever it is called.csv")
    loop.finish(other.store)
    again = other.store.run.result
    assert again is not None and again.is_recorded and not other.upload.room.visible
    assert again.scenario == shown.scenario and again.source.declaration == shown.source.declaration
    rows = [[(s.observer, s.target, s.mode, s.rms) for s in it.result.scores] for it in (shown, again)]
    assert rows[0] == rows[1] and len(rows[0]) > 10
    assert picker.source_title.startswith("Record ") and picker.back.startswith("Back")


def test_who_stays_with_the_simulation_has_a_link_of_it(open_dashboard: Any) -> None:
    dashboard = open_dashboard()
    dashboard.actions.open_link(f"?record.name=night.csv&record.sha256={SHA256}&run.duration=2")
    dashboard.upload.handle({"action": "simulate"})
    dashboard.actions._refresh()
    assert dashboard.upload.picker.source_title == "" and "record" not in dashboard.actions.toolbar.query


def test_back_to_the_simulation_returns_its_own_length(open_dashboard: Any, loop: Any, short: Scenario) -> None:
    dashboard = open_dashboard()
    before = dashboard.store.scenario
    file = io.BytesIO()
    record = simulate(short.replace({"run.seed": 9, "run.duration": 1.5, "sensors.lgs_rate": 500.0}))
    format_of(".csv").write(file, record_arrays(record))
    give(dashboard, loop, file.getvalue(), "night.csv")
    dashboard.upload.confirm()
    assert dashboard.store.change("run.seed", 4)
    assert dashboard.store.scenario.run.duration == 1.5
    dashboard.upload.handle({"action": "simulate"})
    assert dashboard.store.scenario == before.replace({"run.seed": 4}) and dashboard.store.source is None
