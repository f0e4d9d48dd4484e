"""Bushings with curves: values by hand, proven tangents, indifference to the frame, no cost for what is absent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, random_body, random_rotation, says
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.model import Frame
from lgsens.testing import check_force

AT, NONE = (0.3, -0.7, 1.1), (None, None, None)
PLACES, FORCES = np.array([-2.0, -0.5, 0.0, 0.6, 2.0]), np.array([-9.0, -1.0, 0.0, 1.5, 7.0])
CURVE = lg.Sampled(PLACES, FORCES, "monotone")
CUBIC = lg.Polynomial((0.0, 1.0, 0.0, 2.0))
RATES = {"stiffness": (3.0, 1.0, 2.0), "damping": (0.5, 0.2, 0.1), "preload": (0.1, -0.4, 0.3)}
ALL = {
    "springs": (CURVE, None, CUBIC),
    "dampers": (None, CUBIC, None),
    "rotational_springs": (CUBIC, CURVE, None),
    "rotational_dampers": (None, None, CUBIC),
}


@pytest.mark.slow  # a program each
@pytest.mark.parametrize("curves", [ALL, {"dampers": (CURVE, None, None)}], ids=["all", "dampers"])
def test_bushing_is_what_it_says(curves):
    check_force(lg.Bushing("a", "b", at=AT, **RATES, **curves)).raise_if_failed()


def by_hand(a, b, at, va, vb, frames):
    """Force and moment on b at its point, inertial frame, from the definition, by NumPy and SciPy; reference axes."""
    (x_a, r_a), (x_b, r_b) = frames
    local_a, local_b = ((np.asarray(f.orientation).T @ (at - np.asarray(f.position))) for f in (a, b))
    arm_a, arm_b = r_a @ local_a, r_b @ local_b
    axes = r_a @ np.asarray(a.orientation).T  # that turn with a, columns
    d = x_b + arm_b - x_a - arm_a
    w_a, w_b = r_a @ va[3:], r_b @ vb[3:]
    speed = vb[:3] + np.cross(w_b, arm_b) - va[:3] - np.cross(w_a, arm_a)
    u, rate = axes.T @ d, axes.T @ (speed - np.cross(w_a, d))
    pchip, cubic = PchipInterpolator(PLACES, FORCES), lambda x: x + 2 * x**3
    k, c, g = (np.array(RATES[name]) for name in ("stiffness", "damping", "preload"))
    tension = g + k * u + c * rate + [pchip(u[0]), 0.0, cubic(u[2])] + np.array([0.0, cubic(rate[1]), 0.0])
    relative = lambda r_a, r_b: axes_of(r_a, a).T @ axes_of(r_b, b)
    phi = Rotation.from_matrix(relative(r_a, r_b)).as_rotvec()
    h = 1e-5  # h² of the second derivative of the rotation vector, and round-off over h
    ahead, behind = (
        Rotation.from_matrix(relative(turned(r_a, s * va[3:]), turned(r_b, s * vb[3:]))).as_rotvec() for s in (h, -h)
    )
    phi_rate = (ahead - behind) / (2 * h)
    moment = np.array([cubic(phi[0]), pchip(phi[1]), cubic(phi_rate[2])])
    return -axes @ tension, moment, phi, phi_rate


def axes_of(rotation, reference):
    return rotation @ np.asarray(reference.orientation).T


def turned(rotation, vector):
    return rotation @ Rotation.from_rotvec(vector).as_matrix()


def scene(seed=0):
    rng = np.random.default_rng(seed)
    bodies = {name: random_body(rng) for name in "ab"}
    a, b = (bodies[name].frame for name in "ab")
    frames = [
        (np.asarray(f.position) + 0.3 * rng.normal(size=3), turned(np.asarray(f.orientation), 0.3 * rng.normal(size=3)))
        for f in (a, b)
    ]
    return bodies, frames, *rng.normal(size=(2, 6))


def test_force_is_that_of_the_definition():
    """The force on b, and the power of the moments, −m·φ̇."""
    bodies, frames, va, vb = scene()
    ((load, _, _),) = lg.Bushing("a", "b", at=AT, **RATES, **ALL).loads(bodies)
    force, moment, _, phi_rate = by_hand(bodies["a"].frame, bodies["b"].frame, np.array(AT), va, vb, frames)
    at = [Frame(*map(jnp.asarray, frame)) for frame in frames], jnp.asarray(va), jnp.asarray(vb)
    found = np.asarray(load.force(*at[0], *at[1:], 0.0))
    close(found[6:9], force, 50)
    along = {name: ALL[name] for name in ("springs", "dampers")}
    ((plain, _, _),) = lg.Bushing("a", "b", at=AT, **RATES, **along).loads(bodies)
    power = (found - plain.force(*at[0], *at[1:], 0.0)) @ np.concatenate([va, vb])
    np.testing.assert_allclose(power, -moment @ phi_rate, rtol=1e-7)


def test_bushing_does_not_know_the_frame():
    """All turned and moved together by a rigid motion that itself moves: the same forces, turned."""
    bodies, frames, va, vb = scene(1)
    ((load, _, _),) = lg.Bushing("a", "b", at=AT, **RATES, **ALL).loads(bodies)
    rng = np.random.default_rng(2)
    turn, shift, spin, drift = random_rotation(rng), *rng.normal(size=(3, 3))
    moved, twists = [], []
    for (x, r), v in zip(frames, (va, vb)):
        place = turn @ x
        moved.append(Frame(jnp.asarray(place + shift), jnp.asarray(turn @ r)))
        rate = np.concatenate([turn @ v[:3] + drift + np.cross(spin, place), v[3:] + (turn @ r).T @ spin])
        twists.append(jnp.asarray(rate))
    here = [Frame(*map(jnp.asarray, frame)) for frame in frames]
    force = np.asarray(load.force(*here, jnp.asarray(va), jnp.asarray(vb), 0.0)).reshape(4, 3)
    found = np.asarray(load.force(*moved, *twists, 0.0)).reshape(4, 3)
    close(found, np.stack([turn @ force[0], force[1], turn @ force[2], force[3]]), 500)


def test_straight_curves_are_rates():
    k, c = (2.0, 3.0, 4.0), (0.2, 0.3, 0.4)
    line = lambda rates: tuple(lg.Polynomial((0.0, rate)) for rate in rates)
    curves = dict(zip(ALL, map(line, (k, c, k, c))))
    rates = dict(zip(("stiffness", "damping", "rotational_stiffness", "rotational_damping"), (k, c, k, c)))
    bodies, frames, va, vb = scene(3)
    at = *(Frame(*map(jnp.asarray, frame)) for frame in frames), jnp.asarray(va), jnp.asarray(vb), 0.0
    forces = [lg.Bushing("a", "b", at=AT, **more).loads(bodies)[0].load.force(*at) for more in (curves, rates)]
    close(*forces, 200)


def test_a_bushing_without_curves_has_no_operation_more():
    bodies, frames, va, vb = scene()
    at = *(Frame(*map(jnp.asarray, frame)) for frame in frames), jnp.asarray(va), jnp.asarray(vb), 0.0
    loads = [lg.Bushing("a", "b", at=AT, **RATES, **more).loads(bodies)[0].load for more in ({}, {"springs": NONE})]
    plain, curved = (len(jax.make_jaxpr(load.force)(*at).eqns) for load in loads)
    assert type(loads[0]).__name__ == "BushingLoad" and plain < curved


def test_bad_input():
    for curves in ((CURVE, None), CURVE, (1.0, None, None)):
        with pytest.raises(ValueError, match=says("Bushing: `springs` must be a tuple of three")):
            lg.Bushing("a", "b", at=AT, springs=curves)
