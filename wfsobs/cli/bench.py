"""`wfsobs bench`."""

from __future__ import annotations

import json

import click
from rich.console import Console

from wfsobs import bench as benches
from wfsobs.cli.bench_table import bench_table
from wfsobs.cli.show import progress_bar


@click.command()
@click.option("--full", is_flag=True, help="Include m up to 2048, d up to 1000 and a run of 60 s.")
@click.option("--json", "as_json", is_flag=True, help="Print a list of rows instead of a table.")
def bench(full: bool, as_json: bool) -> None:
    """Time the observers beside textbook versions, and other libraries if installed (wfsobs[bench])."""
    with progress_bar("benchmarks") as update:
        measured = benches.measure_all(benches.FULL if full else benches.QUICK, update)
    missing = [name for name in benches.LIBRARIES if name not in benches.is_installed()]
    if missing:
        click.echo(f"wfsobs: bench: without {', '.join(missing)}; the extra wfsobs[bench] installs them", err=True)
    if as_json:
        click.echo(json.dumps(measured, allow_nan=False))
        return
    console = Console()
    table = bench_table(measured, markdown=not console.is_terminal)
    (console if console.is_terminal else Console(width=240)).print(table)
    click.echo(benches.machine(benches.LIBRARIES))
