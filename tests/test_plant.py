"""The plant of loops whose plant is known: delay with a fraction, gain, rotation, and how well they can be known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import pi, sqrt
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import lfilter

from wfsobs import PRESETS, simulate
from wfsobs.cli import main
from wfsobs.control.true_plant import ActingPlant, TruePlant
from wfsobs.identification.plant import GroupPlant, PlantNumber, contradiction, identify_plant, plant_lines
from wfsobs.identification.plant_likelihood import (
    LONGEST,
    PlantLikelihood,
    Response,
    few_lags,
    guess_plant,
    known_signals,
    second_order,
)
from wfsobs.identification.probe import design_probe
from wfsobs.record import Record, RecordError
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.wiener import circle_mean
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.telemetry.records import save_record
from wfsobs.typing import Array

DT, NOISE = 1e-3, 0.02


def rotation(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def closed_loop(
    n: int,
    delay: float,
    matrix: Array,
    seed: int = 1,
    gain: float = 0.3,
    probe: float = 0.0,
    turned: Array | None = None,
    lost: float = 0.0,
) -> Record:
    """An integrator in turbulence, a line and noise, written out.

    turned : what it takes the mirror's matrix for;  lost : share of the measurements that it does not get
    """
    rng = np.random.default_rng(seed)
    slow, line = Ar2(4.0 * pi, 0.9, 0.3, DT), Ar2(94.0 * pi, 0.01, 0.06, DT)
    seen = np.column_stack([slow.sample(n, rng) + line.sample(n, rng) for _ in range(2)])
    seen += NOISE * rng.standard_normal((n, 2))
    d, p, back = int(delay), delay % 1.0, np.linalg.inv(matrix if turned is None else turned)
    y, integral, u = (np.zeros((n + d + 1, 2)) for _ in range(3))
    excitation = probe * rng.standard_normal((n + d + 1, 2))
    is_lost = rng.random(n + d + 1) < lost
    for k in range(d + 1, n + d + 1):
        y[k] = seen[k - d - 1] + matrix @ ((1.0 - p) * u[k - d] + p * u[k - d - 1])
        integral[k] = integral[k - 1] - (0.0 if is_lost[k] else gain) * back @ y[k]
        u[k] = integral[k] + excitation[k]
    y[is_lost] = np.nan
    return Record(y[d + 1 :], u[d + 1 :], DT)


def right(n: PlantNumber, value: float, sds: float = 4.0) -> bool:
    """Whether a number is known, and the value within 4 of its standard deviations: once in 16 000 it is not."""
    return n.value is not None and n.sd is not None and abs(n.value - value) < sds * n.sd


@pytest.mark.slow
def test_errors_are_those_of_the_cramer_rao_bound() -> None:
    """White commands s in white noise w, half a frame; any response of four lags, each coefficient with the sd w / (s sqrt(2 n)).

    The gain is their sum, the delay their mean weighted with the lag, -1.5 to 1.5 from there: 4 and 5 times that variance.
    """
    rng, n, s, gain = np.random.default_rng(2), 8000, 0.05, 1.2
    u = s * rng.standard_normal((n, 2))
    y = NOISE * rng.standard_normal((n, 2))
    y[3:] += gain * 0.5 * (u[1:-2] + u[:-3])
    (found,) = identify_plant(Record(y, u, DT))
    assert right(found.common_delay, 2.5) and right(found.common_gain, gain)
    assert all(right(g, gain) for g in found.gain) and found.rotation is not None and right(found.rotation, 0.0)
    # 6 %: a taper over 5 % of the record, a length whose Fourier transform is fast, the scatter of the spectrum that is fitted
    assert found.common_delay.sd == pytest.approx(NOISE / (gain * s) * sqrt(5.0 / (2.0 * n)), rel=0.06)
    assert found.common_gain.sd == pytest.approx(NOISE / s * sqrt(4.0 / (2.0 * n)), rel=0.06)
    assert found.rotation.sd == pytest.approx(NOISE / s / gain / sqrt(n), rel=0.06)
    assert found.own_share == pytest.approx(1.0, abs=0.02) and not found.has_dynamics


@pytest.mark.parametrize("damping", [0.3, 0.999, 1.6])
def test_response_of_a_mirror(damping: float) -> None:
    """That of the simulated mirror; gain and group delay at low frequency are 1 and 2 damping / omega more than the dead time."""
    omega, dead = 2.0 * pi * 0.25, 1.7
    late = dead + 2.0 * damping / omega
    taps = second_order(np.array([late, np.log(0.25), np.log(damping)]))
    if damping < 1.0:
        w = np.linspace(0.01, 3.0, 50)
        expected = TruePlant(np.eye(1), dead, resonance=omega, damping=damping).response(w)
        assert np.allclose(np.exp(-1j * np.outer(w, 1.0 + np.arange(len(taps)))) @ taps, expected, rtol=0, atol=1e-8)
    for response in (taps, few_lags(3, np.array([late, 0.2, -0.1])), few_lags(1, np.array([late, 0.2, -0.1]))):
        assert response.sum() == pytest.approx(1.0, abs=1e-9)
        assert response @ (1.0 + np.arange(len(response))) == pytest.approx(late, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay", "gain", "angle"),
    [(2.0, (1.0, 1.0), 0.0), (1.5, (1.0, 1.0), 180.0), (2.4, (1.2, 1.2), 96.0), (3.0, (0.8, 1.1), -20.0)],
)
def test_of_a_loop_without_a_probe(delay: float, gain: tuple[float, float], angle: float) -> None:
    record = closed_loop(20_000, delay, rotation(np.radians(angle)) * gain)
    (found,) = identify_plant(record)
    assert all(right(n, delay) for n in found.delay)
    assert all(right(n, g) for n, g in zip(found.gain, gain, strict=True))
    assert right(found.common_gain, gain[0]) or (gain[0] != gain[1] and found.common_gain.value is None)
    off = np.angle(np.exp(1j * (np.radians(angle) - (found.rotation or PlantNumber()).value)))
    assert found.rotation is not None and right(replace(found.rotation, value=0.0), float(off))
    assert found.own_share < 1e-6 and 0.0 < found.uncertainty < 1.0 and not found.flipped_mode


@pytest.mark.slow
def test_both_sides_of_a_whole_number_of_frames_count() -> None:
    """A maximum above it, where the likelihood is steep, is no better than one below: 2.04 +- 0.03 by that one alone."""
    (found,) = identify_plant(closed_loop(20_000, 1.85, np.eye(2), seed=8, gain=0.2))
    assert right(found.common_delay, 1.85, 3.0) and all(right(n, 1.0, 3.0) for n in found.gain)
    assert found.common_delay.sd is not None and found.common_delay.sd < 0.2


@pytest.mark.slow
def test_a_spectrum_with_more_peaks_has_to_be_likelier() -> None:
    """One in a hundred frames lost; the peaks that a search adds to the spectra have 1.3 +- 0.08 frames likeliest."""
    record = closed_loop(6000, 2.0, np.eye(2), seed=13)
    record.y_lgs[np.random.default_rng(13).random(6000) < 0.01] = np.nan
    (found,) = identify_plant(record)
    assert right(found.common_delay, 2.0) and right(found.common_gain, 1.0)
    assert found.common_delay.sd is not None and found.common_delay.sd < 0.1


@pytest.mark.slow
def test_frames_that_the_loop_lacked() -> None:
    """A tenth of them: the errors are as stated. Where gaps count as data they are six times as large."""
    errors = []
    for seed in range(8):
        (found,) = identify_plant(closed_loop(10_000, 2.0, np.eye(2), seed, lost=0.1))
        numbers = (found.common_delay, 2.0), (found.common_gain, 1.0)
        assert found.loop_loss == pytest.approx(0.1, abs=0.02) and "the controller did not receive" in " ".join(
            plant_lines([found])
        )
        errors += [(n.value - value) / n.sd for n, value in numbers if n.value is not None and n.sd is not None]
    # six of 16 are enough: of six normal numbers one in 2000 has this rms
    assert len(errors) >= 6 and np.sqrt(np.mean(np.square(errors))) < 2.0


@pytest.mark.parametrize("value", [-9.999, 40.0])
@pytest.mark.parametrize("rows", [[0], [2000], [3000, 3003, 3999], range(1500, 1505)])
def test_a_number_in_place_of_a_command_is_no_command(rows: Sequence[int], value: float) -> None:
    """In the commands, or in all of the row: as where the commands are missing."""
    right, lost = closed_loop(4000, 2.0, np.eye(2)), closed_loop(4000, 2.0, np.eye(2))
    lost.u[rows] = np.nan
    for signals in ((right.u,), (right.u, right.y_lgs)):
        for x in signals:
            x[rows] = value
        for got, want, whole in zip(known_signals(right, 4000), known_signals(lost, 4000), (right.y_lgs, right.u), strict=True):
            np.testing.assert_array_equal(np.where(whole == value, np.nan, got), np.where(whole == value, np.nan, want))
    assert np.isnan(known_signals(right, 4000)[1]).all(axis=1).sum() == len(rows)


@pytest.mark.parametrize("delay", range(1, LONGEST + 1))
def test_a_command_that_the_mirror_received_stays_however_large(delay: int) -> None:
    record = closed_loop(4000, float(delay), np.eye(2), gain=0.05)
    kick = 10.0 * np.ptp(record.u)
    record.u[[1000, 2000, 2001, 3000]] += kick
    record.y_lgs[[1000 + delay, 2000 + delay, 2001 + delay, 3000 + delay]] += kick
    assert not np.isnan(known_signals(record, 4000)[1]).any()


@pytest.mark.parametrize("probe", [0.0, 0.003])
@pytest.mark.parametrize("share", [0.02, 0.15])
def test_whether_the_controller_missed_what_is_missing(share: float, probe: float) -> None:
    """What is outlying, or follows a command that is lost, plays no part."""
    lacked, had = (closed_loop(10_000, 1.7, np.eye(2), probe=probe, lost=lost) for lost in (share, 0.0))
    rows = np.random.default_rng(5).random(10_000) < share
    had.y_lgs[rows] = np.nan
    lacked.y_lgs[np.random.default_rng(6).random(10_000) < 0.03] += 10.0
    for record, is_blind in ((lacked, True), (had, False)):
        assert PlantLikelihood(*known_signals(record, 10_000), DT).is_blind is is_blind
    had.u[rows] = np.nan
    assert not PlantLikelihood(*known_signals(had, 10_000), DT).is_blind


@pytest.mark.parametrize(
    ("mirror", "shape"), [(None, ()), (partial(few_lags, 2), (0.1, -0.05)), (second_order, (np.log(0.2), np.log(0.5)))]
)
def test_z_of_any_plant_is_filled_alike(mirror: Response | None, shape: tuple[float, ...]) -> None:
    """Where the controller missed frames, its transform is that of z with the missing samples filled; so are its derivatives."""
    data = PlantLikelihood(*known_signals(closed_loop(4000, 1.7, np.eye(2), lost=0.1), 4000), DT)
    theta = np.array([1.7, 1.9, 1.1, -0.9, 0.2, *shape])
    spectra = data.with_spectra(theta).spectra
    fill = data.fill(theta, spectra)
    assert data.is_blind and fill.is_alike

    def z(at: Array) -> Array:
        m = data.mirror_signal(at)
        if mirror is not None:
            taps = np.fft.rfft([mirror(np.append(late, at[5:])) for late in at[:2]], data.n)
            moved = np.fft.irfft(taps * np.fft.rfft(data.u[1].T), data.n)
            m = ((rotation(at[4]) * at[2:4]) @ moved).T
        each = zip(data.missing, (data.y - m).T, spectra, strict=True)
        return data.transform(np.column_stack([missing.fill(one, s.psd(data.f)) for missing, one, s in each]))

    Z, dZ = data.z(theta, fill, mirror=mirror)
    scale = np.sqrt(np.mean(np.abs(Z) ** 2))
    # samples are filled to 1e-4 of the noise
    np.testing.assert_allclose(Z, z(theta), rtol=0, atol=0.01 * scale)
    for i, slope in enumerate(dZ):  # differences over 0.1 lack terms of third order, at most 2 % of a slope
        e = np.zeros(len(theta))
        e[i] = 0.05
        of_two = (z(theta + e) - z(theta - e)) / 0.1
        assert np.sqrt(np.mean(np.abs(slope - of_two) ** 2)) < 0.05 * np.sqrt(np.mean(np.abs(of_two) ** 2)), i


def test_no_probe_is_seen_in_too_few_frames() -> None:
    """A hundred times 17 frames in a row are fewer than four per coefficient of the regression."""
    record = closed_loop(4000, 1.7, np.eye(2), probe=0.01)
    assert guess_plant(PlantLikelihood(*known_signals(record, 4000), DT))[1] > 0.1
    record.y_lgs[130::15] = np.nan
    assert guess_plant(PlantLikelihood(*known_signals(record, 4000), DT))[1] == 0.0


@pytest.mark.slow
def test_frames_that_the_loop_had_hide_its_plant() -> None:
    """Unless there is a probe: with one in ten missing a delay of one frame may seem likelier than the two that it is."""
    for probe, is_known in ((0.0, False), (0.01, True)):
        record = closed_loop(6000, 2.0, np.eye(2), probe=probe)
        record.y_lgs[np.random.default_rng(5).random(6000) < 0.1] = np.nan
        (found,) = identify_plant(record)
        assert right(found.common_delay, 2.0) is right(found.common_gain, 1.0) is is_known
        assert any("the controller received" in line for line in plant_lines([found])) is not is_known


@pytest.mark.slow
def test_a_probe_makes_it_sharper() -> None:
    """And a rotation is found that the controller does not know of."""
    matrix = rotation(np.radians(8.0))
    quiet, probed = (identify_plant(closed_loop(10_000, 1.3, matrix, probe=size, turned=np.eye(2)))[0] for size in (0.0, 0.01))
    for found in (quiet, probed):
        assert right(found.common_delay, 1.3) and found.rotation is not None and right(found.rotation, np.radians(8.0))
    assert quiet.common_gain.sd is not None and probed.common_gain.sd is not None
    assert probed.common_gain.sd < 0.5 * quiet.common_gain.sd and probed.own_share > 1e-3
    assert probed.uncertainty < quiet.uncertainty
    assert quiet.chance == 1.0 and probed.chance > 1e-3


def probed_mirrors(*plants: TruePlant, n: int = 20_000) -> Record:
    """The loop of a mirror, or of several whose motions add up, with a probe of 10 nm."""
    rng = np.random.default_rng(3)
    slow, line = Ar2(4.0 * pi, 0.9, 0.3, DT), Ar2(94.0 * pi, 0.01, 0.06, DT)
    seen = np.column_stack([slow.sample(n, rng) + line.sample(n, rng) for _ in range(2)])
    noise, probe = NOISE * rng.standard_normal((n, 2)), 0.01 * rng.standard_normal((n, 2))
    mirrors = [ActingPlant(plant) for plant in plants]
    residual, u, y = np.zeros(2), np.zeros((n, 2)), np.zeros((n, 2))
    for k in range(n):
        y[k] = residual + noise[k]
        u[k] = (u[k - 1] - probe[k - 1] if k else 0.0) - 0.3 * y[k] + probe[k]
        residual = seen[k] + sum(mirror.take(u[k]) for mirror in mirrors)
    return Record(y, u, DT)


@pytest.mark.slow
@pytest.mark.parametrize(("frequency", "damping"), [(0.0, 0.3), (300.0, 0.3), (300.0, 0.6), (600.0, 0.4)])
def test_a_probe_tells_the_group_delay_of_a_mirror_with_dynamics(frequency: float, damping: float) -> None:
    """2 damping / omega beyond its dead time."""
    omega = 2.0 * pi * frequency * DT
    (found,) = identify_plant(probed_mirrors(TruePlant(np.eye(2), 2.2, 0.0, omega, damping)))
    assert right(found.common_delay, 2.2 + (2.0 * damping / omega if omega else 0.0)) and right(found.common_gain, 1.0)
    assert found.common_delay.sd is not None and found.common_delay.sd < 0.03 and found.chance > 1e-3
    if frequency != 600.0:  # in doubt there
        assert found.has_dynamics == (frequency > 0.0)
        assert ("acts otherwise than by a delay and a gain" in plant_lines([found])[0]) == (frequency > 0.0)


@pytest.mark.slow
def test_what_no_mirror_of_second_order_does_is_not_identifiable() -> None:
    """An echo four frames later."""
    (found,) = identify_plant(probed_mirrors(TruePlant(0.7 * np.eye(2), 2.0), TruePlant(0.3 * np.eye(2), 6.0), n=6000))
    assert found.chance < 1e-6 and all(n.value is None for n in (*found.delay, *found.gain, found.common_delay))
    assert "than by any mirror of second order" in plant_lines([found])[1] and found.uncertainty == np.inf


@pytest.mark.slow
@pytest.mark.parametrize(("flip", "name"), [((1.0, -1.0), "tilt"), ((-1.0, 1.0), "tip")])
def test_a_flipped_axis(flip: tuple[float, float], name: str) -> None:
    """Of 3 s the angle is known to 0.03 rad, and a flip is half a turn away."""
    (found,) = identify_plant(closed_loop(3000, 2.0, np.diag(flip)))
    assert found.flipped_mode == name


@pytest.mark.slow
def test_what_is_not_identifiable() -> None:
    """A loop so slow that its commands are lost in the noise; one too short; a mirror at rest."""
    (slow,) = identify_plant(closed_loop(6000, 2.0, np.eye(2), gain=0.002))
    assert slow.common_delay == slow.common_gain == PlantNumber() and slow.uncertainty == np.inf
    record = closed_loop(1200, 2.0, np.eye(2))
    with pytest.raises(RecordError, match="has 900 frames, the plant needs 1000"):
        identify_plant(Record(record.y_lgs[:900], record.u[:900], DT))


def test_signals_that_tell_nothing_of_a_plant_are_named() -> None:
    record = closed_loop(2000, 2.0, np.eye(2))
    y, u, tip, same = record.y_lgs, record.u, np.array([1.0, 0.0]), np.ones((2, 2)) * [[1.0], [0.0]]
    gone, frozen = np.full_like(y, np.nan), np.where(np.arange(len(y))[:, None] < 1500, y, y[1500])
    for measured, sent, reason in (
        (y, 0.0 * u, "the commands of tip and tilt do not move"),
        (y, u * tip, "the commands of tilt do not move"),
        (0.0 * y + 0.1, u, "the measurements of tip and tilt do not move"),
        (gone, u, "tip: 100 % of the frames are missing, or follow a lost command; at most 20 %"),
        (y * tip, u, "the measurements of tilt do not move"),
        (y @ same, u, "the measurements of tip and tilt are the same"),
        (frozen, u, "of tip and tilt stay the same for 500 frames from frame 1500 on: leave out what is not measured"),
    ):
        with pytest.raises(RecordError, match=reason):
            identify_plant(Record(measured, sent, DT))


@pytest.mark.slow
def test_commands_too_small_for_their_squares_tell_nothing() -> None:
    y, u = np.random.default_rng(1).standard_normal((2, 1000, 2))
    assert not contradiction(Record(y, 1e-200 * u, DT))


@pytest.mark.slow
def test_bad_samples_and_other_units_do_not_matter() -> None:
    record = closed_loop(10_000, 2.4, np.eye(2))
    y, rng = record.y_lgs.copy(), np.random.default_rng(3)
    y[rng.choice(len(y), 100, replace=False)] += 0.8
    y[rng.choice(len(y), 100, replace=False)] = np.nan
    (found,) = identify_plant(Record(y, 1e3 * record.u, DT))
    assert right(found.common_delay, 2.4) and right(found.common_gain, 1e-3)
    assert found.own_share < 1e-6, "lines over missing samples are no probe"


@pytest.mark.slow
def test_command(tmp_path: Path) -> None:
    """Delay and gain are those of the commands in the file, whatever is stated; it ends with what they rest on."""
    file = tmp_path / "r.npz"
    save_record(file, closed_loop(4000, 2.4, np.eye(2)))
    plain = json.loads(CliRunner().invoke(main, ["plant", str(file), "--json"]).stdout)
    stated = ["plant", str(file), "--json", "--command-delay", "1.5", "--command-gain", "1.1", "--trust"]
    assert json.loads(CliRunner().invoke(main, stated).stdout) == plain
    assert (plain["modes"], plain["pairs"]) == (["tip", "tilt"], [["tip", "tilt"]])
    assert plain["delay_frames"] == pytest.approx([2.4, 2.4], abs=4.0 * max(plain["delay_frames_sd"]))
    assert plain["rotation_deg"] == pytest.approx([0.0], abs=4.0 * plain["rotation_deg_sd"][0])
    assert not plain["excited"] and 0.0 < plain["trustworthy_to_percent"] < 50.0
    told = CliRunner().invoke(main, ["plant", str(file)]).stdout
    assert all(line in told for line in plain["remarks"])


@pytest.mark.slow
def test_a_probe_costs_and_tells_what_its_design_says(tmp_path: Path) -> None:
    """Beside the integrator of the simulation, y and u change by what the linear loop makes of it."""
    out = tmp_path / "probe.npz"
    options = ["--set", "run.duration=20", "--set", "loop.gain=0.4"]
    design = json.loads(CliRunner().invoke(main, ["probe", *options, "--json", "--out", str(out)]).stdout)
    assert max(
        design["bound"]["delay_frames"] / 0.03, design["bound"]["gain"] / 0.02, design["bound"]["rotation_deg"]
    ) == pytest.approx(1.0)
    with np.load(out) as data:
        probe = data["probe"]
    assert probe.std(axis=0) == pytest.approx(np.full(2, design["rms"]), rel=1e-9)
    record = simulate(PRESETS["paper"]().replace({"run.duration": 20.0, "loop.gain": 0.4, "run.seed": 3}))
    more = lfilter([1.0, -1.0], [1.0, -1.0, 0.4], probe, axis=0)
    left, added = np.asarray(record.truth("total")) + np.roll(record.u, 1, axis=0), np.roll(more, 1, axis=0)
    cost = np.sqrt((left + added)[500:].var(axis=0) / left[500:].var(axis=0)).max() - 1.0
    assert cost == pytest.approx(design["cost"], rel=0.4), "to the scatter of the correlation of both, over 20 s"
    (found,) = identify_plant(replace(record, y_lgs=record.y_lgs + np.roll(more, 2, axis=0), u=record.u + more))
    numbers = ((found.delay[0], 2.0), (found.gain[0], 1.0), (found.degrees, 0.0))
    for (n, value), bound in zip(numbers, design["bound"].values(), strict=True):
        assert right(n, value) and n.sd is not None
        assert 0.3 * bound < n.sd < 1.1 * bound, "the loop's own motion tells as well, and both modes have one delay"


def test_a_probe_of_a_mirror_at_rest_is_all_in_the_residual() -> None:
    """Nothing answers it: every mode's variance grows by that of the probe."""
    scenario = PRESETS["paper"]().replace({"loop.closed": False})
    found = design_probe(scenario, 20.0, {"delay_frames": 0.03, "gain": 0.02, "rotation_deg": 1.0})
    quietest = min(circle_mean(true_spectra(scenario, mode).total[0]) for mode in range(2))
    assert (1.0 + found.cost) ** 2 - 1.0 == pytest.approx(found.rms**2 / quietest, rel=0.01), "to the bin at the lowest frequency"


def test_text() -> None:
    assert PlantNumber(2.0123, 0.0234).text() == "2.012 +- 0.023" and PlantNumber(170.0, 12.0).text(" nm") == "170 +- 12 nm"
    assert PlantNumber().text() == "not identifiable"
    known = PlantNumber(1.0, 0.1)
    groups = [GroupPlant((n,), (known,), (known,), None, known, known, 1.0, (4,), False, 0.0, np.eye(2)) for n in ("tip", "tilt")]
    for peaks, text in ((4, "resonances per mode: 4;"), (6, "resonances per mode: 4 to 6;")):
        assert any(text in line for line in plant_lines([groups[0], replace(groups[1], peaks=(peaks,))]))


def test_flipped_without_an_angle() -> None:
    known = PlantNumber(1.0, 0.1)
    group = GroupPlant(
        ("tip", "tilt"), (known, known), (known, known), PlantNumber(), known, known, 1.0, (0, 0), False, 0.0, np.zeros((5, 5))
    )
    assert not group.flipped_mode and group.degrees == PlantNumber()
