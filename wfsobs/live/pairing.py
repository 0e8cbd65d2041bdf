"""LGS frames of a stream with the NGS frames of another: a row goes out when its NGS frame is there, or waited for in vain."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from wfsobs.streams.ngs_frames import NgsStream
from wfsobs.typing import Array


class PairedFrames:
    """Holds LGS frames back until the NGS frame has come that belongs to the first of them.

    Parameters
    ----------
    ngs : NgsStream
        The other stream.
    n_modes : int
        Number of modes.
    lag : int
        LGS frames between an NGS frame and the one that it belongs to; one that is due is waited for for one more.
    """

    def __init__(self, ngs: NgsStream, n_modes: int, lag: int):
        self._ngs, self._patience = ngs, min(lag + 1, ngs.ratio - 1)
        self._nothing = np.full(n_modes, np.nan)
        self._rows: deque[tuple[int, Array, Array]] = deque()

    def add(
        self, count: int, z: Array, n_sent: int, is_missing: bool = False, write_time: int = 0
    ) -> Iterator[tuple[Array, Array]]:
        """Take an LGS frame, and yield measurements of both sensors that can go out, each (n_modes,) [um].

        Parameters
        ----------
        count : int
            Counter of the frame.
        z : Array
            Its measurement, (n_modes,) [um].
        n_sent : int
            Rows that have gone out. The number of a row with an NGS measurement is a multiple of the ratio: where NGS frames have
            another place than before, rows without any measurement go out.
        is_missing : bool
            Whether it is not there, or not the newest any more: it waits for the next one that is, as nothing can be told of when
            an NGS frame has come.
        write_time : int
            When it was written [ns]; 0 where it is not known.
        """
        found = None if is_missing else self._ngs.look(count, write_time)
        if self._ngs.phase is not None:
            n_more = (count - self._ngs.phase - n_sent - len(self._rows)) % self._ngs.ratio
            if n_more:
                yield from self.flush()
                for _ in range(n_more):
                    yield self._nothing, self._nothing
        self._rows.append((count, z, self._nothing))
        if found is not None:
            place = count - found[0]
            self._rows = deque((k, row, found[1] if k == place else ngs) for k, row, ngs in self._rows)
        while self._rows and not is_missing and not self._waits(count):
            yield self._rows.popleft()[1:]

    def flush(self) -> Iterator[tuple[Array, Array]]:
        """Yield what is held back."""
        while self._rows:
            yield self._rows.popleft()[1:]

    def restart(self) -> Iterator[tuple[Array, Array]]:
        """Yield what is held back: the counter of the LGS is another one from now on."""
        yield from self.flush()
        self._ngs.restart()

    def _waits(self, count: int) -> bool:
        """Whether the first row waits for its NGS frame still."""
        first, _, ngs = self._rows[0]
        phase = self._ngs.phase
        is_due = phase is not None and (first - phase) % self._ngs.ratio == 0
        return is_due and bool(np.isnan(ngs).all()) and count - first < self._patience
