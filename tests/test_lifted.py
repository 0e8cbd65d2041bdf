"""Periodic filters by blocks against the plain loop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.signal.periodic import BLOCK, PeriodicFilter

Step = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def plain(steps: list[Step], v: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """The definition, step by step."""
    x, out = x0, []
    for k in range(len(v)):
        F, G, H, J = steps[k % len(steps)]
        out.append(H @ x + J @ v[k])
        x = F @ x + G @ v[k]
    return np.array(out).reshape(len(v), steps[0][2].shape[0])


def random_steps(rng: np.random.Generator, cycle: int, n: int, m: int, p: int, radius: float) -> list[Step]:
    out = []
    for _ in range(cycle):
        F = rng.standard_normal((n, n))
        F *= radius / np.abs(np.linalg.eigvals(F)).max()
        out.append((F, rng.standard_normal((n, m)), rng.standard_normal((p, n)), rng.standard_normal((p, m))))
    return out


def bound(steps: list[Step], v: np.ndarray, x0: np.ndarray) -> float:
    """Size that rounding is relative to: the loop with the absolute values of everything."""
    absolute = [tuple(np.abs(part) for part in step) for step in steps]
    return plain(absolute, np.abs(v), np.abs(x0)).max() if len(v) else 1.0  # type: ignore[arg-type]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.integers(1, 9) | st.sampled_from([47, 48, 49, 100]),
    st.integers(1, 7),
    st.integers(1, 3),
    st.integers(1, 3),
    st.floats(0.0, 0.4),
    st.integers(0, 2**31),
    st.data(),
)
def test_blocks_give_what_the_plain_loop_gives(
    cycle: int, n: int, m: int, p: int, radius: float, seed: int, data: st.DataObject
) -> None:
    length = cycle * max(1, round(BLOCK / cycle))
    borders = [k * length + d for k in (1, 2, 4, 9) for d in (-1, 0, 1)]
    n_steps = data.draw(st.sampled_from(borders) | st.integers(1, 600))
    rng = np.random.default_rng(seed)
    steps = random_steps(rng, cycle, n, m, p, radius)
    v, x0 = rng.standard_normal((n_steps, m)), rng.standard_normal(n)
    got = PeriodicFilter(steps).run(v, x0)
    assert got.shape == (n_steps, p)
    # products of matrices cost eps of the same loop with absolute values, times the numbers summed per step (n + m)
    tolerance = 1e-14 * (n + m) * bound(steps, v, x0)
    assert np.abs(got - plain(steps, v, x0)).max() <= max(tolerance, 1e-13)
    since = data.draw(st.integers(0, n_steps))
    assert np.abs(PeriodicFilter(steps).run(v, x0, since=since) - got[since:]).max(initial=0.0) <= max(tolerance, 1e-13)
    if len(steps) == 1:
        zero = PeriodicFilter(steps).run(v)
        assert np.abs(zero - plain(steps, v, 0 * x0)).max() <= max(tolerance, 1e-13)


@pytest.mark.parametrize("n_steps", [1, 47, 48, 49, 95, 2303, 2304, 2305, 5000])
@pytest.mark.parametrize(
    ("F", "tolerance"),
    [
        ([[0.999, 1.0], [0.0, 0.999]], 1e-12),  # defective: one eigenvector
        ([[0.999, 1.0], [1e-13, 0.999]], 1e-12),  # nearly so
        # The paper's turbulence: companion form, both poles p near 0.994. A coefficient rounded by eps moves its output by
        # eps / (1 - p)^2 = 6e-12, whoever computes it; the powers of a block round it some ten times.
        ([[1.98732, -0.98736], [1.0, 0.0]], 1e-10),
        ([[0.0, 1.0], [0.0, 0.0]], 1e-12),  # nilpotent
        ([[0.0, 0.0], [0.0, 0.0]], 1e-12),
    ],
)
def test_defective_matrices_are_as_good_as_any(F: list[list[float]], tolerance: float, n_steps: int) -> None:
    rng = np.random.default_rng(2)
    step = (np.array(F), np.array([[0.3], [1.0]]), np.eye(2), np.array([[0.1], [0.0]]))
    v, x0 = rng.standard_normal((n_steps, 1)), rng.standard_normal(2)
    wanted = plain([step], v, x0)
    got = PeriodicFilter([step]).run(v, x0)
    assert np.abs(got - wanted).max() <= tolerance * max(np.abs(wanted).max(), 1.0)


def test_signals_of_any_size_keep_their_digits() -> None:
    rng = np.random.default_rng(3)
    steps = random_steps(rng, 5, 4, 2, 2, 0.9)
    v = rng.standard_normal((500, 2))
    large, small = PeriodicFilter(steps).run(v), PeriodicFilter(steps).run(1e-9 * v)
    assert np.abs(1e-9 * large - small).max() <= 1e-12 * np.abs(small).max()


def test_a_first_step_of_its_own_comes_before_the_cycle() -> None:
    rng = np.random.default_rng(7)
    first, *steps = random_steps(rng, 6, 4, 2, 3, 0.9)
    v = rng.standard_normal((200, 2))
    F, G, H, J = first
    for x0 in (None, rng.standard_normal(4)):
        x = np.zeros(4) if x0 is None else x0
        wanted = np.vstack([H @ x + J @ v[0], plain(steps, v[1:], F @ x + G @ v[0])])
        for since in (0, 1, 2, 150, 199):
            got = PeriodicFilter(steps, first).run(v, x0, since=since)
            assert np.allclose(got, wanted[since:], rtol=0, atol=1e-12 * np.abs(wanted).max())


@pytest.mark.parametrize("n_steps", [0, 1, 2])
def test_short_and_empty_records(n_steps: int) -> None:
    steps = random_steps(np.random.default_rng(0), 5, 3, 2, 1, 0.5)
    v = np.ones((n_steps, 2))
    got = PeriodicFilter(steps).run(v)
    assert got.shape == (n_steps, 1)
    assert np.allclose(got, plain(steps, v, np.zeros(3)), rtol=1e-12)


def test_an_input_changes_nothing_before_it() -> None:
    """To the last bit: a later sample meets exact zeros in the block's map."""
    rng = np.random.default_rng(4)
    steps = random_steps(rng, 5, 4, 2, 1, 0.9)
    v = rng.standard_normal((300, 2))
    base = PeriodicFilter(steps).run(v)
    for k in (0, 1, 44, 45, 46, 199, 299):
        changed = v.copy()
        changed[k:] += 1e6
        assert np.array_equal(PeriodicFilter(steps).run(changed)[:k], base[:k])


def test_cycle_matrix_is_the_product_in_order() -> None:
    steps = random_steps(np.random.default_rng(5), 3, 4, 1, 1, 0.9)
    x = np.random.default_rng(6).standard_normal(4)
    after = x
    for F, *_ in steps:
        after = F @ after
    assert np.allclose(PeriodicFilter(steps).cycle_matrix() @ x, after, rtol=1e-12)
