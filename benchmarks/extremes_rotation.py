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


FAST, FAST_STEPS = 1e4, 400  # rad/s
RESOLVED, REFUSED = (0.05, 0.3), (1.0, 2.0, 3.0, np.pi - 1e-9, np.pi)  # rad per step
ALIASED = (2 * np.pi, 10.0, 50.0)
MASS, INERTIA, LENGTH, GRAVITY = 15.0, (0.234375, 0.46875, 0.234375), 1.0, 9.81


def fast_top(p, integrator):
    """Axis and spin of a symmetric top at 1e4 rad/s e^p₀, gravity 9.81 e^p₁, after 400 steps of p₂ rad; its result."""
    zero = jnp.zeros_like(p[0])
    centre = LENGTH * jnp.asarray([0.0, 1.0, 0.0], p.dtype)
    spin, gravity = FAST * jnp.exp(p[0]), GRAVITY * jnp.exp(p[1])
    body = lg.RigidBody(MASS, INERTIA, position=centre, angular_velocity=jnp.stack([zero, spin, zero]))
    joint = lg.SphericalJoint(None, "top", at=jnp.zeros_like(centre))
    scene = lg.Model({"top": body}, {"pivot": joint}, {"g": lg.Gravity(jnp.stack([zero, zero, -gravity]))})
    run = lg.simulate(scene, t1=FAST_STEPS * p[2] / FAST, num_steps=FAST_STEPS, integrator=integrator, throw=False)
    top, result = run.body("top"), run.result.astype(p.dtype)[None]
    return jnp.concatenate([top.position[-1], top.angular_velocity[-1] / FAST, result])


TOP, RESULT, BY_BOTH = slice(0, 6), 6, slice(0, 2)


def fast_spin() -> list[Row]:
    points = np.array([(0.0, 0.0, angle) for angle in (*RESOLVED, *REFUSED, *ALIASED)])
    value, forward, reverse = derivatives(lambda p: fast_top(p, lg.GeneralizedAlpha(0.9)), points)
    count = len(RESOLVED)
    exact, slopes, _ = derivatives(lambda p: fast_top(p, lg.IndexReducedODE(diffrax.Dopri8())), points[:count])
    angles, labels = np.array(RESOLVED), [f"{angle:g} rad per step" for angle in RESOLVED]
    turned = FAST_STEPS * angles
    # In the body's frame gravity turns at the spin: it drives transverse rates of the size of those of nutation and
    # precession, each of which the scheme carries with its error for an oscillation of that frequency.
    swing = MASS * GRAVITY * LENGTH / ((MASS * LENGTH**2 + INERTIA[0]) * FAST**2)
    noise = 16 * EPS * FAST_STEPS
    bounds = 2 * (linear_error(0.9, angles, FAST_STEPS) + angles**2) * swing * turned + noise
    extreme = "a top at 1e4 rad/s"
    why = "error of the scheme for an oscillation at hΩ, times the swing mgl/(AΩ²) Ωt; + 16 n ε; Dopri8"
    of = lambda errors: [largest(each) for each in errors]
    rows = [
        worst_row(extreme, "axis, Ω/1e4", of((value[:count] - exact)[:, TOP]), bounds, labels, why),
        worst_row(
            extreme,
            "the same by ln Ω, ln g",
            of((forward[:count] - slopes)[:, TOP, BY_BOTH]),
            (3 + turned) * bounds,
            labels,
            "(3 + Ωt) times that: the phase is differentiated",
        ),
        worst_row(
            extreme,
            "the same, reverse − forward",
            of((reverse - forward)[:count, TOP]),
            (3 + turned) * noise,
            labels,
            "16 n ε (3 + Ωt)",
        ),
    ]
    said = (value[:, RESULT] == lg.RESULTS.newton_failed) & np.isnan(forward[:, 0, 0]) & np.isnan(reverse[:, 0, 0])
    refused = slice(count, count + len(REFUSED))
    silent = float(np.sum(~said[refused]))
    rows.append(Row(extreme, "1 … π rad per step, without a failure", silent, 0.0, "Newton fails, derivatives are NaN"))
    unsaid = float(np.sum(value[refused.stop :, RESULT] != lg.RESULTS.turn_not_resolved))
    why = "`turn_not_resolved`: loads that turn with the body alias from π rad per step on"
    rows.append(Row(extreme, "2π … 50 rad per step, without a failure", unsaid, 0.0, why))
    return rows
