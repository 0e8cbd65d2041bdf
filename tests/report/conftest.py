"""Short runs, and a page taken apart."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from typing import Any

import pytest

from wfsobs.evaluation.result import Result
from wfsobs.pipeline import run
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

SHORT = {
    "run.duration": 2.0,
    "run.warm_up": 0.5,
    "gpr_offline.training_size": 40,
    "gpr_offline.depth": 20,
    "gpr_online.training_size": 40,
    "gpr_online.depth": 20,
    "adaptive.window": 0.5,
}
VOID = {"meta", "link", "br", "input", "use", "line", "img", "hr"}


@pytest.fixture(scope="session")
def short() -> Scenario:
    return PRESETS["paper"]().replace(SHORT)


@pytest.fixture(scope="session")
def result(short: Scenario) -> Result:
    return run(short)


class Page(HTMLParser):
    """A page taken apart. A tag left open, closed twice, or an attribute given twice fails."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.tables: list[list[list[str]]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []
        ids = [attributes["id"] for _, attributes in self.tags if "id" in attributes]
        assert len(ids) == len(set(ids))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len({name for name, _ in attrs}) == len(attrs), (tag, attrs)
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append((dict(attrs), ""))
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            attributes, text = self.scripts[-1]
            self.scripts[-1] = (attributes, text + data)
        elif "style" not in self.open:
            self.text += data
            if {"td", "th"} & set(self.open):
                self.tables[-1][-1][-1] += data

    def data(self, name: str) -> Any:
        """What the page embeds for its script."""
        (text,) = [text for attributes, text in self.scripts if attributes.get("id") == name]
        return json.loads(text, parse_constant=pytest.fail)


@pytest.fixture
def parse() -> type[Page]:
    return Page
