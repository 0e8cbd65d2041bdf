"""What a visitor may ask for: refused in one line, beside the setting, before anything runs."""

from __future__ import annotations

import logging
from dataclasses import fields
from typing import Any

import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.limits import NONE, PUBLIC, Limits
from wfsobs.app.serve import Options, SecurityHeaders, full_html, options, origins
from wfsobs.app.service import Full, Service
from wfsobs.app.share import from_query, to_file
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.cli.serve import serve
from wfsobs.cost import run_bytes, run_seconds
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS, paper
from wfsobs.settings.values import SettingError


def refused(limits: Limits, changes: dict[str, Any]) -> str:
    """Why a change of the paper's settings is refused, or nothing."""
    try:
        limits.check(paper().replace(changes))
    except SettingError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"run.duration": 121}, "run.duration = 121: at most 120 s on this server"),
        (
            {"run.duration": 61, "sensors.lgs_rate": 2000},
            "run.duration = 61: 122000 steps at sensors.lgs_rate = 2000 Hz; at most 120000 on this server",
        ),
        ({"gpr_offline.training_size": 1025}, "gpr_offline.training_size = 1025: at most 1024 on this server"),
        ({"gpr_online.training_size": 2048}, "gpr_online.training_size = 2048: at most 1024 on this server"),
        ({"gpr_online.depth": 1001}, "gpr_online.depth = 1001: at most 1000 on this server"),
        ({"vibration.psd.tip": [0.0] * 101}, "vibration.psd.tip: 101 entries, at most 100 on this server"),
        ({"turbulence.psd.frequency": [0.0] * 101}, "turbulence.psd.frequency: 101 entries, at most 100 on this server"),
    ],
)
def test_one_line_says_what_and_how_much(changes: dict[str, Any], line: str) -> None:
    assert refused(PUBLIC, changes) == line
    assert refused(NONE, changes) == ""


@pytest.mark.parametrize("preset", list(PRESETS))
def test_the_presets_are_allowed(preset: str) -> None:
    PUBLIC.check(PRESETS[preset]())


@settings(deadline=None)
@given(
    st.floats(2.0, 3600.0),
    st.sampled_from([10.0, 500.0, 1000.0, 20_000.0, 100_000.0]),
    st.integers(2, 2048),
    st.integers(1, 2000),
    st.integers(2, 2048),
)
def test_what_is_allowed_is_within_every_bound(duration: float, rate: float, m: int, depth: int, offline: int) -> None:
    changes = {
        "run.duration": duration,
        "sensors.lgs_rate": rate,
        "gpr_online.training_size": m,
        "gpr_online.depth": depth,
        "gpr_offline.training_size": offline,
    }
    scenario = paper().replace(changes)
    within = (
        duration <= PUBLIC.duration
        and round(duration * rate) <= PUBLIC.steps
        and max(m, offline) <= PUBLIC.training_size
        and depth <= PUBLIC.depth
        and run_seconds(scenario) <= PUBLIC.seconds
        and run_bytes(scenario) <= 1e6 * PUBLIC.megabytes
    )
    line = refused(PUBLIC, changes)
    assert (line == "") == within and "\n" not in line


def test_the_whole_run_is_bounded_where_each_setting_is_not() -> None:
    expected = run_seconds(PRESETS["paper"]().replace({"run.duration": 100}))
    line = refused(Limits(seconds=3), {"run.duration": 100})
    assert line.startswith(f"The run would take about {expected:.0f} s, at most 3 on this server")
    assert refused(Limits(megabytes=50), {}).startswith("The run would take about 108 MB of memory, at most 50")


def test_a_loaded_record_is_bounded() -> None:
    Limits(steps=100).check_steps(100)
    with pytest.raises(SettingError, match="The record has 101 steps; at most 100 on this server"):
        Limits(steps=100).check_steps(101)


# ---------------------------------------------------------------------- every way in


@pytest.fixture
def store(loop: Any, short: Scenario, enter: Any) -> Store:
    store = Store(loop.queue.put, enter(limits=Limits(duration=30)), short)
    loop.closing.append(store)
    return store


def test_a_field_says_it_and_the_settings_stand(store: Store) -> None:
    assert not store.change("run.duration", 31)
    assert store.errors == {"run.duration": "run.duration = 31: at most 30 s on this server"}
    assert store.scenario.run.duration == 2.0 and store.run.state == "idle"
    with pytest.raises(SettingError, match="at most 30 s"):
        store.load(paper().replace({"run.duration": 40}))


def test_a_link_and_a_file_say_it(loop: Any, short: Scenario, enter: Any) -> None:
    dashboard = Dashboard(loop.queue.put, enter(limits=Limits(duration=30)), short)
    loop.closing.append(dashboard)
    actions = dashboard.actions
    actions.open_link("?run.duration=31&turbulence.wind_speed=20")
    assert actions.toolbar.notes == ["Not used from the link: run.duration = 31: at most 30 s on this server"]
    assert dashboard.store.scenario.turbulence.wind_speed == 20.0, "the rest of the link is used"
    before = dashboard.store.scenario
    actions.open_file("mine.toml", to_file(paper().replace({"run.duration": 31}), "paper"))
    loop.until(lambda: "mine.toml" in str(actions.toolbar.notes))
    assert actions.toolbar.notes == ["mine.toml: run.duration = 31: at most 30 s on this server"]
    assert dashboard.store.scenario is before


def test_links_are_limited_only_where_asked() -> None:
    assert from_query("?run.duration=500").errors == ()


def test_a_service_refuses_what_has_passed_by_the_page(short: Scenario) -> None:
    def never(*_: Any) -> RunResults:
        raise AssertionError

    service = Service(Limits(duration=1.0), 1, 0, never)
    try:
        with pytest.raises(SettingError, match="at most 1 s"):
            service.run(short)
    finally:
        assert service.close(20)


# ---------------------------------------------------------------------- the server


def test_no_more_sessions_than_may_be(caplog: Any) -> None:
    caplog.set_level(logging.INFO, "wfsobs.serve")
    service = Service(Limits(sessions=2), 1, 0)
    try:
        first, _ = service.enter(), service.enter()
        assert service.full
        with pytest.raises(Full, match="2 visitors"):
            service.enter()
        first.leave()
        first.leave()
        assert service.sessions == 1, "one who leaves twice has left once"
        service.enter()
    finally:
        assert service.close(20)
    events = [record.getMessage().split()[0] for record in caplog.records]
    assert events == ["session-start", "session-start", "refused", "session-end", "session-start"]
    assert "&lt;b&gt;" in full_html("<b>")


@pytest.mark.parametrize(
    ("given", "limited"),
    [
        ({}, False),
        ({"address": "127.0.0.1"}, False),
        ({"address": "::1"}, False),
        ({"address": "0.0.0.0"}, True),
        ({"address": "ao.example.org"}, True),
        ({"origins": ("ao.example.org",)}, True),
        ({"address": "0.0.0.0", "public": False}, False),
        ({"public": True}, True),
    ],
)
def test_limits_are_on_unless_only_this_machine_reaches_the_page(given: dict[str, Any], limited: bool) -> None:
    assert options(**given).limits == (PUBLIC if limited else NONE)


def test_every_limit_has_a_flag() -> None:
    names = ["duration", "training_size", "depth", "seconds", "sweep_seconds", "live_seconds", "megabytes", "sessions"]
    flags = {"max_memory" if name == "megabytes" else f"max_{name}": i for i, name in enumerate(names, start=1)}
    limits = options(**flags).limits
    assert [getattr(limits, name) for name in names] == list(flags.values())
    assert {f.name for f in fields(Limits)} - {"steps", "items"} == set(names)
    given = {option.name for option in serve.params}
    assert set(flags) <= given


def test_pages_come_from_where_the_server_is_reached() -> None:
    assert origins(Options(port=5007)) == ["127.0.0.1:5007", "localhost:5007"]
    assert origins(Options(address="10.0.0.5", origins=["ao.example.org"])) == [
        "10.0.0.5:5006",
        "127.0.0.1:5006",
        "ao.example.org",
        "localhost:5006",
    ]


@pytest.mark.parametrize(
    ("embedders", "ancestors"), [((), "'none'"), (("https://a.org", "http://b:80"), "https://a.org http://b:80")]
)
def test_only_the_pages_named_may_show_this_one_in_a_frame(embedders: tuple[str, ...], ancestors: str) -> None:
    transform = SecurityHeaders(embedders, HTTPServerRequest(start_line=RequestStartLine("GET", "/", "HTTP/1.0")))
    _, headers, _ = transform.transform_first_chunk(200, HTTPHeaders(), b"", True)
    assert headers["Content-Security-Policy"] == f"frame-ancestors {ancestors}"


@pytest.mark.parametrize(
    "origin", ["example.org", "https://a.org; script-src *", "https://a.org\nX: y", "*", "https://a.org/page"]
)
def test_an_origin_that_is_none_is_refused(origin: str) -> None:
    said = CliRunner().invoke(serve, ["--embed", origin])
    assert said.exit_code == 2
    assert "is no origin; it takes https://HOST[:PORT] or http://HOST[:PORT]" in said.output


@pytest.mark.parametrize("host", ["http://x/", "a b", "x:y", ""])
def test_a_host_that_is_none_is_refused(host: str) -> None:
    said = CliRunner().invoke(serve, ["--origin", host])
    assert said.exit_code == 2 and "is no origin; it takes HOST[:PORT]" in said.output
