"""What a file means: units, signs, delays, clocks, frames of another rate, and one line where it cannot be."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest

from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.telemetry.formats.contents import Contents
from wfsobs.telemetry.intake import DeclaredFormat, to_record
from wfsobs.telemetry.records import read_record, record_arrays

RNG = np.random.default_rng(1)
N = 40
Y, U = RNG.standard_normal((N, 2)), RNG.standard_normal((N, 2))
DT = np.array(0.001)


def taken(stated: DeclaredFormat | None = None, scenario: Scenario | None = None, units=None, **arrays):
    plain = {"y_lgs": Y, "u": U, "dt": DT} | {k: np.asarray(v) for k, v in arrays.items()}
    present = {k: v for k, v in plain.items() if v.ndim > 0 or v.dtype != object}
    return to_record(Contents(present, units or {}), scenario or Scenario(), stated or DeclaredFormat())


NONE = np.array(None, dtype=object)


# ---------------------------------------------------------------------- units and signs


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("um", 1.0), ("nm", 1e-3), ("rad", 2e6), ("arcsec", 2e6 * math.pi / 648_000), ("mas", 2e3 * math.pi / 648_000)],
)
def test_units_by_statement_by_file_and_by_signal(unit: str, factor: float) -> None:
    """On 8 m an angle is 4 / 8 of the tip over the aperture: 2 m of tip in one radian."""
    for record in (
        taken(DeclaredFormat(unit=unit)),
        taken(unit=unit),
        taken(units={"y_lgs": unit, "u": unit}),
        taken(DeclaredFormat(unit=unit), units={"y_lgs": unit}),
    ):
        np.testing.assert_allclose(record.y_lgs, Y * factor, rtol=1e-12)
        np.testing.assert_allclose(record.u, U * factor, rtol=1e-12)
        assert (f"unit {unit}" in record.origin) == (unit != "um")
    silent = taken(units={"u": unit})
    np.testing.assert_allclose(silent.y_lgs, Y * factor, rtol=1e-12)
    mixed = taken(units={"u": unit, "y_lgs": "um"})
    np.testing.assert_allclose(mixed.y_lgs, Y)
    np.testing.assert_allclose(mixed.u, U * factor, rtol=1e-12)
    if unit != "um":
        with pytest.raises(RecordError, match=r"turbulence has no unit, where others have .* and .*: give it one"):
            taken(units={"u": unit, "y_lgs": "um"}, turbulence=Y)


def test_100_nm_of_tip_on_8_m_are_10_3133_mas() -> None:
    record = taken(DeclaredFormat(unit="mas"), y_lgs=np.full((N, 2), 10.3133))
    np.testing.assert_allclose(record.y_lgs, 0.1, rtol=1e-4)
    keck = taken(DeclaredFormat(unit="mas"), Scenario().replace({"telescope.diameter": 10.0}), y_lgs=np.full((N, 2), 10.3133))
    np.testing.assert_allclose(keck.y_lgs, 0.125, rtol=1e-4)
    assert keck.origin == "unit mas, aperture 10 m"


def test_the_sign_of_commands() -> None:
    record = taken(DeclaredFormat(command_sign=-1), training_y=Y, training_u=U)
    np.testing.assert_array_equal(record.u, -U)
    np.testing.assert_array_equal(record.training.u, -U)
    np.testing.assert_array_equal(record.y_lgs, Y)
    assert record.origin == "command sign -1"
    np.testing.assert_array_equal(taken(command_sign=-1).u, -U)


@pytest.mark.parametrize("delay", [1, 2, 3, 7])
def test_the_delay_of_commands(delay: int) -> None:
    """z[k] = y[k] - u[k-delay], and of a frame the mean of u[k-delay] ... u[k-delay-n+1]."""
    ngs = np.full((N, 2), np.nan)
    ngs[5::5] = 1.0
    for record in (taken(DeclaredFormat(command_delay=delay), y_ngs=ngs, ratio=5), taken(delay=delay, y_ngs=ngs, ratio=5)):
        for k in range(N):
            np.testing.assert_array_equal(record.z[k], Y[k] - (U[k - delay] if k >= delay else 0.0))
            if k % 5 == 0 and k:
                mirror = np.mean([U[j] if j >= 0 else np.zeros(2) for j in range(k - delay - 4, k - delay + 1)], axis=0)
                np.testing.assert_allclose(record.z_ngs[k], 1.0 - mirror, rtol=1e-12)


def test_what_was_stated_is_kept_and_not_applied_twice() -> None:
    record = taken(DeclaredFormat("nm", -1, 3))
    again = to_record(Contents(record_arrays(record)), Scenario(), DeclaredFormat())
    np.testing.assert_array_equal(again.y_lgs, record.y_lgs)
    np.testing.assert_array_equal(again.u, record.u)
    assert (again.origin, again.delay) == (record.origin, 3) == ("unit nm, command sign -1", 3)
    with pytest.raises(RecordError, match="y_lgs is in um, but nm is stated"):
        to_record(Contents(record_arrays(record)), Scenario(), DeclaredFormat("nm"))


# ---------------------------------------------------------------------- clocks


@pytest.mark.parametrize("start", [0.0, -3.0, 1.7e9])
@pytest.mark.parametrize("lost", [[], [7], [1, 2, 3], [5, 20, 38]])
def test_jumps_of_the_clock_are_missing_frames(start: float, lost: list[int]) -> None:
    """Stamps with a jitter of a tenth of a step; at 1.7e9 s a double resolves 0.2 us, so the step is known to 1e-5."""
    there = np.delete(np.arange(N), lost)
    time = start + 0.001 * there + 1e-4 * np.random.default_rng(2).uniform(-1, 1, there.size) * (there % (N - 1) > 0)
    record = taken(y_lgs=Y[there], u=U[there], time=time, dt=NONE)
    assert record.n_steps == N and record.missing == len(lost)
    assert record.dt == pytest.approx(0.001, rel=1e-4)
    np.testing.assert_array_equal(record.y_lgs[there], Y[there])
    assert np.isnan(record.y_lgs[lost]).all() and np.isnan(record.u[lost]).all()


def test_the_clock_of_a_day_goes_on_after_midnight() -> None:
    time = (86399.99 + 0.001 * np.arange(N)) % 86400.0
    record = taken(time=time, time_ngs=time[5::5], y_ngs=RNG.standard_normal((7, 2)), dt=NONE)
    assert (record.n_steps, record.missing, record.ratio) == (N, 0, 5) and record.dt == pytest.approx(0.001, rel=1e-6)


def test_a_stated_rate_counts_and_must_agree() -> None:
    assert taken(DeclaredFormat(rate=500.0), dt=NONE).dt == 0.002
    assert taken(DeclaredFormat(rate=1000.0), time=0.001 * np.arange(N), dt=NONE).dt == 0.001
    for arrays in ({"dt": 0.001}, {"dt": NONE, "time": 0.001 * np.arange(N)}):
        with pytest.raises(RecordError, match="stated"):
            taken(DeclaredFormat(rate=500.0), **arrays)


def clock(change) -> np.ndarray:
    out = 0.001 * np.arange(float(N))
    change(out)
    return out


WRONG_CLOCKS = [
    (clock(lambda t: t.__setitem__(9, 0.0075)), "time goes backwards at row 9, from 0.008 to 0.0075 s"),
    (clock(lambda t: t.__setitem__(9, t[8])), "time stands still at row 9"),
    (clock(lambda t: t.__setitem__(3, np.nan)), "time is nan in row 3"),
    (0.001 * np.arange(N) ** 1.2, "the rate is not constant"),
    (np.cumsum(np.where(np.arange(N) % 2, 0.001, 0.0015)), "the rate is not constant"),
    (
        clock(lambda t: t.__iadd__(np.where(np.arange(N) > 20, 100.0, 0.0))),
        "frames are missing, more than the 40 measured: cut the record",
    ),
    (np.zeros(3), "time takes 40 numbers"),
]


@pytest.mark.parametrize(("time", "message"), WRONG_CLOCKS, ids=[m[:24] for _, m in WRONG_CLOCKS])
def test_what_is_no_clock(time: np.ndarray, message: str) -> None:
    with pytest.raises(RecordError, match=message):
        taken(time=time, dt=NONE)


@pytest.mark.parametrize(("jitter", "late", "lost"), [(0.0, 0, [5]), (0.08, 0, [700, 701]), (0.3, 0, []), (0.1, 40, [])])
def test_stamps_that_scatter_about_a_stated_rate(jitter: float, late: int, lost: list[int]) -> None:
    """Normal jitter in steps, and stamps that are late: below a tenth lost frames are told from it; above, that there is none."""
    rng, n = np.random.default_rng(4), 2000
    there = np.delete(np.arange(n), lost)
    time = 0.001 * (there + jitter * rng.standard_normal(there.size))
    time[rng.integers(0, there.size, late)] += 0.004
    y = rng.standard_normal((n, 2))
    for rate, file in ((1000.0, NONE), (1000.05, NONE), (None, 0.001)):
        record = taken(DeclaredFormat(rate=rate), time=time, dt=file, y_lgs=y[there], u=y[there])
        assert record.missing == len(lost) and record.n_steps == n and record.dt == pytest.approx(0.001, rel=1e-4)
        np.testing.assert_array_equal(record.y_lgs[there], y[there])
        assert ("steps rms off the stated rate" in record.origin) == (jitter > 0.05)
    if jitter > 0.05:
        with pytest.raises(RecordError, match=r"rate is not constant: .*; stamps that scatter need a stated rate|goes backwards"):
            taken(time=time, dt=NONE, y_lgs=y[there], u=y[there])


def test_stamps_that_scatter_too_much_to_say_what_is_missing() -> None:
    rng, there = np.random.default_rng(4), np.delete(np.arange(2000), [700])
    time = 0.001 * (there + 0.25 * rng.standard_normal(there.size))
    y = rng.standard_normal((there.size, 2))
    with pytest.raises(RecordError, match="; it is not known which frames are missing"):
        taken(DeclaredFormat(rate=1000.0), time=time, dt=NONE, y_lgs=y, u=y)


MS, MJD = 1e-3, 86400e-8


@pytest.mark.parametrize(
    ("rate", "quantum", "start"),
    [(450, MS, 0.0), (700, MS, 0.0), (800, MS, 1.7621456e9), (900, MS, 0.0), (1000, MJD, 60982.9 * 86400), (7000, 1e-4, 0.0)],
)
def test_rounded_stamps_are_no_missing_frames(rate: int, quantum: float, start: float) -> None:
    """A lost frame among them is refused: it could be another rate."""
    n = 2000
    y = RNG.standard_normal((n, 2))
    time = quantum * np.floor((start + np.arange(n) / rate) / quantum + 1e-3)
    record = taken(time=time, dt=NONE, y_lgs=y, u=y)
    assert (record.missing, record.n_steps) == (0, n) and record.dt == pytest.approx(1.0 / rate, rel=1e-9)
    assert record.origin == f"stamps rounded to {quantum:.3g} s"
    assert taken(DeclaredFormat(rate=float(rate)), time=time, dt=NONE, y_lgs=y, u=y).missing == 0
    there = np.delete(np.arange(n), 900)
    with pytest.raises(RecordError, match=r"rounded stamps and missing frames are not told apart; state the rate"):
        taken(time=time[there], dt=NONE, y_lgs=y[there], u=y[there])


@pytest.mark.parametrize("rate", [500, 700, 1000])
@pytest.mark.parametrize("lost", [1, 20, 600])
def test_losses_are_no_rounding(rate: float, lost: int) -> None:
    rows = np.delete(np.arange(2000), np.random.default_rng(lost).choice(np.arange(1, 1999), lost, replace=False))
    y = RNG.standard_normal((rows.size, 2))
    record = taken(time=rows / rate, dt=NONE, y_lgs=y, u=y)
    assert record.missing == lost and record.dt == pytest.approx(1.0 / rate, rel=1e-9) and record.origin == ""
    np.testing.assert_array_equal(record.y_lgs[rows], y)


def test_more_modes_than_the_settings_have() -> None:
    five = RNG.standard_normal((N, 5))
    with pytest.raises(RecordError, match=r"1 to 2 modes\): 5 modes need telescope.radial_order = 2"):
        taken(y_lgs=five, u=five)
    with pytest.raises(RecordError, match=r"1 to 5 modes\): 7 modes need telescope.radial_order = 3"):
        taken(scenario=Scenario().replace({"telescope.radial_order": 2}), y_lgs=five[:, [0, 1, 2, 3, 4, 0, 1]], u=five)
    assert taken(scenario=Scenario().replace({"telescope.radial_order": 2}), y_lgs=five, u=five).n_modes == 5


# ---------------------------------------------------------------------- another rate


def test_one_row_per_frame() -> None:
    frames = RNG.standard_normal((7, 2))  # steps 5 ... 35
    for rows in (frames, np.vstack([frames, frames[:1]])):  # the last would come with step 40
        record = taken(y_ngs=rows, ratio=5)
        np.testing.assert_array_equal(record.y_ngs[5::5], frames)
        assert np.isnan(np.delete(record.y_ngs, np.arange(5, N, 5), axis=0)).all()
    with pytest.raises(RecordError, match="y_ngs has 6 rows; it takes 40, or one per frame, 7"):
        taken(y_ngs=frames[:6], ratio=5)


def test_frames_before_and_after_the_record_are_left_out() -> None:
    """The one at its start has seen nothing of it."""
    steps, frames = np.array([-5, 5, 15, 25, 45]), RNG.standard_normal((5, 2))
    record = taken(time=0.001 * np.arange(N), time_ngs=0.001 * steps, y_ngs=frames)
    np.testing.assert_array_equal(record.y_ngs[np.isfinite(record.y_ngs[:, 0])], frames[2:4])


@pytest.mark.parametrize("phase", [0, 1, 3])
def test_frames_with_a_clock_of_their_own(phase: int) -> None:
    """The record starts where its first frame began, and a frame that is not there is NaN."""
    steps = np.array([5, 10, 20, 25, 30]) + phase
    frames = RNG.standard_normal((5, 2))
    record = taken(time=7.0 + 0.001 * np.arange(N), time_ngs=7.0 + 0.001 * steps + 1e-4, y_ngs=frames, dt=NONE)
    assert record.ratio == 5 and record.n_steps == N - phase
    np.testing.assert_array_equal(record.y_lgs, Y[phase:])
    np.testing.assert_array_equal(record.y_ngs[steps - phase], frames)
    assert np.isnan(record.y_ngs[15]).all()


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([5, 10, 17, 20, 25], "frame in row 2 is not a whole number of 5 steps"),
        ([5, 10, 15.5, 20, 25], "time_ngs is 0.0155 s in row 2, which is no step"),
        ([5, 10, 10, 15, 20], "time_ngs goes backwards or stands still at row 2"),
        (
            [5e3, 1e4, 15e3, 2e4, 25e3],
            "time_ngs: 5 of 5 frames are outside of the record's 0 to 0.039 s; it takes stamps in the unit",
        ),
        ([30, 35, 40, 45, 50], "time_ngs: 3 of 5 frames are outside"),
    ],
)
def test_frames_off_their_clock(steps: list[float], message: str) -> None:
    with pytest.raises(RecordError, match=message):
        taken(time=0.001 * np.arange(N), time_ngs=0.001 * np.array(steps), y_ngs=np.zeros((5, 2)))


def test_a_frame_that_lacks_a_mode_is_lost() -> None:
    ngs = np.full((N, 2), np.nan)
    ngs[5::5] = 1.0
    ngs[10, 1] = np.nan
    ngs[15] = np.nan
    assert np.isnan(taken(y_ngs=ngs, ratio=5).y_ngs[[10, 15]]).all()


@pytest.mark.parametrize("is_held", [False, True])
@pytest.mark.parametrize("first", range(1, 7))
def test_rows_of_ngs_frames_tell_their_distance(first: int, is_held: bool) -> None:
    """Between frames a log has nothing, or the last one: both are read as frames at stated steps."""
    frames, rows = RNG.standard_normal((N, 2)), np.arange(first, N, 5)
    rows = np.delete(rows, 3)  # one is lost
    logged = np.full((N, 2), np.nan)
    logged[rows] = frames[rows]
    cut = first % 5
    expected = logged[cut:].copy()
    expected[0] = np.nan  # a frame there has seen nothing of the record
    if is_held:
        ends = [*rows[1:], N]
        for row, end in zip(rows, ends, strict=True):
            logged[row:end] = frames[row]
    for stated in ({}, {"ratio": 5}):
        record = taken(y_ngs=logged, **stated)
        assert record.ratio == 5
        np.testing.assert_array_equal(record.y_ngs, expected)
        np.testing.assert_array_equal(record.y_lgs, Y[cut:])
        is_said = not stated or is_held or cut > 0
        assert record.origin == f"an NGS frame in 5 rows, the first in row {first}" * is_said


def test_blank_cells_after_the_last_ngs_frame() -> None:
    """A column that is blank to its end is short, also where rows are lost."""
    steps = np.delete(np.arange(N), [7, 23])
    ngs = np.where(np.isin(steps, [5, 10, 15, 20])[:, None], Y[steps], np.nan)[:20]
    arrays = {"y_lgs": Y[steps], "u": U[steps], "dt": NONE, "time": steps * 1e-3, "y_ngs": ngs}
    for record in (taken(**arrays), taken(**arrays, ratio=5)):
        np.testing.assert_array_equal(np.flatnonzero(np.isfinite(record.y_ngs[:, 0])), [5, 10, 15, 20])
        np.testing.assert_array_equal(record.y_ngs[5:21:5], Y[5:21:5])


# ---------------------------------------------------------------------- one line


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"unit": "V"}, "y_lgs is in 'V', which is no unit of a wavefront: state one of um, nm"),
        ({"command_sign": 0}, "command_sign takes 1 or -1, not 0"),
        ({"delay": 0}, "delay takes a number of steps from 1 to 100, not 0"),
        ({"delay": "two"}, "delay takes a number, not 'two'"),
        ({"delay": [1.0, 3.0]}, "delay differs between parts of the file: 1.0, 3.0; --trust takes what is stated"),
        ({"command_sign": [-1, 1]}, "command_sign differs between parts of the file: -1, 1; --trust"),
        ({"y_ngs": np.zeros((N, 2)), "ratio": [4, 5]}, "ratio differs between parts of the file: 4, 5$"),
        ({"dt": NONE}, "has no dt and no time"),
        ({"y_ngs": np.zeros((N, 2))}, "y_ngs needs ratio"),
        ({"y_ngs": np.zeros((N, 1)), "ratio": 1}, r"y_ngs has shape \(40, 1\); expected \(40, 2\)"),
        ({"u": U * 1j}, "u holds complex128, not numbers"),
    ],
)
def test_wrong_contents(arrays: dict, message: str) -> None:
    with pytest.raises(RecordError, match=message) as caught:
        taken(**arrays)
    assert "\n" not in str(caught.value)


def test_what_is_trusted_stands_for_parts_that_differ() -> None:
    assert taken(DeclaredFormat(command_delay=3.0, trust=True), delay=[1.0, 3.0]).delay == 3


CSV = [
    ("y_lgs/tip_um,u/tip_um\n1,2\n3,x\n", "line 3, u/tip_um: 'x' is not a number"),
    ("y_lgs/tip_um,u/tip_um\n1,2\n3\n", "line 3 has 1 cells, the heading 2"),
    ("y_lgs/tip_um;u/tip_um\n1,5;2\n3,x;2\n", "line 3, y_lgs/tip_um: '3,x' is not a number"),
    (
        "y_lgs/tip_um;u/tip_um\n0,001;2\n3;5.235\n",
        "line 3, u/tip_um: '5.235' has a decimal point, where other cells have decimal",
    ),
    ('y_lgs/tip_um,u/tip_um\n5.235,2\n"0,001",5\n', "line 2, y_lgs/tip_um: '5.235' has a decimal point, where other cells"),
    ("y_lgs/tip_um;u/tip_um\n1;2\n1\n", "line 3 has 1 cells, the heading 2; cells are separated by semicolons"),
    ("frame,seeing\n1,2\n", "has no y_lgs; a record needs y_lgs, u and dt"),
    ("y_lgs/tip_um,y_lgs/tip_um,u/tip_um\n1,2,3\n", "two columns have the same heading, y_lgs/tip_um"),
    ("timestamp,y_lgs/tip_um,u/tip_um\n1,2,3\n2,3,3\n", "has no dt and no time; .*suggest: --column 'time=timestamp'"),
    ("y_lgs/tip_um,y_lgs/tip_nm,u/tip_um\n1,2,3\n", "two columns are named y_lgs/tip"),
    ("y_lgs/tip_um,y_lgs/tilt_nm,u/tip_um,u/tilt_um\n1,2,3,4\n", "y_lgs is in um and in nm"),
    ("y_lgs/tip_V,u/tip_um\n1,2\n2,1\n", "y_lgs is in 'V', which is no unit"),
    ("y_lgs/tip_um,y_lgs/tilt_um,u/tip_um\n1,2,3\n", "u has the modes tip; y_lgs has tip, tilt"),
    ("# dt: fast\ny_lgs/tip_um,u/tip_um\n1,2\n", "line 1: dt takes a number, not 'fast'"),
    ("", "holds no table"),
    ("y_lgs/tip_um,u/tip_um\n" + "1" * 70_000, "line 2 is longer than 65536 bytes"),
]


@pytest.mark.parametrize(("text", "message"), CSV, ids=[m[:30] for _, m in CSV])
def test_wrong_tables(text: str, message: str) -> None:
    with pytest.raises(RecordError, match=message):
        read_record(io.BytesIO(text.encode()), "r.csv")


def test_empty_cells_are_missing_samples_and_ends() -> None:
    text = "\ufeffu/tip_um,y_lgs/tip_nm,training_y/tip_um,training_u/tip_um\n1,1000,5,6\n2,,7,8\n\n3,3000,,\n4,nan,,\n"
    record = read_record(io.BytesIO(text.encode()), "r.csv", declaration=DeclaredFormat(rate=100.0, unit=None))
    np.testing.assert_array_equal(record.y_lgs[:, 0], [1.0, np.nan, 3.0, np.nan])
    np.testing.assert_array_equal(record.u[:, 0], [1, 2, 3, 4])
    np.testing.assert_array_equal(record.training.u[:, 0], [6, 8])
    assert record.dt == 0.01 and record.missing == 2 and record.origin == "unit nm"
