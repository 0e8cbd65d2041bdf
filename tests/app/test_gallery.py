"""The gallery of presets against the presets."""

from __future__ import annotations

from wfsobs.app.controls.gallery import presets_shown
from wfsobs.app.dashboard import Dashboard
from wfsobs.scenario.presets import PRESETS


def test_every_preset_has_a_line_and_its_peaks() -> None:
    items = {item["name"]: item for item in presets_shown()}
    assert list(items) == list(PRESETS)
    for item in items.values():
        assert item["line"].endswith(".") and item["title"]
    paper = PRESETS["paper"]().vibration.peaks
    # a peak of no rms in tip has no line there, and those above the cut-off are not simulated
    assert items["paper"]["peaks"] == [[p.frequency, p.rms[0]] for p in paper if p.rms[0] > 0 and p.frequency <= 80.0]
    assert [name for name, item in items.items() if item["events"]] == [n for n, make in PRESETS.items() if make().events]


def test_a_choice_starts_from_the_preset(dashboard: Dashboard) -> None:
    gallery = dashboard.controls.gallery
    assert gallery.items == [], "not with the page"
    gallery._handle_msg({"open": True})
    assert gallery.items == presets_shown()
    gallery._handle_msg({"choose": "none such"})
    assert dashboard.store.preset == "paper"
    gallery._handle_msg({"choose": "ut4"})
    assert dashboard.store.preset == "ut4" and dashboard.store.scenario == PRESETS["ut4"]()
