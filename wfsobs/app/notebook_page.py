"""The dashboard in a notebook: served to this machine by a thread, shown as the value of a cell."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from time import sleep
from typing import Any

import panel as pn

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.limits import NONE
from wfsobs.app.serve import make_service, session_page
from wfsobs.app.service import Post
from wfsobs.evaluation.result import Result
from wfsobs.scenario import Scenario
from wfsobs.settings.values import check_kind


class Explorer:
    """The dashboard in a notebook, where it stands as the value of a cell.

    Attributes
    ----------
    url : str
        Address of the page, served by a thread of this process to this machine alone.
    """

    def __init__(self, scenario: Scenario, height: int):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._first, self._height, self._service = scenario, height, make_service(NONE)
        self._dashboard: Dashboard | None = None
        self.url: str = f"http://localhost:{port}/"
        self._thread: Any = pn.serve(  # a thread, as `threaded` is given
            {"/": self._page}, port=port, address="127.0.0.1", websocket_origin=f"localhost:{port}", show=False, threaded=True,
            verbose=False,
        )  # fmt: skip
        threading.Thread(target=self._close_at_exit, daemon=True).start()
        for _ in range(300):  # a page that is asked for before its thread listens is not there
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
                return
            sleep(0.1)

    def _page(self) -> Any:
        def build(post: Post) -> Dashboard:
            self._dashboard = Dashboard(post, self._service.enter(), self.scenario)
            return self._dashboard

        return session_page(build)

    def _close_at_exit(self) -> None:
        """End with the program: Python waits for the server's thread."""
        threading.main_thread().join()
        self._thread.stop()

    def __repr__(self) -> str:
        return f"<dashboard at {self.url}>"

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" title="wfsobs" style="width: 100%; height: {self._height}px; border: 0"></iframe>'

    @property
    def scenario(self) -> Scenario:
        """The settings as they stand on the page."""
        return self._dashboard.store.scenario if self._dashboard else self._first

    @property
    def result(self) -> Result | None:
        """The newest result on the page; None before the first."""
        shown = self._dashboard and self._dashboard.store.run.result
        return shown.result if shown else None

    def close(self) -> None:
        """Stop serving; runs end."""
        self._thread.stop()
        self._thread.join(5.0)  # nobody answers there any more
        self._service.close(1.5)


def explore(scenario: Scenario, *, height: int = 900) -> Explorer:
    """Show the dashboard's controls with live figures in a notebook.

    Parameters
    ----------
    scenario : Scenario
        Settings to start from.
    height : int
        Height of the page [pixels].

    Returns
    -------
    Explorer
        The page as the value of a cell. Its `scenario` and `result` are those of the page at any time, `close()` ends it.

    See Also
    --------
    wfsobs.run : Run observers without a page.
    """
    check_kind("explore", scenario, Scenario)
    return Explorer(scenario, height)
