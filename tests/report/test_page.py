"""The file: well formed, closed to the network, every number that of the run, every text escaped."""

from __future__ import annotations

import base64
import hashlib
import re
import shlex
import tomllib
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tests.report.levels import read_levels
from wfsobs import __version__
from wfsobs.app.display import AT_LIMIT
from wfsobs.app.render import hundredths, number
from wfsobs.app.report.data import Grid, Report, state_of
from wfsobs.app.report.page import page
from wfsobs.app.report.sections import command_of
from wfsobs.app.share import FILE, LONGEST
from wfsobs.app.views.traces import word
from wfsobs.evaluation.result import TIME, Result, is_non_causal, row_label, scored_interval, target_title
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import observe, run
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import Variation, from_toml, parse_variation, scenario_from, scenarios
from wfsobs.scenario.groups.events import Event

MADE = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>&\"'"


@pytest.fixture(scope="module")
def report(short: Scenario) -> Report:
    base = short.replace({"loop.gain": 0.4})
    variations = (parse_variation("turbulence.wind_speed=5,15"), parse_variation("loop.gain=0.2,0.4"))
    states = tuple(state_of(run(s, observers=["kf-lgs", "butterworth-ol", "zero"]), 4) for s in scenarios(base, variations))
    return Report("paper", base, variations, states)


@pytest.fixture(scope="module")
def text(report: Report) -> str:
    return page(report, MADE)


def test_it_is_well_formed(text: str, parse: Any) -> None:
    it = parse(text)
    assert text.startswith("<!doctype html>") and ("html", {"lang": "en"}) in it.tags
    assert len(it.data("data")["states"]) == 4


def test_the_policy_lets_nothing_out_and_only_these_scripts_run(text: str, parse: Any) -> None:
    it = parse(text)
    (policy,) = [a["content"] for tag, a in it.tags if tag == "meta" and a.get("http-equiv") == "Content-Security-Policy"]
    rules = {name: values.split() for name, _, values in (rule.strip().partition(" ") for rule in policy.split(";"))}
    assert rules["default-src"] == ["'none'"] and "connect-src" not in rules and "frame-src" not in rules
    run = [body for attributes, body in it.scripts if attributes.get("type") != "application/json"]
    sums = [f"'sha256-{base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()}'" for body in run]
    assert rules["script-src"] == sums and len(run) == 3
    assert rules["img-src"] == ["data:", "blob:"] and rules["base-uri"] == rules["form-action"] == ["'none'"]
    fetching = ("link", "iframe", "base", "object", "embed")
    assert [(tag, a) for tag, a in it.tags if {"src", "srcset", "action"} & set(a) or tag in fetching] == []
    links = [a["href"] for _, a in it.tags if "href" in a]
    assert all(link.startswith(("#line-", "data:application/toml;base64,")) for link in links)
    assert not any(name.startswith("on") for _, a in it.tags for name in a)


def test_the_events_of_a_simulation_are_marked(result: Result, parse: Any) -> None:
    events = [Event(start=1.5, kind="wind", wind_factor=2.0), Event(start=1.2, duration=0.1, kind="laser")]
    scenario = result.scenario.replace({"events": events})
    report = Report("paper", scenario, (), (replace(state_of(result), scenario=scenario),))
    for recorded, of in ((False, sorted(events, key=lambda e: e.start)), (True, [])):
        (state,) = parse(page(replace(report, is_recorded=recorded), MADE)).data("data")["states"]
        assert state["events"]["start"] == [e.start for e in of] and state["events"]["text"] == [word(e, scenario) for e in of]


def test_the_numbers_are_those_of_the_run(report: Report, text: str, parse: Any) -> None:
    """In the file to every digit; in the tables that need no script to three."""
    it = parse(text)
    embedded = it.data("rows")
    assert [state["rows"] for state in embedded] == [state.rows for state in report.states]
    names = [f"Wind speed V₀ {v} m/s, Integrator gain g {g}" for v in (5, 15) for g in (0.2, 0.4)]
    assert [state["state"] for state in embedded] == names and all(name in it.text for name in names)
    tables = [table for table in it.tables if table[0][:2] == ["Observer", "RMS error [nm]"]]
    assert len(tables) == 4
    for table, state in zip(tables, report.states, strict=True):
        title, got = "", {}
        for first, *cells in table[1:]:
            title = (
                title
                if cells or first.startswith(("Prior", "Theoretical"))
                else first.partition(f", {scored_interval(state.rows)}")[0]
            )
            if cells:
                got[title, first] = cells
        want = {}
        own = {("lgs",): "bound", ("lgs", "ngs"): "bound-both"}
        rows = {(row["observer"], row["target"], row["mode"]): row for row in state.rows}
        known = {key: row["interval_um"] for key, row in rows.items() if key[0] in OBSERVERS and key[0] != "zero"}
        least = {
            key: rows[own[OBSERVERS[key[0]].sensors], *key[1:]]["rms_um"] for key in known if OBSERVERS[key[0]].sensors in own
        }
        narrow = {k for k, (low, high) in known.items() if high - low <= 0.5 * rows[k]["rms_um"]}
        limits = {k for k, x in least.items() if OBSERVERS[k[0]].causal and k in narrow and known[k][0] <= x <= known[k][1]}
        for row in state.rows:
            name = row_label(row["observer"]) + (" looks ahead" if is_non_causal(row["observer"]) else "")
            name += f" {AT_LIMIT}" if (row["observer"], row["target"], row["mode"]) in limits else ""
            lag = "–" if row["lag_s"] is None else hundredths(1e3 * row["lag_s"])
            ends = " – ".join(number(1e3 * x) for x in row["interval_um"] or ())
            if ends and row["interval_um"][1] > 10.0 * row["rms_um"]:
                ends = "interval unknown"
            spread = f" {ends} " if ends else ""
            want[f"{target_title(row['target'])}, {row['mode']}", name] = [
                spread + number(1e3 * row["rms_um"]),
                hundredths(row["normalised_rms"]),
                lag,
                hundredths(row[TIME]),
                "–" if row[TIME] is None else hundredths(row[TIME] / 1000.0),
                "–" if row["sd_um"] is None else number(1e3 * row["sd_um"]),
            ]
        plain = {key: [re.sub(r"(smallest|worse than zero) ", "", cell) for cell in cells] for key, cells in got.items()}
        assert plain == want
        assert not any("−0.00" in cells for cells in plain.values()), "a lag of nothing has no sign"
        for key in {title for title, _ in want}:
            others = ("looks ahead", "Theoretical limit")
            causal = {name: c for (title, name), c in got.items() if title == key and not any(o in name for o in others)}
            best = [name for name, cells in causal.items() if "smallest " in cells[0]]
            assert best == [min(causal, key=lambda name: float(causal[name][0].split()[-1]))], "of one record no more than that"
        above = {key for key, cells in got.items() if cells[1].startswith("worse than zero")}
        assert above == {key for key, cells in want.items() if cells[1] != "1.00" and float(cells[1]) > 1}


def test_lines_are_those_of_the_state(report: Report, text: str, parse: Any) -> None:
    data = parse(text).data("data")
    content = zlib.decompress(base64.b64decode(data["arrays"]))
    ends = np.cumsum([0, *data["lengths"]])
    arrays = [content[start:end] for start, end in pairwise(ends)]
    assert len(content) == ends[-1]
    for state, kept in zip(data["states"], report.states, strict=True):
        assert set(state["lines"]) == {name for name in kept.lines if "/" in name}
        for name in ("signal/vibration/truth/tilt", "error/turbulence/kf-lgs/tip", "psd/vibration/butterworth-ol/tip"):
            index, low, step = state["lines"][name]
            levels = read_levels(arrays[index])
            line = np.where(levels > 65534, np.nan, low + step * levels)
            expected = np.log10(kept.lines[name]) if name.startswith("psd") else kept.lines[name]
            np.testing.assert_allclose(line, expected, rtol=0, atol=0.51 * step + 1e-7 * abs(low))
        time = np.frombuffer(arrays[state["axes"]["time"]], dtype="<f4")
        np.testing.assert_allclose(time, kept.grid.times(), rtol=1e-6)


def test_it_says_what_it_is_made_with_and_how_to_make_it_again(report: Report, text: str, parse: Any) -> None:
    it = parse(text)
    assert f"wfsobs {__version__}, Python" in it.text and "2026-03-04 05:06:07 UTC" in it.text and "bokeh 3" in it.text
    command, by_file = command_of(report)
    assert command in it.text and not by_file
    program, verb, out, *words = shlex.split(command)
    assert (program, verb, out) == ("wfsobs", "export", "report.html")
    given = list(zip(words[::2], words[1::2], strict=True))
    values = {option: [v for o, v in given if o == option] for option in ("--preset", "--set", "--vary")}
    assert scenario_from(*values["--preset"], None, tuple(values["--set"])) == report.base
    assert tuple(map(parse_variation, values["--vary"])) == report.variations
    (saved,) = [a["href"] for tag, a in it.tags if tag == "a"]
    toml = base64.b64decode(saved.partition(",")[2]).decode()
    assert from_toml(toml) == report.base and tomllib.loads(toml)["preset"] == "paper" and toml in it.text


def test_settings_too_long_for_a_command_go_by_file(result: Result) -> None:
    base = result.scenario.replace({"vibration.psd.frequency": [1.0 + i / 100 for i in range(3000)]})
    command, by_file = command_of(Report("paper", base, (Variation("loop.gain", (0.1,)),), ()))
    assert by_file and command == f"wfsobs export report.html --config {FILE} --vary loop.gain=0.1" and len(command) < LONGEST


def test_what_changed_is_listed(text: str, parse: Any) -> None:
    (table,) = [table for table in parse(text).tables if table[0][0] == "Setting"]
    assert ["Integrator gain gloop.gain", "0.3", "0.4"] in table
    assert ["Duration [s]run.duration", "10", "2"] in table
    assert len(table) == 1 + 8


def test_the_words_fit_the_report(report: Report, text: str, result: Result, parse: Any) -> None:
    words = " ".join(parse(text).text.split())
    for part in ("no controller can have it", "a baseline and not an observer", "The traces keep every sample", "4 variations"):
        assert part in words
    cut = replace(report.states[0], grid=Grid(2000, 1e-3, 100))
    said = parse(page(replace(report, states=(cut,), variations=()), MADE)).text
    assert "Each trace keeps 700 points" in said and "every sample from 0.750 to 1.249 s" in said
    manual = result.scenario.replace({"kalman.process_noise": "manual", "kalman.measurement_noise": "manual"})
    one = Report("paper", manual, (), (replace(state_of(result), scenario=manual),))
    assert "are given the strength" in words and "are given the strength" not in parse(page(one, MADE)).text


def test_a_run_of_more_modes_has_a_list_of_them(short: Scenario, parse: Any) -> None:
    """The states have tip and tilt, and five modes; the list has the five."""
    variations = (parse_variation("telescope.radial_order=1,2"),)
    states = tuple(state_of(run(s, observers=["kf-lgs", "zero"]), 2) for s in scenarios(short, variations))
    it = parse(page(Report("paper", short, variations, states), MADE))
    modes = [m.name for m in states[1].scenario.modes]
    assert len(modes) == 5 and it.data("data")["modes"] == modes
    assert [a["value"] for tag, a in it.tags if tag == "option"][: len(modes)] == modes
    assert "psd/vibration/kf-lgs/defocus" in it.data("data")["states"][1]["lines"]


def test_errors_are_drawn_over_what_varies_in_numbers(report: Report, text: str, result: Result, parse: Any) -> None:
    data = parse(text).data("data")
    assert data["sweeps"] == {"0": ["Wind speed V₀ [m/s]", [5, 15]], "1": ["Integrator gain g", [0.2, 0.4]]}
    words = (Variation("kalman.process_noise", ("matched", "manual")), Variation("loop.closed", (True, False)))
    it = parse(page(replace(report, variations=words), MADE))
    assert it.data("data")["sweeps"] == {} and "RMS error over a setting" not in it.text
    assert len(it.data("figures")["roots"]) == 4


def test_a_loaded_record_promises_no_simulation(result: Result, parse: Any) -> None:
    record = replace(result.record, turbulence=None, vibration=None)
    state = state_of(observe(record, result.scenario, observers=["kf-lgs", "zero"]))
    said = parse(page(Report("paper", result.scenario, (), (state,), is_recorded=True), MADE)).text
    assert "of a loaded record" in said and f"wfsobs observe RECORD --config {FILE}" in said and "wfsobs export" not in said
    command = "wfsobs observe night.csv --preset paper --sha256 0a1b"
    named = Report("paper", result.scenario, (), (state,), is_recorded=True, command=command)
    it = parse(page(named, MADE))
    said = it.text
    assert "peakspeak in the Kalman filters" not in said and it.data("data")["states"][0]["peaks"] == []
    assert command in said and "RECORD" not in said and "saved as" not in said
    assert {row["target"] for row in state.rows} == {"next z", "residual y"}
    assert "Next measurement, tip" in said
    assert "psd/vibration/kf-lgs/tip" in state.lines and "error/vibration/kf-lgs/tip" not in state.lines


def test_no_text_escapes(result: Result, parse: Any) -> None:
    """Whatever reaches the page as text stays text: reasons, values of settings, names of modes."""
    state = replace(state_of(result), reasons=(HOSTILE,))
    base = result.scenario
    it = parse(page(Report("paper", base, (Variation(HOSTILE, (HOSTILE,)),), (state,)), MADE))
    assert it.text.count(HOSTILE) >= 3
    assert len([tag for tag, _ in it.tags if tag == "script"]) == 6 and not [tag for tag, _ in it.tags if tag == "img"]
    assert HOSTILE[:57] in it.data("rows")[0]["state"]
