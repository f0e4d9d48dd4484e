"""Sums by place: against NumPy, with derivatives in both modes, by gathers and by a scatter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, equations

from lgsens.linear._sparse import added

RNG = np.random.default_rng(5)
EVEN = RNG.integers(-1, 12, (30, 3)), RNG.integers(0, 12, 40)
ONE_FULL = np.zeros(90, int), np.arange(12)  # a table as wide as the first place is full would be mostly empty


@pytest.mark.parametrize(("places", "by_gather"), [(EVEN, True), (ONE_FULL, False)])
def test_sums_and_their_derivatives(places, by_gather):
    values = [jnp.asarray(RNG.normal(size=each.shape)) for each in places]
    total = lambda values: added(list(zip(values, places)), 12)
    wanted = np.zeros(13)  # the last one is nowhere
    for value, each in zip(values, places):
        np.add.at(wanted, each, np.asarray(value))
    round_off = 100 * EPS * np.abs(wanted).max()  # sums of a hundred numbers
    found, linear = jax.linearize(total, values)
    np.testing.assert_allclose(found, wanted[:12], rtol=0, atol=round_off)
    np.testing.assert_allclose(linear(values), wanted[:12], rtol=0, atol=round_off)

    weights = np.append(RNG.normal(size=12), 0.0)
    (pulled,) = jax.vjp(total, values)[1](jnp.asarray(weights[:12]))
    for actual, each in zip(pulled, places):
        np.testing.assert_array_equal(actual, weights[each])
    names = {each.primitive.name for each in equations(jax.make_jaxpr(total)(values).jaxpr)}
    assert ("scatter-add" in names) != by_gather


def test_nothing_to_add():
    assert not added([], 3, jnp.float64).any()
    nowhere = added([(jnp.ones(2), np.full(2, -1))], 3, jnp.float64)
    np.testing.assert_array_equal(nowhere, np.zeros(3))
