"""Adds to the site what is made when it is built: the reference, the plan of the code, the notebooks of the tutorials.

Run by properdocs (`make docs`).
"""

from __future__ import annotations

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import mkdocs_gen_files
import notebook
import reference
import rooms

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

with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
    for files in pool.map(notebook.run, sorted((DOCS / "tutorials").glob("*.ipynb"))):
        for name, content in files.items():
            write(f"tutorials/{name}", content)
