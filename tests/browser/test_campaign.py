"""The page of a campaign in a browser: opened, and a square of its map clicked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from playwright.sync_api import expect

from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.store import open_folder, write_batch
from wfsobs.campaign.work import run_rows

SHORT = {"run.duration": 1.0, "run.warm_up": 0.2, "gpr_online.training_size": 40, "gpr_offline.training_size": 40}
PLAN = {
    "seeds": 2,
    "observers": ["kf-lgs", "persistence"],
    "settings": SHORT,
    "grid": {"turbulence.wind_speed": [5, 20], "sensors.exposure_ratio": [5, 10]},
}


def toml(table: dict[str, Any]) -> str:
    """Write a plan: in JSON's values, which TOML shares."""
    plain = [f"{key} = {json.dumps(value)}" for key, value in table.items() if not isinstance(value, dict)]
    tables = [f"[{key}]\n{toml(value)}" for key, value in table.items() if isinstance(value, dict)]
    return "\n".join([*plain, *tables])


def make_campaign(folder: Path) -> None:
    """Run a small campaign to its end."""
    plan = parse_plan(toml(PLAN), folder.parent)
    open_folder(plan, folder)
    rows = [row for cell in plan.cells for seed in plan.seeds for row in run_rows(cell, seed, plan.observers, ())]
    write_batch(folder, rows, {"host": "", "process": 1, "written": 1.0})


def test_a_square_opens_its_scenario(make_server: Any, open_page: Any, tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    make_campaign(folder)
    server = make_server(["-m", "wfsobs", "serve", "--port", "{port}", "--campaign", str(folder)], tmp_path / "log", "/")
    try:
        page = open_page(url=server.url + "?" + "&".join(f"{path}={value}" for path, value in SHORT.items()))
        page.get_by_role("button", name="Campaign", exact=True).click()
        expect(page.get_by_text("8 of 8 runs")).to_be_visible()
        expect(page.get_by_role("region", name="Observers of the campaign").get_by_text("Persistence")).to_be_visible()
        page.get_by_role("button", name="Wind speed V₀ [m/s] 20, Exposure ratio n 10: ").click()
        expect(page.get_by_role("button", name="Explore", exact=True)).to_have_attribute("aria-pressed", "true")
        expect(page.get_by_role("textbox", name="Wind speed V₀ [m/s]")).to_have_value("20")
        expect(page.get_by_role("textbox", name="Exposure ratio n")).to_have_value("10")
    finally:
        server.close()
    assert not server.errors(0)
