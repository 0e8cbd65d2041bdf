"""Challengers against textbook formulas and known limits."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs.arena.challengers import CHALLENGERS
from wfsobs.arena.challengers.rls import histories, predict_rls
from wfsobs.testing import check_observer


@pytest.mark.parametrize("name", CHALLENGERS)
def test_challengers_keep_the_rules_for_observers(name: str) -> None:
    check_observer(CHALLENGERS[name].observer, alone=False)


def test_without_forgetting_rls_is_ridge_least_squares() -> None:
    z = np.random.default_rng(2).standard_normal((400, 2)).cumsum(axis=0)
    predicted, weights = predict_rls(z, 3, 1.0, 0.1)
    H = histories(z, 3)
    batch = np.linalg.solve(H[:-1].T @ H[:-1] + 0.1 * np.eye(6), H[:-1].T @ z[1:])
    np.testing.assert_allclose(weights, batch, rtol=0, atol=1e-8)  # 400 rank-one updates, condition 1e5
    np.testing.assert_allclose(predicted[-1], H[-1] @ batch, rtol=1e-6)


def test_forgetting_weighs_the_past_exponentially() -> None:
    z = np.random.default_rng(3).standard_normal((300, 1)).cumsum(axis=0)
    _, weights = predict_rls(z, 2, 0.98, 0.1)
    H, n = histories(z, 2), len(z)
    w = 0.98 ** np.arange(n - 2, -1, -1)
    batch = np.linalg.solve((H[:-1].T * w) @ H[:-1] + 0.1 * 0.98 ** (n - 1) * np.eye(2), (H[:-1].T * w) @ z[1:])
    np.testing.assert_allclose(weights, batch, rtol=0, atol=1e-8)  # rounding of 300 updates
