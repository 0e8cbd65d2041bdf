"""`python -m wfsobs`."""

from wfsobs.cli import main

if __name__ == "__main__":
    main(prog_name="wfsobs")
