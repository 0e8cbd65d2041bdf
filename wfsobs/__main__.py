"""`python -m wfsobs`."""

from wfsobs.cli import main

main(prog_name="wfsobs")
