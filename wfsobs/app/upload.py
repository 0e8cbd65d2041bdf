"""A record or a vibration spectrum from a file, in place of the simulated one, after a preview.

The browser sends the file in parts. What it is said to be can be changed while the preview stands; nothing runs before it
is confirmed. Reading is done beside the page, in a thread.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from html import escape
from typing import Any, Final

import numpy as np
import panel as pn
import panel_material_ui as pmui
import param
from bokeh.models import ColumnDataSource

from wfsobs.app.actions import Actions
from wfsobs.app.downloads import Save
from wfsobs.app.jobs import CANCELLED, FAILED, RUNNING, Job
from wfsobs.app.limits import Limits
from wfsobs.app.pages.parts import read_number
from wfsobs.app.render import render, signs
from wfsobs.app.service import BackgroundTask
from wfsobs.app.session_file import LARGEST, SUFFIX
from wfsobs.app.sources import fit_to_record
from wfsobs.app.store import Store
from wfsobs.app.style import WIDE, HtmlComponent, html, make_button, make_select, script, sheets
from wfsobs.app.views.plots import new_spectrum, send
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.names import name_settings
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.settings.values import SettingError
from wfsobs.telemetry.columns import ROLES
from wfsobs.telemetry.formats import FORMATS
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import ColumnsPreview, Preview, Reading, SpectrumPreview, preview_any, safe_name
from wfsobs.telemetry.records import TEMPLATE, sample_csv
from wfsobs.units import UNITS

BACK, STAY = "Back to the simulation", "Stay with the simulation"

RECORDS = ",".join(ending for form in FORMATS for ending in form.endings)
"""Of files that are offered to be chosen."""

PART = 1_000_000
"""Of what the browser sends at a time [bytes]."""


class Picker(HtmlComponent):
    """The button and what is said beside it; files up in parts."""

    message: param.String[str] = param.String("", doc="What there is to say, in one line.")
    source_title: param.String[str] = param.String("", doc="What takes the place of the simulation.")
    back: param.String[str] = param.String(BACK, doc="What the button is called that ends it.")
    largest: param.Integer[int] = param.Integer(LARGEST, doc="The largest file that is sent [bytes].")
    part: param.Integer[int] = param.Integer(PART, doc="How much is sent at a time [bytes].")

    _esm = script("page", "markup", "upload")
    _stylesheets = sheets("base", "bare", "upload")

    @param.depends("message", "source_title", "back", watch=True, on_init=True)
    def _draw(self) -> None:
        self.html = render("upload.html", title=self.source_title, back=self.back, message=self.message, records=RECORDS)


INCOMPLETE = "The upload is incomplete: choose the file again."


class PartialFile:
    """A file on its way, in parts that come one after the other; the first part of a file ends the one before."""

    def __init__(self) -> None:
        self.name: str = ""
        self._parts: list[bytes] | None = None

    def take(self, msg: dict[str, Any]) -> bytes | None:
        """Add a part {name, index, count, data}; the whole file with the last one. Raises ValueError, one line."""
        index, count, data = (msg.get(key) for key in ("index", "count", "data"))
        if index == 0:
            self.name, self._parts = safe_name(str(msg.get("name", ""))), []
        parts = self._parts
        if parts is None:  # more of a file that has been given up
            return None
        self._parts = None
        if type(index) is not int or type(count) is not int or not len(parts) == index < count or not isinstance(data, bytes):
            raise ValueError(INCOMPLETE)
        parts.append(data)
        if sum(map(len, parts)) > LARGEST:
            raise ValueError(too_large(self.name))
        if index == count - 1:
            return b"".join(parts)
        self._parts = parts
        return None

    def drop(self) -> None:
        """Give the file up: parts that still come are passed over."""
        self._parts = None


def too_large(name: str) -> str:
    """Return the message for a file of this name that is too large."""
    return f"{name}: larger than {LARGEST // 1_000_000} MB"


TEMPLATE_NAME, SAMPLE_NAME = "wfsobs-template.csv", "wfsobs-sample.csv"
SILENT = "from the file"
TEXT = {"font-size": "13px"}


class UploadFields:
    """The fields. An empty one, or one at its first choice, leaves the question to the file."""

    def __init__(self, on_change: Callable[[], None]):
        """Make the fields. on_change : called after every change of one."""
        self.unit: Final = _select("Unit", [SILENT, *UNITS])
        self.sign: Final = _select("Commands", {SILENT: 0, "are added to the measurement (+1)": 1, "are subtracted (-1)": -1})
        self.delay: Final = _text("Delay of commands [steps]", 240)
        self.rate: Final = _text("Rate [Hz]")
        self.gain: Final = _text("Gain of commands")
        self.rail: Final = _text("Rail: largest command")
        said = "Trust sign and delay as stated", "Open loop: the mirror was at rest"
        self.trust, self.open_loop = (pmui.Checkbox(label=label, size="small", margin=(4, 0)) for label in said)
        self.widgets: Final = (self.unit, self.sign, self.delay, self.rate, self.gain, self.rail, self.trust, self.open_loop)
        self._options: Final = {"--trust": self.trust, "--open-loop": self.open_loop, "--rail": self.rail}
        self._first: Final = [widget.value for widget in self.widgets]
        for widget in self.widgets:
            widget.param.watch(lambda _event: on_change(), "value")

    def clear(self) -> None:
        """Leave every question to the file."""
        for widget, value in zip(self.widgets, self._first, strict=True):
            widget.value = value

    def name_fields(self, text: str) -> str:
        """Name the fields in place of the options of commands."""
        for option, widget in self._options.items():
            text = text.replace(option, f"“{widget.label}”")
        return signs(text)

    def read(self, roles: dict[str, str]) -> DeclaredFormat:
        """Read the fields; roles : of columns that have been chosen. Raises SettingError where a field holds no number."""
        unit = None if self.unit.value == SILENT else self.unit.value
        delay, rate = _number(self.delay, 1), _number(self.rate, 1e-3)
        gain, rail = _number(self.gain, 1e-3), _number(self.rail, 1e-9)
        mirror = {"command_gain": None if gain is None else (gain,), "rail": rail, "open_loop": self.open_loop.value}
        return DeclaredFormat(unit, self.sign.value or None, delay, rate, roles, self.trust.value, **mirror)

    def take_proposals(self, reading: Reading) -> None:
        """Fill in the sign and the delay that the data propose."""
        found = reading.proposal
        self.trust.value = self.trust.value or reading.is_stated
        self.sign.value = found.get("command_sign", self.sign.value)
        self.delay.value = f"{found['command_delay']:g}" if "command_delay" in found else self.delay.value


def _number(field: Any, least: float) -> Any:
    """Return the number in a field, None for an empty one."""
    return read_number(field, least, 1e6) if (field.value or "").strip() else None


def _select(label: str, options: Any) -> pmui.Select:
    first = options[0] if isinstance(options, list) else next(iter(options.values()))
    return make_select(label, options, first, 190, margin=(4, 0))


def _text(label: str, width: int = 190) -> pmui.TextInput:
    return pmui.TextInput(label=label, value="", placeholder=SILENT, size="small", width=width, margin=(4, 0))


AnyPreview = Preview | SpectrumPreview | ColumnsPreview
COLOURS = ("#0B4F6C", "#FF6600")
NOTHING = np.empty(0)


class PreviewView:
    """The text and the figure of a preview."""

    def __init__(self, in_words: Callable[[str], str]) -> None:
        """Make them. in_words : writes a line of evidence as the page has it."""
        self.in_words: Final = in_words
        self.text: Final = html(margin=(4, 0), styles=TEXT)
        self.figure: Final = new_spectrum(None, None)
        self.figure.name = "Spectrum of the record"
        self.sources: Final = [ColumnDataSource({"x": [], "y": []}) for _ in TIP_TILT]
        for source, colour, mode in zip(self.sources, COLOURS, TIP_TILT, strict=True):
            self.figure.line("x", "y", source=source, color=colour, line_width=1.4, legend_label=mode.name)

    def show(self, name: str, preview: Preview | SpectrumPreview | None) -> None:
        """Show what was read of the file of this name; why it could not be stands above."""
        self.figure.yaxis.axis_label = "PSD [µm²/Hz]" if isinstance(preview, SpectrumPreview) else "PSD of z [µm²/Hz]"
        words = f"<p><b>{escape(name)}</b></p>{_list(preview.lines() if preview else [])}"
        if isinstance(preview, Preview):
            words += (
                f'<p>Evidence in the data:</p><div class="evidence">{_list(map(self.in_words, preview.reading.lines()))}</div>'
            )
        self.text.html = words
        self.figure.visible = preview is not None
        for mode, source in enumerate(self.sources):
            there = preview is not None and mode < preview.spectrum.shape[1]
            x, y = (preview.frequency, preview.spectrum[:, mode]) if preview and there else (NOTHING, NOTHING)
            send(source, {"x": x[x > 0], "y": y[x > 0]})


def _list(lines: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>"


READ_RATE = 2e6
"""About what is read of a file [bytes/s]."""


def read_stranger(
    content: bytes, name: str, scenario: Scenario, declaration: DeclaredFormat, limits: Limits, watch: Watch
) -> AnyPreview:
    """Read a file that may be anything. Raises RecordError or SettingError, one line, and Cancelled."""
    try:
        return preview_any(content, name, scenario, declaration, limits.check_steps, watch)
    except (RecordError, SettingError, Cancelled):
        raise
    except Exception:  # whatever a stranger's file may do
        raise RecordError(f"{name}: cannot be read") from None


HINT = (
    "Assign the columns. Likely matches are preselected. A record needs a measurement and, but in open loop, a command of the "
    "same modes, and a time or a rate."
)


class ColumnForm:
    """A list per role, of the columns that may have it."""

    def __init__(self, on_change: Callable[[], None]):
        """Make the lists. on_change : called after every choice."""
        self._on_change = on_change
        self._fills = False
        self.choices: Final = {role: _select(label[0].upper() + label[1:], {"–": ""}) for role, label in ROLES.items()}
        for choice in self.choices.values():
            choice.param.watch(self._choose, "value")
        self.view: Final = pn.Column(
            html(f"<p>{HINT}</p>", styles=TEXT),
            pn.FlexBox(*self.choices.values(), gap="8px", margin=0),
            sizing_mode="stretch_width",
            margin=(4, 0),
        )

    @property
    def roles(self) -> dict[str, str]:
        """Role -> name of the column that has it."""
        return {role: choice.value for role, choice in self.choices.items() if choice.value}

    def show(self, columns: Mapping[str, str], roles: Mapping[str, str]) -> None:
        """Offer the columns of another file (name -> its values in a few words). roles : role -> the one that has it."""
        options = {"–": "", **{f"{name}: {values}" if values else name: name for name, values in columns.items()}}
        self._fills = True
        for role, choice in self.choices.items():
            choice.param.update(options=options, value=roles.get(role, ""))
        self._fills = False

    def _choose(self, event: Any) -> None:
        """Take the column away from the role that had it."""
        if self._fills:
            return
        self._fills = True
        for choice in self.choices.values():
            if choice is not event.obj and choice.value == event.new:
                choice.value = ""
        self._fills = False
        self._on_change()


class Upload:
    """How a record comes into a session's store, whose aperture turns angles into wavefronts."""

    def __init__(self, store: Store, actions: Actions) -> None:
        """Make the button. actions : open other files, and save."""
        self.store = store
        self.actions: Final = actions
        self.picker: Final = Picker(**WIDE)
        self.picker.on_message = self.handle
        self.use: Final = make_button("Use this record", self.confirm, color="primary", margin=4)
        self.drop: Final = make_button("Discard", self.discard, variant="outlined", margin=4)
        self.missing: Final = html(margin=(8, 4))
        self.fields: Final = UploadFields(self.look)
        self.content: Final = PreviewView(self.fields.name_fields)
        self.form: ColumnForm | None = None
        proposals = {"variant": "outlined", "margin": 4, "visible": False}
        self.take: Final = make_button("Take the proposed sign and delay", self.take_proposals, **proposals)
        self.room: Final = pn.Column(visible=False, **WIDE)
        self._parcel = PartialFile()
        self._name, self._content, self._digest = "", b"", ""
        self._digest_shown = ""  # SHA-256 of the file whose preview is shown
        self._preview: AnyPreview | None = None
        self.reading: Final = BackgroundTask(store.session)
        self.reading.param.watch(self._read, ["state", "place", "message"])
        store.param.watch(self._follow, "scenario")
        store.param.watch(self._entitle, ["source", "wanted_record"])

    def _follow(self, event: Any) -> None:
        if event.new.telescope.diameter != event.old.telescope.diameter:
            self.look()

    def _entitle(self, *_: object) -> None:
        source, wanted = self.store.source, self.store.wanted_record
        title = source.title if source else ""
        if wanted is not None:
            title = wanted.line(self._name, self._digest) if self._content and not self._is_wanted else wanted.line()
        self.picker.param.update(source_title=title, back=STAY if wanted else BACK)

    # ------------------------------------------------------------------ the file

    def handle(self, msg: dict[str, Any]) -> None:
        """Do what a message of the browser says; one that makes no sense is a file that cannot be read."""
        action = msg.get("action")
        if action == "simulate":
            self.store.simulate()
        elif action == "large":
            self.discard(too_large(safe_name(str(msg.get("name", "")))))
        elif action == "part":
            self._take(msg)
        elif action == "template":
            self.actions.save(Save(TEMPLATE_NAME, "text/csv", TEMPLATE.encode))
        elif action == "sample":
            self.actions.save(Save(SAMPLE_NAME, "text/csv", sample_csv))
        elif action == "scenario":
            self.actions.open_file(str(msg.get("name", "")), msg.get("text"))

    def _take(self, msg: dict[str, Any]) -> None:
        if msg.get("index") == 0:
            self.discard()
        try:
            content = self._parcel.take(msg)
        except ValueError as error:
            self.discard(str(error))
            return
        if content is not None:
            name = self._parcel.name
            if name.endswith(SUFFIX):
                self.actions.open_session(name, content)
            else:
                self._name, self._content, self._digest = name, content, hashlib.sha256(content).hexdigest()
                self._say("" if content else f"{name}: is empty")
                self._entitle()
                self.look()

    # ------------------------------------------------------------------ the preview

    @property
    def _is_wanted(self) -> bool:
        """Whether the file is that of the link that was opened."""
        return self.store.wanted_record is not None and self.store.wanted_record.sha256 == self._digest

    def read_fields(self) -> DeclaredFormat:
        """Read the fields, or what the link says of its file. Raises SettingError where one holds no number."""
        if self.store.wanted_record is not None and self._is_wanted:
            return self.store.wanted_record.declaration
        return self.fields.read(self.form.roles if self.form is not None else {})

    def take_proposals(self) -> None:
        """Fill in the sign and the delay that the data propose."""
        if isinstance(self._preview, Preview):
            self.fields.take_proposals(self._preview.reading)

    def look(self) -> None:
        """Read the file, beside the page, as what the fields say."""
        if not self._content:
            return
        scenario = self.store.scenario.replace({"telescope.radial_order": 6})  # as many modes as there may be

        def read() -> None:
            limits, cost = self.store.session.service.limits, len(self._content) / READ_RATE
            work = partial(read_stranger, self._content, self._name, scenario, self.read_fields(), limits)
            self.reading.start(Job("upload", lambda watch, _tell: work(watch), cost=cost, time_limit=limits.seconds))

        self.reading.attempt(read)

    def _read(self, *_: object) -> None:
        task = self.reading
        if task.state == RUNNING:
            self._say(task.line() if task.place else f"Reading {self._name} …")
        elif self._content and task.state != CANCELLED:
            found = RecordError(task.message) if task.state == FAILED else task.result
            (self._use_wanted if self._is_wanted else self._show)(found)

    def _use_wanted(self, preview: AnyPreview | RecordError) -> None:
        """Use the file of a link at once; look at it as at any other where that cannot be."""
        self._preview = preview if isinstance(preview, Preview) else None
        self.confirm()
        if self.store.wanted_record is not None:
            self.store.wanted_record = None
            self.look()

    def _show(self, preview: AnyPreview | RecordError) -> None:
        if isinstance(preview, ColumnsPreview):
            self._ask(preview)
            return
        self._preview = None if isinstance(preview, RecordError) else preview
        self.use.label = "Use this spectrum" if isinstance(preview, SpectrumPreview) else "Use this record"
        self.picker.message = "" if self._preview else self.fields.name_fields(str(preview))
        missing = self._obstacle(preview) if isinstance(preview, Preview) else ""
        self.missing.html = missing and f'<span role="status">{missing}</span>'
        self.use.disabled = self._preview is None or bool(missing)
        if self._preview is not None or self._digest_shown != self._digest:  # else what was read before stays
            self.content.show(self._name, self._preview)
            self._digest_shown = self._digest
        self.take.visible = isinstance(preview, Preview) and not self.fields.trust.value and bool(preview.reading.proposal)
        self._lay_out()

    def _obstacle(self, preview: Preview) -> str:
        """Say why a record cannot be used as it is, or nothing."""
        try:
            fit_to_record(preview.record, self.store.scenario)
        except SettingError as error:
            return name_settings(str(error))
        return self.fields.name_fields(preview.reading.missing)

    def _ask(self, preview: ColumnsPreview) -> None:
        """Ask which column is what; read the file at once if its names tell enough."""
        if self.form is None:
            self.form = ColumnForm(self.look)
            self.room.clear()
        self.form.show(preview.columns, preview.roles)
        self.form.view.visible = True
        self._show(RecordError(preview.why))
        if any(role.startswith("y_lgs/") for role in preview.roles) and any(role.startswith("u/") for role in preview.roles):
            self.look()

    def _lay_out(self) -> None:
        if not len(self.room):
            self.room[:] = [
                self.content.text,
                *([self.form.view] if self.form is not None else []),
                pn.FlexBox(*self.fields.widgets, self.take, gap="8px", align_items="center", margin=0),
                pn.pane.Bokeh(self.content.figure, **WIDE),
                pn.FlexBox(self.use, self.drop, self.missing, align_items="center", margin=0),
            ]
        self.room.visible = True

    def confirm(self) -> None:
        """Use what was read: a record with its rate, ratio and length in place of the simulation, or a spectrum of vibration."""
        found, said = self._preview, ""
        try:
            if isinstance(found, SpectrumPreview):
                self.store.replace({"vibration.source": "psd", "vibration.psd": found.table})
                said = f"The vibration has the spectrum of {found.name}."
            elif isinstance(found, Preview) and not self._obstacle(found):
                self.store.take_record(found, self.read_fields(), self._digest)
            else:
                return
        except SettingError as error:
            self._say(f"{self._name}: {str(error)[:300]}")
        else:
            self.discard(said)

    def discard(self, why: str = "") -> None:
        """Forget the file that is being looked at."""
        self._content, self._digest, self._preview = b"", "", None
        self._parcel.drop()
        self._entitle()
        self.fields.clear()  # what was said of one file is not true of the next
        if self.form is not None:
            self.form.view.visible = False
            self.form.show({}, {})
        self.reading.cancel()
        self.room.visible = False
        self._say(why)

    def _say(self, line: str) -> None:
        self.picker.message = line
