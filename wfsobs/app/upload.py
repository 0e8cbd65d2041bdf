"""A record or a vibration spectrum from a file, in place of the simulated one, after a preview.

The browser sends the file in parts. What it is said to be can be changed while the preview stands; nothing runs before it
is confirmed. Reading is done beside the page, in a thread.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.column_form import ColumnForm
from wfsobs.app.controls.names import name_settings
from wfsobs.app.jobs import CANCELLED, FAILED, RUNNING, BackgroundTask, Job
from wfsobs.app.picker import PartialFile, Picker, too_large
from wfsobs.app.sample_files import Examples
from wfsobs.app.session_file import SUFFIX
from wfsobs.app.sources import fit_to_record
from wfsobs.app.store import RecordPlace, Store
from wfsobs.app.upload_fields import UploadFields, differs_from_proposals
from wfsobs.app.upload_preview import AnyPreview, PreviewView, read_stranger
from wfsobs.record import RecordError
from wfsobs.settings.errors import SettingError
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import ColumnsPreview, Preview, SpectrumPreview, safe_name

BACK, STAY = "Back to the simulation", "Stay with the simulation"


class Upload:
    """How a record comes into a session's store, whose aperture turns angles into wavefronts."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.picker = Picker(sizing_mode="stretch_width", margin=0)
        self.picker.on_message = self.handle
        self.use = pmui.Button(label="Use this record", color="primary", size="small", margin=4)
        self.drop = pmui.Button(label="Discard", variant="outlined", size="small", margin=4)
        self.missing = pn.pane.HTML("", margin=(8, 4))
        self.content = PreviewView()
        self.form: ColumnForm | None = None
        self.take = pmui.Button(
            label="Take the proposed sign and delay", variant="outlined", size="small", margin=4, visible=False
        )
        self.take.on_click(lambda _event: self.take_proposals())
        self.place = RecordPlace(store)
        self.examples = Examples(store, self.picker, self._say)
        self.open_scenario: Callable[[str, object], None] = lambda _name, _text: None
        self.open_session: Callable[[str, bytes], None] = lambda _name, _content: None
        self.room = pn.Column(visible=False, sizing_mode="stretch_width", margin=0)
        self._parcel = PartialFile()
        self._name, self._content, self._digest = "", b"", ""
        self._preview: AnyPreview | None = None
        self.reading = BackgroundTask(store.session)
        self.reading.param.watch(self._read, ["state", "place", "message"])
        self.use.on_click(lambda _event: self.confirm())
        self.drop.on_click(lambda _event: self.discard())
        self.fields = UploadFields(self.look)
        self._diameter = store.scenario.telescope.diameter
        store.param.watch(self._follow, "scenario")
        store.param.watch(self._entitle, ["source", "wanted_record"])

    def _follow(self, _event: object) -> None:
        diameter = self.store.scenario.telescope.diameter
        if diameter != self._diameter:
            self._diameter = diameter
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
            self.place.give_back()
        elif action == "large":
            self.discard(too_large(safe_name(str(msg.get("name", "")))))
        elif action == "part":
            self._take(msg)
        elif action == "template":
            self.examples.send_template()
        elif action == "sample":
            self.examples.send_sample()
        elif action == "scenario":
            self.open_scenario(str(msg.get("name", "")), msg.get("text"))

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
                self.open_session(name, content)
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
        """Read the fields, or what the link says of its file. Raises RecordError where one holds no number."""
        if self.store.wanted_record is not None and self._is_wanted:
            return self.store.wanted_record.declaration
        return self.fields.read(self.form.roles if self.form is not None else {})

    def take_proposals(self) -> None:
        """Fill in the sign and the delay that the data propose."""
        if isinstance(self._preview, Preview):
            self.fields.take_proposals(self._preview)

    def look(self) -> None:
        """Read the file, beside the page, as what the fields say."""
        if not self._content:
            return
        content, name = self._content, self._name
        scenario = self.store.scenario.replace({"telescope.radial_order": 6})  # as many modes as there may be
        try:
            stated = self.read_fields()
        except RecordError as error:
            self.reading.refuse(str(error))
            return

        self.reading.start(Job("upload", lambda _watch, _tell: read_stranger(content, name, scenario, stated)))

    def _read(self, *_: object) -> None:
        task = self.reading
        if task.state == RUNNING:
            self._say(task.line() if task.place else f"Reading {self._name} …")
        elif self._content and task.state != CANCELLED:
            found = RecordError(task.message) if task.state == FAILED else task.result
            if self._is_wanted:
                self._use_wanted(found)
            else:
                self._show(found)

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
        self.picker.message = "" if self._preview else str(preview)
        missing = self._obstacle(preview) if isinstance(preview, Preview) else ""
        self.missing.object = missing and f'<span role="status">{missing}</span>'
        self.use.disabled = self._preview is None or bool(missing)
        self.content.show(self._name, preview)
        self.take.visible = isinstance(preview, Preview) and differs_from_proposals(preview)
        self._lay_out()

    def _obstacle(self, preview: Preview) -> str:
        """Say why a record cannot be used as it is, or nothing."""
        try:
            fit_to_record(preview.record, self.store.scenario)
        except SettingError as error:
            return name_settings(str(error))
        return preview.reading.missing

    def _ask(self, preview: ColumnsPreview) -> None:
        """Ask which column is what; read the file at once if its names tell enough."""
        if self.form is None:
            self.form = ColumnForm(self.look, sizing_mode="stretch_width", margin=(4, 0))
            self.room.clear()
        self.form.show(preview.columns, preview.roles)
        self.form.visible = True
        self._show(RecordError(preview.why))
        if any(role.startswith("y_lgs/") for role in preview.roles) and any(role.startswith("u/") for role in preview.roles):
            self.look()

    def _lay_out(self) -> None:
        if not len(self.room):
            self.room[:] = [
                self.content.text,
                *([self.form] if self.form is not None else []),
                pn.FlexBox(*self.fields.widgets, self.take, gap="8px", align_items="center", margin=0),
                pn.pane.Bokeh(self.content.figure, sizing_mode="stretch_width", margin=0),
                pn.FlexBox(self.use, self.drop, self.missing, align_items="center", margin=0),
            ]
        self.room.visible = True

    def confirm(self) -> None:
        """Let the record take the place of the simulation, the settings of rate, ratio and length with it."""
        if isinstance(found := self._preview, SpectrumPreview):
            self._vibrate(found)
        if not isinstance(found, Preview) or self._obstacle(found):
            return
        try:
            self.place.take(found, self.read_fields(), self._digest)
        except SettingError as error:
            self._say(f"{found.name}: {error}")
        else:
            self.discard()

    def _vibrate(self, preview: SpectrumPreview) -> None:
        """Take a spectrum as that of the vibration."""
        try:
            self.store.replace({"vibration.source": "psd", "vibration.psd": preview.table})
        except SettingError as error:
            self._say(f"{preview.name}: {str(error)[:300]}")
        else:
            self.discard(f"The vibration has the spectrum of {preview.name}.")

    def discard(self, why: str = "") -> None:
        """Forget the file that is being looked at."""
        self._content, self._digest, self._preview = b"", "", None
        self._parcel.drop()
        self._entitle()
        if self.form is not None:
            self.form.visible = False
            self.form.show({}, {})
        self.reading.cancel()
        self.room.visible = False
        self._say(why)

    def _say(self, line: str) -> None:
        self.picker.message = line
