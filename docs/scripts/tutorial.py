"""Runs the tutorials: `python docs/scripts/tutorial.py docs/tutorials/PAGE.md ...` brings their outputs and figures up to date.

On a page, blocks of ```python and of ```sh with `wfsobs` commands run in order, in one namespace and one folder; what one prints
stands in the ```text block after it. Figures are saved by the page's own code and shown from `docs/tutorials`.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two are slower at these sizes; before numpy is loaded
os.environ.setdefault("MPLBACKEND", "agg")

from click.testing import CliRunner

from wfsobs.cli import main

BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```\n(?:\n```text\n(.*?)^```\n)?", flags=re.M | re.S)


def run(page: Path) -> list[tuple[str, str, str]]:
    """(code, output on the page, output now) of every block, run in the current folder."""
    namespace: dict[str, object] = {"__name__": "__main__"}
    out = []
    for language, code, shown in BLOCK.findall(page.read_text(encoding="utf-8")):
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            if language == "python":
                exec(compile(code, str(page), "exec"), namespace)
            else:
                said.write("".join(_command(line) for line in code.splitlines()))
        out.append((code, shown, said.getvalue()))
    return out


def _command(line: str) -> str:
    words = shlex.split(line)
    if words[0] != "wfsobs":
        raise ValueError(f"{line}: only wfsobs commands")
    result = CliRunner().invoke(main, words[1:], catch_exceptions=False)
    if result.exit_code:
        raise RuntimeError(f"{line}: {result.output}")
    return result.stdout


def renewed(page: Path) -> tuple[str, dict[str, bytes]]:
    """The page with the outputs of now, and the figures that its code saves; run in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        outputs = iter([output for _, _, output in run(page)])
        figures = {figure.name: figure.read_bytes() for figure in Path(folder).glob("*.png")}

    def block(match: re.Match[str]) -> str:
        language, code, output = match.group(1), match.group(2), next(outputs)
        return f"```{language}\n{code}```\n" + (f"\n```text\n{output}```\n" if output else "")

    return BLOCK.sub(block, page.read_text(encoding="utf-8")), figures


if __name__ == "__main__":
    for name in map(Path, sys.argv[1:]):
        page = name.resolve()
        text, figures = renewed(page)
        for figure, content in figures.items():
            (page.parent / figure).write_bytes(content)
        page.write_text(text, encoding="utf-8")
