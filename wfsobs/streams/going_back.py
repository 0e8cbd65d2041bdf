"""An NGS frame that comes after its LGS frame goes to its place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from wfsobs.record import Sampling
from wfsobs.typing import Array


class StateObserver(Protocol):
    """What it takes of a `StepObserver`."""

    @property
    def frame(self) -> int: ...  # noqa: D102

    @property
    def sampling(self) -> Sampling: ...  # noqa: D102

    def update(self, z: Array, ngs: Array | None = None, /) -> None: ...  # noqa: D102

    def reset(self) -> None: ...  # noqa: D102

    def state_dict(self) -> dict[str, Array]: ...  # noqa: D102

    def load_state_dict(self, state: Mapping[str, Array], /) -> None: ...  # noqa: D102


class GoingBack:
    """Takes LGS frames as they come, and an NGS frame up to one NGS frame later than it is due.

    The state before the last frame with an NGS measurement is kept, and what has come since; a late NGS frame goes to its place
    and the LGS frames after it are taken again. From then on the observer is where it would be had the frame come in time.

    Parameters
    ----------
    observer : StateObserver
        Of a sampling with a ratio; without one there is nothing to go back for.
    """

    def __init__(self, observer: StateObserver):
        self._observer, self._ratio = observer, observer.sampling.ratio
        self._state: dict[str, Array] | None = None
        self._since: list[Array] = []

    def update(self, z: Array, ngs: Array | None = None, late: int = 0) -> None:
        """Take a frame.

        Parameters
        ----------
        z : Array
            LGS measurement, (n_modes,) [um].
        ngs : Array, optional
            NGS measurement, (n_modes,) [um], of the frame `late` before this one; the first frame of an observer has none.
        late : int
            LGS frames, below the ratio.
        """
        observer = self._observer
        if ngs is not None and late:
            self._take_late(ngs, late)
            ngs = None
        if self._ratio is not None:
            self.keep()
            self._since.append(z)
        observer.update(z, ngs if observer.frame else None)

    def keep(self) -> None:
        """Keep the state where the next frame is one with an NGS measurement; `update` does it otherwise."""
        if self._ratio is not None and self._observer.frame % self._ratio == 0 and (self._since or self._state is None):
            self._state, self._since = self._observer.state_dict(), []

    def align(self, age: int) -> bool:
        """Start the observer anew unless its last frame with an NGS measurement was so many frames before the next one.

        age : 0 to ratio - 1, 0 where the next one has an NGS measurement
        """
        observer = self._observer
        if self._ratio is None or observer.frame % self._ratio == age:
            return False
        observer.reset()
        self.forget()
        for _ in range(age):
            self.update(np.full(observer.sampling.n_modes, np.nan))
        return True

    def forget(self) -> None:
        """Start anew with an observer that does."""
        self._state, self._since = None, []

    def _take_late(self, ngs: Array, late: int) -> None:
        first = self._observer.frame - late
        if self._state is None or late != len(self._since) or first <= 0:
            return
        self._observer.load_state_dict(self._state)
        for k, z in enumerate(self._since):
            self._observer.update(z, ngs if k == 0 else None)
