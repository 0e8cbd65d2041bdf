"""What a run and the pages leave to take home: data as CSV and NPZ, the scenario in both; tables as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from wfsobs.app.loop_work import LoopResults
from wfsobs.app.work import RunResults
from wfsobs.observers.base import TARGETS
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import to_toml
from wfsobs.telemetry.formats import writer_of
from wfsobs.telemetry.records import record_arrays
from wfsobs.typing import Array

MOST = 4_000_000
"""Numbers in a download: about 100 s at 1 kHz."""


class Save(NamedTuple):
    """A file to be saved; content is made in a thread. Raises TooLarge."""

    name: str
    kind: str
    content: Callable[[], bytes]


class TooLarge(ValueError):
    """More than a browser should be sent: one line saying so."""


def data_npz(results: RunResults) -> bytes:
    """Write the record as `wfsobs observe` reads it, finished estimates as observer/target, the scenario. Raises TooLarge."""
    _check(results)
    result = results.result
    return record_file(".npz", result.record, results.scenario, _estimates(results))


def data_csv(results: RunResults) -> bytes:
    """Time, truth, measurements, commands and finished estimates, one row per step, the scenario as comments.

    Numbers have nine digits; NaN where there is none. Raises TooLarge.
    """
    _check(results)
    record = results.result.record
    # comments of the TOML text too, and what a record is read by
    head = [f"# # dt: {record.dt!r}", f"# # delay: {record.delay}", *([f"# # ratio: {record.ratio}"] if record.ratio else [])]
    signals = {f"truth/{target}": record.truth(target) for target in TARGETS}
    signals |= {"y_lgs": record.y_lgs, "y_ngs": record.y_ngs, "u": record.u, "open_loop_y": record.open_loop_y}
    return _csv(record, results.scenario, signals | _estimates(results), head)


def record_file(name: str, record: Record, scenario: Scenario, more: Mapping[str, Array] = {}) -> bytes:
    """Write a record in the format of the name's ending, as `wfsobs observe` reads it, with the scenario. Raises RecordError.

    more : arrays beside those of the record, where the format takes them
    """
    file = io.BytesIO()
    writer_of(name)(file, {**record_arrays(record, to_toml(scenario)), **more})
    return file.getvalue()


def residuals_csv(results: LoopResults) -> bytes:
    """Time and the residual of every controller that has one, a row per step; nine digits; the scenario as comments."""
    result = results.result
    return _csv(result.record, result.scenario, {o.controller: o.residual for o in result.outcomes})


def table_csv(rows: Sequence[Mapping[str, object]]) -> bytes:
    """Rows of the same keys as a table, these at its head; empty where there is no value."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _estimates(results: RunResults) -> dict[str, Array]:
    return {f"{e.observer}/{e.target}": e.values for e in results.result.estimates}


def _csv(record: Record, scenario: Scenario, signals: Mapping[str, Array | None], head: Sequence[str] = ()) -> bytes:
    """Write the time and every signal that there is, a row per step, under comments."""
    columns = {"time_s": np.arange(record.n_steps) * record.dt}
    for name, values in signals.items():
        if values is not None:
            columns |= {f"{name}/{mode.name}_um": column for mode, column in zip(scenario.modes, values.T, strict=False)}
    row = ",".join(["%.9g"] * len(columns))
    lines = [row % tuple(values) for values in np.column_stack([*columns.values()]).tolist()]
    comments = [f"# {line}".rstrip() for line in to_toml(scenario).splitlines()]
    return "\n".join([*head, *comments, ",".join(columns), *lines, ""]).encode()


def _check(results: RunResults) -> None:
    result = results.result
    numbers = result.record.n_steps * (1 + result.record.n_modes * (5 + len(result.estimates)))
    if numbers > MOST:
        raise TooLarge(
            f"{numbers / 1e6:.0f} million numbers, at most {MOST // 1_000_000} million can be downloaded: "
            "shorten the record, or use wfsobs run --save"
        )
