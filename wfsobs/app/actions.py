"""The menus: load and open files, save data and figures, make a report, share the settings; undo and redo by keys."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import param

from wfsobs.app.downloads import Save, TooLarge, data_csv, data_npz
from wfsobs.app.history import HistorySheet, session_save
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.jobs import DONE, FAILED, RUNNING, Job
from wfsobs.app.pages.pages import ViewState
from wfsobs.app.render import render
from wfsobs.app.report.page import make
from wfsobs.app.service import BackgroundTask
from wfsobs.app.session_file import SessionError, read_session
from wfsobs.app.share import FILE, Link, from_file, from_query, name_record, to_command, to_file, to_python, to_query
from wfsobs.app.sources import LoadedRecord, SimulatedRecord
from wfsobs.app.store import Store
from wfsobs.app.style import HtmlComponent, labels, script, sheets
from wfsobs.app.views.plots import AFTERWARDS_MS, once
from wfsobs.app.work import RunResults
from wfsobs.settings.values import SettingError

LARGEST = 2_000_000
"""Of a scenario file that is opened [bytes]."""

REPORT = "wfsobs-report.html"


class Menus(HtmlComponent):
    """The menus in the browser: texts down, messages {action, ...} up, files down as messages.

    A component whose name ended in Toolbar would be styled as one of a figure, and the whole page laid out anew each time.
    """

    query: param.String[str] = param.String("", doc="What a link to the settings has after its ?.")
    view: param.String[str] = param.String("", doc="What the address has beside the settings, of the view.")
    has_link: param.Boolean[bool] = param.Boolean(True, doc="Whether the settings are short enough for a link.")
    record: param.String[str] = param.String("", doc="The loaded record, where a link cannot name it.")
    command: param.String[str] = param.String("", doc="The settings as a command line.")
    python: param.String[str] = param.String("", doc="The settings as Python.")
    ready: param.Boolean[bool] = param.Boolean(False, doc="Whether there are results to save.")
    reporting: param.Boolean[bool] = param.Boolean(False, doc="Whether a report is being made.")
    message: param.String[str] = param.String("", doc="What was done, in one line.")
    notes: param.List[list[Any]] = param.List([], doc="What was refused, a line each.")
    labels: param.Dict[dict[str, str]] = param.Dict(
        {}, doc="Name of a line in the figures -> what it is called, for the legends of figures that are saved."
    )
    saves: param.List[list[Any]] = param.List([], doc="What the page can save beside the data, as it is called in the menu.")

    _esm = script("page", "markup", "figures", "actions")
    _stylesheets = sheets("base", "bare", "actions")

    def save(self, name: str, kind: str, content: bytes) -> None:
        """Have the browser save a file."""
        self._send_msg({"name": name, "kind": kind, "content": content})

    @param.depends("ready", "reporting", "saves", "notes", watch=True, on_init=True)
    def _draw(self) -> None:
        names = "ready", "reporting", "saves", "notes"
        self.html = render("toolbar.html", **{name: getattr(self, name) for name in names})


class Actions:
    """The toolbar over a store."""

    def __init__(self, store: Store, sheet: HistorySheet, view: ViewState, seeds: SeedRuns):
        """Make the menus. view : of the page, and its pages;  seeds : what a report says of further seeds."""
        self.store = store
        self.sheet: Final = sheet
        self.view: Final = view
        self.pages: Final = view.pages
        self._seeds = seeds
        self.toolbar: Final = Menus(self.handle, labels=labels(), margin=0)
        self._tasks: dict[str, BackgroundTask] = {}
        self._under_way: dict[str, tuple[str, Callable[[Any], None]]] = {}
        store.param.watch(once(self._refresh, AFTERWARDS_MS), ["scenario", "preset", "source", "wanted_record"])
        store.param.watch(lambda _event: self.toolbar.param.update(notes=[]), "source")  # of files before the one that is used
        store.run.param.watch(lambda event: self.toolbar.param.update(ready=event.new is not None), "result")
        self.pages.param.watch(self._turn, "current")
        view.param.watch(self._follow_view, "query", onlychanged=False)
        self._refresh()

    def _follow_view(self, event: Any) -> None:
        """Keep the view in the address, behind settings that wait for theirs: an entry of the browser's history has both."""
        self._refresh()
        self.toolbar.view = event.new

    def open_view(self, query: str) -> None:
        """Bring the page to the view of an address, and name what cannot be taken."""
        if refused := self.view.open(query):
            self.toolbar.notes = [*self.toolbar.notes, *(f"Not used from the link: {line}" for line in refused)]

    def _turn(self, _event: object) -> None:
        self.toolbar.saves = [*self.pages.page.saves()]
        self._refresh()

    def handle(self, msg: dict[str, Any]) -> None:
        """Do what a message of the toolbar says."""
        does: dict[str, Callable[[], object]] = {
            "undo": self.store.undo,
            "redo": self.store.redo,
            "history": self.sheet.toggle,
            "session": lambda: self.save(session_save(self.sheet.history)),
            "unlinked": lambda: self._note("These settings are too long for a link: save the scenario and send the file."),
            "dismiss": lambda: self.toolbar.param.update(notes=[]),
            # what has been read is unsaid, unless something else has been said meanwhile
            "read": lambda: self.toolbar.message == msg.get("text") and self.toolbar.param.update(message=""),
            "view": lambda: self.open_view(str(msg.get("query", ""))),
            "report": self.make_report,
            "toml": self.save_scenario,
            "csv": lambda: self.save_data("wfsobs.csv", "text/csv", data_csv),
            "npz": lambda: self.save_data("wfsobs.npz", "application/octet-stream", data_npz),
            "page": lambda: self.save_of_page(str(msg.get("key", ""))),
        }
        if (action := str(msg.get("action"))) in does:
            does[action]()

    def open_link(self, query: str) -> None:
        """Take the settings that the page's address asks for, and name what cannot be taken."""
        link = from_query(query, self.store.validate)
        kept = SimulatedRecord(link.simulation) if link.simulation and link.simulation != link.scenario else None
        self.store.load(link.scenario, link.preset, kept)
        self.store.wanted_record = link.record
        self.toolbar.notes = [f"Not used from the link: {line}" for line in link.errors]

    def open_file(self, name: str, text: object) -> None:
        """Take the settings of a TOML file, read in a thread, or say in one line why not; then nothing changes."""
        if not isinstance(text, str) or len(text) > LARGEST:
            self._note(f"{name[:80]}: larger than {LARGEST // 1_000_000} MB, not a scenario")
            return
        job = Job("upload", lambda _watch, _tell: from_file(text), refusal=SettingError)
        self._start("open", name[:80], job, partial(self._take, name))

    def _take(self, name: str, link: Link) -> None:
        try:
            self.store.load(link.scenario, link.preset or None)
        except SettingError as error:
            self._note(f"{name[:80]}: {_reason(str(error))}")
        else:
            self.toolbar.param.update(notes=[], message=f"Opened {name[:80]}.")

    def open_session(self, name: str, content: bytes) -> None:
        """Read a session's file beside the page, and show it; nothing changes where it cannot be read."""
        job = Job("upload", lambda _watch, _tell: read_session(content), refusal=SessionError)
        self._start("open", name[:80], job, partial(self.sheet.show_session, name))

    def save_scenario(self) -> None:
        """Send the settings as TOML."""
        text = to_file(self.store.scenario, self.store.preset)
        self.save(Save(FILE, "application/toml", text.encode))

    def save_data(self, name: str, kind: str, make: Callable[[RunResults], bytes]) -> None:
        """Make a file of the results shown, beside the page, and send it."""
        shown = self.store.run.result
        if shown is None:
            self._note("There are no results to save yet.")
        else:
            self.save(Save(name, kind, lambda: make(shown)))

    def save_of_page(self, what: str) -> None:
        """Make a file of what the page shown has found, and send it."""
        saves = self.pages.page.saves()
        if (save := saves.get(what)) is not None:
            self.save(save)
        elif what in saves:
            self._note(f"{what}: there is none yet.")

    def save(self, save: Save) -> None:
        """Make a file beside the page, and send it."""
        job = Job("save", lambda _watch, _tell: save.content(), refusal=TooLarge)
        self._start(save.name, save.name, job, partial(self.toolbar.save, save.name, save.kind))

    def make_report(self) -> None:
        """Make the report of the results shown, beside everything else, and send it; one at a time."""
        shown, preset = self.store.run.result, self.store.preset
        if shown is None or self.toolbar.reporting:
            return
        command = to_command(shown.scenario, preset, shown.source) if shown.is_recorded else ""
        evidence = self._seeds.evidence
        beside = self.pages.shown_beside(shown.result, evidence)
        job = Job("report", partial(make, shown, preset, command=command, evidence=evidence, **beside))
        self._start("report", "Report", job, partial(self.toolbar.save, REPORT, "text/html"))

    def _start(self, which: str, name: str, job: Job, then: Callable[[Any], None]) -> None:
        """Have a job done, one of each at a time, say under a name how it goes, and then do something with its result."""
        self._under_way[which] = name, then
        if which not in self._tasks:
            task = self._tasks[which] = BackgroundTask(self.store.session)
            task.param.watch(lambda *_: self._follow(which), ["state", "place"])
        self._tasks[which].start(job)

    def _follow(self, which: str) -> None:
        task, (name, then) = self._tasks[which], self._under_way[which]
        if which == "report":
            self.toolbar.reporting = task.state == RUNNING
        if task.state == FAILED:
            self._note(f"{name}: {_reason(task.message)}")
        else:
            self.toolbar.param.update(notes=[], message=f"{name}: {task.line()}" if task.place else "")
        if task.state == DONE:
            then(task.result)

    def _note(self, line: str) -> None:
        self.toolbar.param.update(notes=[line], message="")

    def _refresh(self, *_: object) -> None:
        scenario, preset, source = self.store.scenario, self.store.preset, self.store.source
        named = name_record(source) or self.store.wanted_record
        query = to_query(scenario, preset, source.simulation if source else None, named)
        task = self.pages.page.task
        self.toolbar.param.update(
            has_link=query is not None,
            query=query or "",
            record=source.name if isinstance(source, LoadedRecord) and named is None else "",
            command=to_command(scenario, preset, source, task),
            python=to_python(scenario, preset, source, task),
        )


def _reason(text: str) -> str:
    return text.removeprefix("file: ")[:300]
