"""Store the numbers that tests/campaign/test_physics.py holds the simulation to, after `PHYSICS_VERSION` was raised."""

import json
from pathlib import Path

import wfsobs
from wfsobs.campaign.store import PHYSICS_VERSION

FILE = Path(__file__).parents[1] / "tests" / "campaign" / "physics.json"
OBSERVERS = ["kf-lgs", "kf-multi", "multirate", "multirate-optimal", "ridge"]
PRESETS = {
    "paper": {"run.duration": 3.0},
    "ut4": {"run.duration": 3.0},
    "lost-frames": {},
    "higher-orders": {"run.duration": 2.0, "telescope.radial_order": 2},
}


def numbers() -> dict[str, float]:
    """Return "preset observer target mode" -> error [nm]."""
    out = {}
    for name, changes in PRESETS.items():
        result = wfsobs.run(wfsobs.PRESETS[name]().replace(changes), observers=OBSERVERS)
        out |= {f"{name} {s.observer} {s.target} {s.mode}": s.rms * 1e3 for s in result.scores}
    return out


if __name__ == "__main__":
    FILE.write_text(json.dumps({"version": PHYSICS_VERSION, "rms_nm": numbers()}, indent=1) + "\n", encoding="utf-8")
