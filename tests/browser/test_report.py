"""The report from disk, without a network: every state's numbers, the switches, the keyboard, without JavaScript."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from playwright.sync_api import Browser, Locator, Page, expect

import wfsobs
from tests.browser.conftest import PATIENCE, until
from wfsobs.app.display import UNITS, per_micrometre
from wfsobs.app.render import hundredths, number
from wfsobs.app.report.page import STEP
from wfsobs.app.style import TERM_COLOURS
from wfsobs.app.work import TRUTH
from wfsobs.cli import main
from wfsobs.evaluation.exact_errors import cumulative_rms, spectra
from wfsobs.evaluation.result import is_unknown, row_label
from wfsobs.observers.base import TARGETS

SETTINGS = {
    "run.duration": 2.0,
    "run.warm_up": 0.5,
    "gpr_online.training_size": 20,
    "gpr_offline.training_size": 50,
    "gpr_online.depth": 20,
    "gpr_offline.depth": 20,
    "adaptive.window": 0.5,
}
SHORT = [word for path, value in SETTINGS.items() for word in ("--set", f"{path}={value}")]
SPEEDS, GAINS = (5, 15), (0.2, 0.3)
START = (1, 1)
"""The settings as they are, among the variations."""

TABLE = """() => Object.fromEntries([...document.querySelectorAll("#table tbody:not([hidden])")].flatMap(body =>
    [...body.querySelectorAll("tr[data-observer]")].map(tr =>
        [`${body.dataset.target}/${tr.dataset.observer}`, [...tr.cells].map(c => c.textContent.trim())])))"""

LINES = """() => Object.fromEntries([...document.querySelectorAll(".lines input")].map(it =>
    [`${it.closest("[data-target]").dataset.target}/${it.name}`, it.parentElement.querySelector("output").textContent]))"""
"""Target/name -> the error beside the line."""

LINE = """([figure, name]) => {
  const it = Bokeh.documents[0].get_model_by_name(figure)
  const line = it.renderers.find(r => r.name === name)
  const data = line.data_source.data
  return {y: [...data[name]].map(v => Number.isFinite(v) ? v : null), x: [...data.x], visible: line.visible,
          label: it.left[0].axis_label, range: [it.x_range.start, it.x_range.end], colour: line.glyph.line_color.value}
}"""

VIOLATIONS = """async () => (await axe.run(document, {resultTypes: ["violations"]})).violations
    .flatMap(v => v.nodes.map(n => [v.id, n.html.slice(0, 300), (n.any[0] ?? n.all[0] ?? n.none[0])?.message ?? ""]))"""


OPEN = """() => document.querySelectorAll("details")
    .forEach((it) => { it.open ||= !it.parentElement.querySelector(":scope > details[open]") })"""
"""Opens what can be opened; of several beside each other, as the tables of the states, one is enough."""

FITS = "width => document.documentElement.scrollWidth <= width"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "r.html"
    vary = [f"turbulence.wind_speed={','.join(map(str, SPEEDS))}", f"loop.gain={','.join(map(str, GAINS))}"]
    command = [sys.executable, "-m", "wfsobs", "export", str(path), *SHORT, "--vary", vary[0], "--vary", vary[1]]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == done.stderr == ""
    return path


@contextmanager
def opening(browser: Browser, report: Path) -> Iterator[Callable[..., Page]]:
    """A function that opens the report from disk with the network off; a request or an error on the console fails."""
    faults: list[str] = []
    allowed: list[str] = []
    contexts = []

    def open_it(width: int = 1300, **options: Any) -> Page:
        context = browser.new_context(viewport={"width": width, "height": 900}, offline=True, **options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.on("console", lambda m: faults.append(f"console: {m.text}") if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda e: faults.append(f"page: {e}"))
        page.on("request", lambda r: faults.append(f"request: {r.url}") if r.url != report.as_uri() else None)
        page.goto(report.as_uri())
        if options.get("java_script_enabled", True):
            page.locator("#table tbody").first.wait_for()
            until(page, "() => window.Bokeh?.documents?.[0]?.get_model_by_name('spectrum-vibration')")
        return page

    open_it.allowed = allowed  # type: ignore[attr-defined]
    yield open_it
    for context in contexts:
        context.close()
    assert [fault for fault in faults if not any(text in fault for text in allowed)] == []


@pytest.fixture
def open_report(browser: Browser, report: Path) -> Iterator[Callable[..., Page]]:
    """As `opening`, for the pages of one test."""
    with opening(browser, report) as open_it:
        yield open_it


@pytest.fixture(scope="module")
def opened(browser: Browser, report: Path) -> Iterator[Page]:
    """A report that the tests below share."""
    with opening(browser, report) as open_it:
        yield open_it()


RESET = """() => {
  for (const it of document.querySelectorAll("select")) {
    it.value = (it.querySelector("[selected]") ?? it.options[0]).value
    it.dispatchEvent(new Event("change", {bubbles: true}))
  }
}"""


@pytest.fixture
def page(opened: Page) -> Iterator[Page]:
    """That report as it opens."""
    yield opened
    opened.evaluate(RESET)
    slide(opened, *START)


def choose(page: Page, name: str) -> None:
    option = page.locator("option", has_text=re.compile(f"^{re.escape(name)}$"))
    page.locator("select", has=option).select_option(name)


def line(page: Page, figure: str, name: str) -> dict[str, Any]:
    return page.evaluate(LINE, [figure, name])


def box_of(page: Page, name: str) -> Locator:
    """The box that shows or hides the line of an observer of the vibration."""
    return page.locator(f'.lines[data-target=vibration] input[name="{name}"]')


def slide(page: Page, *places: int) -> None:
    for i, place in enumerate(places):
        page.locator(f"#vary-{i}").fill(str(place))


def changes(canvas: Locator, before: bytes) -> None:
    """Wait until a figure looks different."""
    end = time.monotonic() + 60.0
    while canvas.screenshot() == before:
        assert time.monotonic() < end, "as before"


def scenario(speed: float, gain: float) -> wfsobs.Scenario:
    return wfsobs.PRESETS["paper"]().replace({**SETTINGS, "turbulence.wind_speed": speed, "loop.gain": gain})


def test_every_state_shows_the_numbers_of_its_run(page: Page) -> None:
    diameter = scenario(5, 0.2).telescope.diameter
    for (i, speed), (j, gain) in product(enumerate(SPEEDS), enumerate(GAINS)):
        slide(page, i, j)
        said = (
            CliRunner()
            .invoke(main, ["run", *SHORT, "--set", f"turbulence.wind_speed={speed}", "--set", f"loop.gain={gain}", "--json"])
            .stdout
        )
        rows = json.loads(said)
        embedded = json.loads(page.locator("#rows").text_content())[i * len(GAINS) + j]["rows"]
        assert [{k: v for k, v in row.items() if k in rows[0]} for row in embedded] == rows
        for (mode, title), (unit, written) in product((("tip", "Tip"), ("tilt", "Tilt")), UNITS.items()):
            choose(page, title)
            choose(page, written)
            scale = per_micrometre(unit, diameter)
            table, lines = page.evaluate(TABLE), page.evaluate(LINES)
            of_mode = [row for row in rows if row["mode"] == mode]
            assert len(of_mode) == len(table) > 10
            for row in of_mode:
                key = f"{row['target']}/{row['observer']}"
                cells = [re.sub(r"(smallest|worse than zero) ", "", cell) for cell in table[key]]
                assert cells[0].startswith(row_label(row["observer"]))
                error = number(row["rms_um"] * scale)
                ends = " – ".join(number(x * scale) for x in row["interval_um"] or ())
                unknown = bool(ends) and is_unknown(row["rms_um"], row["interval_um"])
                spread = "interval unknown " if unknown else f"{ends} " if ends else ""
                assert cells[1:3] == [spread + error, hundredths(row["normalised_rms"])]
                assert cells[3] == ("–" if row["lag_s"] is None else hundredths(1e3 * row["lag_s"]))
                assert lines.get(key, f"{error} {written}") == f"{error} {written}"
            assert set(lines) - {f"{target}/{TRUTH}" for target in TARGETS} <= set(table)
            assert page.locator("#table .unit").first.text_content() == written


def test_lines_follow_the_switches(page: Page) -> None:
    result = wfsobs.run(scenario(SPEEDS[0], GAINS[0]))
    estimate, truth = result.estimate("kf-lgs", "vibration"), result.record.vibration
    assert estimate is not None and truth is not None
    slide(page, 0, 0)
    choose(page, "Signal")

    def shows(name: str, values: np.ndarray, scale: float) -> dict[str, Any]:
        got = line(page, "trace-vibration", name)
        y = np.array(got["y"], dtype=float)
        assert len(y) == len(got["x"]) == result.record.n_steps, "every sample of a short record"
        np.testing.assert_allclose(y, values * scale, rtol=0, atol=STEP * np.subtract(*np.percentile(values, (75, 25))) * scale)
        return got

    assert shows("kf-lgs", estimate.values[:, 0], 1e3)["label"] == "tip [nm]"
    choose(page, "Tilt")
    shows("truth", truth[:, 1], 1e3)
    choose(page, "Error")
    choose(page, "mas")
    mas = per_micrometre("mas", result.scenario.telescope.diameter)
    assert shows("kf-lgs", (estimate.values - truth)[:, 1], mas)["label"] == "error of tilt [mas]"
    assert all(v is None for v in line(page, "trace-vibration", "truth")["y"])

    power = line(page, "spectrum-vibration", "kf-lgs")
    assert power["label"] == "PSD of error, tilt [mas²/Hz]"
    choose(page, "Cumulative rms")
    summed = line(page, "spectrum-vibration", "kf-lgs")
    assert summed["label"] == "cumulative rms of error, tilt [mas]"
    found = spectra(result.record, "vibration", estimate.values, 0.5)
    assert found is not None
    frequency, _, density = found
    np.testing.assert_allclose(power["y"][:300], density[1:301, 1] * mas**2, rtol=1.2e-3)  # half a step of a logarithm
    total = cumulative_rms(frequency[1:], density[1:])[:, 1]
    at = np.searchsorted(frequency[1:], np.array(summed["x"]) - 1e-3)
    np.testing.assert_allclose(summed["y"], total[at] * mas, rtol=1.2e-3)


def test_errors_over_a_setting(page: Page) -> None:
    rows = [state["rows"] for state in json.loads(page.locator("#rows").text_content())]

    def error(state: int, mode: str) -> float:
        of = ("vibration", "kf-lgs", mode)
        (row,) = [row for row in rows[state] if (row["target"], row["observer"], row["mode"]) == of]
        return 1e3 * row["rms_um"]

    drawn = line(page, "sweep-vibration", "kf-lgs")
    assert drawn["x"] == list(SPEEDS) and drawn["y"] == pytest.approx([error(1, "tip"), error(3, "tip")])
    page.get_by_label("Over").select_option("Integrator gain g")
    choose(page, "Tilt")
    slide(page, 0, 1)
    drawn = line(page, "sweep-vibration", "kf-lgs")
    assert drawn["x"] == list(GAINS) and drawn["y"] == pytest.approx([error(0, "tilt"), error(1, "tilt")])
    assert drawn["label"] == "rms error, tilt [nm]"
    box = box_of(page, "kf-lgs")
    box.uncheck()
    assert not line(page, "sweep-vibration", "kf-lgs")["visible"]
    box.check()


def test_a_box_hides_its_line(page: Page) -> None:
    box = box_of(page, "kf-lgs")
    canvas = page.locator("#trace-vibration")
    page.mouse.move(0, 0)
    until(page, "() => [...Bokeh.index.query((it) => it.model.name === 'trace-vibration')].some((it) => it.has_finished())")
    before = canvas.screenshot()
    box.uncheck()
    page.mouse.move(0, 0)
    assert not line(page, "trace-vibration", "kf-lgs")["visible"]
    assert not line(page, "spectrum-vibration", "kf-lgs")["visible"]
    assert line(page, "trace-turbulence", "kf-lgs")["visible"]
    changes(canvas, before)
    slide(page, 0, 0)
    assert not line(page, "trace-vibration", "kf-lgs")["visible"], "it stays hidden"
    box.press(" ")
    assert line(page, "trace-vibration", "kf-lgs")["visible"]
    expect(box).to_be_focused()


def test_a_zoom_is_of_both_traces(page: Page) -> None:
    assert line(page, "trace-turbulence", "truth")["range"] == [0, 2]
    page.locator("#trace-vibration").scroll_into_view_if_needed()
    box = page.locator("#trace-vibration").bounding_box()
    assert box is not None
    across = [box["x"] + box["width"] * part for part in (0.4, 0.6)]
    page.mouse.move(across[0], box["y"] + 120)
    page.mouse.down()
    page.mouse.move(across[1], box["y"] + 120, steps=3)
    page.mouse.up()
    zoomed = (
        f"() => {{ const [a, b] = ({LINE})(['trace-turbulence', 'truth']).range; return 0.4 < a && a < 1 && 1 < b && b < 1.5 }}"
    )
    until(page, zoomed)  # a drag zooms both
    page.locator("#trace-vibration .bk-tool-icon-reset").click()
    until(page, f"() => ({LINE})(['trace-turbulence', 'truth']).range.join() === '0,2'")


def test_by_keyboard(page: Page) -> None:
    slider = page.get_by_role("slider", name=re.compile("Wind speed"))
    expect(slider).to_have_attribute("aria-valuetext", str(SPEEDS[START[0]]))
    before = page.evaluate(TABLE)
    slider.press("ArrowLeft")
    expect(slider).to_have_attribute("aria-valuetext", "5")
    assert page.evaluate(TABLE) != before
    slider.press("ArrowRight")
    assert page.evaluate(TABLE) == before
    page.get_by_label("Mode").focus()
    page.keyboard.press("ArrowDown")
    expect(page.get_by_label("Mode")).to_have_value("tilt")
    stretch = r", 0\.51 to 2\.00 s"  # the adaptive multi-rate filter estimates after its first window and the first NGS frame
    expect(page.locator("#table th.target").filter(visible=True, has_text="tilt")).to_have_text(
        [
            re.compile(f"^{of}, tilt{stretch}, rms of truth")
            for of in ("Turbulence", "Vibration", "Turbulence and vibration together")
        ]
    )


def test_without_javascript_the_numbers_are_there(open_report: Any) -> None:
    page = open_report(java_script_enabled=False)
    expect(page.get_by_role("heading", name="Scenario")).to_be_visible()
    expect(page.get_by_text("The figures need JavaScript")).to_be_visible()
    expect(page.locator(".controls")).to_be_hidden()
    expect(box_of(page, "kf-lgs")).to_be_hidden()
    shown = page.locator('details[open] table.rms:not(.budget):has(tr[data-observer="kf-ngs"])')
    expect(shown).to_have_count(1)
    result = wfsobs.run(scenario(SPEEDS[START[0]], GAINS[START[1]]), observers=["kf-ngs"])
    for score in (s for s in result.scores if s.observer == "kf-ngs"):
        row = shown.locator(f'tbody[data-target="{score.target}"][data-mode="{score.mode}"] tr[data-observer="kf-ngs"] td').first
        expect(row).to_have_text(re.compile(re.escape(number(1e3 * score.rms)) + "$"))
    other = page.locator("summary", has_text="Wind speed V₀ 5 m/s, Integrator gain g 0.2").first
    other.click()
    expect(shown).to_have_count(2)
    page.get_by_text("Every setting, as TOML").click()
    expect(page.locator("pre", has_text="[gpr_online]")).to_be_visible()


def test_accessible_and_no_wider_than_the_window(open_report: Any) -> None:
    page = open_report(1300, color_scheme="light", bypass_csp=True)
    page.evaluate(OPEN)
    page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
    assert page.evaluate(VIOLATIONS) == []
    until(page, FITS, arg=1300)
    drawn = f"colour => ({LINE})(['trace-vibration', 'kf-lgs']).colour === colour"
    for scheme, colour in (("light", "#FF6600"), ("dark", "#FF8533")):
        page.emulate_media(color_scheme=scheme)
        until(page, drawn, arg=colour)
    assert page.evaluate(VIOLATIONS) == [], "dark"
    page.set_viewport_size({"width": 390, "height": 844})
    until(page, FITS, arg=390)
    assert page.evaluate(VIOLATIONS) == [], "on a phone"


def test_opens_with_the_verdict_and_the_errors_of_the_main_lines(page: Page) -> None:
    expect(page.locator(".box h2").first).to_have_text("Verdict")
    best = page.locator("p.verdict").filter(visible=True)
    expect(best).to_have_text([re.compile(r"^Turbulence, tip\. "), re.compile(r"^Vibration, tip\. ")])
    expect(page.locator(".box h2").nth(1)).to_have_text("Error budget")
    bars = page.locator("table.budget").filter(visible=True).locator("th.target")
    expect(bars).to_have_text(["Turbulence, tip", "Vibration, tip"])
    choose(page, "Tilt")
    expect(best).to_have_text([re.compile(r"^Turbulence, tilt\. "), re.compile(r"^Vibration, tilt\. ")])
    first = line(page, "trace-vibration", "kf-lgs")
    assert first["label"].startswith("error of tilt") and first["visible"]
    assert not line(page, "trace-vibration", "butterworth-cl")["visible"]
    expect(box_of(page, "butterworth-cl")).to_be_hidden()
    page.locator("[data-target=vibration] summary").click()
    box_of(page, "butterworth-cl").check()
    assert line(page, "trace-vibration", "butterworth-cl")["visible"]


def test_on_paper_bars_have_their_colours_and_nothing_is_cut(open_report: Any) -> None:
    page = open_report()
    pdf = page.pdf(format="A4")
    pages = len(re.findall(rb"/Type\s*/Page\b", pdf))
    assert 4 <= pages <= 9, "verdict, budget and figures, the errors of one state of four, closed loop, words"
    parts = re.findall(rb"stream\r?\n(.*?)endstream", pdf, re.S)
    # The end of each stream is found by zlib: its last byte may be that of a line's end.
    drawn = b"".join(zlib.decompressobj().decompress(part) for part in parts if part[:1] == b"x")
    fills = {tuple(map(float, colour)) for colour in re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) rg", drawn)}
    for colour in TERM_COLOURS.values():
        rgb = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        assert any(np.allclose(fill, rgb, atol=0.002) for fill in fills), colour
    page.emulate_media(media="print")
    width = round((210 - 2 * 10) / 25.4 * 96)  # A4 within its margins [px]
    page.set_viewport_size({"width": width, "height": 1000})
    wide = "() => [...document.querySelectorAll('.scroll')].filter(it => it.scrollWidth > it.clientWidth).length"
    until(page, f"width => document.documentElement.scrollWidth <= width && ({wide})() === 0", arg=width)


def test_the_policy_holds(open_report: Any) -> None:
    """A script that got into the page after all could neither run nor call out."""
    open_report.allowed.append("Content Security Policy")
    page = open_report()
    ran = page.evaluate("""async () => {
      const script = document.createElement("script")
      script.textContent = "window.ran = true"
      const refused = new Promise(done => document.addEventListener("securitypolicyviolation", e => done(e.effectiveDirective)))
      document.body.append(script)
      return [await refused, window.ran ?? false]
    }""")
    assert ran == ["script-src-elem", False]


def test_the_button_saves_what_is_shown(open_page: Any, server: Any, tmp_path: Path) -> None:
    link = "&".join(f"{path}={value}" for path, value in SETTINGS.items())
    page = open_page(url=f"{server.url}?{link}&turbulence.wind_speed=22")
    page.get_by_role("button", name="File", exact=True).click()
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Save report").click()
        expect(page.get_by_role("status").filter(has_text="Making the report …")).to_be_visible()
    assert waiting.value.suggested_filename == "wfsobs-report.html"
    path = tmp_path / "r.html"
    waiting.value.save_as(path)
    text = path.read_text(encoding="utf-8")
    (found,) = re.findall(r'id="rows">(.*?)</script>', text)
    rows = json.loads(found)[0]["rows"]
    cells = page.locator('tr[data-target="vibration"] td:nth-child(2)')
    shown = [cell.split()[-1] for cell in cells.all_inner_texts()]  # an interval over seeds comes before
    want = [number(1e3 * row["rms_um"]) for row in rows if (row["target"], row["mode"]) == ("vibration", "tip")]
    assert sorted(shown, key=float) == sorted(want, key=float)
    assert "--set turbulence.wind_speed=22.0" in text


EVENT = ("events.0.kind=wind", "events.0.duration=0.5", "run.duration=6", "run.warm_up=0.5")


def test_traces_begin_where_the_event_of_a_state_is(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "events.html"
    changes = [word for change in EVENT for word in ("--set", change)]
    arguments = ["export", str(path), *changes, "--vary", "events.0.start=2,4", "--observer", "kf-lgs"]
    assert CliRunner().invoke(main, arguments).exit_code == 0
    with opening(browser, path) as open_it:
        page = open_it()
        for place, start in (("0", 1.0), ("1", 3.0), ("0", 1.0)):  # two seconds with the event in the middle
            page.locator("#vary-0").fill(place)
            until(page, f"() => Bokeh.documents[0].get_model_by_name('trace-vibration').x_range.start === {start}")
