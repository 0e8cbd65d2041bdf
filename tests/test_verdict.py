"""The sentences above the figures, against the numbers of the table, in several scenarios."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from wfsobs.evaluation.budget import error_budget
from wfsobs.evaluation.evidence import LEVEL, Evidence, means_differ
from wfsobs.evaluation.result import NOTHING, PEAKS, Result, can_be_best, prior_knowledge, row_label, target_title
from wfsobs.evaluation.scores import BATCHES, BOUND_BOTH, BOUNDS, PREDICTION, batch_means
from wfsobs.evaluation.verdict import HEADINGS, explain_harm, verdict
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import observe, run
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

pytestmark = pytest.mark.slow

QUICK = ("kf-lgs", "kf-multi", "multirate-optimal", "ridge-30", "butterworth-cl", "persistence", "zero")
SCENARIOS = {
    "paper": PRESETS["paper"](),
    "ut4": PRESETS["ut4"](),
    "strong turbulence": PRESETS["strong-turbulence"](),
    "one line": PRESETS["paper"]().replace(
        {"vibration.peaks": [{"frequency": 13.0, "damping": 0.003, "rms": [0.05, 0.05]}], "kalman.peak": "matched"}
    ),
}


@pytest.fixture(scope="module", params=SCENARIOS)
def result(request: pytest.FixtureRequest) -> Result:
    return run(SCENARIOS[request.param], observers=QUICK)


def power_near(x: Array, dt: float, lines: list[float]) -> float:
    """Share of the power of x within 1.5 Hz of the lines, by Parseval's theorem, in pieces of 2 s that overlap by half."""
    n = round(2.0 / dt)
    pieces = np.array([x[i : i + n] for i in range(0, x.size - n + 1, n // 2)])
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(n) / n)
    power = (np.abs(np.fft.fft((pieces - pieces.mean(axis=1, keepdims=True)) * window)) ** 2).sum(axis=0)
    frequency = np.abs(np.fft.fftfreq(n, dt))
    near = (np.abs(frequency[:, None] - np.array(lines)) <= 1.5).any(axis=1)
    return float(power[near].sum() / power.sum())


def test_the_best_by_prior_knowledge_is_the_least_error_of_the_table_and_the_sentence_has_its_numbers(result: Result) -> None:
    for target in ("turbulence", "vibration"):
        for mode in ("tip", "tilt"):
            of = [s for s in result.scores if (s.target, s.mode) == (target, mode)]
            rivals = {s.observer: s.rms for s in of if can_be_best(s.observer, s.apart) and s.observer != "zero"}
            found = verdict(
                result.scenario, result.record, result.estimates, result.scores, target, mode, simulation=result.scenario
            )
            least = min(rivals.values())
            same = [name for name in OBSERVERS if rivals.get(name, np.inf) <= 1.001 * least]  # two ways of one filter
            assert found is not None and found.best.observer == same[0]
            lead, *others = found.sentences()
            assert lead.startswith(f"{target.capitalize()}, {mode}. ")
            said = dict(re.findall(r"(With[a-z ]+(?:\d+ of \d+ [a-z ]+)?): (.*?)\.(?= |$)", lead))
            for kind in {NOTHING, PEAKS, found.best.knowledge}:
                of_kind = {name: rms for name, rms in rivals.items() if prior_knowledge(name) == kind}
                if not of_kind:
                    continue
                place, text = found.best_with(kind), said[HEADINGS[kind]]
                assert place is not None and place.rms <= 1.001 * min(of_kind.values())
                assert text.startswith(f"{row_label(place.observer)} ")
                number = re.search(r" ([\d.]+) (?:± ([\d.]+)|\(([\d.]+) to ([\d.]+)\)) nm", text)
                # Three digits, so that half of the last is at most 0.5 %.
                assert number and float(number[1]) == pytest.approx(place.rms * 1e3, rel=5e-3)
                score = next(s for s in of if s.observer == place.observer)
                assert place.interval == score.interval and score.interval is not None
                low, high = score.interval
                half = float(number[2]) if number[2] else 0.5 * (float(number[4]) - float(number[3]))
                assert low < score.rms < high and half == pytest.approx(500.0 * (high - low), abs=0.051)
                assert ("statistically equal to the best" in text) == (place.is_tie and place is not found.best)
            first = said[HEADINGS[found.best.knowledge]]
            low, high = found.best.interval or (0.0, 0.0)
            bound = next(s.rms for s in of if s.observer == BOUND_BOTH)
            percent = re.search(r"(\d+) % (above|below) the theoretical limit using LGS and NGS", first)
            if low <= bound <= high:
                where = "at" if high - low <= 0.5 * found.best.rms else "possibly at"
                assert f", {where} the theoretical limit using LGS and NGS" in first
            else:
                assert percent and percent[2] == ("above" if bound < found.best.rms else "below")
                assert float(percent[1]) == pytest.approx(100.0 * abs(found.best.rms / bound - 1.0), abs=0.51)
            assert ("statistically equal to" in lead) == bool(found.ties) and all(row_label(name) in lead for name in found.ties)
            assert f"LGS KF {rivals['kf-lgs'] * 1e3:#.3g} " in " ".join([lead, *others]), "always named"


def test_a_record_without_truth_has_a_verdict_on_the_next_measurement() -> None:
    simulated = run(SCENARIOS["paper"].replace({"run.duration": 4.0}), observers=("kf-lgs", "kf-multi", "persistence"))
    record = replace(simulated.record, turbulence=None, vibration=None)
    result = observe(record, SCENARIOS["paper"], observers=("kf-lgs", "kf-multi", "persistence"))
    found = verdict(result.scenario, record, result.estimates, result.scores, PREDICTION, "tip", source=result.prior_source)
    scores = {s.observer: s.rms for s in result.scores if (s.target, s.mode) == (PREDICTION, "tip")}
    assert found is not None and not found.harms
    assert found.best.observer == min((n for n in scores if n in OBSERVERS), key=scores.__getitem__)
    said = found.sentences()[0]
    assert said.startswith(f"{target_title(PREDICTION)}, tip. ")
    assert "With given peak frequencies: Multi-peak KF " in said, "as the table of such a record calls them"


def test_who_does_harm_is_named_with_where_its_error_lies(result: Result) -> None:
    for target in ("turbulence", "vibration"):
        found = verdict(
            result.scenario, result.record, result.estimates, result.scores, target, "tip", simulation=result.scenario
        )
        assert found is not None
        harmful = {s.observer for s in result.scores if (s.target, s.mode) == (target, "tip") and s.rms >= s.truth_rms}
        assert {harm.observer for harm in found.harms} == harmful - {*BOUNDS, "zero"}
        truth = result.record.truth(target)
        assert truth is not None
        said = " ".join(found.sentences()[1:])
        lines = [line[0] for line in vibration_lines(result.scenario, 0)]
        for harm in found.harms:
            estimate = result.estimate(harm.observer, target)
            assert estimate is not None and row_label(harm.observer) in said
            error = (estimate.values - truth)[1000:, 0]
            # The same windows: rounding alone.
            whole = power_near(error[~np.isnan(error)], result.record.dt, lines)
            assert harm.at_known + harm.at_others == pytest.approx(whole, abs=1e-6)


def test_a_filter_of_one_line_does_harm_at_the_others_and_not_where_there_are_none() -> None:
    by_name = {}
    for name in ("paper", "one line"):
        result = run(SCENARIOS[name], observers=("kf-lgs", "kf-multi", "zero"))
        found = verdict(
            result.scenario, result.record, result.estimates, result.scores, "vibration", "tilt", simulation=result.scenario
        )
        assert found is not None
        by_name[name] = found
    (harm,) = by_name["paper"].harms
    assert harm.observer == "kf-lgs" and harm.worse and harm.at_others > 0.6 > 0.3 > harm.at_known
    said = by_name["paper"].sentences()[-1]
    assert said.startswith("LGS KF ") and " nm is worse than assuming no vibration: its model has one of 12 peaks" in said
    # With one line both filters have the same model.
    assert not by_name["one line"].harms and by_name["one line"].ties


def test_who_knows_bands_has_no_model_of_peaks() -> None:
    result = run(SCENARIOS["paper"].replace({"sensors.lgs_noise": 0.2}), observers=("gpr-online", "kf-lgs", "zero"))
    given = (result.scenario, result.record, result.estimates, result.scores, "vibration", "tilt")
    found = verdict(*given, simulation=result.scenario)
    assert found is not None and found.harms[0].observer == "gpr-online"
    said = next(line for line in found.sentences() if line.startswith("Online GPR"))
    assert (
        "knows the frequency bands; " in said and "model" not in said and re.search("error lies (at|away from) the peaks", said)
    )


NAMES = {
    "noise": "sensor noise",
    "lag": "lag",
    "lines": "unmodelled peaks",
    "mismatch": "model mismatch",
    "cone": "cone effect and aliasing",
}


CAUSED = {
    "noise": ("vibration", {"sensors.lgs_noise": 0.2, "kalman.measurement_noise": "manual", "kalman.lgs_noise": 0.002}),
    "cone": ("turbulence", {"sensors.lgs_low_frequency_rms": 2.0}),
}
"""A noise that the filters do not know; a slow error of the LGS larger than the turbulence."""


@pytest.mark.parametrize("name", ["paper", "strong turbulence", *CAUSED])
def test_who_does_harm_is_named_with_the_largest_term_of_its_error_budget(name: str) -> None:
    target, changes = CAUSED.get(name, ("vibration", {}))
    scenario = SCENARIOS["one line"].replace(changes) if changes else SCENARIOS[name]
    result = run(scenario, observers=QUICK)
    budgets = error_budget(result, observers=QUICK[:-1], mode="tip")
    given = (scenario, result.record, result.estimates, result.scores, target, "tip")
    found = verdict(*given, simulation=scenario, budgets=budgets)
    assert found is not None and found.harms
    errors = {s.observer: s.rms for s in result.scores if (s.target, s.mode) == (target, "tip")}
    terms = {b.observer: b.terms for b in budgets if b.target == target}
    sentences = found.sentences()[1:]
    for harm in found.harms:
        of = terms[harm.observer]
        assert harm.cause == max(of, key=of.__getitem__)
        # Rounding: the terms add up to the square of the error in the table.
        assert harm.share == pytest.approx(of[harm.cause] / errors[harm.observer] ** 2, rel=1e-6)
        (said,) = (s for s in sentences if row_label(harm.observer) in s.partition(" than assuming")[0])
        assert said.endswith(f"{NAMES[harm.cause]}.")
        together = [
            h.share for h in found.harms if h.cause == harm.cause and row_label(h.observer) in said.partition(" than assuming")[0]
        ]
        percent = re.search(r"(?:(\d+) %|all) of (?:its|their) error comes from", said)
        assert percent and float(percent[1] or 100.0) == pytest.approx(100.0 * np.mean(together), abs=0.51)
    if name in CAUSED:
        assert {harm.cause for harm in found.harms if harm.observer.startswith(("kf", "multirate"))} == {name}


def test_budgets_are_made_of_those_that_do_harm_and_of_a_simulation_alone() -> None:
    result = run(SCENARIOS["paper"], observers=("kf-lgs", "kf-multi", "zero"))
    assert {(b.observer, b.mode) for b in explain_harm(result, "tilt")} == {("kf-lgs", "tilt")}
    assert not explain_harm(replace(result, record=replace(result.record, vibration=None)))


FOUND = [{"frequency": 14.0, "damping": 0.003, "rms": [0.01, 0.01]}, {"frequency": 47.4, "damping": 0.003, "rms": [0.01, 0.01]}]


@pytest.mark.parametrize(
    ("peaks", "counted", "words"),
    [
        ([], 0, "With 0 of 14 peak frequencies known: "),
        ([*FOUND, {"frequency": 40.0, "damping": 0.003, "rms": [0.01, 0.01]}], 2, "With 2 of 14 peak frequencies known: "),
        (PRESETS["paper"]().vibration.peaks, 14, "With known peak frequencies: "),
    ],
)
def test_the_peaks_that_are_counted_are_those_that_the_observers_are_told(peaks: list, counted: int, words: str) -> None:
    """As after an identification, which found two of the peaks, and one where there is none."""
    simulation = PRESETS["paper"]().replace({"run.duration": 2.0})
    told = simulation.replace({"vibration.peaks": peaks})
    result = observe(simulate(simulation), told, observers=("kf-multi", "zero"))
    given = (result.scenario, result.record, result.estimates, result.scores, "turbulence", "tip")
    found = verdict(*given, simulation=simulation)
    assert found is not None and found.lines == 14
    assert found.best.n_peaks == counted and words in found.sentences()[0]
    # Without the simulation nobody knows which of them there are.
    alone = verdict(*given)
    assert alone is not None and alone.best.n_peaks == sum(p.rms[0] > 0 for p in told.vibration.peaks)


def test_the_best_with_each_kind_of_prior_knowledge_is_the_least_error_of_those_that_have_it(result: Result) -> None:
    found = verdict(
        result.scenario, result.record, result.estimates, result.scores, "vibration", "tip", simulation=result.scenario
    )
    assert found is not None
    of = {s.observer: s.rms for s in result.scores if (s.target, s.mode) == ("vibration", "tip")}
    kinds = {
        "peaks": {"kf-multi"},
        "one peak": {"kf-lgs", "multirate-optimal"},
        "training data": {"ridge-30"},
        "bands": {"butterworth-cl"},
    }
    for kind, names in kinds.items():
        best = found.best_with(kind)
        assert best is not None and best.rms == min(of[name] for name in names) and best.observer in names
    assert found.best_with("nothing") is None


def test_errors_that_few_seeds_cannot_tell_apart_are_equal_only_where_they_are_alike() -> None:
    """Of three seeds that scatter by 40 % no difference is significant, and 25 % is the most that is called equal."""
    result = run(SCENARIOS["paper"].replace({"run.duration": 2.0}), observers=("kf-lgs", "kf-multi", "multirate-optimal", "zero"))
    means, scatter = {"kf-multi": 10.0, "multirate-optimal": 12.4, "kf-lgs": 12.6}, np.array([[0.6, 1.0, 1.4], [1.4, 0.6, 1.0]])
    errors = {(n, "vibration", "tip"): m * scatter[int(m > 10.0)] for n, m in means.items()}
    few = Evidence(errors, {key: np.full(3, 20.0) for key in errors}, 3)
    assert few.leaders("vibration", "tip") == tuple(means), "none differs significantly"
    given = (result.scenario, result.record, result.estimates, result.scores, "vibration", "tip")
    found = verdict(*given, evidence=few)
    assert found is not None and [p.observer for p in found.places] == list(means) and found.ties == ("multirate-optimal",)
    assert "statistically equal to Optimal" in found.sentences()[0].replace(row_label("multirate-optimal"), "Optimal")


def test_without_truth_there_is_no_verdict_and_without_a_simulation_no_lines() -> None:
    result = run(SCENARIOS["paper"], observers=("kf-lgs", "kf-multi", "zero"))
    given = (result.scenario, result.record, result.estimates, result.scores, "vibration", "tilt")
    unknown = verdict(*given)
    assert unknown is not None and unknown.lines == 0 and "%" not in " ".join(unknown.sentences()[1:])
    assert verdict(result.scenario, replace(result.record, turbulence=None, vibration=None), *given[2:]) is None


def differs(*errors: Array) -> bool:
    """Whether any of some errors of one record differ significantly."""
    return bool(means_differ(batch_means(np.array(errors).T ** 2), in_order=True).any())


def errors_of(rng: np.random.Generator, scale: float) -> tuple[Array, Array]:
    """Two records of 10 s of equally distributed errors, correlated over 20 ms and with each other; the other scaled."""
    shared, one, other = lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], rng.standard_normal((3, 10_000)))
    return 0.8 * shared + 0.6 * one, scale * (0.8 * shared + 0.6 * other)


def test_a_difference_is_called_significant_as_often_as_the_level_says_and_a_large_one_always() -> None:
    """Of 400 pairs, LEVEL with a standard deviation of 1.1 %: within four of these. Twenty per cent of rms are 11 standard
    deviations of the mean difference (with a correlation time of 20 ms, 250 independent samples of a difference with a
    standard deviation of 1.6 and the mean 0.44: 4.4 of them at least)."""
    rng = np.random.default_rng(3)
    even = np.mean([differs(*errors_of(rng, 1.0)) for _ in range(400)])
    assert abs(even - LEVEL) < 4.0 * np.sqrt(LEVEL * (1.0 - LEVEL) / 400)
    assert np.mean([differs(*errors_of(rng, 1.2)) for _ in range(50)]) > 0.9
    assert not differs(np.zeros(BATCHES), np.zeros(BATCHES))


def test_of_eight_equal_errors_of_one_record_any_is_called_different_as_rarely() -> None:
    rng, found = np.random.default_rng(5), 0
    for _ in range(200):
        shared, *own = lfilter([np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], rng.standard_normal((9, 10_000)))
        found += differs(*(0.8 * shared + 0.6 * one for one in own))
    assert found / 200 < LEVEL + 4.0 * np.sqrt(LEVEL * (1.0 - LEVEL) / 200)


@pytest.mark.parametrize("seconds", [0.3, 1.0])
def test_slow_errors_do_not_feign_a_difference(seconds: float) -> None:
    """As long as two pieces of a record of 10 s: without their correlation 9 and 24 % of even pairs are said to differ."""
    rng, pole = np.random.default_rng(4), np.exp(-1e-3 / seconds)
    found = 0
    for _ in range(400):
        noise = rng.standard_normal((3, 20_000))
        shared, one, other = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], noise)[:, 10_000:]
        found += differs(0.8 * shared + 0.6 * one, 0.8 * shared + 0.6 * other)
    # Never more than the level; a test that never says so would be of no use.
    assert 0.005 < found / 400 < LEVEL + 4.0 * np.sqrt(LEVEL * (1.0 - LEVEL) / 400)


PAPER = PRESETS["paper"]().replace({"run.duration": 3.0, "run.warm_up": 0.5})
DOZEN = {
    "calm": PAPER.replace({"turbulence.wind_speed": 3.0}),
    "windy": PAPER.replace({"turbulence.wind_speed": 40.0}),
    "good seeing": PAPER.replace({"turbulence.r0": 0.3}),
    "bad seeing": PAPER.replace({"turbulence.r0": 0.06}),
    "fast NGS": PAPER.replace({"sensors.exposure_ratio": 2}),
    "slow NGS": PAPER.replace({"sensors.exposure_ratio": 20}),
    "noisy LGS": PAPER.replace({"sensors.lgs_noise": 0.1}),
    "noisy NGS": PAPER.replace({"sensors.ngs_noise": 0.1}),
    "no slow error of the LGS": PAPER.replace({"sensors.lgs_low_frequency_rms": 0.0}),
    "large slow error of the LGS": PAPER.replace({"sensors.lgs_low_frequency_rms": 0.5}),
    "no peaks": PAPER.replace({"vibration.peaks": []}),
    "three peaks": PAPER.replace({"vibration.peaks": [peak.to_dict() for peak in PAPER.vibration.peaks][:3]}),
    "another seed": PAPER.replace({"run.seed": 99}),
}


@pytest.mark.parametrize("name", DOZEN)
def test_in_a_dozen_scenarios_the_verdict_is_that_of_the_table(name: str) -> None:
    scenario = DOZEN[name]
    result = run(scenario, observers=("kf-lgs", "kf-multi", "multirate-multi", "persistence", "ridge", "zero"))
    for target in ("turbulence", "vibration"):
        of = {s.observer: s for s in result.scores if (s.target, s.mode) == (target, "tip")}
        found = verdict(scenario, result.record, result.estimates, result.scores, target, "tip", simulation=scenario)
        if found is None:  # there is nothing to estimate
            assert target == "vibration" and not scenario.vibration.peaks
            continue
        said = " ".join(found.sentences())
        rivals = {n: s.rms for n, s in of.items() if can_be_best(n, s.apart) and n != "zero"}
        for kind, heading in (("nothing", "Without prior knowledge"), ("peaks", "With known peak frequencies")):
            errors = {n: x for n, x in rivals.items() if prior_knowledge(n) == kind}
            if not errors:
                assert heading not in said
                continue
            match = re.search(rf"{heading}: (.*?) ([\d.]+)(?: ± [\d.]+| \([\d.]+ to [\d.]+\)| \(interval unknown\))? nm", said)
            # Three digits; of two that are the same to a thousandth the first in the tables is named.
            assert match and float(match[2]) == pytest.approx(1e3 * min(errors.values()), rel=6e-3)
            assert match[1] in {row_label(n) for n, x in errors.items() if x <= 1.001 * min(errors.values())}
        assert row_label("kf-lgs") in said, "always named"
        for harm in found.harms:
            assert of[harm.observer].rms >= of[harm.observer].truth_rms
        assert ("than assuming no" in said) == any(x >= of["zero"].rms for x in rivals.values())
        above = found.best.above_limit
        if above is not None and np.isnan(above):
            assert ", possibly at the theoretical limit" in said
        elif above is not None and above != 0.0 and round(100 * above):
            assert f"{abs(round(100 * above))} % {'above' if above > 0 else 'below'} the theoretical limit" in said
        elif above == 0.0:
            assert ", at the theoretical limit" in said
