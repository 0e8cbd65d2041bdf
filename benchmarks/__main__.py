"""`python -m benchmarks [--full] [--json]`: `wfsobs bench` with the libraries that are installed."""

import click

from benchmarks.libraries import LIBRARIES, NAMES, missing
from wfsobs.cli.bench import bench

if __name__ == "__main__":
    absent = missing()
    if absent:
        click.echo(f"benchmarks: without {', '.join(absent)}; the extra wfsobs[bench] installs them", err=True)
    bench(obj={name: LIBRARIES[name] for name in NAMES if name not in absent}, prog_name="python -m benchmarks")
