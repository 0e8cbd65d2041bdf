"""A frame as a message of two parts, a header in JSON and the numbers (docs/streams.md)."""

from __future__ import annotations

import json

import numpy as np

from wfsobs.typing import Array

DTYPES = {"float32": np.dtype("<f4"), "float64": np.dtype("<f8")}
HEADER = 256
"""Longest header [bytes]."""


def written_frame(count: int, values: Array) -> list[bytes]:
    """Return the parts of the message of a frame: its counter, and its numbers, (n,), of one of DTYPES."""
    return [json.dumps({"frame": count, "dtype": values.dtype.name, "n": values.size}).encode(), values.tobytes()]


def parse_frame(parts: list[bytes]) -> tuple[int, Array, int]:
    """Return counter, numbers, (n,), and time [ns], 0 for none, of a message in parts. Raises ValueError where it is no frame."""
    if len(parts) != 2:
        raise ValueError(f"it has {len(parts)} part{'s' * (len(parts) != 1)}, not 2")
    if len(parts[0]) > HEADER:
        raise ValueError(f"its header has {len(parts[0])} bytes, {HEADER} at most")
    try:
        header = json.loads(parts[0])
        count, dtype, n = header["frame"], DTYPES[header["dtype"]], header["n"]
        is_header = type(count) is type(n) is int and 0 <= count < 2**64 and n > 0
    except (ValueError, KeyError, TypeError):
        is_header = False
    if not is_header:
        raise ValueError('its header is not {"frame": counter, "dtype": "float32" or "float64", "n": how many numbers}')
    if len(parts[1]) != n * dtype.itemsize:
        raise ValueError(f"{len(parts[1])} bytes are not the {dtype.name} numbers that its header says")
    sent = header.get("time_ns")
    return count, np.frombuffer(parts[1], dtype), sent if type(sent) is int and sent > 0 else 0
