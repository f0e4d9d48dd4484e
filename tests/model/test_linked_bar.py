"""The anti-roll bar with drop links: its rate at the sides in closed form, and its parts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, says

import lgsens as lg

LEVER, SPRING, DIAMETER = 0.25, 2e4, 0.02
BEARINGS, SIDES = [(0.0, 0.4, 0.3), (0.0, -0.4, 0.3)], ("left", "right")
ARMS = [(LEVER, 0.4, 0.3), (LEVER, -0.4, 0.3)]
LINKS = [(LEVER, 0.4, 0.15), (LEVER, -0.4, 0.15)]
RATE = np.pi * 79.3e9 * DIAMETER**4 / (32 * 0.8)  # of the bar [N m/rad]
SHAPE = {"bearings": BEARINGS, "arms": ARMS, "links": LINKS, "mass": 1.5, "diameter": DIAMETER}


def axle(forces, **more):
    """Two sides that move up and down on springs, pushed by `forces`."""
    bar = lg.LinkedAntiRollBar("bar", None, SIDES, **SHAPE | more)
    sides = {name: lg.RigidBody(10.0, None, position=at, free="z") for name, at in zip(SIDES, LINKS)}
    springs = {
        f"{name} spring": lg.Bushing(None, name, at=at, stiffness=(0.0, 0.0, SPRING)) for name, at in zip(SIDES, LINKS)
    }
    pushes = {
        f"{name} push": lg.AppliedForce(name, force=jnp.zeros(3).at[2].set(force)) for name, force in zip(SIDES, forces)
    }
    return lg.Model({**sides, **bar.bodies}, bar.joints, {**springs, **pushes, **bar.forces})


@pytest.mark.slow
def test_rate_at_the_sides():
    """In parallel travel the springs alone; in opposite travel 2 k/r² more, and its change with the lever."""

    @eqx.filter_jit
    @jax.vmap
    def travel(forces, lever):
        arms = [(lever, y, 0.3) for y in (0.4, -0.4)]
        links = [(lever, y, 0.15) for y in (0.4, -0.4)]
        model = axle(forces, arms=jnp.asarray(arms), links=jnp.asarray(links))
        state, system = lg.equilibrium(model, throw=False), model.system()
        return jnp.stack([state.q.position[system.body_names.index(name), 2] - 0.15 for name in SIDES])

    push, changed = 1.0, 1.01 * LEVER
    forces = jnp.array([[push, push], [push, -push], [push, -push]])
    parallel, opposite, longer = travel(forces, jnp.array([LEVER, LEVER, changed]))
    # pushes that leave angles δ/r of 1e-4 rad, of which the square is left
    np.testing.assert_allclose(parallel, push / SPRING, rtol=1e-6)
    for found, lever in ((opposite, LEVER), (longer, changed)):
        np.testing.assert_allclose(found, np.array([1, -1]) * push / (SPRING + 2 * RATE / lever**2), rtol=1e-6)


def test_halves_are_rods():
    bar = lg.LinkedAntiRollBar("bar", "chassis", SIDES, **SHAPE)
    left = bar.bodies["bar left"]
    close(left.position, [LEVER / 2, 0.4, 0.3], 10)
    thin = 1.5 * np.array([DIAMETER**2 / 8, *(LEVER**2 / 12 + DIAMETER**2 / 16,) * 2])
    close(left.inertia, np.diag(thin), 10)
    assert sorted(bar.joints) == ["bar left hinge", "bar left link", "bar right hinge", "bar right link"]
    assert bar.joints["bar left hinge"].a == "chassis" and bar.joints["bar right link"].b == "right"


def test_bad_input():
    for more, message in (
        ({"arms": BEARINGS}, "an end in `arms` is at its bearing"),
        ({"mass": 0.0}, "LinkedAntiRollBar: `mass` must be positive"),
        ({"links": ARMS[0]}, "`links` must have shape (2, 3)"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            lg.LinkedAntiRollBar("bar", None, SIDES, **SHAPE | more)
