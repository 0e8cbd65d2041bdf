"""`wfsobs serve`."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import click

from wfsobs.cli.options import POSITIVE, FiniteRange, needing

ORIGIN = re.compile(r"https?://(\*\.)?[\w.-]+(:\d+|:\*)?|https?://\[[\da-f:]+\](:\d+)?", re.ASCII | re.IGNORECASE)

HOST = re.compile(r"[\w.*-]+(:\d+)?", re.ASCII)


def _check(pattern: re.Pattern[str], takes: str) -> Callable[[click.Context, click.Parameter, tuple[str, ...]], tuple[str, ...]]:
    """Return the check of an option's values, which a header or the server takes as they are."""

    def check(_context: click.Context, _option: click.Parameter, values: tuple[str, ...]) -> tuple[str, ...]:
        for value in values:
            if not pattern.fullmatch(value):
                raise click.BadParameter(f"{value!r} is no origin; it takes {takes}")
        return values

    return check


@click.command()
@click.option("--port", type=click.IntRange(0, 65535), default=5006, help="Port to listen on; 0 for a free one.")
@click.option("--address", default="localhost", help="Address to listen on; 0.0.0.0 for all of the machine.")
@click.option("--open", "open_browser", is_flag=True, help="Open a browser.")
@click.option(
    "--origin",
    "origins",
    multiple=True,
    metavar="HOST[:PORT]",
    callback=_check(HOST, "HOST[:PORT]"),
    help="Host name of the page behind a proxy; can be repeated.",
)
@click.option(
    "--embed",
    "embedders",
    multiple=True,
    metavar="ORIGIN",
    callback=_check(ORIGIN, "https://HOST[:PORT] or http://HOST[:PORT]"),
    help="Origin (https://HOST[:PORT]) whose pages may show this one in a frame; can be repeated. By default none.",
)
@click.option("--prefix", default="", show_default=False, metavar="PATH", help="Path of the page behind a proxy.")
@click.option(
    "--public/--local",
    default=None,
    help="Switch the limits on or off; they are on unless only this machine reaches the page.",
)
@click.option("--max-duration", type=POSITIVE, metavar="S", help="Maximum length of a record.")
@click.option("--max-steps", type=click.IntRange(1), metavar="N", help="Maximum number of steps of a record.")
@click.option("--max-training-size", type=click.IntRange(2), metavar="M", help="Maximum training size of a GPR.")
@click.option("--max-depth", type=click.IntRange(1), metavar="D", help="Maximum window length of a GPR.")
@click.option("--max-seconds", type=POSITIVE, metavar="S", help="Maximum estimated time of a run.")
@click.option("--max-sweep-seconds", type=POSITIVE, metavar="S", help="Maximum estimated time of a sweep.")
@click.option("--max-live-seconds", type=POSITIVE, metavar="S", help="Maximum time of a live loop.")
@click.option("--max-memory", type=POSITIVE, metavar="MB", help="Maximum estimated memory of a run.")
@click.option("--max-sessions", type=click.IntRange(1), metavar="N", help="Maximum number of open pages.")
@click.option(
    "--runs", type=click.IntRange(1), metavar="N", help="Maximum number of jobs at once; by default the number of processors."
)
@click.option("--cache-mb", type=click.IntRange(0), default=256, metavar="MB", help="Size of the cache of results.")
@click.option(
    "--lifetime",
    type=FiniteRange(0.1),
    default=60.0,
    metavar="S",
    help="Time to keep the settings of a page that has lost its connection.",
)
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="info",
    help="Minimum level of messages on standard error.",
)
@click.option(
    "--campaign",
    metavar="DIR",
    default="",
    show_default=False,
    help="Show a campaign on a page of its own, while it runs and after.",
)
@click.option("--log-requests", is_flag=True, help="Log every request, with address and query.")
def serve(**options: Any) -> None:
    """Serve the dashboard (docs/serving.md)."""
    with needing("serve: the dashboard needs", "app"):
        from wfsobs.app import serve as server
    server.serve(server.options(**options))
