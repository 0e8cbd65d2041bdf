"""Links, a settings file and a session's file that version 0.2.0 wrote are read as what they were."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from wfsobs.app.service import run_key
from wfsobs.app.session_file import read_session
from wfsobs.app.share import from_file, from_query
from wfsobs.app.sources import LoadedRecord, SimulatedRecord
from wfsobs.scenario.presets import PRESETS

HERE = Path(__file__).parent / "written_by_0_2_0"
"""By its own code: a link for each setting; three results, on the settings, on a simulation of others and on a file."""


def test_links() -> None:
    links = json.loads((HERE / "links.json").read_text(encoding="utf-8"))
    assert len(links) > 100
    for query, change in links.items():
        link = from_query(query)
        assert not link.errors and link.preset == "paper", query
        assert link.scenario.to_dict() == PRESETS["paper"]().replace(change).to_dict(), query


def test_a_settings_file() -> None:
    link = from_file((HERE / "night.toml").read_text(encoding="utf-8"))
    assert link.preset == "night" and link.scenario.to_dict() == PRESETS["night"]().to_dict()


def test_a_session() -> None:
    content = read_session((HERE / "results.wfsobs-session").read_bytes())
    told = PRESETS["paper"]().replace({"turbulence.wind_speed": 9.0, "vibration.peaks": [{"frequency": 33.0}]})
    alone, simulated, loaded = content.entries
    assert content.view == "page=identify" and content.compared_keys == [simulated.key]
    assert [(e.preset, e.name, e.star, e.own_name, e.view, len(e.scores)) for e in content.entries] == [
        ("paper", "wind 9", True, True, "page=tune", 12),
        ("ut4", "told 9", False, False, "", 12),
        ("paper", "night.npz", False, False, "", 0),
    ]
    assert all(e.scenario.to_dict() == told.to_dict() and e.key == run_key(told, e.source) for e in content.entries)
    first = alone.scores[0]
    assert (first.observer, first.target, first.mode, first.rms) == ("kf-lgs", "turbulence", "tip", 0.030216907821156356)
    assert alone.source is None and isinstance(simulated.source, SimulatedRecord)
    assert simulated.source.simulation.run.seed == 5 and simulated.source.simulation.turbulence.wind_speed == 15.0
    source = loaded.source
    assert isinstance(source, LoadedRecord) and isinstance(content.step[2], LoadedRecord) and content.step[2].key == source.key
    said = source.declaration
    assert (source.name, source.what, source.sha256) == ("night.npz", "what it is", "ab" * 32)
    assert (said.unit, said.command_delay, dict(said.columns)) == ("nm", 3.0, {"u/tip": "c"})
    record, y = source.record, np.random.default_rng(3).standard_normal((4, 60, 2)).round(3)[0]
    assert record.delay == 3 and record.training is not None and record.training.y_lgs.shape == (40, 2)
    assert np.isnan(record.y_lgs[7]).all() and np.array_equal(np.delete(record.y_lgs, 7, 0), np.delete(y, 7, 0))
