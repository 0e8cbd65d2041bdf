"""What seeds say: intervals with the coverage that they claim, and differences pair by pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, ttest_1samp, ttest_rel

from wfsobs.evaluation.evidence import Evidence, columns_differ, gather_evidence, holm, marks_of, means_differ
from wfsobs.evaluation.result import can_be_best
from wfsobs.evaluation.scores import Score, batch_means
from wfsobs.evaluation.verdict import verdict
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import run
from wfsobs.scenario.presets import PRESETS


def score(observer: str, rms: float, apart: bool = False) -> Score:
    return Score(observer, "vibration", "tip", rms, 1.0, rms, None, 0.0, 0.0, 1.0, apart)


def test_a_difference_is_that_of_a_paired_t_test() -> None:
    rng = np.random.default_rng(1)
    for shift in np.linspace(0.0, 2.0, 9):
        one = rng.normal(10.0, 3.0, 8)
        other = one + rng.normal(shift, 1.0, 8)
        expected = ttest_rel(one, other).pvalue < 0.05
        assert columns_differ(np.column_stack([one, other])).tolist() == [[False, expected], [expected, False]]


def test_many_tests_are_those_of_a_table_done_by_hand() -> None:
    """Holm: 0.001 <= 0.05 / 4, 0.012 <= 0.05 / 3, 0.03 > 0.05 / 2: that and all above are not significant."""
    assert holm(np.array([0.03, 0.001, 0.04, 0.012])).tolist() == [False, True, False, True]


@pytest.mark.slow
@pytest.mark.parametrize(("names", "seeds"), [(8, 8), (12, 3), (20, 20)])
def test_of_equals_any_is_called_worse_in_at_most_five_per_cent(names: int, seeds: int) -> None:
    """Without a correction for their number: 43 to 60 % of cases."""
    rng, n = np.random.default_rng(names), 600
    ids = [name for name in OBSERVERS if can_be_best(name, False) and name != "zero"][: min(names, 8)]
    worse = unequal = 0
    for _ in range(n):
        shared = rng.normal(10.0, 1.0, (seeds, 1))
        errors = shared + rng.normal(0.0, 0.5, (seeds, names))
        worse += bool(columns_differ(errors).any())
        of = {(name, "vibration", "tip"): errors[:, i] for i, name in enumerate(ids)}
        unequal += len(Evidence(of, of, seeds).leaders("vibration", "tip")) < len(ids)
    most = binom.ppf(0.9999, n, 0.05) / n
    assert worse / n <= most and unequal / n <= most


@pytest.mark.parametrize("slow", [0.0, 0.3, 0.6, 1.0])
def test_of_equals_on_one_record_any_is_called_different_in_at_most_five_per_cent(slow: float) -> None:
    """Eight errors of nine seconds, first-order autoregressions of a correlation time [s]."""
    rng, n, dt = np.random.default_rng(3), 400, 1e-2
    a = np.exp(-dt / slow) if slow else 0.0
    different = 0
    for _ in range(n):
        errors = lfilter([1.0], [1.0, -a], rng.standard_normal((1700, 8)), axis=0)[-900:]
        pieces = batch_means(errors**2)
        different += bool(means_differ(pieces, in_order=True)[pieces.mean(axis=0).argmin()].any())
    assert different / n <= binom.ppf(0.9999, n, 0.05) / n


def test_one_of_many_that_is_worse_is_found() -> None:
    rng = np.random.default_rng(2)
    errors = rng.normal(10.0, 1.0, (8, 1)) + rng.normal(0.0, 0.2, (8, 10)) + 2.0 * (np.arange(10) == 4)
    of = {
        (name, "turbulence", "tip"): errors[:, i] for i, name in enumerate([n for n in OBSERVERS if can_be_best(n, False)][:10])
    }
    worst = list(of)[4][0]
    found = Evidence(of, of, 8).leaders("turbulence", "tip")
    assert worst not in found and len(found) == 9


def test_the_interval_is_that_of_the_mean() -> None:
    values = [10.0, 11.5, 9.0, 10.2, 10.9]
    found = gather_evidence([[score("kf-lgs", x)] for x in values])
    expected = ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert found.interval(("kf-lgs", "vibration", "tip")) == pytest.approx((expected.low, expected.high))
    assert found.mean(("kf-lgs", "vibration", "tip")) == pytest.approx(np.mean(values))


def test_leaders_are_the_best_and_those_that_do_not_differ() -> None:
    noise = np.array([0.0, 1.0, -1.0, 2.0, -2.0])
    base = np.array([10.0, 14.0, 9.0, 12.0, 11.0])
    names = {
        "kf-multi": base,
        "ridge": base + 0.1 * noise + 0.02,
        "kf-lgs": base + 1.0 + 0.1 * noise,
        "butterworth-ol": base - 5.0,
    }
    found = gather_evidence([[score(name, float(x[i])) for name, x in names.items()] for i in range(5)])
    # The one that looks ahead cannot be best, however small its error.
    assert found.leaders("vibration", "tip") == ("kf-multi", "ridge")
    assert gather_evidence([[score("kf-lgs", 1.0)]] * 2).leaders("vibration", "tip") == ()


@pytest.mark.parametrize(
    ("leaders", "marks"),
    [
        (("kf-multi",), {"kf-multi": "best"}),
        (("kf-multi", "ridge", "kf-lgs"), {"kf-multi": "tied", "ridge": "tied"}),
        (("kf-multi", "kf-lgs"), {"kf-multi": "smallest"}),
        ((), {"kf-multi": "smallest"}),
    ],
)
def test_equal_errors_are_close_as_well(leaders: tuple[str, ...], marks: dict[str, str]) -> None:
    """The error of the third is 30 % larger, whatever few seeds can tell."""
    errors = {"kf-lgs": (13.0, False), "butterworth-ol": (5.0, False), "ridge": (12.0, False), "kf-multi": (10.0, False)}
    assert marks_of(errors, leaders) == marks


def test_one_alone_leads_by_two_samples_too() -> None:
    two = gather_evidence([run(PRESETS["paper"]().replace({"run.duration": 1.002}), observers=["kf-lgs"]).scores])
    assert two.leaders("turbulence", "tip") == ("kf-lgs",)


def test_rows_that_are_missing_or_apart_in_a_seed_say_nothing() -> None:
    found = gather_evidence(
        [[score("kf-lgs", 1.0), score("ridge", 2.0)], [score("kf-lgs", 1.0), score("ridge", 2.0, apart=True)]]
    )
    assert set(found.errors) == {("kf-lgs", "vibration", "tip")}


@pytest.mark.slow
def test_the_verdict_over_seeds_has_their_mean_and_says_how_many() -> None:
    scenario = PRESETS["paper"]().replace({"run.duration": 3.0, "run.warm_up": 1.0})
    observers = ["kf-lgs", "kf-multi", "ridge-30", "zero"]
    results = [run(scenario.replace({"run.seed": 1 + i}), observers=observers) for i in range(4)]
    evidence, first = gather_evidence([r.scores for r in results]), results[0]
    found = verdict(
        first.scenario, first.record, first.estimates, first.scores, "vibration", "tip", simulation=scenario, evidence=evidence
    )
    assert found is not None and found.best.observer == "kf-multi" and found.seeds == 4
    of = [s.rms for r in results for s in r.scores if (s.observer, s.target, s.mode) == ("kf-multi", "vibration", "tip")]
    assert found.best.rms == pytest.approx(np.mean(of))
    assert found.sentences()[0].startswith("Vibration, tip, over 4 seeds. With known peak frequencies: Multi-peak KF ")
    single = verdict(first.scenario, first.record, first.estimates, first.scores, "vibration", "tip", simulation=scenario)
    assert single is not None and "seeds" not in " ".join(single.sentences())
    worse = replace(evidence, errors={k: v * (100.0 if k[0] == "kf-lgs" else 1.0) for k, v in evidence.errors.items()})
    harm = verdict(
        first.scenario, first.record, first.estimates, first.scores, "vibration", "tip", simulation=scenario, evidence=worse
    )
    assert harm is not None and all(h.worse for h in harm.harms if h.observer == "kf-lgs")
