"""The dashboard's own server, for `wfsobs serve`."""

from __future__ import annotations

from collections.abc import Sequence

import panel as pn

from wfsobs.app.dashboard import page
from wfsobs.app.work import one_blas_thread


def serve(
    port: int = 5006, address: str = "localhost", open_browser: bool = False, origins: Sequence[str] = (),
) -> None:
    """Serve the dashboard at http://address:port/ until interrupted.

    origins : further host:port names that browsers may reach it by, for use behind a proxy
    """
    one_blas_thread()
    allowed = sorted({f"{address}:{port}", f"localhost:{port}", f"127.0.0.1:{port}", *origins})
    pn.serve(
        {"/": page}, port=port, address=address, websocket_origin=allowed, show=open_browser,
        title="wfsobs", liveness=True,
    )
