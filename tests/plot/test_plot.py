"""Figures by their data and as pictures: an element has the numbers of the result, labels have units, both backends draw it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import holoviews as hv
import numpy as np
import pytest
from bokeh.embed import json_item
from bokeh.models import Plot
from click.testing import CliRunner
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import wfsobs
from wfsobs.campaign.sweep import SweepResults, parse_axis, plan_sweep, run_sweep
from wfsobs.cli import main
from wfsobs.closed_loop.envelope import PlantEnvelope
from wfsobs.closed_loop.run import ClosedLoop, residual_rms
from wfsobs.evaluation.exact_errors import cumulative_rms, spectra
from wfsobs.identification.result import Identification
from wfsobs.observers import OBSERVERS
from wfsobs.plot.elements import BINS, save_figure, to_matplotlib
from wfsobs.plot.figures import plots_of
from wfsobs.plot.looks import look
from wfsobs.plot.paper import NUMBERS, draw_paper_figure, observers_in, samples_of
from wfsobs.record import Estimate
from wfsobs.signal.spectrum import psd

SHORT = {"run.duration": 3.0, "gpr_offline.training_size": 30, "gpr_online.training_size": 30}
SCENARIO = wfsobs.PRESETS["paper"]().replace(SHORT)
ARGUMENTS = [word for path, value in SHORT.items() for word in ("--set", f"{path}={value}")]


@pytest.fixture(scope="module")
def result() -> wfsobs.Result:
    return wfsobs.run(SCENARIO, observers=["kf-lgs", "kf-ngs", "multirate", "kf-multi", "gpr-online", "zero"])


@pytest.fixture(scope="module")
def record(result: wfsobs.Result) -> wfsobs.Record:
    return result.record


@pytest.fixture(scope="module")
def envelope() -> PlantEnvelope:
    return wfsobs.plant_envelope(SCENARIO, controllers=["integrator", "lqg-kf-lgs"], points=100)


@pytest.fixture(scope="module")
def loop() -> ClosedLoop:
    return wfsobs.close_loop(SCENARIO, controllers=["none", "integrator", "lqg-kf-lgs"])


@pytest.fixture(scope="module")
def found(result: wfsobs.Result) -> Identification:
    return wfsobs.identify(result.record)


def sweep_over(*axes: str) -> SweepResults:
    plan = plan_sweep(SCENARIO.replace({"run.duration": 2.0}), [*map(parse_axis, axes)], 3, ["kf-lgs", "kf-multi", "zero"])
    return run_sweep(plan)


@pytest.fixture(scope="module")
def sweep() -> SweepResults:
    return sweep_over("turbulence.wind_speed=20,5,12.5")


@pytest.fixture(scope="module")
def field() -> SweepResults:
    return sweep_over("turbulence.wind_speed=5,20", "sensors.lgs_noise=0.01,0.02")


SOURCES = {
    wfsobs.Record: "record",
    wfsobs.Result: "result",
    Identification: "found",
    SweepResults: "sweep",
    ClosedLoop: "loop",
    PlantEnvelope: "envelope",
}
"""What has figures -> the fixture that is one."""

PLOTS: dict[str, Callable[..., Any]] = {
    **{
        f"{source} {method}": lambda it, source=source, method=method: getattr(it(source).plot, method)()
        for kind, source in SOURCES.items()
        for method in vars(plots_of.registry[kind])
        if not method.startswith("_")
    },
    "record tilt": lambda it: it("record").plot.spectra(mode="tilt"),
    "error traces": lambda it: it("result").plot.traces(of_error=True, target="vibration", start=1.0, stop=2.0),
    "measured": lambda it: it("found").plot.spectra(it("record")),
    "map": lambda it: it("field").plot.errors(),
    **{name: lambda it, name=name: it(name) for name in NUMBERS},
}


def test_everything_that_has_figures_is_drawn_here() -> None:
    assert SOURCES.keys() == plots_of.registry.keys() - {object}
    with pytest.raises(TypeError, match="no figures of int"):
        plots_of(3)


@pytest.fixture
def drawn(request: pytest.FixtureRequest) -> Callable[[str], Any]:
    return lambda name: paper_figure(name, request) if name in NUMBERS else request.getfixturevalue(name)


def paper_figure(name: str, request: pytest.FixtureRequest) -> Any:
    return draw_paper_figure(name, request.getfixturevalue("of_paper"))


@pytest.fixture(scope="module")
def of_paper() -> wfsobs.Result:
    return wfsobs.run(SCENARIO, observers=[o for name in NUMBERS for o in observers_in(name)])


def curves(figure: Any) -> dict[str, Any]:
    return {curve.label: curve for curve in figure.traverse(lambda x: x, [hv.Curve])}


def test_traces_are_the_numbers_of_the_result(result: wfsobs.Result) -> None:
    record, estimate = result.record, result.estimate("gpr-online", "vibration")
    assert record.vibration is not None and estimate is not None
    lines = curves(result.plot.traces(target="vibration", mode="tilt", start=1.0, stop=1.5))
    part = slice(1000, 1500)
    for label, values in (("Truth", record.vibration), ("Online GPR", estimate.values)):
        np.testing.assert_array_equal(lines[label].dimension_values(1), 1e3 * values[part, 1])
        np.testing.assert_array_equal(lines[label].dimension_values(0), record.dt * np.arange(1000, 1500))
    errors = curves(result.plot.traces(target="vibration", of_error=True, start=1.0, stop=1.5))
    assert "Truth" not in errors
    error = 1e3 * (estimate.values - record.vibration)[part, 0]
    np.testing.assert_array_equal(errors["Online GPR"].dimension_values(1), error)


def test_a_record_is_drawn_with_its_own_numbers(record: wfsobs.Record) -> None:
    traces, densities = curves(record.plot.traces(mode="tilt", start=1.0, stop=1.5)), curves(record.plot.spectra(mode="tilt"))
    for label, signal in (("Pseudo-open-loop LGS", record.z), ("Residual LGS", record.y_lgs), ("Vibration", record.vibration)):
        assert signal is not None
        np.testing.assert_array_equal(traces[label].dimension_values(1), 1e3 * signal[1000:1500, 1])
        expected = 1e6 * psd(signal[:, 1:], record.dt)[1][1:, 0]
        np.testing.assert_array_equal(densities[label].dimension_values(1), expected)


def test_an_envelope_is_drawn_with_its_own_numbers(envelope: PlantEnvelope) -> None:
    lines = curves(envelope.plot.residuals(over="gain", controllers=["integrator"], mode="tilt"))
    at, mean, most = envelope.curves("gain", 1)["integrator"]
    assert list(lines) == ["Integrator", "Integrator, worst"]
    for line, values in zip(lines.values(), (mean, most), strict=True):
        np.testing.assert_array_equal(line.dimension_values(0), at[np.isfinite(mean)])
        np.testing.assert_array_equal(line.dimension_values(1), 1e3 * values[np.isfinite(mean)])


def test_long_traces_keep_their_extremes(result: wfsobs.Result) -> None:
    lines = curves(result.plot.traces(target="turbulence", observers="kf-lgs"))
    assert lines.keys() == {"LGS KF", "Truth"}
    truth = result.record.turbulence
    assert truth is not None
    drawn = lines["Truth"].dimension_values(1)
    assert drawn.size == 2 * BINS < len(truth)
    assert (drawn.min(), drawn.max()) == (1e3 * truth[:, 0].min(), 1e3 * truth[:, 0].max())


def test_spectra_are_those_of_the_scores(result: wfsobs.Result) -> None:
    estimate = result.estimate("kf-lgs", "vibration")
    assert estimate is not None
    known = spectra(result.record, "vibration", estimate.values, SCENARIO.run.warm_up)
    assert known is not None
    frequency, signal, error = known
    line = curves(result.plot.spectra(target="vibration", mode="tilt"))["LGS KF"]
    np.testing.assert_array_equal(line.dimension_values(0), frequency[1:])
    np.testing.assert_allclose(line.dimension_values(1), 1e6 * signal[1:, 1], rtol=1e-12)  # one column or two at once
    line = curves(result.plot.cumulative(target="vibration"))["LGS KF"]
    np.testing.assert_allclose(line.dimension_values(1), 1e3 * cumulative_rms(frequency[1:], error[1:, 0]), rtol=1e-12)


def test_bars_are_the_scores_and_their_intervals(result: wfsobs.Result) -> None:
    figure = result.plot.errors(target="vibration")
    (bars,) = figure.traverse(lambda x: x, [hv.Rectangles])
    (ends,) = figure.traverse(lambda x: x, [hv.Segments])
    scores = sorted((s for s in result.scores if (s.target, s.mode) == ("vibration", "tip")), key=lambda s: s.rms)
    np.testing.assert_array_equal(bars.dimension_values(2), [1e3 * s.rms for s in scores])
    np.testing.assert_array_equal(ends.dimension_values(0), [1e3 * s.interval[0] for s in scores if s.interval])
    colours = list(bars.dimension_values(4))
    assert colours == [look(s.observer).light for s in scores]


def test_bars_are_seen_where_an_interval_is_wide(result: wfsobs.Result) -> None:
    """Of a second of turbulence the scatter is hardly known: it is up to thousands of times the rms."""
    wide = [replace(s, interval=(0.01 * s.rms, 100.0 * s.rms)) for s in result.scores]
    for scores, is_cut in ((wide, True), (result.scores, False)):
        figure = replace(result, scores=scores).plot.errors(target="vibration")
        longest = max(1e3 * s.rms for s in scores if (s.target, s.mode) == ("vibration", "tip"))
        low, high = to_matplotlib(figure).axes[0].get_xlim()
        assert (low, high) == ((0.0, 2.0 * longest) if is_cut else (low, high)) and longest < high <= 2.0 * longest


def pixels(paper: Any) -> np.ndarray:
    """(height, width, 3) colours of a picture, from the bottom."""
    canvas = FigureCanvasAgg(paper)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[::-1, :, :3].astype(float)


def plain_picture(axes: Any, elements: Iterable[Any]) -> np.ndarray:
    """Colours of axes in the same place on which Matplotlib alone draws the numbers of the elements."""
    paper = Figure(figsize=axes.figure.get_size_inches(), dpi=axes.figure.dpi)
    plain = paper.add_axes(axes.get_position())
    plain.set(**{name: getattr(axes, f"get_{name}")() for name in ("xscale", "yscale", "xlim", "ylim")})
    plain.axis("off")
    for element in elements:
        style = hv.Store.lookup_options("matplotlib", element, "style").kwargs
        look = {key: style[key] for key in ("color", "linewidth", "linestyle", "marker", "s", "alpha") if key in style}
        x, y, *rest = (element.dimension_values(dimension) for dimension in element.dimensions())
        match element:
            case hv.Curve():
                plain.plot(x, y, **look)
            case hv.Segments():
                plain.plot([x, rest[0]], [y, rest[1]], **look)
            case hv.Spread():
                plain.fill_between(x, y - rest[0], y + rest[1], **look)
            case hv.Scatter():
                plain.scatter(x, y, linewidth=0, zorder=2, **look)
            case hv.Rectangles():
                for x0, y0, x1, y1, colour in zip(x, y, *rest, strict=True):
                    plain.fill([x0, x1, x1, x0], [y0, y0, y1, y1], facecolor=colour, linewidth=0)
            case hv.HeatMap():
                edges = [np.append(of - np.ptp(of) / 2, of[-1] + np.ptp(of) / 2) for of in map(np.unique, (x, y))]
                plain.pcolormesh(*edges, rest[0].reshape(2, 2).T, cmap=style["cmap"], alpha=style["alpha"])
    return pixels(paper)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLOTS)
def test_both_backends_draw_every_figure(name: str, drawn: Callable[[str], Any]) -> None:
    """By Bokeh on axes of the figure's own labels, with units; by Matplotlib in one column."""
    figure = PLOTS[name](drawn)
    overlays = figure.traverse(lambda x: x, [hv.Overlay])
    state = hv.renderer("bokeh").get_plot(figure).state
    made = [m for m in state.references() if isinstance(m, Plot)]
    assert len(made) == len(overlays)
    for one in made:
        labels = " ".join(str(axis.axis_label) for axis in (*one.xaxis, *one.yaxis))
        assert one.renderers and ("[" in labels or name in ("map", "loop nyquist")), labels
    assert json_item(state)["doc"]  # what a page holds of it
    paper = to_matplotlib(figure)
    check_layout(name, paper, len(overlays))
    check_picture(paper, overlays)


def check_layout(name: str, paper: Any, count: int) -> None:
    """So many plots whose labels have units, in one column, with nothing cut off."""
    paper.draw_without_rendering()  # which places its axes
    assert paper.get_size_inches()[0] == pytest.approx(88.0 / 25.4)  # as it is set, to rounding
    axes = [a for a in paper.axes if a.get_subplotspec() is not None]
    assert len(axes) == count
    for one in axes:
        labels = one.get_xlabel() + one.get_ylabel()
        assert "[" in labels or name in ("map", "loop nyquist"), labels
        box = one.get_tightbbox()
        assert box.x0 >= -1.0 and box.x1 <= paper.bbox.width + 1.0  # a pixel: nothing is cut off
        label = one.yaxis.label.get_window_extent()
        assert box.y0 >= -1.0 and max(box.y1, label.y1) <= paper.bbox.height + 1.0


def check_picture(paper: Any, overlays: Iterable[Any]) -> None:
    """The numbers where they are: inside the axes, as Matplotlib alone draws them.

    But for 2 % of what is not white, where markers and edges are rounded. Moved by three pixels, the picture with the most area
    and the least outline differs in 3 %.
    """
    paper.set_dpi(200)
    every = [axes for axes in paper.axes if axes.get_subplotspec() is not None]
    for axes in every:
        axes.grid(False)
        for text in [*axes.texts]:
            text.remove()
    picture = pixels(paper)
    for axes, overlay in zip(every, overlays, strict=True):
        x0, y0, x1, y1 = np.round(axes.get_window_extent().extents).astype(int)
        inside = np.s_[y0 + 4 : y1 - 4, x0 + 4 : x1 - 4]  # pixels beside the axes' lines
        plain, shown = plain_picture(axes, overlay)[inside], picture[inside]
        ink = np.count_nonzero((plain < 250.0).any(axis=2))

        def differs(other: np.ndarray, plain: np.ndarray = plain) -> int:
            return int(np.count_nonzero(np.abs(other - plain).max(axis=2) > 64.0))

        assert ink > 1000
        assert differs(shown) < 0.02 * ink < differs(np.roll(shown, 3, axis=0))


def test_a_budget_adds_up_to_the_error(result: wfsobs.Result) -> None:
    figure = result.plot.budget(observers=["kf-lgs"], target="vibration")
    (bars,) = figure.traverse(lambda x: x, [hv.Rectangles])
    (score,) = (s for s in result.scores if (s.observer, s.target, s.mode) == ("kf-lgs", "vibration", "tip"))
    assert bars.dimension_values(2)[-1] == pytest.approx(1e6 * score.rms**2, rel=1e-9)  # of sums of thousands of samples


def test_the_loop_is_drawn_with_its_own_numbers(loop: ClosedLoop) -> None:
    (bars,) = loop.plot.errors(mode="tilt").traverse(lambda x: x, [hv.Rectangles])
    left = [residual_rms(it, loop.record, loop.design.start) for it in loop.outcomes]
    np.testing.assert_array_equal(bars.dimension_values(2), sorted(1e3 * rms[1] for rms in left if rms))
    outcome = loop.outcomes[1]
    assert outcome.residual is not None
    density = psd(outcome.residual[round(loop.design.start / loop.record.dt) :], loop.record.dt)[1]
    line = curves(loop.plot.residuals())[look(outcome.controller).label]
    np.testing.assert_array_equal(line.dimension_values(1), 1e6 * density[1:, 0])
    rejection = curves(loop.plot.rejection())["Integrator"].dimension_values(1)
    gain = curves(loop.plot.nyquist())["Integrator"]
    L = gain.dimension_values(0) + 1j * gain.dimension_values(1)
    np.testing.assert_allclose(rejection, -20 * np.log10(np.abs(1 + L)), atol=1e-6)  # E = 1 / (1 + L), L up to 1e4


def test_the_model_is_drawn_over_what_was_measured(found: Identification, result: wfsobs.Result) -> None:
    lines = curves(found.plot.spectra(result.record, mode="tilt"))
    model = lines["Model"]
    expected = 1e6 * found.modes[1].spectrum.psd(model.dimension_values(0))
    np.testing.assert_array_equal(model.dimension_values(1), expected)
    z = result.record.z[result.record.delay :]
    np.testing.assert_array_equal(lines["Measured"].dimension_values(1), 1e6 * psd(z, result.record.dt)[1][1:, 1])


@pytest.mark.parametrize("lost", [0.1, 0.3])
def test_what_was_measured_is_drawn_without_gaps_and_outliers(found: Identification, record: wfsobs.Record, lost: float) -> None:
    rng, y = np.random.default_rng(4), record.y_lgs.copy()
    y[rng.random(y.shape) < lost] = np.nan
    y[rng.integers(10, len(y), 5 if lost < 0.2 else 0)] += 3.0  # with more lost, 3 s are too few to tell outliers
    drawn = curves(found.plot.spectra(replace(record, y_lgs=y)))["Measured"]
    frequency, density = drawn.dimension_values(0), drawn.dimension_values(1)
    whole = 1e6 * psd(record.z[record.delay :, 0], record.dt)[1][1:]
    for low, high in ((1.0, 10.0), (80.0, 150.0), (150.0, 300.0), (400.0, 500.0)):
        band = (low < frequency) & (frequency < high)
        # The mean over 70 Hz and 3 s scatters by 7 %, and what is drawn of it is that of another record: three times that.
        assert density[band].mean() == pytest.approx(whole[band].mean(), rel=0.2)


def test_a_sweep_is_drawn_with_its_own_numbers(sweep: SweepResults, field: SweepResults) -> None:
    """From the least value to the highest, in whatever order they are given."""
    figure = sweep.plot.errors(target="turbulence")
    errors = [sweep.error(i, ("kf-lgs", "turbulence", "tip")) for i in (1, 2, 0)]
    for drawn in (curves(figure)["LGS KF"], figure.traverse(lambda x: x, [hv.Spread])[0]):
        np.testing.assert_array_equal(drawn.dimension_values(0), [5.0, 12.5, 20.0])
        np.testing.assert_array_equal(drawn.dimension_values(1), [1e3 * error[0] for error in errors if error])
    (names,) = field.plot.errors().traverse(lambda x: x, [hv.Labels])
    best = [field.winner(i, "vibration", "tip") for i in range(4)]
    assert {text.split("\n")[0] for text in names.dimension_values("best")} == {look(it.name).label for it in best if it}


@pytest.mark.slow
def test_a_sweep_over_words_has_them_as_ticks() -> None:
    """One after the other, by both backends."""
    lines = sweep_over("turbulence.source=ar2,ar3,none").plot.errors()
    assert [tick.get_text() for tick in to_matplotlib(lines).axes[0].get_xticklabels()] == ["ar2", "ar3", "none"]
    (made,) = hv.renderer("bokeh").get_plot(lines).state.xaxis
    assert made.major_label_overrides == {0.0: "ar2", 1.0: "ar3", 2.0: "none"} and made.axis_label == "turbulence.source"
    grid = sweep_over("sensors.lgs_noise=0.01,0.02", "loop.closed=true,false").plot.errors()
    axes = to_matplotlib(grid).axes[0]
    assert [tick.get_text() for tick in axes.get_yticklabels()] == ["True", "False"]
    assert axes.get_xlabel() == "sensors.lgs_noise [µm]"
    (field,) = grid.traverse(lambda x: x, [hv.HeatMap])
    x, y, _ = (field.dimension_values(i) for i in range(3))
    assert {*zip(x, y, strict=True)} == {(0.01, 0.0), (0.01, 1.0), (0.02, 0.0), (0.02, 1.0)}


def test_a_paper_figure_is_the_result(of_paper: wfsobs.Result) -> None:
    """Its zoomed plot has every sample of half a second."""
    figure = draw_paper_figure("paper-4", of_paper)
    zoomed = list(figure)[1]
    estimate = of_paper.estimate("butterworth-ol", "vibration")
    first, last = samples_of(of_paper.record, SCENARIO.run.warm_up)["zoomed"]
    assert estimate is not None and last - first == 500
    lines = curves(zoomed)
    assert lines.keys() == {"Filtered vibration, open loop", "Real vibration"}
    np.testing.assert_array_equal(lines["Filtered vibration, open loop"].dimension_values(1), estimate.values[first:last, 0])


def test_plots_of_the_paper_that_a_record_has_nothing_for_are_left_out(record: wfsobs.Record) -> None:
    """The one of tilt of a record of one mode, spectra of ten samples after the warm-up."""
    tip = wfsobs.Record(y_lgs=record.y_lgs[:, :1], u=record.u[:, :1], dt=record.dt)
    for name, of, scenario, count in (
        ("paper-5", tip, SCENARIO, 1),
        ("paper-6", record, SCENARIO.replace({"run.warm_up": 2.99}), 2),
    ):
        assert len(draw_paper_figure(name, wfsobs.observe(of, scenario, observers=["kf-lgs"]))) == count


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "suffix"), [*((name, "pdf") for name in NUMBERS), *(("paper-5", suffix) for suffix in ("svg", "png", "pgf", "html"))]
)
def test_a_paper_figure_is_written_as_every_kind_of_file(name: str, suffix: str, of_paper: wfsobs.Result, tmp_path: Path) -> None:
    path, figure = tmp_path / f"figure.{suffix}", draw_paper_figure(name, of_paper)
    if suffix == "pgf" and not shutil.which("xelatex"):
        with pytest.raises(wfsobs.SettingError, match="PGF needs LaTeX"):
            save_figure(figure, path)
        return
    save_figure(figure, path)
    with pytest.raises(wfsobs.SettingError, match=r"takes a width and a height from 20 to 1000 mm, not -5 and 0"):
        save_figure(figure, path, width=-5.0)
    content = path.read_bytes()
    begins = {"pdf": b"%PDF", "svg": b"<?xml", "png": b"\x89PNG", "pgf": b"%% Creator", "html": b"<!DOCTYPE html>"}[suffix]
    assert content.startswith(begins)
    if suffix == "pdf":  # 88 mm in points, and a TrueType font inside
        assert b"/MediaBox [ 0 0 249.44" in content and b"/FontFile2" in content


@pytest.mark.slow
def test_the_command_draws_from_a_record_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert CliRunner().invoke(main, ["run", *ARGUMENTS, "--observer", "zero", "--save", "own.npz"]).exit_code == 0
    done = CliRunner().invoke(main, ["figure", "paper-5", "--record", "own.npz", "--out", "own.pdf"])
    assert done.exit_code == 0, done.output
    assert Path("own.pdf").read_bytes().startswith(b"%PDF")
    bare = np.load("own.npz")
    np.savez("bare.npz", y_lgs=bare["y_lgs"], u=bare["u"], dt=bare["dt"])  # no open loop, NGS, training or truth
    for name in NUMBERS:
        done = CliRunner().invoke(main, ["figure", name, "--record", "bare.npz", "--out", f"{name}.pdf"])
        assert (done.exit_code, "left out" in done.output) == (0, True), done.output
    for out, why in (("own.doc", "is written as"), ("nowhere/own.pdf", "No such file")):
        refused = CliRunner().invoke(main, ["figure", "paper-5", "--out", out, *ARGUMENTS])
        assert refused.exit_code == 2 and why in refused.output and "Traceback" not in refused.output


@pytest.mark.slow
def test_what_is_composed_keeps_its_units_and_a_title_its_place(result: wfsobs.Result) -> None:
    """The title stands with the legend of a column, not under it."""
    both = result.record.plot.traces() * result.record.plot.traces(mode="tilt")
    for figure in (both, both.opts(title="Night", clone=True, backend="matplotlib")):
        (axes,) = to_matplotlib(figure).axes
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "tip [nm]")
    legend = axes.get_legend()
    assert legend is not None and (legend.get_title().get_text(), axes.get_title()) == ("Night", "")


@pytest.mark.slow
def test_what_is_composed_begins_a_row_where_it_does_not_fit(result: wfsobs.Result) -> None:
    """At 40 mm each, bars with their names at 80 mm; nothing is cut off."""
    traces, bars = result.plot.traces() + result.plot.spectra(), result.plot.errors() + result.plot.budget()
    for figure, width, columns in ((traces, 88.0, 2), (traces, 180.0, 4), (bars, 88.0, 1), (bars, 180.0, 2)):
        paper = to_matplotlib(figure, width)
        paper.draw_without_rendering()  # which warns where there is no room
        for axes in paper.axes:
            place = axes.get_subplotspec()
            assert place is not None and place.get_gridspec().ncols == columns
            box = axes.get_tightbbox()
            assert box is not None and box.x0 >= -1.0 and box.x1 <= paper.bbox.width + 1.0  # a pixel


def test_a_line_alone_is_named_once(result: wfsobs.Result) -> None:
    """In the legend, not by a title as well."""
    alone = result.plot.traces(target="vibration", observers=["kf-lgs"], of_error=True)
    (axes,) = to_matplotlib(alone).axes
    legend = axes.get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["LGS KF"]
    assert axes.get_title() == legend.get_title().get_text() == ""
    (made,) = (m for m in hv.renderer("bokeh").get_plot(alone).state.references() if isinstance(m, Plot))
    assert made.title.text == ""  # type: ignore[union-attr]


def test_spectra_of_nothing_are_zero() -> None:
    """Without a logarithmic axis, which they would not be on."""
    axes = to_matplotlib(wfsobs.Record(y_lgs=np.zeros((100, 1)), u=np.zeros((100, 1)), dt=1e-2).plot.spectra()).axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "linear")
    assert all(not np.any(line.get_ydata()) for line in axes.lines)


def test_two_columns_have_legends_beside(result: wfsobs.Result) -> None:
    paper = to_matplotlib(result.plot.traces(), 180.0, 100.0)
    assert tuple(25.4 * paper.get_size_inches()) == pytest.approx((180.0, 100.0))
    assert all(axes.get_legend() for axes in paper.axes)


@pytest.mark.slow
@pytest.mark.parametrize("width", [88.0, 180.0])
def test_a_legend_of_all_observers_has_room(width: float, result: wfsobs.Result) -> None:
    truth = result.record.vibration
    assert truth is not None
    estimates = tuple(Estimate(o.id, "vibration", truth, 0.0) for o in OBSERVERS.values() if "vibration" in o.targets)
    paper = to_matplotlib(replace(result, estimates=estimates).plot.spectra(target="vibration"), width)
    paper.savefig(BytesIO())
    legend, own = paper.axes[0].get_legend().get_window_extent(), paper.bbox
    assert len(estimates) > 15 and own.y0 <= legend.y0 and legend.y1 <= own.y1 and legend.x1 <= own.x1
    assert paper.axes[0].get_position().height * own.height / paper.dpi > 0.8  # inches: the plot keeps its height


@pytest.mark.slow
def test_legends_of_all_observers_do_not_cover_each_other_in_a_notebook(result: wfsobs.Result) -> None:
    truths = {"turbulence": result.record.turbulence, "vibration": result.record.vibration}
    estimates = tuple(Estimate(o.id, of, x, 0.0) for o in OBSERVERS.values() for of, x in truths.items() if x is not None)
    page = hv.renderer("matplotlib").get_plot(replace(result, estimates=estimates).plot.traces()).state
    page.savefig(BytesIO())
    above, below = (axes.get_legend().get_window_extent() for axes in page.axes)
    assert above.y0 > below.y1


def test_what_cannot_be_drawn_is_one_line(
    result: wfsobs.Result, loop: ClosedLoop, envelope: PlantEnvelope, sweep: SweepResults
) -> None:
    for draw, why in (
        (lambda: result.plot.traces(mode="focus"), "mode 'focus': there are tip, tilt"),
        (lambda: result.plot.spectra(target="noise"), "target 'noise': there are turbulence, vibration"),
        (lambda: result.plot.traces(observers="kf"), "observer 'kf': there are kf-lgs, "),
        (lambda: result.plot.traces(observers=["gpr-online"], target="turbulence", of_error=True), "no estimate of turbulence"),
        (lambda: result.plot.errors(target="noise"), "there is no error of noise"),
        (lambda: result.plot.traces(start=2.0, stop=2.0), "from 2 s to 2 s: the record has 3 s"),
        (lambda: result.record.plot.traces(start=-1.0), "from -1 s to 3 s: the record has 3 s"),
        (lambda: loop.plot.rejection(controllers=["none"]), "there is no time-invariant loop"),
        (lambda: loop.plot.residuals(controllers=["pid"]), "controller 'pid': there are none, integrator, lqg-kf-lgs"),
        (lambda: loop.plot.nyquist(controllers=["pid"]), "controller 'pid': there are none, integrator, lqg-kf-lgs"),
        (lambda: envelope.plot.residuals(controllers=["pid"]), "controller 'pid': there are integrator, lqg-kf-lgs"),
        (lambda: sweep.plot.errors(observers=["kf"]), "observer 'kf': there are kf-lgs, kf-multi"),
        (
            lambda: wfsobs.Record(y_lgs=np.zeros((15, 1)), u=np.zeros((15, 1)), dt=0.1).plot.spectra(),
            "no spectrum of fewer than 16 samples",
        ),
    ):
        with pytest.raises(ValueError, match=why):
            draw()


@pytest.mark.slow
def test_without_holoviews_the_extra_is_named() -> None:
    code = (
        "import sys; sys.modules['holoviews'] = None\nimport wfsobs\n"
        "record = wfsobs.simulate(wfsobs.Scenario().replace({'run.duration': 2.0}))\n"
        "try: record.plot\nexcept ImportError as error: print(error)\n"
        "print(sorted({'holoviews', 'matplotlib', 'bokeh', 'wfsobs.plot'} & {n for n, m in sys.modules.items() if m}))\n"
    )
    said = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.splitlines()
    assert said[0].endswith("pip install wfsobs[plot]")


def test_arrays_are_those_of_the_result(result: wfsobs.Result) -> None:
    data, record = result.to_xarray(), result.record
    assert dict(data.sizes) == {"time": record.n_steps, "mode": 2, "observer": 6}
    assert list(data.mode.values) == ["tip", "tilt"] and data.time.attrs["units"] == "s"
    for e in result.estimates:
        here = data[f"{e.target}_estimate"].sel(observer=e.observer)
        assert here.attrs["units"] == "um"
        np.testing.assert_array_equal(here, e.values)
    assert np.isnan(data["vibration_estimate"].sel(observer="kf-ngs")).all()  # which has none
    np.testing.assert_array_equal(data["vibration"], record.vibration)
    np.testing.assert_array_equal(record.to_xarray()["y_lgs"].sel(mode=3), record.y_lgs[:, 1])


def test_arrays_of_a_sweep(field: SweepResults) -> None:
    data = field.to_xarray()
    assert data["turbulence.wind_speed"].attrs == {"units": "m/s"} and data["rms"].attrs == {"units": "um"}
    assert data["rms"].dims == ("turbulence.wind_speed", "sensors.lgs_noise", "observer", "target", "mode")
    for cell, changes in enumerate(field.sweep.cells):
        for key in field.known_keys():
            known = field.error(cell, key)
            here = data.sel({**changes, **dict(zip(("observer", "target", "mode"), key, strict=True))})
            assert known == tuple(float(here[name]) for name in ("rms", "low", "high"))


def test_arrays_of_a_sweep_over_lists_have_them_as_text() -> None:
    swept, key = sweep_over("vibration.peaks=[{frequency=20}],[{frequency=30}]"), ("kf-lgs", "vibration", "tip")
    where = {"vibration.peaks": "[{frequency = 30}]", **dict(zip(("observer", "target", "mode"), key, strict=True))}
    here = swept.to_xarray().sel(where)
    assert swept.error(1, key) == tuple(float(here[name]) for name in ("rms", "low", "high"))


def test_an_identification_is_a_table(found: Identification) -> None:
    frame = found.to_dataframe()
    peaks = frame[(frame["mode"] == "tip") & frame["what"].isin(["line", "resonance"])]
    assert list(peaks["frequency_hz"]) == [p.frequency.value for p in found.modes[0].peaks]
    html = found._repr_html_()
    assert html.count("<tr>") == len(frame) + 1 and "<td>white noise</td>" in html


def test_a_closed_loop_is_a_table(loop: ClosedLoop) -> None:
    """A row per controller and mode with the rms of its residual, and one per bound."""
    frame = loop.to_dataframe().set_index(["controller", "mode"])
    for outcome in loop.outcomes:
        left = residual_rms(outcome, loop.record, loop.design.start)
        assert left == pytest.approx(
            [1e-3 * frame.loc[(outcome.controller, mode), "residual_rms_nm"] for mode in ("tip", "tilt")]
        )
    assert set(frame.index.get_level_values(0)) == {o.controller for o in loop.outcomes} | loop.design.bounds.keys()


def test_without_xarray_the_extra_is_named(result: wfsobs.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"^xarray is not installed: pip install wfsobs\[arrays\]$"):
        result.to_xarray()
