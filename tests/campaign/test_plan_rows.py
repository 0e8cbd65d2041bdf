"""The plan of a campaign counts the rows that its runs give."""

from __future__ import annotations

from pathlib import Path

import pytest

from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.run import run_rows
from wfsobs.cli.campaign import rows_of_a_run
from wfsobs.evaluation.scores import COMMON_BOUNDS


@pytest.mark.parametrize(
    ("observers", "controllers"),
    [(["persistence"], []), (["kf-lgs", "multirate", "zero"], ["none", "integrator"]), ([], ["integrator"])],
)
def test_rows_are_counted(observers: list[str], controllers: list[str]) -> None:
    text = f'observers = {observers}\ncontrollers = {controllers}\n[settings]\n"run.duration" = 2.0\n'
    plan = parse_plan(text, Path())
    rows = run_rows(plan.cells[0], plan.seeds[0], plan.observers, plan.controllers)
    named = [row for row in rows if row["name"] in (*COMMON_BOUNDS, *observers, *controllers)]
    assert rows_of_a_run(plan) == len(named)
