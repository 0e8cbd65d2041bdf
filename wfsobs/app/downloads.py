"""What a run and the pages leave to take home: data as CSV and NPZ, the scenario in both; tables as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
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
    result = results.result
    _check(results)
    arrays = record_arrays(result.record, to_toml(results.scenario))
    arrays |= {f"{e.observer}/{e.target}": e.values for e in result.estimates}
    return _npz(arrays)


def data_csv(results: RunResults) -> bytes:
    """Time, truth, measurements, commands and finished estimates, one row per step, the scenario as comments.

    Numbers have nine digits; NaN where there is none. Raises TooLarge.
    """
    _check(results)
    record = results.result.record
    # comments of the TOML text too, and what a record is read by
    head = [f"# # dt: {record.dt!r}", *([f"# # ratio: {record.ratio}"] if record.ratio else [])]
    head += [f"# {line}".rstrip() for line in to_toml(results.scenario).splitlines()]
    return _csv(head, dict(_columns(results)))


def record_file(name: str, record: Record, scenario: Scenario) -> bytes:
    """Write a record in the format of the name's ending, as `wfsobs observe` reads it, with the scenario. Raises RecordError."""
    file = io.BytesIO()
    writer_of(name)(file, record_arrays(record, to_toml(scenario)))
    return file.getvalue()


def residuals_csv(results: LoopResults) -> bytes:
    """Time and the residual of every controller that has one, a row per step; nine digits; the scenario as comments."""
    record, scenario = results.result.record, results.result.scenario
    modes = [m.name for m in scenario.modes][: record.n_modes]
    columns = {"time_s": np.asarray(np.arange(record.n_steps) * record.dt, dtype=np.float64)} | {
        f"{o.controller}/{mode}_um": o.residual[:, i]
        for o in results.result.outcomes
        if o.residual is not None
        for i, mode in enumerate(modes)
    }
    return _csv([f"# {line}".rstrip() for line in to_toml(scenario).splitlines()], columns)


def table_csv(rows: Sequence[Mapping[str, object]]) -> bytes:
    """Rows of the same keys as a table, these at its head; empty where there is no value."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _csv(head: Sequence[str], columns: Mapping[str, Array]) -> bytes:
    row = ",".join(["%.9g"] * len(columns))
    lines = [row % tuple(values) for values in np.column_stack([*columns.values()]).tolist()]
    return "\n".join([*head, ",".join(columns), *lines, ""]).encode()


def _columns(results: RunResults) -> Iterator[tuple[str, Array]]:
    """(name with its unit, values) of every column."""
    result, record = results.result, results.result.record
    modes = [m.name for m in results.scenario.modes][: record.n_modes]
    signals = {f"truth/{target}": record.truth(target) for target in TARGETS}
    signals |= {"y_lgs": record.y_lgs, "y_ngs": record.y_ngs, "u": record.u}
    signals |= {f"{e.observer}/{e.target}": e.values for e in result.estimates}
    yield "time_s", np.asarray(np.arange(record.n_steps) * record.dt, dtype=np.float64)
    for name, values in signals.items():
        if values is not None:
            yield from ((f"{name}/{mode}_um", values[:, i]) for i, mode in enumerate(modes))


def _check(results: RunResults) -> None:
    result = results.result
    numbers = result.record.n_steps * (1 + result.record.n_modes * (5 + len(result.estimates)))
    if numbers > MOST:
        raise TooLarge(
            f"{numbers / 1e6:.0f} million numbers, at most {MOST // 1_000_000} million can be downloaded: "
            "shorten the record, or use wfsobs run --save"
        )
