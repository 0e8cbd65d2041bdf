"""Runs the notebooks of the tutorials, and makes a page of each.

They are kept without outputs. A notebook whose code fails ends the build; what it claims of its numbers it asserts itself.
"""

from __future__ import annotations

import base64
import os
import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

ROOT = Path(__file__).parents[2]
PICTURE = re.compile(r"src='data:image/png;base64,([^']+)'")


def run(path: Path) -> dict[str, bytes]:
    """Name of a file -> content: the page, its figures, and the notebook with its outputs; run in a folder of its own."""
    os.environ["PYTHONPATH"] = str(ROOT)  # of the kernel
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
    figures: dict[str, bytes] = {}
    cells = [_cell(cell, path.stem, figures) for cell in notebook.cells]
    cells.insert(
        1, f'<a href="{path.name}" download>This page as a notebook</a> ([how to open it](../installation.md#notebooks)).'
    )
    page = "\n\n".join(filter(None, cells)) + "\n"
    return {f"{path.stem}.md": page.encode(), path.name: nbformat.writes(notebook).encode(), **figures}


def _cell(cell: NotebookNode, stem: str, figures: dict[str, bytes]) -> str:
    if cell.cell_type != "code":
        return cell.source
    shown = [_output(output, stem, figures) for output in cell.outputs]
    return "\n\n".join([f"```python\n{cell.source}\n```", *filter(None, shown)])


def _output(output: NotebookNode, stem: str, figures: dict[str, bytes]) -> str:
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```" if output.name == "stdout" else ""
    html = output.get("data", {}).get("text/html", "")
    if picture := PICTURE.search(html):
        name = f"{stem}-{len(figures) + 1}.png"
        figures[name] = base64.b64decode(picture[1])
        return f"![Figure]({name})"
    if "<script" in html:  # what a notebook loads for HoloViews
        return ""
    text = output.get("data", {}).get("text/plain", "")
    html = re.sub(r'<style.*?</style>|\n\s*| border="1" class="dataframe"', "", html, flags=re.S)
    return html or (f"```text\n{text}\n```" if text else "")
