"""Examples of a record's file: a template to fill in, and a sample from the simulation."""

from __future__ import annotations

import io
from dataclasses import replace

from wfsobs.progress import QUIET, Watch
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.formats.csv import write
from wfsobs.telemetry.records import record_arrays

TEMPLATE = """\
# One row per step of the fast loop, one column per signal and mode. Lines that start with # may hold numbers and texts:
# ratio: 5
# command_sign: 1
# delay: 2
# y_lgs is the measurement, u the command that follows from the measurement of its row, y_ngs a slow sensor: cells are empty
# between its frames, and the columns may be left out. The command sign is 1 where measurement = disturbance + command, and -1
# where the command is taken off; the delay is that from a command to the first measurement that sees it, in rows; the ratio is
# that of rows to frames. Units at the end of names are um, nm, m, mas, arcsec, rad. An empty cell is a missing sample.
time_s,y_lgs/tip_nm,y_lgs/tilt_nm,u/tip_nm,u/tilt_nm,y_ngs/tip_nm,y_ngs/tilt_nm
0.000,12.1,-3.0,-3.6,0.9,,
0.001,,,-3.6,0.9,,
0.002,10.4,-2.2,-6.8,1.6,,
0.003,9.1,-1.7,-9.5,2.1,,
0.004,7.7,-0.9,-11.8,2.4,,
0.005,5.2,-0.4,-13.4,2.5,8.9,-1.6
"""

SAMPLE_S = 5.0
"""Length of the sample [s]."""


def sample_csv(watch: Watch = QUIET) -> bytes:
    """Return a sample record as CSV: SAMPLE_S of the preset paper in closed loop, with its truth. Raises Cancelled."""
    record = simulate(paper().replace({"run.duration": SAMPLE_S}), watch=watch)
    file = io.BytesIO()
    write(file, record_arrays(replace(record, open_loop_y=None, training=None)))
    return file.getvalue()
