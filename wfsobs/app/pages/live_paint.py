"""What changes in a picture, as one message: each property and each array sent by itself costs more than what is in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from bokeh.model import Model
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from wfsobs.app.pages.live_controls import Pulse
from wfsobs.typing import Array


class Painter:
    """Collects changes of models, and has the browser make them; those of models that it has not seen are made here.

    Once the browser makes them the models of the server keep the values of before.
    """

    def __init__(self, pulse: Pulse):
        self._pulse = pulse
        self._steps: list[list[Any]] = []
        self._numbers: list[Array] = []

    def data(self, fig: figure, source: ColumnDataSource, columns: Mapping[str, Array]) -> None:
        """Have a source of a figure hold these numbers, columns of one length, in single precision."""
        numbers = {name: np.asarray(x, dtype=np.float32) for name, x in columns.items()}
        if not self._reaches(source):
            source.data = {**numbers}
            return
        self._steps.append([fig.id, source.id, list(numbers), len(next(iter(numbers.values()))), []])
        self._numbers += numbers.values()

    def update(self, fig: figure, model: Model, **values: float) -> None:
        """Set properties of a part of a figure that are numbers."""
        if self._reaches(model):
            self._steps.append([fig.id, model.id, [], 0, [list(pair) for pair in values.items()]])
        else:
            model.update(**values)

    def send(self) -> None:
        """Send what has been collected."""
        if self._steps:
            numbers = np.concatenate(self._numbers) if self._numbers else np.empty(0, dtype=np.float32)
            self._pulse.changes = [self._steps, numbers]
            self._steps, self._numbers = [], []

    def _reaches(self, model: Model) -> bool:
        return self._pulse.is_seen and model.document is not None
