"""Searches from many starts: each is what it is alone, and the best of them is found."""

import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.optimize import minimize, multi_start

BOUNDS = {"lower": {"a": -2.0, "b": -2.0}, "upper": {"a": 2.0, "b": 2.0}}


def two_valleys(x):
    """Minima near a = ±1, the one on the left lower by 0.2; the constraint cuts off its floor."""
    return (x["a"] ** 2 - 1) ** 2 + 0.1 * x["a"] + x["b"] ** 2, jnp.stack([-x["a"] - 0.9])


def test_each_search_is_what_it_is_alone_and_the_best_is_found():
    traces = []

    def fun(x):
        traces.append(x)
        return two_valleys(x)

    starts = {"a": jnp.asarray([1.5, -0.5, 0.7]), "b": jnp.asarray([0.3, -1.0, 1.0])}
    found = multi_start(fun, starts, **BOUNDS, num_steps=60, progress=False)
    assert len(traces) <= 2  # for its shapes, and in the program
    assert found.best == 1 and list(found.reason) == ["converged"] * 3 and found.feasible.all()
    for i in range(3):
        x0 = {"a": starts["a"][i], "b": starts["b"][i]}
        alone = minimize(two_valleys, x0, **BOUNDS, num_steps=60, progress=False)
        assert found.steps[i] == len(alone.history.objective)
        # one program and its batched version: round-off, which a search may enlarge up to its tolerance
        np.testing.assert_allclose(found.objective[i], alone.objective, rtol=1e-8)
        np.testing.assert_allclose(found.x["a"][i], float(alone.x["a"]), rtol=1e-6)
    # The floor at a = −1.01 is cut off: a = −0.9, g = 0 to 1e-5 and b = 0.
    assert found.objective[1] == pytest.approx((0.81 - 1) ** 2 - 0.09, abs=1e-5)


def test_random_starts_fill_the_box_and_failures_are_left_out(tmp_path):
    def fun(x):
        f, g = two_valleys(x)
        return jnp.where(x["b"] > 1.0, jnp.nan, f), g

    options = {"num_steps": 40, "progress": False, "seed": 1, "folder": tmp_path / "starts"}
    found = multi_start(fun, 12, **BOUNDS, **options)
    for name in ("a", "b"):
        assert found.starts[name].shape == (12,)
        assert -2 <= found.starts[name].min() < -0.5 and 0.5 < found.starts[name].max() <= 2
    lost = found.starts["b"] > 1.0
    assert 0 < lost.sum() < 6
    assert np.isnan(found.objective[lost]).all() and (found.reason[lost] == "stalled").all()
    assert (found.reason[~lost] == "converged").all()
    assert found.objective[found.best] == np.min(found.objective[found.feasible & ~lost])


def test_bad_starts():
    with pytest.raises(ValueError, match="`starts` must be at least 1, got 0"):
        multi_start(two_valleys, 0, **BOUNDS, num_steps=3)
    with pytest.raises(ValueError, match=r"a = 3.0 is outside \[-2.0, 2.0\]"):
        multi_start(two_valleys, {"a": jnp.asarray([0.0, 3.0]), "b": jnp.zeros(2)}, **BOUNDS, num_steps=3)
    with pytest.raises(ValueError, match="`starts`: 3 random designs need finite `lower` and `upper`; give them, or"):
        multi_start(two_valleys, 3, lower={"a": -2.0, "b": None}, upper=BOUNDS["upper"], num_steps=3)


@pytest.mark.parametrize("forward", [True, False])
def test_designs_without_bounds(forward):
    starts = {"a": jnp.asarray([1.5, -0.5]), "b": jnp.asarray([0.3, -1.0])}
    found = multi_start(lambda x: two_valleys(x)[0], starts, num_steps=60, forward=forward, progress=False)
    assert list(found.reason) == ["converged"] * 2 and found.best == 1
