"""The lines of a figure, one per observer, each made when it is first shown: most of them never are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from bokeh.models import AllIndices, CDSView, ColumnDataSource, GlyphRenderer
from bokeh.plotting import figure

from wfsobs.app.style import look
from wfsobs.app.views.plots import make_line


class LazyLine:
    """A line that is in its figure once it has been shown."""

    def __init__(self, make: Callable[[], GlyphRenderer]):
        self._make = make
        self.renderer: GlyphRenderer | None = None

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self.renderer is not None and self.renderer.visible

    def show(self, visible: bool, colour: str) -> None:
        """Show it in a colour, or hide it."""
        if self.renderer is None and visible:
            self.renderer = self._make()
        if self.renderer is not None:
            self.renderer.glyph.line_color = colour
            self.renderer.visible = visible


class FigureLines(Mapping[str, LazyLine]):
    """The lines of a figure by name; those that come first lie below."""

    def __init__(self, fig: figure, columns: Mapping[str, tuple[ColumnDataSource, str]]):
        """Make none yet. columns : name -> where its data are, and the column of y."""
        self.figure = fig
        self._all = AllIndices()
        self._lines = {name: LazyLine(self._maker(name, *at)) for name, at in columns.items()}

    def __getitem__(self, name: str) -> LazyLine:
        return self._lines[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._lines)

    def __len__(self) -> int:
        return len(self._lines)

    def restyle(self, dark: bool, hidden_names: Sequence[str]) -> None:
        """Show every line but those that are to be hidden, in the colours of light or dark mode."""
        for name, line in self.items():
            line.show(name not in hidden_names, look(name).colour(dark))

    def _maker(self, name: str, source: ColumnDataSource, y: str) -> Callable[[], GlyphRenderer]:
        def make() -> GlyphRenderer:
            renderer = make_line(name, source, y, view=CDSView(filter=self._all))
            names = list(self)
            above = [line.renderer for line in map(self.get, names[names.index(name) + 1 :]) if line and line.renderer]
            renderers = self.figure.renderers
            renderers.insert(renderers.index(above[0]) if above else len(renderers), renderer)
            return renderer

        return make
