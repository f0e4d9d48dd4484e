"""The extremes of rotation: any angle per step, any orientation, a spin of 1e4 rad/s."""

import diffrax
import jax.numpy as jnp
import numpy as np
from extremes_rows import EPS, Row, both_modes, derivatives, largest, linear_error, worst_row
from scipy.linalg import expm_frechet

import lgsens as lg
from lgsens.liegroups import SO3

ANGLES = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 3.0, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi, 10.0, 50.0)
AXIS = np.array([0.6, -0.48, 0.64])
HALF_TURN = np.pi * np.array([0.48, 0.6, 0.64])  # where the body starts: R = exp of this
STEPS = 8


def ball(p):
    """Where a free ball of angular velocity p₀₁₂ [rad/s] is after 8 steps of 1 s; it starts at exp(p₃₄₅)."""
    spin, orientation = p[:3], SO3().exp(p[3:])
    body = lg.RigidBody(2.0, (0.3, 0.3, 0.3), orientation=orientation, angular_velocity=spin)
    run = lg.simulate(lg.Model({"ball": body}), t1=float(STEPS), num_steps=STEPS)
    return run.body("ball").orientation[-1].reshape(9)


_one_ball = both_modes(ball)


def any_ball(p):
    """R, its derivative forwards and backwards, from a program compiled once."""
    return tuple(np.asarray(found[0]) for found in _one_ball(jnp.asarray(p)[None]))


def _wedge(x):
    return np.cross(np.eye(3).astype(x.dtype), x)


def _turn(x):
    """Rodrigues' formula in extended precision; SciPy's matrix exponential is off by 4e-14 here."""
    x = np.asarray(x, np.longdouble)
    angle = np.sqrt(np.sum(x * x))
    w = _wedge(x)
    safe = angle if angle > 0 else np.longdouble(1)
    return np.eye(3) + np.sin(angle) / safe * w + 2 * (np.sin(angle / 2) / safe) ** 2 * w @ w


def exact_ball(p):
    """R₀ exp(t Ω̃), and its derivative by Ω and by the start from SciPy's derivative of the matrix exponential."""
    start, spin = p[3:], STEPS * p[:3]
    first, turned = _turn(start), _turn(spin)
    slope = lambda x, e: expm_frechet(_wedge(x), _wedge(e), compute_expm=False)
    slopes = [first @ slope(spin, STEPS * e) for e in np.eye(3)] + [slope(start, e) @ turned for e in np.eye(3)]
    return (first @ turned).reshape(9), np.stack([each.reshape(9) for each in slopes], axis=1)


def ball_bound(p) -> float:
    """16 ε for each rounded rotation, and as much of its angle: h Ω in every step, and the start."""
    return 16 * EPS * (STEPS * (1 + float(np.linalg.norm(p[:3]))) + float(np.linalg.norm(p[3:])))


def rotation_per_step() -> list[Row]:
    points = np.array([(*(angle * AXIS), *HALF_TURN) for angle in ANGLES])
    value, forward, reverse = (np.stack(found) for found in zip(*map(any_ball, points)))
    exact = [exact_ball(p) for p in points]
    bounds = np.array([ball_bound(p) for p in points])
    labels = [f"{angle:.12g} rad" for angle in ANGLES]
    why = "16 ε (n (1 + θ) + π): increments rounded to ε θ, products of rotations to ε; Rodrigues in long double"
    errors = lambda computed, k: [largest(a - b[k]) for a, b in zip(computed, exact)]
    extreme = "rotation per step 0 … 50 rad, starting at exp(π)"
    between = [largest(a - b) for a, b in zip(forward, reverse)]
    return [
        worst_row(extreme, "R", errors(value, 0), bounds, labels, why),
        worst_row(
            extreme, "dR/dΩ and by the start, forward", errors(forward, 1), STEPS * bounds, labels, "n times that of R"
        ),
        worst_row(extreme, "the same, reverse − forward", between, STEPS * bounds, labels, "n times that of R"),
    ]


FAST, FAST_STEPS, FAST_ANGLE = 1e4, 400, 0.05  # rad/s, steps, rad per step
MASS, INERTIA, LENGTH, GRAVITY = 15.0, (0.234375, 0.46875, 0.234375), 1.0, 9.81


def fast_top(p, integrator):
    """Axis and spin of a symmetric top at 1e4 rad/s e^p₀, gravity 9.81 e^p₁, after 20 rad."""
    zero = jnp.zeros_like(p[0])
    centre = LENGTH * jnp.asarray([0.0, 1.0, 0.0], p.dtype)
    spin, gravity = FAST * jnp.exp(p[0]), GRAVITY * jnp.exp(p[1])
    body = lg.RigidBody(MASS, INERTIA, position=centre, angular_velocity=jnp.stack([zero, spin, zero]))
    joint = lg.SphericalJoint(None, "top", at=jnp.zeros_like(centre))
    scene = lg.Model({"top": body}, {"pivot": joint}, {"g": lg.Gravity(jnp.stack([zero, zero, -gravity]))})
    run = lg.simulate(scene, t1=FAST_STEPS * FAST_ANGLE / FAST, num_steps=FAST_STEPS, integrator=integrator)
    top = run.body("top")
    return jnp.concatenate([top.position[-1], top.angular_velocity[-1] / FAST])


def fast_spin() -> list[Row]:
    alpha = derivatives(lambda p: fast_top(p, lg.GeneralizedAlpha(0.9)), [[0.0, 0.0]])
    reference = derivatives(lambda p: fast_top(p, lg.IndexReducedODE(diffrax.Dopri8())), [[0.0, 0.0]])
    turned = FAST_STEPS * FAST_ANGLE
    # In the body's frame gravity turns at the spin: it drives transverse rates of the size of those of nutation and
    # precession, each of which the scheme carries with its error for an oscillation of that frequency.
    swing = MASS * GRAVITY * LENGTH / ((MASS * LENGTH**2 + INERTIA[0]) * FAST**2)
    scheme = 2 * (linear_error(0.9, FAST_ANGLE, FAST_STEPS)[0] + FAST_ANGLE**2) * swing * turned
    noise = 16 * EPS * FAST_STEPS
    extreme = f"spin of 1e4 rad/s, {FAST_ANGLE} rad per step"
    why = "error of the scheme for an oscillation at hΩ, times the swing mgl/(AΩ²) · Ωt; + 16 n ε; Dopri8"
    return [
        Row(extreme, "axis and Ω/1e4", largest(alpha[0] - reference[0]), scheme + noise, why),
        Row(
            extreme,
            "derivative by ln Ω, ln g, forward",
            largest(alpha[1] - reference[1]),
            (scheme + noise) * (3 + turned),
            "(3 + Ωt) times that: the phase is differentiated",
        ),
        Row(
            extreme,
            "derivative, reverse − forward",
            largest(alpha[1] - alpha[2]),
            noise * (3 + turned),
            "16 n ε (3 + Ωt)",
        ),
    ]
