"""The drawer: preset, every setting by topic, and a box that finds them; and on the bar at the top the run and its progress."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import panel as pn
import panel_material_ui as pmui
import param

from wfsobs.app.controls.fields import NUMBER_WIDTH, ROOM, TAG, Field, SliderField, heading, heading_html, make_field
from wfsobs.app.controls.topics import TopicList
from wfsobs.app.display import label_of
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING
from wfsobs.app.store import Store
from wfsobs.app.style import PRIMARY, WIDE, Component, HtmlText, html, make_button, script, sheets, watch
from wfsobs.app.views.plots import AFTERWARDS_MS, once
from wfsobs.app.work import RunResults
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changed_settings
from wfsobs.scenario.names import preset_line, preset_title, setting_name
from wfsobs.scenario.presets import PRESETS
from wfsobs.scenario.scenario import idle_settings

ON_BAR = {
    "color": "#fff",
    "borderColor": "#fff",
    "&.Mui-disabled": {"color": "#ffffff80", "borderColor": "#ffffff60"},
    "&:hover": {"backgroundColor": "#ffffff30", "borderColor": "#fff", "color": "#fff"},
    "@media (max-width: 600px)": {
        "fontSize": 0,
        "minWidth": "40px",
        "height": "34px",
        "padding": 0,
        "& .MuiButton-startIcon": {"margin": 0, "fontSize": "22px"},
    },
}
"""Buttons on the bar at the top, which is dark in either mode; on a phone their icons alone are seen."""

BAR = ":host { align-items: center; }"

STATUS_ON_BAR = """
:host { color: #fff; display: contents !important; }
progress::-webkit-progress-value { background: #8fd3f0; }
progress::-moz-progress-bar { background: #8fd3f0; }
.line { white-space: nowrap; }
.note { color: #ffc9c2; height: auto; }
"""


class Status(Component):
    """The state of the run in the browser."""

    progress: param.Number[float] = param.Number(0.0, doc="Fraction done.")
    text: param.String[str] = param.String("", doc="The state, in words.")
    note: param.String[str] = param.String("", doc="What was refused.")
    label: param.String[str] = param.String("Progress of the run", doc="What the bar is the progress of.")

    _esm = script("status")
    _stylesheets = sheets("base", "status")


def status_of(store: Store) -> tuple[float, str, str]:
    """Return how much of the run is done, its state in one line, and what was refused in another.

    Work that goes on after it takes its place.
    """
    run, progress = store.run, store.run.progress
    seconds = f" in {run.result.seconds:.2f} s{_share(run.result)}" if run.result and run.state == DONE else ""
    text = {
        RUNNING: run.line(),
        DONE: f"Done{seconds}",
        CANCELLED: "Cancelled",
        FAILED: "The run failed",
    }.get(run.state, "")
    if store.waiting:
        text = waiting_text(store.waiting)
    elif run.state != RUNNING and store.session.doing:
        progress, text = next(reversed(store.session.doing.values()))
    note = f"Not accepted: {', '.join(map(setting_name, store.errors))}" if store.errors else ""
    return progress, text, note


def _share(run: RunResults) -> str:
    """Say how many observers ran where not all did."""
    every = {item.observer for item in (*run.result.estimates, *run.result.failures)}
    return f", {len(run.ran)} of {len(every)} ran" if run.ran is not None and len(run.ran) < len(every) else ""


def waiting_text(seconds: float) -> str:
    """How long a run takes that waits to be asked for.

    >>> waiting_text(12.3), waiting_text(1000.0)
    ('About 12 s: press Run', 'About 17 min: press Run')
    """
    length = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
    return f"About {length}: press Run"


class Search(Component):
    """The box in the browser; it gets the settings when it is first used, and asks where what is chosen or typed stands."""

    items: param.List[list[Any]] = param.List([], doc="{path, name} of every setting.")

    _esm = script("page", "search")
    _stylesheets = sheets("base", "search")

    def __init__(self, reveal: Callable[[str], object], **params: Any):
        """Make the box. reveal : opens the topic of the setting of a path."""
        self._reveal = reveal
        super().__init__(self._take, **params)

    def _take(self, data: dict[str, Any]) -> None:
        if data.get("open"):
            self.items = settings_found()
        elif isinstance(text := data.get("find"), str):
            if path := find_setting(text):
                self._reveal(path)
            self._send_msg({"path": path, "text": text})


def drawer_settings(scenario: Scenario) -> dict[str, param.Parameter[Any]]:
    """Return path -> declaration of every list of groups, and of every setting that is not in one."""
    lists = dict(scenario.lists())
    inner = tuple(f"{path}." for path in lists)
    return {**lists, **{path: p for path, _, p in scenario.walk() if not path.startswith(inner)}}


def settings_found() -> list[dict[str, str]]:
    """List every setting and every list of settings, by its name and its topic."""
    topics = Scenario.settings()
    known = drawer_settings(Scenario())
    return [{"path": path, "name": f"{label_of(p)} · {topics[topic_of(path)].label}"} for path, p in known.items()]


def find_setting(text: str) -> str:
    """Return the path of the setting in whose name or path every word stands, one whose name begins with them first; or nothing.

    >>> find_setting("outer scale"), find_setting("no such thing")
    ('turbulence.outer_scale', '')
    """
    text = text.strip().lower()
    found = [it for it in settings_found() if all(word in f"{it['name']} {it['path']}".lower() for word in text.split())]
    found.sort(key=lambda it: not it["name"].lower().startswith(text))
    return found[0]["path"] if found else ""


FIRST: Mapping[str, Sequence[str]] = {
    "": ("turbulence.wind_speed", "sensors.exposure_ratio"),
    "Online GPR": ("gpr_online.length_scale", "gpr_online.signal_std", "gpr_online.training_size"),
    "Vibration": ("vibration.peaks",),
}
"""Settings that stand above the topics, under a heading."""

AT_HAND = tuple(path for paths in FIRST.values() for path in paths)

TOPICS = ("vibration", "gpr_offline", "gpr_online")
"""Topics that come first; the others follow as declared."""


PRESET = "preset"
"""What the box of presets is called where the others are called by the paths of their settings."""


TWO_LINES = """
.MuiFormHelperText-root {
  height: 2lh; overflow: hidden; overflow-wrap: anywhere;
  display: -webkit-box; -webkit-line-clamp: 2; -webkit-box-orient: vertical;
}
"""
"""What is below must not move under the pointer with every change."""


EFFECT = "div { font-size: 12px; line-height: 14px; white-space: nowrap; overflow: hidden; text-overflow: ellipsis; }"

IN_GAP = {"position": "absolute", "bottom": "-6px", "max-width": f"calc(100% - {NUMBER_WIDTH + 8}px)"}
"""Below a slider, beside its number: what a change has done takes no room there, and what is below does not move."""


class Controls:
    """Everything in the drawer, in step with the store."""

    def __init__(self, store: Store):
        self.store = store
        self.fields: dict[str, Field] = {}
        self.headings: dict[str, HtmlText] = {}
        self.preset: Final = pmui.Select(
            label="Preset",
            tags=[TAG + PRESET],
            value=store.preset,
            options={preset_title(name): name for name in PRESETS},
            size="small",
            stylesheets=[TWO_LINES],
            min_height=75,
            **ROOM,
        )
        self.reset: Final = make_button("Reset", lambda: store.choose(store.preset), variant="text", margin=(4, 0))
        self.undo, self.redo = (
            make_button(name, act, variant="text", margin=(4, 4, 4, 0), disabled=True)
            for name, act in (("Undo", store.undo), ("Redo", store.redo))
        )
        white = ON_BAR | {"backgroundColor": "#fff", "color": PRIMARY}
        self.run: Final = make_button("Run", store.start, icon="play_arrow", sx=white)
        self.cancel: Final = make_button(
            "Cancel", store.run.cancel, icon="stop", variant="outlined", margin=(0, 10, 0, 6), sx=ON_BAR
        )
        self.status: Final = Status(sizing_mode="stretch_width", max_width=200, margin=0, stylesheets=[STATUS_ON_BAR])
        self.effect_of: Callable[[RunResults, RunResults], str] = lambda _before, _now: ""
        self._effect = html(stylesheets=[EFFECT])
        self._before: RunResults | None = None
        self._changed_part: Field | None = None
        self._settings = drawer_settings(store.scenario)
        groups = Scenario.settings()
        self.topics: Final = {name: str(groups[name].label) for name in dict.fromkeys((*TOPICS, *groups))}
        self.rooms: Final[dict[str, pn.Column]] = {}
        self.topic_list: Final = TopicList(self.topics, self.open_topic)
        self.search: Final = Search(
            lambda path: path in AT_HAND or self.topic_list.open(topic_of(path)),
            sizing_mode="stretch_width",
            margin=(8, 0, 4, 0),
        )
        self.preset.param.watch(lambda event: event.new == store.preset or store.choose(event.new), "value")
        watch(self._refresh_preset, (store, ["preset", "can_undo", "can_redo"]))
        watch(once(self._count_changes, AFTERWARDS_MS), (store, ["scenario", "preset"]))
        watch(self._refresh_parts, (store, ["scenario", "source"]))
        watch(self._refresh_run, (store, ["errors", "waiting"]), (store.session, "doing"))
        store.run.param.watch(self._show_effect, "state")
        # Last, so that "Done" is said of what has been drawn.
        store.run.param.watch(self._refresh_run, ["state", "progress", "place", "message"], precedence=2)
        self._refresh_run()
        self._refresh_preset()
        self._count_changes()

    def view(self) -> pn.Column:
        """Make the contents of the drawer."""
        first: list[Any] = []
        for title, paths in FIRST.items():
            first += [heading(title)] if title else []
            first += [self._field(path).view for path in paths]
        self._refresh_parts()
        return pn.Column(
            self.preset,
            pn.Row(self.undo, self.redo, self.reset, min_height=43, **WIDE),
            *first,
            self.search,
            self.topic_list.view,
            sizing_mode="stretch_width",
            margin=(8, 14),
        )

    def bar(self) -> pn.Row:
        """Return what stays in sight: the buttons of the run, and how it is going."""
        return pn.Row(self.run, self.cancel, self.status, **WIDE, stylesheets=[BAR])

    def open_topic(self, name: str) -> pn.Column:
        """Return a topic's room, filled with its fields the first time it is opened."""
        if name not in self.rooms:
            views: list[Any] = []
            group = name
            for path in self._settings:
                if topic_of(path) != name or path in AT_HAND:
                    continue
                above = path.rpartition(".")[0] or name
                if above != group:
                    group = above
                    self.headings[group] = heading("")
                    views.append(self.headings[group])
                views.append(self._field(path).view)
            self.rooms[name] = pn.Column(*views, sizing_mode="stretch_width", margin=(4, 8, 12, 8))
            self._refresh_parts()
        return self.rooms[name]

    def take(self, change: dict[str, Any]) -> None:
        """Make a change of the visitor's that did not arrive: {setting, value} of a box, {setting, message} of a table.

        One that makes no sense, or none any more, is left.
        """
        path, value = change.get("setting"), change.get("value")
        with contextlib.suppress(ValueError, TypeError, KeyError, IndexError):
            if path == PRESET:
                self.preset.value = value
            elif isinstance(path, str) and topic_of(path) in self.topics:
                self.open_topic(topic_of(path))
                self._field(path).enter(change.get("message", value))

    def _refresh_parts(self, *_: object) -> None:
        """Grey what has no effect for the settings as they are, and say why; of groups and tables only the name is left."""
        scenario = self.store.scenario
        idle = idle_settings(scenario, is_simulated=self.store.source is None)
        gone = tuple(f"{path}." for path in idle if path in self.headings)
        with pn.io.hold():
            for path, field in self.fields.items():
                field.view.visible = not path.startswith(gone)
                field.rest(idle.get(path, idle.get(topic_of(path), "")))
            for path, pane in self.headings.items():
                topic, name = path.split(".", 1)
                pane.html = heading_html(str(getattr(scenario, topic).settings()[name].label), idle.get(path, ""))

    def _field(self, path: str) -> Field:
        """Return the field of a setting or the table of a list, made when first wanted. Raises KeyError where there is none."""
        if path not in self.fields:
            self.fields[path] = make_field(self.store, path, self._settings[path])
        return self.fields[path]

    def _refresh_preset(self, *_: object) -> None:
        self.preset.value = self.store.preset
        self.undo.disabled, self.redo.disabled = not self.store.can_undo, not self.store.can_redo

    def _count_changes(self) -> None:
        """Say what the preset is, or what differs from it, in all and by topic."""
        changed = self.store.changed_paths()
        told = f"{len(changed)} changed: {', '.join(map(setting_name, changed))}" if changed else preset_line(self.store.preset)
        self.preset.param.update(helper_text=told, description=told)
        self.reset.disabled = not changed
        count = Counter(map(topic_of, changed))
        self.topic_list.rename(
            {name: title + (f" · {count[name]} changed" if count[name] else "") for name, title in self.topics.items()}
        )

    def _show_effect(self, event: Any) -> None:
        """Say below the one setting that changed what came of it."""
        now = self.store.run.result
        if event.new != DONE or now is None or now is self._before:
            return
        before, self._before = self._before, now
        changed = [*changed_settings(now.scenario, before.scenario)] if before else []
        part = self.fields.get(changed[0]) if len(changed) == 1 else None
        line = self.effect_of(before, now) if before and part else ""
        self._effect.param.update(
            html=f'<div title="{line}">{line}</div>' if line else "", styles=IN_GAP if isinstance(part, SliderField) else {}
        )
        for at in (it for it in {self._changed_part, part} if it is not None):
            at.view[:] = [*(it for it in at.view if it is not self._effect), *([self._effect] if at is part else [])]
        self._changed_part = part

    def _refresh_run(self, *_: object) -> None:
        self.cancel.disabled = self.store.run.state != RUNNING
        progress, text, note = status_of(self.store)
        self.status.param.update(progress=progress, text=text, note=note)


def topic_of(path: str) -> str:
    """Return the topic of a setting."""
    return path.split(".")[0]
