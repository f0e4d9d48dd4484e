"""The leaf spring of the examples against the beam on two supports."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.examples import leaf_spring

E, NU, WIDTH, LEAVES, LENGTH, ELEMENTS = 2.07e11, 0.29, 0.06, 5, 1.2, 8


def rate(thickness=0.008, **given):
    """Of the middle, from its first 10 N [N/m]."""
    model = leaf_spring(LENGTH, width=WIDTH, thickness=thickness, leaves=LEAVES, elements=ELEMENTS, **given)
    height = lg.statics(model, loads={"load": [0.0, 10.0]}).body("axle").position[:, 2]
    return 10.0 / (height[1] - height[0])


def closed_form(thickness):
    """Of two supports, with what 4 elements on either side leave of the bending: 1/(4 · 4²)."""
    second, area = LEAVES * WIDTH * thickness**3 / 12.0, LEAVES * WIDTH * thickness
    shear = 10.0 * (1.0 + NU) / (12.0 + 11.0 * NU) * E / (2.0 * (1.0 + NU)) * area
    bending = LENGTH**3 / (48.0 * E * second) * (1.0 - 1.0 / (4.0 * (ELEMENTS / 2) ** 2))
    return 1.0 / (bending + LENGTH / (4.0 * shear))


FLAT = {"camber": 1e-3, "shackle_angle": 0.0}


@pytest.mark.slow  # beams against closed forms are in `test_beam_problems`
def test_a_flat_leaf_is_a_beam_on_two_supports():
    # (camber/length)² = 7e-7, some of it; 10 N bend it by a tenth of a millimetre
    np.testing.assert_allclose(rate(**FLAT), closed_form(0.008), rtol=5e-6)
    with pytest.raises(ValueError, match="`elements` must be even, got 5"):
        leaf_spring(elements=5)


@pytest.mark.slow  # programs of statics with derivatives
def test_rates_by_thickness_and_by_the_shackle():
    found, slope = jax.value_and_grad(lambda t: rate(t, **FLAT))(jnp.asarray(0.008))
    np.testing.assert_allclose(slope, jax.grad(closed_form)(0.008), rtol=2e-5)  # three times the rate's own
    # With its foot inside of its pin a shackle swings down where the load lengthens the leaf, which stiffens it.
    flatter, upright, steeper = (rate(camber=0.1, shackle_angle=angle) for angle in (-0.2, 0.0, 0.2))
    assert flatter < upright < steeper
    assert abs(upright / found - 1.0) < (2.0 * 0.1 / LENGTH) ** 2  # the slope of the ends, squared
    np.testing.assert_allclose(steeper - upright, upright - flatter, rtol=0.2)  # odd in the angle at first
