"""A page with as little as a page of this kind can have, to compare times with: five sliders and two figures.

python -m panel serve scripts/minimal_page.py
"""

import numpy as np
import panel as pn
import panel_material_ui as pmui
from bokeh.plotting import figure

x = np.linspace(0.0, 10.0, 1000)


def plot() -> figure:
    """Draw a line of as many points as those of the dashboard."""
    fig = figure(height=300, sizing_mode="stretch_width", tools="xbox_zoom,xpan,xwheel_zoom,reset,save")
    fig.line(x, np.sin(x))
    return fig


pmui.Page(
    title="Minimal",
    sidebar=[pmui.FloatSlider(label=f"Slider {i + 1}", start=0.0, end=10.0, value=5.0) for i in range(5)],
    main=[pn.Column(pn.pane.Bokeh(plot()), pn.pane.Bokeh(plot()), sizing_mode="stretch_width")],
).servable()
