"""The history of a session: every result that was shown, which ones are compared with the present one, and the way back to each.

Settings and scores of an entry stay. Its traces stay as long as the session's share of memory allows; otherwise its settings
and seed give the same ones again. What a session holds of loaded records is limited as well, for nothing gives these again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, Final

import param

from wfsobs.app.compared import LETTERS, ComparedRun, name_of_change, thin_lines
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save, TooLarge
from wfsobs.app.jobs import DONE, FAILED
from wfsobs.app.render import number, render
from wfsobs.app.service import BackgroundTask, run_key
from wfsobs.app.session_file import (
    LARGEST,
    LONGEST_NAME,
    MOST,
    RECORD_BYTES,
    SUFFIX,
    HistoryEntry,
    SessionContent,
    let_go,
    make_entry,
    write_session,
)
from wfsobs.app.sources import Step
from wfsobs.app.store import Store
from wfsobs.app.style import NO_ROOM, HtmlComponent, look, script, sheets
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import Evidence, rank_observers
from wfsobs.evaluation.result import can_be_best
from wfsobs.evaluation.scores import PREDICTION
from wfsobs.observers.base import TARGETS
from wfsobs.scenario.names import name_settings
from wfsobs.settings.values import SettingError

AFTER_DRAWING = 1
"""Precedence of a watcher that comes after the figures, whose own is 0, and before the status line, whose own is 2."""


class History(param.Parameterized):
    """The entries, newest first, in step with the store; and the runs of the display that are compared."""

    entries: param.List[list[HistoryEntry]] = param.List([], item_type=HistoryEntry, doc="Every result, newest first.")
    current: param.String[str] = param.String("", doc="Key of the entry shown.")
    note: param.String[str] = param.String("", doc="What was done or refused, in one line.")
    can_undelete: param.Boolean[bool] = param.Boolean(False, doc="Whether an entry was deleted that can come back.")

    def __init__(self, store: Store, display: Display):
        super().__init__()
        self.store = store
        self.display = display
        service = store.session.service
        self.most_bytes: int = service.session_share(service.cache.most_bytes)
        self.most_record_bytes: int = service.session_share(RECORD_BYTES)
        self.open_view: Callable[[str], Any] = lambda _query: None
        self._query = ""
        self._view_to_open = "", ""  # key of the results to wait for, and the view
        self._shown_step: Step | None = None
        self._deletions: list[HistoryEntry] = []
        self.task: Final = BackgroundTask(store.session)
        # After the store, which says what is stale, and the figures; before "Done" is said.
        store.run.param.watch(self._on_run, ["state", "result"], precedence=AFTER_DRAWING)
        self.task.param.watch(self._on_lines, "state")

    def find(self, key: str) -> HistoryEntry | None:
        """Return the entry of a key, or None."""
        return next((entry for entry in self.entries if entry.key == key), None)

    # ------------------------------------------------------------------ what comes in

    def _on_run(self, *_: object) -> None:
        """Keep a result that is complete; show a restored one as it was."""
        run, (key, view) = self.store.run, self._view_to_open
        results: RunResults | None = run.result
        if results is None or self.store.stale:
            return
        if key:  # the first results since: of what is restored, or of what was changed in its place
            self._view_to_open = "", ""
            if run_key(results.scenario, results.source) == key:
                self.open_view(view)
        if run.state == DONE:
            self.keep((results.scenario, self.store.preset, results.source), results)

    def keep(self, step: Step, results: RunResults | None = None) -> None:
        """Put settings and what they gave on top; those that are there already move there."""
        entry = make_entry(step, "", results)
        known = self.find(entry.key)
        if known is None:
            entry.name, known = name_of_change(self._shown_step, step), entry
        else:
            known.time = entry.time
            known.scores, known.source = entry.scores or known.scores, entry.source
        known.results, known.view = results or known.results, self._query
        self._shown_step = step
        if results is not None:
            self.current = known.key
        self._put([known, *(e for e in self.entries if e is not known)])

    def add(self, entries: list[HistoryEntry]) -> None:
        """Add entries in the order of their times; of those that are there already a star, and a name that was given."""
        for entry in entries:
            if (known := self.find(entry.key)) is not None:
                known.star = known.star or entry.star
                if entry.own_name and not known.own_name:
                    known.name, known.own_name = entry.name, True
        own = {entry.key for entry in self.entries}
        merged = [*self.entries, *(entry for entry in entries if entry.key not in own)]
        self._put(sorted(merged, key=lambda entry: -entry.time))

    def follow_view(self, query: str) -> None:
        """Keep the view with what is shown."""
        self._query = "&".join(part for part in query.split("&") if part.startswith("view."))
        entry = self.find(self.current)
        if entry is not None and self.store.run.state == DONE and not self.store.stale and not self._view_to_open[0]:
            entry.view = self._query

    def _put(self, entries: list[HistoryEntry]) -> None:
        """Replace the entries, within the limits."""
        used = {run.key for run in self.display.compared_runs} | {self.current}
        spare = [entry.key for entry in reversed(entries) if not entry.star and entry.key not in used]
        gone = set(spare[: max(len(entries) - MOST, 0)])
        self.entries = [entry for entry in entries if entry.key not in gone]
        lines = [run.lines for run in self.display.compared_runs]
        let_go(self.entries, self.current, self.most_bytes, self.most_record_bytes, lines)
        self.param.trigger("entries")

    # ------------------------------------------------------------------ what is asked for

    def rename(self, key: str, name: str) -> None:
        """Give an entry another name; an empty one changes nothing."""
        entry, name = self.find(key), " ".join(name.split())[:LONGEST_NAME]
        if entry is not None and name:
            entry.name, entry.own_name = name, True
            self._update_run(key, name=name)
        self.param.trigger("entries")

    def star(self, key: str) -> None:
        """Give an entry a star, or take it away."""
        if (entry := self.find(key)) is not None:
            entry.star = not entry.star
            self.param.trigger("entries")

    def delete(self, key: str) -> None:
        """Take an entry away; `undelete` brings it back."""
        if (entry := self.find(key)) is not None:
            self.compare(key, False)
            entry.results = None
            self._deletions.append(entry)
            self.param.update(can_undelete=True, note=f"Deleted {entry.name}.")
            self._put([e for e in self.entries if e is not entry])

    def undelete(self) -> None:
        """Bring the entry back that was deleted last."""
        if self._deletions:
            entry = self._deletions.pop()
            self.param.update(can_undelete=bool(self._deletions), note=f"{entry.name} is back.")
            self.add([entry])

    def restore(self, key: str) -> None:
        """Return to the settings, the record and the view of an entry."""
        entry = self.find(key)
        if entry is None:
            return
        if not entry.is_restorable:
            self.note = f"{entry.name}: {entry.record} is no longer held, load it again"
            return
        if entry.results is not None:
            self.store.session.service.cache.put(entry.key, entry.results)
        if self._return_to(entry.step, entry.view, entry.name):
            self.note = f"Restored {entry.name}."

    def content(self) -> SessionContent:
        """Return what a file of the session holds."""
        entries = [replace(entry, results=None, evidence=None) for entry in self.entries]
        return SessionContent(entries, self.store.step, self._query, [run.key for run in self.display.compared_runs])

    def open(self, content: SessionContent, name: str) -> None:
        """Add the entries of a session's file, and show what it showed."""
        self.add([*content.entries])
        if not self.display.compared_runs:
            for key in content.compared_keys:
                self.compare(key)
        if self._return_to(content.step, content.view, name):
            count = len(content.entries)
            self.note = f"Opened {name}: {count} result{'s' * (count != 1)}."

    def _return_to(self, step: Step, view: str, name: str) -> bool:
        """Show settings and a view again; say under a name why not where they are refused."""
        if self.store.stale or self.store.run.result is None:  # what has not run is not lost either
            self.keep(self.store.step)
        try:
            self.store.restore(step)
        except SettingError as error:
            self.note = f"{name}: {error}"
            return False
        key = run_key(step[0], step[2])
        if key == self.current and not self.store.stale:
            self.open_view(view)
        else:
            self._view_to_open = key, view
        return True

    def compare(self, key: str, on: bool = True) -> None:
        """Compare an entry with what is shown, or no longer."""
        entry, runs = self.find(key), [run for run in self.display.compared_runs if run.key != key]
        if on and entry is not None:
            if len(runs) == len(LETTERS):
                self.note = f"{len(LETTERS)} are compared already: untick one of them first."
                return
            letter = next(letter for letter in LETTERS if letter not in [run.letter for run in runs])
            shown = self.store.run.result if entry.key == self.current else None
            results = entry.results or shown
            lines = thin_lines(results) if results else None
            run = ComparedRun(entry.key, letter, entry.name, entry.scenario, entry.scores, lines, entry.evidence)
            runs = sorted([*runs, run], key=lambda it: it.letter)
        self._show_runs(runs)

    def note_evidence(self, evidence: Evidence | None) -> None:
        """Attach errors over several seeds to the entry that is shown; those of another result are ignored."""
        entry = self.find(self.current)
        if evidence is None or entry is None or not all(score in entry.scores for score in evidence.record.values()):
            return
        entry.evidence = evidence
        self._update_run(entry.key, evidence=evidence)

    def _update_run(self, key: str, **values: Any) -> None:
        """Change what is said of an entry where it is compared."""
        runs = self.display.compared_runs
        if any(run.key == key for run in runs):
            self.display.compared_runs = [replace(run, **values) if run.key == key else run for run in runs]

    def compare_none(self) -> None:
        """Compare nothing any more."""
        self._show_runs([])

    def _show_runs(self, runs: list[ComparedRun]) -> None:
        self.display.compared_runs = runs
        self._put(self.entries)
        self._make_lines()

    # ------------------------------------------------------------------ traces made again

    def _make_lines(self) -> None:
        """Run the first compared entry whose traces are no longer there."""
        self.task.close()
        for run in self.display.compared_runs:
            entry = self.find(run.key) if run.lines is None else None
            if entry is None or not entry.is_restorable:
                continue
            try:
                self.task.start(self.store.session.service.run(entry.scenario, entry.source))
            except SettingError as error:
                self.note = f"{entry.name}: {error}"
            else:
                return

    def _on_lines(self, *_: object) -> None:
        results: RunResults | None = self.task.result
        if self.task.state == FAILED:
            self.note = self.task.message
        if self.task.state != DONE or results is None:
            return
        key = run_key(results.scenario, results.source)
        self.task.result = None
        if (entry := self.find(key)) is not None:
            entry.results = results
            self._update_run(key, lines=thin_lines(results))
            self._put(self.entries)
        self._make_lines()


FILE = f"session{SUFFIX}"


class Sheet(HtmlComponent):
    """The sheet in the browser; it asks by messages {action, key, name, on}, and has contents only while it is open."""

    open: param.Boolean[bool] = param.Boolean(False, doc="Whether it is seen.")

    _esm = script("page", "markup", "history")
    _stylesheets = sheets("base", "history")


class HistorySheet:
    """The sheet over a history, made when it is first opened."""

    def __init__(self, history: History, show: Callable[[Sheet], None]):
        """Make nothing yet. show : puts the sheet on the page, once."""
        self.history = history
        self.display: Final = history.display
        self._show = show
        self.message = ""
        self.rows, self._stars_alone = list[dict[str, Any]](), False

    def toggle(self) -> None:
        """Open the sheet, or close it."""
        if self.sheet.open:
            self.close()
        else:
            self.sheet.open = True
            self._refresh()

    def close(self) -> None:
        """Close the sheet, which needs no rows then."""
        self.rows = []
        self.sheet.param.update(open=False, html="")

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
            "filter": lambda: self._show_stars_alone(msg.get("on") is True),
        }
        if msg.get("action") in does:
            does[msg["action"]]()

    def show_session(self, name: str, content: SessionContent) -> None:
        """Add what a session's file of this name holds, where it is seen."""
        if not self.sheet.open:
            self.toggle()
        self.history.open(content, name)

    @cached_property
    def sheet(self) -> Sheet:
        """The sheet in the browser."""
        sheet = Sheet(self.handle, **NO_ROOM, styles={"position": "absolute"})
        self.history.param.watch(self._refresh, ["entries", "current", "can_undelete"])
        self.history.param.watch(lambda event: self._say(event.new), "note", onlychanged=False)
        self.display.param.watch(self._refresh, ["mode", "unit", "compared_runs"])
        self._show(sheet)
        return sheet

    def _say(self, line: str) -> None:
        self.message = name_settings(line)
        self._refresh()

    def _show_stars_alone(self, alone: bool) -> None:
        self._stars_alone = alone
        self._refresh()

    def _refresh(self, *_: object) -> None:
        if self.sheet.open:
            runs = {run.key: run for run in self.display.compared_runs}
            self.rows = [self._row(entry, runs.get(entry.key)) for entry in self.history.entries]
            self.sheet.html = render(
                "history.html",
                rows=[row for row in self.rows if row["star"] or not self._stars_alone],
                starred=self._stars_alone,
                room=len(runs) < len(LETTERS),
                undo=self.history.can_undelete,
                message=self.message,
            )

    def _row(self, entry: HistoryEntry, run: ComparedRun | None) -> dict[str, Any]:
        return {
            **{name: getattr(entry, name) for name in ("key", "name", "time", "star")},
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
    scale = display.scale(entry.scenario)
    parts = []
    for target in (*TARGETS, PREDICTION):
        own = [s for s in entry.scores if (s.target, s.mode) == (target, display.mode)]
        if errors := {s.observer: s.rms for s in own if can_be_best(s.observer, s.apart)}:
            best = rank_observers(errors)[0]
            parts.append(f"{target.capitalize()} {number(errors[best] * scale)} {display.unit_label} ({look(best).label})")
    return ", ".join(parts)
