"""What the linear controllers leave of an uncertain plant: a box of the page Closed loop."""

from __future__ import annotations

from functools import partial

import numpy as np
import panel as pn
from bokeh.models import DataRange1d, Range1d

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.jobs import DONE
from wfsobs.app.loop_work import uncertain, uncertain_seconds
from wfsobs.app.pages.parts import WIDE, Starter, box, figure_with_caption, line, text
from wfsobs.app.render import macro, number
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.views.plots import PairedLines, new_figure
from wfsobs.closed_loop.envelope import POINTS, PlantEnvelope, Uncertainty
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.settings.errors import SettingError

UNSTABLE = macro("tag", "above", "unstable")

LINEAR = tuple(c.id for c in CONTROLLERS.values() if c.law and not c.predict)

INTRO = (
    f"What the linear controllers, designed for the plant as it is set, leave over {POINTS} others, by theory: with errors of "
    f"delay (±{Uncertainty.delay:g} frame), gain (±{100.0 * Uncertainty.gain:g} %), rotation (±{Uncertainty.rotation:g}°) and, "
    f"where the mirror has one, resonance (±{100.0 * Uncertainty.resonance:g} %), of which they know nothing."
)
ABOUT = "The worst plant bold, the mean faint, against the error of the delay; all other errors as they come."


def uncertain_columns(unit: str) -> dict[str, str]:
    """Return the columns of a table of controllers that an envelope adds: heading -> explanation."""
    return {
        f"95 % [{unit}]": "of the stable ones of the uncertain plants are below, by theory",
        f"Worst [{unit}]": "of the uncertain plants and of the corners of their range",
        "Unstable [%]": "of the uncertain plants",
    }


def uncertain_cells(envelope: PlantEnvelope, column: int, scale: float) -> dict[str, list[str]]:
    """Return the cells of these columns by controller; scale : of [um]."""
    out = {}
    for spread in envelope.spreads:
        (_, most), worst = spread.summary(column), spread.worst[column]
        cells = [UNSTABLE if x is None or np.isinf(x) else number(scale * x) for x in (most, worst)]
        out[spread.controller] = [*cells, number(100.0 * spread.unstable / len(spread.points), 2)]
    return out


class DelayFigure(PairedLines):
    """The residual against the error of the delay: the worst plant, and the mean."""

    def __init__(self) -> None:
        fig = new_figure(x_range=Range1d(start=-1.0, end=1.0), y_range=DataRange1d(only_visible=True), y_axis_type="log")
        super().__init__(fig, LINEAR)
        fig.xaxis.axis_label = "error of the delay [frames]"

    def draw(self, envelope: PlantEnvelope, display: Display) -> None:
        """Send every line."""
        scale = per_micrometre(display.unit, envelope.scenario.telescope.diameter)
        of = envelope.curves("delay", display.column)
        end = envelope.uncertainty.delay
        self.figure.x_range.update(start=-end, end=end)
        self.put_both({name: (x, scale * most, scale * mean) for name, (x, mean, most) in of.items()})
        self.figure.yaxis.axis_label = f"residual {display.mode_label} [{display.unit_label}]"


class UncertainPlant:
    """The box: a button, the figure, and what the page adds to its table and verdict."""

    def __init__(self, store: Store, display: Display):
        self.store, self.display = store, display
        self.work = BackgroundTask(store.session, title="Uncertain plant")
        self.starter = Starter(self.work, self._start, "Compute", "Progress of the uncertain plant")
        self.figure = DelayFigure()
        drawn = figure_with_caption("Residual against delay error", self.figure.figure)
        self.room = pn.Column(drawn, text(ABOUT), **WIDE, visible=False)

    def view(self) -> pn.Column:
        """Return the box."""
        return box("Uncertain plant", text(INTRO), line(*self.starter.view()), self.starter.status, self.room)

    @property
    def finding(self) -> PlantEnvelope | None:
        """What there is so far."""
        return self.work.result

    @property
    def complete(self) -> bool:
        """Whether all controllers are in it."""
        return self.work.state == DONE and self.finding is not None

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
        envelope = self.finding
        self.room.visible = envelope is not None
        if envelope is not None:
            self.figure.draw(envelope, self.display)
            self.figure.restyle(self.display.dark, hidden_names)
