"""Adds to the site what is made when it is built: the reference, the plan of the code, the outputs of the tutorials.

Run by properdocs (`make docs`). With TUTORIALS=shown in the environment the tutorials stay as they are written.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import mkdocs_gen_files
import reference
import rooms
import tutorial

DOCS = Path(__file__).parents[1]
PLAN = "<!-- rooms -->"
"""Where the plan of the code goes, in docs/architecture.md."""


def write(path: str, content: str | bytes) -> None:
    """A file of the site, new or in the place of one of the docs."""
    with mkdocs_gen_files.open(path, "wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)


for path, text in reference.pages().items():
    write(path, text)

told = rooms.plan()
page = (DOCS / "architecture.md").read_text(encoding="utf-8")
write("architecture.md", page.replace(PLAN, f'<div class="rooms">{rooms.svg(told)}</div>\n\n{rooms.table(told)}'))

if os.environ.get("TUTORIALS") != "shown":
    pages = sorted((DOCS / "tutorials").glob("*.md"))
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        for source, (text, figures) in zip(pages, pool.map(tutorial.renewed, pages), strict=True):
            for name, content in {source.name: text, **figures}.items():
                write(f"tutorials/{name}", content)
