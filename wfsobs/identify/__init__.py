"""From a record to the model behind it: noise, turbulence, peaks, with errors and a test. docs/identification.md has it all."""

from wfsobs.identify.identification import identify
from wfsobs.identify.result import Identified

__all__ = ["Identified", "identify"]
