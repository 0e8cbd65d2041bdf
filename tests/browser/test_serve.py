"""The command's own server."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def test_serve(open_page: Any, make_server: Any, tmp_path: Path) -> None:
    server = make_server(["-m", "wfsobs", "serve", "--port", "{port}"], tmp_path / "log", "/")
    try:
        page = open_page(url=server.url)
        assert page.title() == "wfsobs"
        assert server.errors(0) == []
    finally:
        server.close()
