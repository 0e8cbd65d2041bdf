"""Results move with the version of the physics alone: the keys of stored campaigns depend on it."""

import json

import pytest

from scripts.store_physics import FILE, numbers
from wfsobs.campaign.store import PHYSICS_VERSION

pytestmark = pytest.mark.slow

TOLERANCE = 1e-5
"""Relative. BLAS kernels differ by up to 4e-7 (fits of models; HASWELL, ZEN, SKYLAKEX); another formula moves more."""


def test_numbers_move_with_the_version():
    stored = json.loads(FILE.read_text(encoding="utf-8"))
    assert stored["version"] == PHYSICS_VERSION, "run scripts/store_physics.py"
    assert numbers() == pytest.approx(stored["rms_nm"], rel=TOLERANCE), (
        "results have moved: raise PHYSICS_VERSION in wfsobs/campaign/store.py and run scripts/store_physics.py"
    )
