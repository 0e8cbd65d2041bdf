"""The sheet of the history: its results, and the session as a file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import param

from wfsobs.app.compared import LETTERS, ComparedRun
from wfsobs.app.component import Component
from wfsobs.app.controls.names import name_settings
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.downloads import Save, TooLarge
from wfsobs.app.history import History
from wfsobs.app.jobs import DONE, FAILED, RUNNING, BackgroundTask, Job
from wfsobs.app.picker import LARGEST, PART, PartialFile, too_large
from wfsobs.app.render import number, render
from wfsobs.app.session_file import SUFFIX, HistoryEntry, SessionError, read_session, write_session
from wfsobs.app.style import asset, look
from wfsobs.evaluation.evidence import rank_observers
from wfsobs.evaluation.rows import can_be_best
from wfsobs.evaluation.scores import PREDICTION, Score
from wfsobs.observers.base import TARGETS
from wfsobs.telemetry.preview import safe_name

FILE = f"session{SUFFIX}"


class Sheet(Component):
    """The sheet in the browser; it asks by messages {action, key, name, on}, and has contents only while it is open."""

    open = param.Boolean(False, doc="Whether it is seen.")
    dark = param.Boolean(False, doc="Dark mode.")
    html = param.String("", doc="What is in it.")
    largest = param.Integer(LARGEST, doc="The largest file that is sent [bytes].")
    part = param.Integer(PART, doc="How much is sent at a time [bytes].")

    _esm = asset("patch.js") + asset("markup.js") + asset("parts.js") + asset("history.js")
    _stylesheets = [asset("history.css")]


class HistorySheet:
    """The sheet over a history, made when it is first opened."""

    def __init__(self, history: History, show: Callable[[Sheet], None]):
        """Make nothing yet. show : puts the sheet on the page, once."""
        self.history, self.display, self._show = history, history.display, show
        self.sheet: Sheet | None = None
        self._parcel = PartialFile()
        self._name = self.message = ""
        self.rows, self._starred = list[dict[str, Any]](), False
        self.saving, self.reading = BackgroundTask(history.store.session), BackgroundTask(history.store.session)
        self.saving.param.watch(self._save, ["state", "place"])
        self.reading.param.watch(self._open, ["state", "place"])

    def toggle(self) -> None:
        """Open the sheet, or close it."""
        if self._sheet().open:
            self.close()
        else:
            self._sheet().open = True
            self._refresh()

    def close(self) -> None:
        """Close the sheet, which needs no rows then."""
        self.rows = []
        self._sheet().param.update(open=False, html="")

    def handle(self, msg: dict[str, Any]) -> None:
        """Do what a message of the sheet says."""
        history, key = self.history, str(msg.get("key", ""))
        does: dict[str, Callable[[], None]] = {
            "close": self.close,
            "star": lambda: history.star(key),
            "rename": lambda: history.rename(key, str(msg.get("name", ""))),
            "compare": lambda: history.compare(key, msg.get("on") is True),
            "restore": lambda: history.restore(key),
            "delete": lambda: history.delete(key),
            "undelete": history.undelete,
            "filter": lambda: self._show_starred(msg.get("on") is True),
            "save": self.save,
            "large": lambda: self._say(too_large(safe_name(str(msg.get("name", ""))))),
            "part": lambda: self._take(msg),
        }
        if msg.get("action") in does:
            does[msg["action"]]()

    # ------------------------------------------------------------------ the session as a file

    def save(self) -> None:
        """Make the session's file beside the page, and send it."""
        save = session_save(self.history)
        self.saving.start(Job("save", lambda *_: save.content(), refusal=TooLarge))

    def _save(self, *_: object) -> None:
        task = self.saving
        self._say({RUNNING: task.line("Writing the session"), FAILED: task.message}.get(task.state, ""))
        if task.state == DONE:
            self._sheet().save(FILE, "application/zip", task.result)
            self._say(f"Saved {FILE}.")

    def _take(self, msg: dict[str, Any]) -> None:
        try:
            content = self._parcel.take(msg)
        except ValueError as error:
            self._say(str(error))
            return
        if content is not None:
            self.open_file(self._parcel.name, content)

    def open_file(self, name: str, content: bytes) -> None:
        """Read a session's file beside the page, and open it; nothing changes where it cannot be read."""
        if not self._sheet().open:
            self.toggle()
        self._name = name
        self.reading.start(Job("upload", lambda _watch, _tell: read_session(content), refusal=SessionError))

    def _open(self, *_: object) -> None:
        task = self.reading
        self._say({RUNNING: task.line(f"Reading {self._name}"), FAILED: f"{self._name}: {task.message}"}.get(task.state, ""))
        if task.state == DONE:
            self.history.open(task.result, self._name)

    # ------------------------------------------------------------------ the sheet

    def _sheet(self) -> Sheet:
        if self.sheet is None:
            self.sheet = Sheet(self.handle, width=0, height=0, margin=0, styles={"position": "absolute"})
            self.history.param.watch(self._refresh, ["entries", "current", "can_undelete"])
            self.history.param.watch(lambda event: self._say(event.new), "note", onlychanged=False)
            self.display.param.watch(self._refresh, ["mode", "unit", "dark", "compared_runs"])
            self._show(self.sheet)
        return self.sheet

    def _say(self, line: str) -> None:
        self.message = name_settings(line)
        self._refresh()

    def _show_starred(self, alone: bool) -> None:
        self._starred = alone
        self._refresh()

    def _refresh(self, *_: object) -> None:
        sheet = self._sheet()
        if sheet.open:
            runs = {run.key: run for run in self.display.compared_runs}
            self.rows = [self._row(entry, runs.get(entry.key)) for entry in self.history.entries]
            html = render(
                "history.html",
                rows=[row for row in self.rows if row["star"] or not self._starred],
                starred=self._starred,
                room=len(runs) < len(LETTERS),
                undo=self.history.can_undelete,
                message=self.message,
                suffix=SUFFIX,
            )
            sheet.param.update(html=html, dark=self.display.dark)

    def _row(self, entry: HistoryEntry, run: ComparedRun | None) -> dict[str, Any]:
        return {
            "key": entry.key,
            "name": entry.name,
            "time": entry.time,
            "star": entry.star,
            "letter": run.letter if run else "",
            "current": entry.key == self.history.current,
            "restorable": entry.is_restorable,
            "what": f"Record {entry.record}" if entry.record else "",
            "scores": best_scores(entry, self.display),
            "note": self._note(entry, making=run is not None and run.lines is None),
        }

    def _note(self, entry: HistoryEntry, making: bool) -> str:
        """Say what of an entry is not there any more."""
        if not entry.is_restorable:
            return "Scores alone: its record is no longer held"
        if making:
            return "Its lines are being made again"
        if not entry.scores:
            return "Not run yet: restoring runs it"
        if entry.results is None and entry.key != self.history.current:
            return "Restoring runs it again"
        return ""


def session_save(history: History) -> Save:
    """Offer a session as a file."""
    content = history.content()

    def write() -> bytes:
        file = write_session(content)
        if len(file) > LARGEST:
            raise TooLarge(f"The session has {len(file) / 1e6:.0f} MB, more than can be opened: delete results of records")
        return file

    return Save(FILE, "application/zip", write)


def best_scores(entry: HistoryEntry, display: Display) -> str:
    """Write the smallest error of each target in the mode shown, and whose it is."""
    scale = per_micrometre(display.unit, entry.scenario.telescope.diameter)
    parts = []
    for target in (*TARGETS, PREDICTION):
        scores: list[Score] = [
            s for s in entry.scores if (s.target, s.mode) == (target, display.mode) and can_be_best(s.observer, s.apart)
        ]
        if scores:
            errors = {s.observer: s.rms for s in scores}
            best = rank_observers(errors)[0]
            parts.append(f"{target.capitalize()} {number(errors[best] * scale)} {display.unit_label} ({look(best).label})")
    return ", ".join(parts)
