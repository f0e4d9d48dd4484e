"""Bushings along axes of their own, and how many of them share a load at rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, says
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.model import Frame
from lgsens.model._stack import load_tangents

AXES = np.array([[2.0, 1.0, 0.5], [0.3, -1.0, 4.0]])
K, C, K_R, C_R = np.arange(1.0, 13.0).reshape(4, 3)
RATES = {"stiffness": K, "damping": C, "rotational_stiffness": K_R, "rotational_damping": C_R}


def triad():
    """By hand: the first, then what is left of the second, Gram–Schmidt."""
    first = AXES[0] / np.linalg.norm(AXES[0])
    second = AXES[1] - (AXES[1] @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def test_six_rates_along_its_axes():
    """At its place −∂Q/∂q and −∂Q/∂v are R diag(k) Rᵀ; a way along or a turn about an axis is met along it."""
    body, r, rest = lg.RigidBody(1.0, (1.0, 1.0, 1.0)), triad(), jnp.zeros(6)
    preload, moment = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.4, -0.6])
    bushing = lg.Bushing(None, "b", at=(0, 0, 0), axes=AXES, **RATES)
    loaded = lg.Bushing(None, "b", at=(0, 0, 0), axes=AXES, preload=preload, rotational_preload=moment, **RATES)
    (attached,), (more,) = (one.loads({"b": body}) for one in (bushing, loaded))
    ground = Frame(jnp.zeros(3), jnp.eye(3))
    tangents = jax.jit(load_tangents)(attached.load, ground, body.frame, rest, rest, 0.0)
    whole = lambda rates, about: np.block(
        [[(r * rates) @ r.T, np.zeros((3, 3))], [np.zeros((3, 3)), (r * about) @ r.T]]
    )
    close(-tangents.position[6:, 6:], whole(K, K_R), 50)
    close(-tangents.velocity[6:, 6:], whole(C, C_R), 50)
    force = jax.jit(lambda load, frame: load.force(ground, frame, rest, rest, 0.0)[6:])
    for i, e in enumerate(r.T):
        turned = Frame(jnp.asarray(0.1 * e), jnp.asarray(Rotation.from_rotvec(0.7 * e).as_matrix()))
        expected = np.concatenate([-0.1 * K[i] * e, -0.7 * K_R[i] * e])
        close(force(attached.load, turned), expected, 100)
    close(force(more.load, body.frame), -np.concatenate([r @ preload, r @ moment]), 50)


@pytest.mark.parametrize("axes", [[[1.0, 0.0, 0.0], [-2.0, 0.0, 0.0]], np.zeros((2, 3))])
def test_axes_that_are_none(axes):
    with pytest.raises(ValueError, match=says("Bushing: `axes`", "along each other or are zero", "two directions")):
        lg.Bushing(None, "b", at=(0, 0, 0), stiffness=K, axes=axes)


def test_bushings_share_a_load_as_they_yield():
    """A beam on three bushings and a spring: that keeps its length, and they bear k times what a stiff beam sinks.

    Heights z + φ x of the three, with z + φ x_s = 0 at the spring: its force follows from the balance.
    """
    at, rates, weight = np.array([0.0, 0.4, 1.0]), np.array([1e6, 3e6, 0.5e6]), 5.0 * 9.81
    beam = lg.RigidBody(5.0, (0.1, 0.4, 0.4), position=(0.5, 0.0, 0.0))
    others = {"rotational_stiffness": (0.0, 0.0, 0.0), "preload": (0.0, 0.0, 7.0)}
    forces = {
        f"b{i}": lg.Bushing(None, "beam", at=(x, 0.0, 0.0), stiffness=(k, k, k), **others)
        for i, (x, k) in enumerate(zip(at, rates))
    }
    stay = lg.SpringDamper(None, "beam", at_a=(1.5, 0.0, 1.0), at_b=(1.5, 0.0, 0.0), stiffness=1e3)
    roll = lg.TorsionSpringDamper(None, "beam", axis=(0.0, 1.0, 0.0), stiffness=1.0)
    model = lg.Model(
        {"beam": beam},
        {"guide": lg.PlanarJoint(None, "beam", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))},
        forces | {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "stay": stay, "roll": roll},
    )
    loaded, unbalanced = lg.static_preload(model, ("b0", "stay", "b1", "b2"))
    # unknown: fall of the left end d, turn φ, pull of the spring F; rows: forces, moments about it, the spring's length
    rows = np.array([[rates.sum(), rates @ at, 1.0], [rates @ at, rates @ at**2, 1.5], [1.0, 1.5, 0.0]])
    fall, turn, pull = np.linalg.solve(rows, [weight, 0.5 * weight, 0.0])
    assert float(unbalanced) < 1e-12 * weight
    assert float(loaded.forces["stay"].preload) == pytest.approx(pull, rel=1e-10)  # condition 1e6 by hand
    for i, (x, k) in enumerate(zip(at, rates)):
        found = loaded.forces[f"b{i}"]
        np.testing.assert_allclose(found.preload, [0.0, 0.0, -k * (fall + turn * x)], rtol=1e-10, atol=1e-10)
        np.testing.assert_array_equal(found.rotational_preload, np.zeros(3))
