"""The tables of docs/trust.md: controllers over an uncertain plant.

`trust.py [PRESET ...]`: `paper` and `ut4` by default; by theory, without random numbers.
"""

from __future__ import annotations

import sys

import numpy as np

from wfsobs import PRESETS, plant_envelope
from wfsobs.closed_loop.envelope import POINTS, PlantEnvelope
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.tuning import tuned_envelope


def table(result: PlantEnvelope) -> str:
    """Nominal, mean, 95 % and worst of tip / tilt, the caution, and how many plants are unstable."""
    lines = ["| Controller | caution | nominal | mean | 95 % | worst | unstable |", "|---|---|---|---|---|---|---|"]
    of = {spread.controller: spread for spread in result.spreads}
    for name in result.ranking():
        spread = of[name]
        middle = [spread.summary(mode) for mode in range(2)]
        columns = [spread.nominal, [mean for mean, _ in middle], [most for _, most in middle], spread.worst]
        cells = [" / ".join("-" if x is None or np.isinf(x) else f"{1e3 * x:.1f}" for x in two[:2]) for two in columns]
        every = len(spread.points) + len(spread.corners)
        lost = spread.unstable + int(np.isinf(spread.corners).any(axis=1).sum())
        lines.append(f"| {CONTROLLERS[name].label} | {spread.caution:.2g} | {' | '.join(cells)} | {lost} of {every} |")
    return "\n".join(lines)


if __name__ == "__main__":
    for preset in sys.argv[1:] or ["paper", "ut4"]:
        for tune in (False, True):
            print(f"\n{preset}, {'tuned' if tune else 'as designed'}\n")
            print(table((tuned_envelope if tune else plant_envelope)(PRESETS[preset](), points=POINTS)))
