"""Side-by-side timings of the observers: ours, the textbook way, and other libraries (`wfsobs bench`)."""

from wfsobs.bench.external import LIBRARIES, is_installed
from wfsobs.bench.measure import Row, machine
from wfsobs.bench.sizes import FULL, QUICK, Sizes
from wfsobs.bench.tasks import measure_all

__all__ = ["FULL", "LIBRARIES", "QUICK", "Row", "Sizes", "is_installed", "machine", "measure_all"]
