"""The equations, with the numbers of the present settings in them."""

from __future__ import annotations

from html import escape

import panel as pn

from wfsobs.app.display import Display
from wfsobs.app.pages import mathml as m
from wfsobs.app.store import Store
from wfsobs.app.style import asset, swatch
from wfsobs.evaluation.description import Description, FilterFacts, describe
from wfsobs.observers import OBSERVERS
from wfsobs.signal.ar2 import Ar2
from wfsobs.typing import Array

STATES = tuple(f"<math>{m.at(m.name('φ', kind), step)}</math>" for kind in ("turb", "vib") for step in ("k", "k−1"))


class Model:
    """The page; follows the settings and the mode while it is visible."""

    def __init__(self, store: Store, display: Display):
        self.store, self.display = store, display
        self.visible = False
        self.pane = pn.pane.HTML("", sizing_mode="stretch_width", margin=0, stylesheets=[asset("style.css"), asset("model.css")])
        store.param.watch(self._refresh, "scenario")
        display.param.watch(self._refresh, ["mode", "dark"])

    def view(self) -> pn.pane.HTML:
        """What is shown."""
        return self.pane

    def show(self, visible: bool) -> None:
        """Write what has changed meanwhile, and go on while visible."""
        behind = visible and not self.visible
        self.visible = visible
        if behind:
            self._refresh()

    def _refresh(self, *_: object) -> None:
        if self.visible:
            scenario = self.store.scenario
            mode = min(self.display.column, len(scenario.modes) - 1)
            self.pane.object = html(describe(scenario, mode), self.display.dark)


def html(told: Description, dark: bool) -> str:
    """The whole page."""
    parts = (_processes(told), _sensors(told), _state_space(told), _filters(told, dark), _gprs(told, dark))
    intro = f"The numbers are those of the settings, mode {told.mode}, in micrometres and steps of the loop."
    return f'<p class="text">{intro}</p>' + "".join(f'<section class="part">{part}</section>' for part in parts)


def _title(words: str) -> str:
    return f'<h2 class="title">{escape(words)}</h2>'


def _scroll(label: str, content: str) -> str:
    return f'<div class="scroll" tabindex=0 role=region aria-label="{escape(label)}">{content}</div>'


def _processes(told: Description) -> str:
    """Equations 1 and 2."""
    phi, w, xi, t = m.name("φ"), m.name("ω"), m.name("ξ"), m.name("T")
    general = m.math(
        m.at(phi, "k+1"),
        m.op("="),
        m.name("a", "1"),
        m.at(phi, "k"),
        m.op("+"),
        m.name("a", "2"),
        m.at(phi, "k−1"),
        m.op("+"),
        m.at(m.name("v"), "k"),
    )
    root = f"<msup><mrow><mo>(</mo><mn>1</mn><mo>−</mo><msup>{xi}<mn>2</mn></msup><mo>)</mo></mrow><mn>½</mn></msup>"
    first = m.math(
        m.name("a", "1"),
        m.op("="),
        "<mn>2</mn>",
        f"<msup><mi>e</mi><mrow><mo>−</mo>{xi}{w}{t}</mrow></msup>",
        m.text("\u2009cos"),
        m.op("("),
        w,
        root,
        t,
        m.op(")"),
        m.gap(),
        m.name("a", "2"),
        m.op("="),
        m.op("−"),
        f"<msup><mi>e</mi><mrow><mo>−</mo><mn>2</mn>{xi}{w}{t}</mrow></msup>",
    )
    lines = _process("turb", told.turbulence) + _process("vib", told.vibration)
    rows = "".join(
        f"<tr><th scope=row>{kind}</th><td>{m.short(p.omega)}</td><td>{m.short(p.damping)}</td><td>{m.short(p.rms)}</td>"
        f"<td>{m.short(p.a1, 7)}</td><td>{m.short(p.a2, 7)}</td><td>{p.drive_variance:.3e}</td></tr>"
        for kind, p in (("Turbulence", told.turbulence), ("Vibration", told.vibration))
    )
    head = "".join(
        f"<th scope=col>{h}</th>"
        for h in ("Modelled process", "ω [rad/s]", "ξ", "rms [µm]", "a<sub>1</sub>", "a<sub>2</sub>", "variance of v [µm²]")
    )
    table = f'<table class="rms"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
    return _title("Disturbances: AR(2), equations 1 and 2") + _scroll("Disturbances", general + first + lines + table)


def _sensors(told: Description) -> str:
    """What the sensors get wrong by themselves."""
    head = "".join(f"<th scope=col>{h}</th>" for h in ("Sensor", "noise of a frame, rms [µm]", "aliasing, rms [µm]"))
    rows = "".join(
        f"<tr><th scope=row>{'One LGS' if name == 'LGS' else name}</th><td>{m.short(facts.noise)}</td>"
        f"<td>{m.short(facts.aliasing)}</td></tr>"
        for name, facts in told.sensors.items()
    )
    table = f'<table class="rms"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
    note = (
        '<p class="text">Aliasing is what a Shack-Hartmann sensor takes for the mode and is none of those it fits: its '
        "output less the Zernike coefficient of frozen flow in the same beam. No filter knows of it.</p>"
    )
    return _title("Sensors") + _scroll("Sensors", table) + note


def _process(kind: str, p: Ar2) -> str:
    phi = m.name("φ", kind)
    sign = m.op("−" if p.a2 < 0 else "+")
    return m.math(
        m.at(phi, "k+1"),
        m.op("="),
        m.value(p.a1, 7),
        m.at(phi, "k"),
        sign,
        m.value(abs(p.a2), 7),
        m.at(phi, "k−1"),
        m.op("+"),
        m.at(m.name("v", kind), "k"),
    )


def _state_space(told: Description) -> str:
    """Equations 6 and 7."""
    x, u = m.name("x"), m.name("u")
    state = m.math(
        m.at(x, "k"),
        m.op("="),
        m.column(
            [
                *(m.at(m.name("φ", kind), step) for kind in ("turb", "vib") for step in ("k", "k−1")),
                m.at(u, "k−1"),
                m.at(u, "k−2"),
            ]
        ),
    )
    equations = m.math(
        m.at(x, "k+1"),
        m.op("="),
        m.name("A"),
        m.at(x, "k"),
        m.op("+"),
        m.name("B"),
        m.at(u, "k"),
        m.op("+"),
        m.at(m.name("v"), "k"),
        m.gap(),
        m.at(m.name("y"), "k"),
        m.op("="),
        m.name("C"),
        m.at(x, "k"),
        m.op("+"),
        m.at(m.name("w"), "k"),
    )
    numbers = m.math(m.name("A"), m.op("="), m.matrix(told.A)) + m.math(
        m.name("B"), m.op("="), m.matrix(told.B[:, None]), m.gap(), m.name("C"), m.op("="), m.matrix(told.C)
    )
    return _title("State space: equations 6 and 7") + _scroll("State space", equations + state + numbers)


def _filters(told: Description, dark: bool) -> str:
    """Equations 8 to 11, and a table per filter."""
    x, z = m.hat("x"), m.name("z")
    predicted = m.name("x", "pred")
    update = m.math(
        m.at(x, "k"),
        m.op("="),
        m.at(predicted, "k"),
        m.op("+"),
        m.name("L"),
        m.op("("),
        m.at(z, "k"),
        m.op("−"),
        m.name("C"),
        m.at(predicted, "k"),
        m.op(")"),
        m.gap(),
        m.at(predicted, "k+1"),
        m.op("="),
        m.name("A"),
        m.at(x, "k"),
    )
    P, C, R = m.name("P"), m.name("C"), m.name("R")
    Ct = m.name("C", above="⊤")
    gain = m.math(
        m.name("L"),
        m.op("="),
        P,
        Ct,
        "<msup><mrow>",
        m.op("("),
        C,
        P,
        Ct,
        m.op("+"),
        R,
        m.op(")"),
        "</mrow><mn>−1</mn></msup>",
        m.gap(),
        m.name("K"),
        m.op("="),
        m.name("A"),
        m.name("L"),
    )
    note = (
        '<p class="text">P solves the Riccati equation. A filter is stable where every pole of A − K C lies inside the unit '
        "circle; of a multi-rate filter the poles are those of the product over one cycle.</p>"
    )
    tables = "".join(_filter(name, facts, dark) for name, facts in told.filters.items())
    return _title("Kalman filters: equations 8 to 11") + _scroll("Kalman filter equations", update + gain) + note + tables


def _filter(name: str, facts: FilterFacts, dark: bool) -> str:
    label = OBSERVERS[name].label
    head = f'<h3 class="observer" data-observer="{name}">{swatch(name, dark)}{escape(label)}</h3>'
    if facts.reason:
        return head + f'<p class="failure" role="alert">{escape(facts.reason)}</p>'
    columns = "".join(f"<th scope=col>{state}</th>" for state in STATES)
    rows = "".join(
        f"<tr><th scope=row>L, {escape(of)}</th>{''.join(f'<td>{m.short(x)}</td>' for x in gain)}</tr>"
        for of, gain in facts.gains.items()
    )
    table = f'<table class="rms"><thead><tr><th scope=col>Filter gain</th>{columns}</tr></thead><tbody>{rows}</tbody></table>'
    what = "one step" if facts.period == facts.step else "one cycle"
    poles = (
        f'<p class="text">Poles of {what}, {m.short(1e3 * facts.period)} ms: {", ".join(_poles(facts.poles))}. '
        f"Radius {m.short(facts.radius or 0.0, 6)}.</p>"
    )
    return head + _scroll(f"{label}: filter gain", table) + poles


def _poles(poles: Array) -> list[str]:
    """Poles in words, of a conjugate pair the upper; those that are zero to rounding only counted."""
    zero = abs(poles) < 1e-9
    words = [
        m.short(p.real) if abs(p.imag) < 1e-9 else f"{m.short(p.real)} ± {m.short(p.imag)} i"
        for p in poles[~zero]
        if p.imag > -1e-9
    ]
    return [*words, *([f"{zero.sum()} at 0"] if zero.any() else [])]


def _gprs(told: Description, dark: bool) -> str:
    """Equations 13 and 14, and what the GPR amounts to."""
    phi, kernel = m.at(m.hat("φ", "vib"), "k"), m.name("k")
    estimate = m.math(
        phi,
        m.op("="),
        "<msup><mrow>",
        kernel,
        m.op("("),
        m.at(m.name("x"), "k"),
        m.op(")"),
        "</mrow><mi>⊤</mi></msup>",
        "<msup><mrow>",
        m.op("("),
        m.name("K"),
        m.op("+"),
        m.name("σ", "n", "2"),
        m.name("I"),
        m.op(")"),
        "</mrow><mn>−1</mn></msup>",
        m.name("f"),
        m.gap(),
        m.name("λ"),
        m.op("="),
        "<msup><mrow>",
        m.op("("),
        m.name("σ", "n"),
        m.name("l"),
        m.op("/"),
        m.name("σ", "SE"),
        m.op(")"),
        "</mrow><mn>2</mn></msup>",
    )
    head = "".join(f"<th scope=col>{h}</th>" for h in ("GPR", "Ridge weight λ [µm²]", "Window [s]", "Training windows span [s]"))
    rows = "".join(
        f'<tr data-observer="{name}"><th scope=row>{swatch(name, dark)}{escape(OBSERVERS[name].label)}</th>'
        f"<td>{m.short(g.ridge)}</td><td>{m.short(g.window)}</td><td>{m.short(g.training)}</td></tr>"
        for name, g in told.gprs.items()
    )
    table = f'<table class="rms"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
    note = (
        '<p class="text">Where the length scale l is far above the norm of the windows the kernel is linear, and the '
        "regression all but a ridge regression of weight λ.</p>"
    )
    return _title("Gaussian process regression: equations 13 and 14") + _scroll("GPR", estimate + table) + note
