"""The extremes of rotation: any angle per step, any orientation, a spin of 1e4 rad/s."""

import diffrax
import jax.numpy as jnp
import numpy as np
from extremes_rows import EPS, Row, derivatives, largest, linear_error, worst_row
from scipy.linalg import expm, expm_frechet

import lgsens as lg
from lgsens.liegroups import SO3

ANGLES = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 3.0, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi, 10.0, 50.0)
AXIS = np.array([0.6, -0.48, 0.64])
HALF_TURN = np.pi * np.array([0.48, 0.6, 0.64])  # where the body starts: R = exp of this
STEPS = 8


def ball(spin, start=HALF_TURN):
    """Where a free ball of angular velocity `spin` [rad/s] is after 8 steps of 1 s; it starts at exp(start)."""
    orientation = SO3().exp(jnp.asarray(start, spin.dtype))
    body = lg.RigidBody(2.0, (0.3, 0.3, 0.3), orientation=orientation, angular_velocity=spin)
    run = lg.simulate(lg.Model({"ball": body}), t1=float(STEPS), num_steps=STEPS)
    return run.body("ball").orientation[-1].reshape(9)


def exact_ball(spin, start=HALF_TURN):
    """R₀ exp(t Ω̃) and its derivative by Ω, from SciPy's matrix exponential."""
    wedge = lambda x: np.cross(np.eye(3), -np.asarray(x))
    first, x = expm(wedge(start)), STEPS * wedge(spin)
    slopes = [expm_frechet(x, STEPS * wedge(e), compute_expm=False) for e in np.eye(3)]
    return (first @ expm(x)).reshape(9), np.stack([(first @ slope).reshape(9) for slope in slopes], axis=1)


def rotation_per_step() -> list[Row]:
    spins = np.outer(ANGLES, AXIS)
    value, forward, reverse = derivatives(ball, spins)
    exact = [exact_ball(spin) for spin in spins]
    # The increment h Ω is rounded to ε of the angle, each product of rotations to some ε; SciPy squares as often.
    bounds = np.array([16 * EPS * STEPS * (1 + angle) for angle in ANGLES])
    labels = [f"{angle:.12g} rad" for angle in ANGLES]
    why = "16 ε n (1 + θ): increments rounded to ε θ, products of rotations to ε; SciPy's expm"
    errors = lambda computed, k: [largest(a - b[k]) for a, b in zip(computed, exact)]
    extreme = "rotation per step 0 … 50 rad, starting at exp(π)"
    between = [largest(a - b) for a, b in zip(forward, reverse)]
    return [
        worst_row(extreme, "R", errors(value, 0), bounds, labels, why),
        worst_row(extreme, "dR/dΩ, forward", errors(forward, 1), STEPS * bounds, labels, "n times that of R"),
        worst_row(extreme, "dR/dΩ, reverse − forward", between, STEPS * bounds, labels, "n times that of R"),
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
