"""What every controller leaves of the disturbance shown, and of that of an uncertain plant; how far each is from instability."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from html import escape
from typing import Any, Final

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, DataRange1d, Range1d

from wfsobs.app.display import Display
from wfsobs.app.downloads import residuals_csv, table_csv
from wfsobs.app.glossary import TERMS
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING, Job
from wfsobs.app.loop_work import LoopResults, compute, cost, seconds, uncertain, uncertain_seconds
from wfsobs.app.pages.parts import (
    EDITED,
    SMALL_LABEL,
    TALL,
    WIDE,
    Page,
    Starter,
    box,
    boxes,
    figure_with_caption,
    halves,
    html,
    line,
    render_part,
    text,
    tick,
    zoom_buttons,
)
from wfsobs.app.render import signs
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.share import LOOP, CopiedTask
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.cards import Cards, card_of, error_fields
from wfsobs.app.views.gain_editor import GainEditor, decibel, plane
from wfsobs.app.views.plots import (
    FigureLines,
    PairedLines,
    in_view,
    new_figure,
    new_spectrum,
    on_settle,
    set_ends,
)
from wfsobs.app.views.switches import LineChoice
from wfsobs.closed_loop.envelope import POINTS, PlantEnvelope, Uncertainty
from wfsobs.closed_loop.run import LIMITED, NOT_APPLICABLE, label, loop_verdict, no_theory
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import Row as Score
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.evaluation.verdict import Verdict
from wfsobs.settings.values import SettingError
from wfsobs.signal.envelope import envelope, envelope_times

LINEAR = tuple(c.id for c in CONTROLLERS.values() if c.law and not c.predict)

PLANT_INTRO = (
    f"What the linear controllers, designed for the plant as it is set, leave over {POINTS} others, by theory: with errors of "
    f"delay (±{Uncertainty.delay:g} frames), gain (±{100.0 * Uncertainty.gain:g} %), rotation (±{Uncertainty.rotation:g}°) and, "
    f"where the mirror has one, resonance (±{100.0 * Uncertainty.resonance:g} %), of which they know nothing."
)
PLANT_ABOUT = "The worst plant bold, the mean faint, against the error of the delay; all other errors as they come."


class DelayFigure(PairedLines):
    """The residual against the error of the delay: the worst plant, and the mean."""

    def __init__(self) -> None:
        fig = new_figure((-1.0, 1.0), DataRange1d(only_visible=True), "error of the delay [frames]", "y")
        super().__init__(fig, LINEAR)

    def draw(self, envelope: PlantEnvelope, display: Display) -> None:
        """Send every line."""
        scale = display.scale(envelope.scenario)
        of = envelope.curves("delay", display.column)
        end = envelope.uncertainty.delay
        self.figure.x_range.update(start=-end, end=end)
        self.put_both({name: (x, scale * most, scale * mean) for name, (x, mean, most) in of.items()})
        self.figure.yaxis.axis_label = f"residual {display.mode_label} [{display.unit_label}]"


class UncertainPlant:
    """The box: a button, the figure, and what the page adds to its table and verdict."""

    def __init__(self, store: Store, display: Display):
        self.store, self.display = store, display
        self.work: Final = BackgroundTask(store.session, title="Uncertain plant")
        self.starter: Final = Starter(self.work, self._start, "Compute", "Progress of the uncertain plant")
        self.figure: Final = DelayFigure()
        drawn = figure_with_caption("Residual against delay error", self.figure.figure)
        self.room: Final = pn.Column(drawn, text(PLANT_ABOUT), **WIDE, visible=False)

    def view(self) -> pn.Column:
        """Return the box."""
        return box("Uncertain plant", text(PLANT_INTRO), line(*self.starter.view()), self.starter.status, self.room)

    def _start(self) -> None:
        of = self.store.run.result
        if of is None or isinstance(of.source, LoadedRecord):
            raise SettingError("An envelope takes the true spectra, which only a simulation has.")
        work, cost = partial(uncertain, of.scenario), uncertain_seconds(of.scenario)
        self.work.start(self.store.limits.job("envelope", "uncertain plant", work, cost))

    def forget(self) -> None:
        """Forget what is of other results."""
        self.work.close()
        self.work.param.update(state=IDLE, result=None)

    def draw(self, hidden_names: list[str]) -> None:
        """Draw what there is."""
        envelope: PlantEnvelope | None = self.work.result
        self.room.visible = envelope is not None
        if envelope is not None:
            self.figure.draw(envelope, self.display)
            self.figure.restyle(self.display.dark, hidden_names)


BINS = 600
DECADES = 7
NYQUIST = 2.5
"""How far the Nyquist plot reaches from the origin."""

NONE = "none"
CURVES = tuple(c.id for c in CONTROLLERS.values() if c.law and not c.predict and not c.ngs)
"""Controllers that may have a transfer function."""


class Trace(FigureLines):
    """The residual of every controller over time; that of none would dwarf the rest. seconds : shown of a record at first."""

    def __init__(self, seconds: float):
        self.x_range: Final = Range1d(start=0.0, end=1.0)
        super().__init__(new_figure(self.x_range, (-1.0, 1.0), "time [s]"), [name for name in CONTROLLERS if name != NONE])
        self.seconds = seconds
        self._of: tuple[LoopResults, Display] | None = None
        self._invisible_names: list[str] = []
        on_settle([self.x_range], self._send)

    def draw(self, results: LoopResults, display: Display) -> None:
        """Draw what is in view of every line; of another record that is its middle at first."""
        it = results.result
        start, end = it.scenario.run.warm_up, it.record.n_steps * it.record.dt
        self._of = results, display
        if (start, end) != (self.x_range.reset_start, self.x_range.reset_end):
            self.x_range.update(reset_start=start, reset_end=end)
            self.zoom(self.seconds)
        self._send()
        self.figure.yaxis.axis_label = f"residual {display.mode_label} [{display.unit_label}]"

    def zoom(self, seconds: float | None) -> None:
        """Show the middle of the record, or all of it after the start."""
        whole: Any = self.x_range
        start, end = whole.reset_start, whole.reset_end
        half = 0.5 * min(seconds or end - start, end - start)
        self.x_range.update(start=0.5 * (start + end) - half, end=0.5 * (start + end) + half)

    def _send(self) -> None:
        """Send the samples in view, as extremes where they are many."""
        if self._of is None:
            return
        results, display = self._of
        record = results.result.record
        start, end = in_view(self.x_range)
        first = min(max(int(start / record.dt), 0), record.n_steps - 2)
        last = min(max(int(np.ceil(end / record.dt)) + 1, first + 2), record.n_steps)
        scale = display.scale(results.result.scenario)
        times = envelope_times(first, last, BINS, record.dt)
        with pn.io.hold():
            self.put(
                {
                    o.controller: (times, scale * envelope(o.residual[first:last, display.column], BINS))
                    for o in results.result.outcomes
                    if o.residual is not None
                }
            )
            self.fit(self._invisible_names)

    def fit(self, hidden_names: list[str]) -> None:
        """Have the axis hold every visible line."""
        self._invisible_names = hidden_names
        top = 1.1 * self.highest(hidden_names, 1.0)
        set_ends(self.figure.y_range, -top, top)


class LoopSpectrum(FigureLines):
    """The power spectral density of every residual."""

    def __init__(self) -> None:
        super().__init__(new_spectrum(), CONTROLLERS)

    def draw(self, results: LoopResults, display: Display) -> None:
        """Send every line."""
        scale = display.scale(results.result.scenario) ** 2
        lines = {name: (f[1:], scale * density[1:, display.column]) for name, (f, density) in results.spectra.items()}
        self.put(lines)
        for frequency, _ in lines.values():
            self.figure.x_range.update(start=float(frequency[0]), end=float(frequency[-1]))
        self.figure.yaxis.axis_label = f"PSD of residual, {display.mode_label} [{display.unit_label}²/Hz]"

    def fit(self, hidden_names: list[str]) -> None:
        """Have the axis hold every visible line, but for what lies too far below the highest."""
        top = 3.0 * self.highest(hidden_names, 0.0) or 1.0
        self.figure.y_range.update(start=top * 10.0**-DECADES, end=top)


class Response(PairedLines):
    """Rejection and noise transfer of the loops that have them."""

    def __init__(self) -> None:
        fig = new_figure((0.5, 500.0), (-50.0, 15.0), "frequency [Hz]", "x", y_axis_label="amplitude [dB]")
        super().__init__(fig, CURVES)

    def draw(self, results: LoopResults, display: Display) -> None:
        """Send every line."""
        nyquist = 0.5 / results.result.record.dt
        self.figure.x_range.update(start=1e-3 * nyquist, end=nyquist)
        curves = {name: of[display.column] for name, of in results.curves.items()}
        self.put_both({name: (c.frequency, decibel(c.rejection), decibel(c.noise)) for name, c in curves.items()})


class Nyquist(FigureLines):
    """The loop gain in the complex plane, the unit circle, and where the margins are measured."""

    def __init__(self) -> None:
        fig = new_figure((-NYQUIST, NYQUIST), (-NYQUIST, NYQUIST), "real part", y_axis_label="imaginary part")
        fig.update(height=None, aspect_ratio=1.0, max_width=480)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        fig.line(np.cos(turn), np.sin(turn), line_color="#888888", line_dash=[4, 3])
        fig.scatter([-1.0], [0.0], marker="x", size=11, line_color="#888888", line_width=2)
        super().__init__(fig, CURVES)
        self.marks: Final = ColumnDataSource({"x": [], "y": [], "colour": [], "marker": []})
        fig.scatter(
            "x",
            "y",
            source=self.marks,
            marker="marker",
            line_color="colour",
            fill_alpha=0.0,
            size=9,
            line_width=2,
            level="annotation",
        )
        self._at: dict[str, list[tuple[complex, str]]] = {}

    def draw(self, results: LoopResults, display: Display) -> None:
        """Send every line and mark."""
        gains = {name: of[display.column].loop_gain for name, of in results.curves.items()}
        self.put({name: plane(L) for name, L in gains.items()})
        self._at = {}
        for name, L in gains.items():
            margins = results.result.design.laws[name][display.column].margins
            if margins is None or name not in self.sources:
                continue
            self._at[name] = [(complex(-1.0 / margins.gain), "circle")] if margins.gain else []
            if margins.phase is not None:
                both = [-np.exp(1j * sign * margins.phase) for sign in (1.0, -1.0)]
                self._at[name].append((min(both, key=lambda p, L=L: np.nanmin(np.abs(L - p))), "square"))

    def restyle(self, dark: bool, hidden_names: Sequence[str], main_names: Sequence[str] = ()) -> None:
        """Restyle the marks too."""
        super().restyle(dark, hidden_names, main_names)
        rows = [
            (point.real, point.imag, look(name).colour(dark), marker)
            for name, at in self._at.items()
            if name not in hidden_names
            for point, marker in at
        ]
        self.marks.data = {name: [row[i] for row in rows] for i, name in enumerate(("x", "y", "colour", "marker"))}


def of_mode(results: LoopResults, display: Display) -> list[Score]:
    """Select the rows of the mode shown, least residual first, those without one last."""
    rows = [r for r in results.rows if r["mode"] == display.mode]
    return sorted(rows, key=lambda r: float("inf") if r["residual_rms_nm"] is None else r["residual_rms_nm"])


def loop_html(results: LoopResults, display: Display, envelope: PlantEnvelope | None = None) -> str:
    """Residual and Strehl of every controller, and the bounds; with an envelope, what an uncertain plant does to them."""
    rows = of_mode(results, display)
    ranked = (r["controller"] for r in rows if r["controller"] not in BOUNDS and r["residual_rms_nm"] is not None and r["ranked"])
    return render_part(
        "controllers",
        display,
        rows=rows,
        smallest=next(ranked, None),
        noted=[*{r["note"]: r for r in reversed(rows) if r["note"] not in ("", LIMITED)}.values()],
        said=no_theory(rows),
        spreads={} if envelope is None else {spread.controller: spread for spread in envelope.spreads},
        envelope=envelope,
        scale=1e-3 * display.scale(results.result.scenario),
        wavelength=results.result.scenario.control.wavelength,
        terms=TERMS,
        limited=LIMITED,
        not_applicable=NOT_APPLICABLE,
        label=label,
    )


def loop_verdict_html(
    results: LoopResults, verdict: Verdict | None, display: Display, envelope: PlantEnvelope | None = None
) -> str:
    """Write the controllers with the smallest residual by prior knowledge, and the limit; and the best over an envelope."""
    scale = display.scale(results.result.scenario)
    said = [*verdict.sentences(scale, display.unit_label)] if verdict else []
    if envelope is not None:
        lines = envelope.sentences(scale, display.unit_label, display.column)
        said += [signs(line).replace(" deg", "°") for line in lines]
    return f'<p class="verdict">{escape(" ".join(said))}</p>' if said else ""


def margins_html(results: LoopResults, display: Display) -> str:
    """Margins of the loops that have a transfer function."""
    return render_part("margins", display, rows=of_mode(results, display), label=label)


FIRST_S, ZOOM_S = 2.0, 0.5
"""Length of the two traces at first [s], in the middle of the record."""

INTRO = (
    "Every controller runs on the disturbance and the noise of the results shown, with the delay and the "
    "limits of the mirror set under Controllers. The Strehl ratio counts the simulated modes alone."
)
ABOUT = (
    "Rejection |E| bold, noise transfer faint. The distance of the loop gain L from −1 is the distance of the loop from "
    "instability; ○ marks the gain margin, □ the phase margin. Multi-rate loops change from step to step, and a GPR is not "
    "linear: neither has such curves."
)


class ClosedLoopPage(Page):
    """The page; computed anew when the results change, while it is visible."""

    files = {
        "Controllers as CSV": ("wfsobs-controllers.csv", lambda shown: table_csv(shown.rows)),
        "Residuals as CSV": ("wfsobs-residuals.csv", residuals_csv),
    }
    """The table of `wfsobs loop --json`, and the residuals."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "mode", "unit")
        self.work: Final = BackgroundTask(store.session, title="Closed loop")
        self._of = object()
        self._verdict: Verdict | None = None
        self._rooms = list[pn.viewable.Viewable]()
        self.note, self.verdict, self.table, self.margins = (html() for _ in range(4))
        self.cards: Final = Cards("controllers")
        self.link = self.lines = LineChoice("hide", CONTROLLERS)
        self.lines.tie(self.cards)
        self.trace: Final = Trace(FIRST_S)
        self.zoom: Final = Trace(ZOOM_S)
        self.spectrum: Final = LoopSpectrum()
        self.response: Final = Response()
        self.nyquist: Final = Nyquist()
        self.room: Final = figure_with_caption("Rejection and noise transfer", self.response.figure, tall=True)
        self.stability: Final = figure_with_caption("Loop gain L, unit circle", self.nyquist.figure)
        self.editor: GainEditor | None = None
        display.param.watch(self._edit, "editing")
        self._edit()
        self.uncertain: Final = UncertainPlant(store, display)
        self.uncertain.work.param.watch(self._restyle, ["state", "result"])
        self._figures = (self.trace, self.zoom, self.spectrum, self.response, self.nyquist)
        self.work.param.watch(self._say, ["state", "place", "message"])
        self.work.param.watch(self.redraw, "result")
        self.run.param.watch(self.follow, ["result", "state"])
        display.param.watch(self._restyle, "dark")
        self.lines.watch(self._restyle)

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        titles = "Residual", "Spectrum of the residual", "Residual, zoomed"
        drawn = zip(titles, (self.trace, self.spectrum, self.zoom), strict=True)
        rooms = [figure_with_caption(title, of.figure, tall=True) for title, of in drawn]
        stability = halves(self.stability, pn.Column(text(ABOUT), self.margins, **WIDE))
        edit = tick(self.display, "editing", stylesheets=[SMALL_LABEL])
        switch = pn.FlexBox(*zoom_buttons(self.trace.zoom, {"All": None, f"{FIRST_S:g} s": FIRST_S}), edit, **WIDE)
        below = box("Controllers", self.table), self.uncertain.view(), box("Stability", stability)
        # A grid by its own style is shown even where it is not visible.
        self._rooms = [pn.Column(part, **WIDE) for part in (switch, halves(*rooms, self.room), *below)]
        residual = box("Residual in closed loop", text(INTRO), self.note, self.verdict, self.cards, *self._rooms[:2])
        return boxes(residual, *self._rooms[2:])

    def _edit(self, *_: object) -> None:
        """Make the handle when it is first wanted, and room for what stands below the figure."""
        self.room.stylesheets = [EDITED] if self.display.editing else TALL["stylesheets"]
        if self.display.editing and self.editor is None:
            self.editor = GainEditor(self.response.figure, self.nyquist.figure, self.store, self.display, lambda: self.results)
            for room, handle in zip((self.room, self.stability), self.editor.handles, strict=True):
                room.append(handle.layer)

    @property
    def task(self) -> CopiedTask:
        """To close the loop."""
        return CopiedTask(LOOP)

    def follow(self, *_: object) -> None:
        """Start the loop of the results shown, once their run is over; stop where the page is hidden."""
        of = self.run.result
        if not self.visible:
            self.work.cancel()
            if self.work.state == CANCELLED:
                self._of = object()
            return
        if of is None or self.run.state == RUNNING or of is self._of:
            return
        self._of = of
        self.uncertain.forget()
        self.work.start(Job("loop", partial(compute, of, memo=self.store.session.service.memo), cost=cost(of.scenario)))

    @property
    def results(self) -> LoopResults | None:
        """What the loop has given so far, or the one before; None where there cannot be one."""
        return None if self.work.state == FAILED else self.work.result

    finding = results

    def _say(self, *_: object) -> None:
        work = self.work
        doing = work.line() if work.place else "computing …"
        said = {RUNNING: doing, FAILED: f"No closed loop: {work.message}"}.get(work.state, "")
        self.note.html = f'<p class="text" role="status">{escape(said)}</p>' if said else ""
        for room in (self.cards, *self._rooms):  # of other results
            room.visible = work.state != FAILED

    def draw(self) -> None:
        """Draw what every controller leaves."""
        shown = self.results
        if shown is None or self.display.column >= len(shown.result.scenario.modes):
            return
        self._verdict = loop_verdict(shown.result, self.display.mode, source=shown.source)
        for drawn in self._figures:
            drawn.draw(shown, self.display)
        self.lines.offer([place.observer for place in self._verdict.named_places] if self._verdict else CONTROLLERS)
        self._restyle()
        if self.editor is not None:
            self.editor.follow()

    def _restyle(self, *_: object) -> None:
        with pn.io.hold():
            for drawn in self._figures:
                drawn.restyle(self.display.dark, self.lines.hidden_lines)
            for drawn in (self.trace, self.zoom, self.spectrum):
                drawn.fit(self.lines.hidden_lines)
            if self.results is not None:
                envelope = self.uncertain.work.result
                known = envelope if self.uncertain.work.state == DONE else None
                self.verdict.html = loop_verdict_html(self.results, self._verdict, self.display, known)
                self.table.html = loop_html(self.results, self.display, envelope)
                self.uncertain.draw(self.lines.hidden_lines)
                self.margins.html = margins_html(self.results, self.display)
                self.cards.show(self._items(self.results))

    def _items(self, results: LoopResults) -> list[dict[str, Any]]:
        """Describe a card per controller."""
        scale = self.display.scale(results.result.scenario)
        left = {r["controller"]: r for r in results.rows if r["mode"] == self.display.mode}
        intervals = {place.observer: place.interval for place in self._verdict.places} if self._verdict else {}
        out = []
        for name in CONTROLLERS:
            row = left.get(name)
            fields: dict[str, Any] = {"main": name not in (self.lines.minor or ())}
            if row is None:
                note = f"left out, {seconds(name, results.result.scenario):.0f} s" if results.complete else "computing …"
            elif row["residual_rms_nm"] is None:
                note = "unstable" if row["stable"] is False else "could not run"
            else:
                note = f"Strehl {row['strehl']:.3f}"
                fields |= error_fields(1e-3 * row["residual_rms_nm"], intervals.get(name), scale)
                fields["unit"] = self.display.unit_label
            out.append(card_of(name, self.display.dark, note, **fields))
        return out
