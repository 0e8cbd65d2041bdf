"""What a file would be, before it is used: what was read, what the data say, and the spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource

from wfsobs.app.views.plots import new_figure, send
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import ColumnsPreview, Preview, SpectrumPreview, preview_any

AnyPreview = Preview | SpectrumPreview | ColumnsPreview
COLOURS = ("#0B4F6C", "#FF6600")
NOTHING = np.empty(0)


class PreviewView:
    """The text and the figure of a preview."""

    def __init__(self) -> None:
        self.text = pn.pane.HTML("", sizing_mode="stretch_width", margin=(4, 0))
        self.figure = new_figure(x_axis_type="log", y_axis_type="log")
        self.figure.name = "Spectrum of the record"
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = "frequency [Hz]", "PSD of z [µm²/Hz]"
        self.sources = [ColumnDataSource({"x": [], "y": []}) for _ in TIP_TILT]
        for source, colour, mode in zip(self.sources, COLOURS, TIP_TILT, strict=True):
            self.figure.line("x", "y", source=source, color=colour, line_width=1.4, legend_label=mode.name)

    def show(self, name: str, preview: Preview | SpectrumPreview | RecordError) -> None:
        """Show what was read of the file of this name, or why it could not be."""
        known = None if isinstance(preview, RecordError) else preview
        self.figure.yaxis.axis_label = "PSD [µm²/Hz]" if isinstance(preview, SpectrumPreview) else "PSD of z [µm²/Hz]"
        self.text.object = f"<p><b>{escape(name)}</b></p>{_list(known.lines() if known else [str(preview)])}"
        if isinstance(preview, Preview):
            self.text.object += f'<p>Evidence in the data:</p><div class="evidence">{_list(preview.reading.lines())}</div>'
        self.figure.visible = known is not None
        for mode, source in enumerate(self.sources):
            there = known is not None and mode < known.spectrum.shape[1]
            x, y = (known.frequency, known.spectrum[:, mode]) if known and there else (NOTHING, NOTHING)
            send(source, {"x": x[x > 0], "y": y[x > 0]})


def _list(lines: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"


def read_stranger(content: bytes, name: str, scenario: Scenario, declaration: DeclaredFormat) -> AnyPreview:
    """Read a file that may be anything. Raises RecordError, one line."""
    try:
        return preview_any(content, name, scenario, declaration)
    except RecordError:
        raise
    except Exception:  # whatever a stranger's file may do
        raise RecordError(f"{name}: cannot be read") from None
