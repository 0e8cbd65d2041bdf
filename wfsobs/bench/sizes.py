"""How much a benchmark does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper


@dataclass(frozen=True)
class Sizes:
    """Sizes of all tasks; data and all other settings are those of the preset `paper`.

    settings          : changes to the preset
    duration          : record of the GPR tasks and of the whole run [s]
    filter_duration   : record of the Kalman filters [s]
    repeats           : every time is the median of at least so many
    textbook_steps    : steps of the textbook's online GPR; a quarter of them for `more_online`
    library_steps     : the same for a library; offline it predicts 50 times as many
    exact_steps       : steps at which GPR results are compared with a direct solve
    more_online       : further (m, d) of the online GPR
    more_steps        : predicted steps of each of these
    order, layers     : radial order and number of layers of the larger frozen-flow task
    step_count        : steps timed back to back, of every observer and controller
    paced_duration    : of such steps at a paced rate [s]
    longest_duration  : of a whole run of which the memory is measured too [s], or None
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    duration: float = 10.0
    filter_duration: float = 60.0
    repeats: int = 3
    textbook_steps: int = 32
    library_steps: int = 8
    exact_steps: int = 8
    more_online: tuple[tuple[int, int], ...] = ()
    more_steps: int = 2048
    order: int = 5
    layers: int = 10
    step_count: int = 2000
    paced_duration: float = 1.0
    longest_duration: float | None = None

    def scenario(self, duration: float, changes: Mapping[str, Any] | None = None) -> Scenario:
        """Return the scenario of a task: preset, settings, duration [s], and the task's own changes."""
        return paper().replace({**self.settings, "run.duration": duration, **(changes or {})})


QUICK = Sizes()
FULL = Sizes(
    step_count=20_000,
    paced_duration=60.0,
    more_online=((511, 1000), (1024, 170), (1024, 1000), (2048, 170), (2048, 1000)),
    longest_duration=60.0,
)
