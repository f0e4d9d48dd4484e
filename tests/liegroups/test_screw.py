"""SE(3) at the angles where its formulas switch or lose digits, against the matrix exponential."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from lgsens.liegroups import SE3

GROUP = SE3()


def ad(x):
    """(ad x) y = (ω_x × u_y + u_x × ω_y, ω_x × ω_y) for complex x too."""
    u, w = (np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]]) for p in (x[:3], x[3:]))
    return np.block([[w, u], [np.zeros((3, 3)), w]])


def tangent(x):
    """T = φ(−ad x), φ(z) = (e^z − 1)/z: a corner of the exponential of [[−ad, I], [0, 0]]."""
    zero = np.zeros((6, 6))
    return expm(np.block([[-ad(x), np.eye(6)], [zero, zero]]))[:6, 6:]


def inverse_with_derivatives(x, y):
    """T⁻¹, its derivative along y by a complex step, and the second one by central differences of that."""
    first = lambda x: np.linalg.inv(tangent(x + 1e-30j * y)).imag / 1e-30
    return np.linalg.inv(tangent(x)), first(x), (first(x + 1e-4 * y) - first(x - 1e-4 * y)) / 2e-4


@pytest.mark.parametrize(("dtype", "eps"), [(np.float64, 2.2e-16), (np.float32, 1.2e-7)])
def test_inverse_tangent_and_two_derivatives_up_to_two_pi(dtype, eps):
    along = lambda f: lambda x, y: jax.jvp(f, (x, y), (y, jnp.zeros_like(y)))[1]
    first = along(lambda x, y: GROUP.tangent_inv(x))
    every = jax.jit(jax.vmap(lambda x, y: (GROUP.tangent_inv(x), first(x, y), along(first)(x, y))))
    axis, y = np.array([0.48, -0.6, 0.64]), np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.3])
    angles = np.array([1e-9, 1e-4, 0.3, 2.999, 3.001, 3.14159, 5.0, 6.0])
    points = np.array([[0.5, 0.7, -0.4, *(angle * axis)] for angle in angles])
    actual = every(points.astype(dtype), np.tile(y, (len(points), 1)).astype(dtype))
    for i, (angle, x) in enumerate(zip(angles, points)):
        # T⁻¹ has a simple pole at 2π, with it its k-th derivative one of order k + 2 (u enters as a derivative), and a
        # formula loses as many digits; 1e-7 is what central differences of step 1e-4 leave, relative to the pole.
        gap = min(1.0, 2 * np.pi - angle)
        for order, (found, expected) in enumerate(zip(actual, inverse_with_derivatives(x, y))):
            tolerance = 100 * eps / gap ** (order + 3) + (1e-7 / gap**5 if order == 2 else 0.0)
            np.testing.assert_allclose(found[i], expected, rtol=0, atol=tolerance)


def test_screw_of_a_helix():
    """exp(u, ω) with u along ω turns about the axis and slides along it; with u across, it is an arc of length |u|."""
    slide = GROUP.exp(jnp.array([0.0, 0.0, 2.0, 0.0, 0.0, 1.2]))
    np.testing.assert_allclose(slide.position, [0.0, 0.0, 2.0], atol=1e-15)
    arc = GROUP.exp(jnp.array([np.pi, 0.0, 0.0, 0.0, 0.0, np.pi / 2]))  # a quarter of a circle of radius 2
    np.testing.assert_allclose(arc.position, [2.0, 2.0, 0.0], atol=1e-15)
