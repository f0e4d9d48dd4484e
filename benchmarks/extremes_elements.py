"""The extremes of newer elements, and of every scheme: drivers, rolling, states, curves, stops; all in closed form."""

from functools import partial

import diffrax
import jax.numpy as jnp
import numpy as np
from extremes_rows import EPS, derivatives, largest, linear_error, worst_row

import lgsens as lg

MASS, STEPS = 2.0, 64


def _line(p, forces, *, velocity, start=1.0, t1=1.0, steps=STEPS, integrator=lg.GeneralizedAlpha()):
    """A point mass on the z axis under forces on it: z and ż at the end."""
    zero = jnp.zeros_like(p[0])
    body = lg.RigidBody(MASS, None, position=(0, 0, start), velocity=jnp.stack([zero, zero, velocity]), free="z")
    run = lg.simulate(lg.Model({"mass": body}, {}, forces), t1=t1, num_steps=steps, integrator=integrator)
    motion = run.body("mass")
    return jnp.stack([motion.position[-1, 2], motion.velocity[-1, 2]])


ENDS = {"at_a": (0.0, 0.0, 0.0), "at_b": (0.0, 0.0, 1.0)}
AWAY = {"at_a": (0.0, 0.0, -9.0), "at_b": (0.0, 0.0, 2.0), "free_length": 10.0}  # z − 1, from z = 2 on


def oscillation(p, integrator):
    """On a spring of ω = p₀ from rest at z = 2, free at z = 1: z − 1 = cos ωt."""
    spring = lg.SpringDamper(None, "mass", stiffness=MASS * p[0] ** 2, **AWAY)
    return _line(p, {"spring": spring}, velocity=jnp.zeros_like(p[0]), start=2.0, integrator=integrator)[:1]


def _radau_error(phase, steps):
    """|R(is)^n − exp(isn)|, R the Padé approximant (2, 3) that is the stability function of Radau IIA."""
    z = 1j * np.asarray(phase)
    stability = (1 + 2 * z / 5 + z**2 / 20) / (1 - 3 * z / 5 + 3 * z**2 / 20 - z**3 / 60)
    return np.abs(stability**steps - np.exp(z * steps))


def _explicit_error(solver, phase, steps):
    """The same of an explicit scheme, R(z) = 1 + z bᵀ (I − z A)⁻¹ 1 from its coefficients."""
    b = np.asarray(solver.tableau.b_sol)
    a = np.zeros((b.size, b.size))
    for i, row in enumerate(solver.tableau.a_lower):
        a[i + 1, : i + 1] = row
    z, one = 1j * np.asarray(phase), np.ones(b.size)
    stability = np.array([1 + one_z * b @ np.linalg.solve(np.eye(b.size) - one_z * a, one) for one_z in z])
    return np.abs(stability**steps - np.exp(z * steps))


SCHEMES = {
    "generalized-α, index 3": (lg.GeneralizedAlpha(0.9), partial(linear_error, 0.9)),
    "generalized-α, stabilized": (lg.GeneralizedAlpha(0.9, stabilized=True), partial(linear_error, 0.9)),
    "Radau IIA": (lg.RadauIIA(), _radau_error),
    "index-reduced, Tsit5": (lg.IndexReducedODE(), partial(_explicit_error, diffrax.Tsit5())),
    "index-reduced, Dopri8": (lg.IndexReducedODE(diffrax.Dopri8()), partial(_explicit_error, diffrax.Dopri8())),
}


def schemes():
    """Every scheme on a linear oscillation of 1e-3 to 0.3 rad per step."""
    phases, rows = np.array([1e-3, 1e-2, 1e-1, 0.3]), []
    for name, (scheme, error) in SCHEMES.items():
        value, forward, reverse = derivatives(partial(oscillation, integrator=scheme), phases[:, None] * STEPS)
        # z starts as cos, and what is not the principal root's share is φ² of it and dies out
        bounds = 1.5 * error(phases, STEPS) + 64 * EPS * STEPS
        labels = [f"{phase:g} rad per step" for phase in phases]
        exact = 1 + np.cos(phases * STEPS)
        errors = np.abs(value[:, 0] - exact)
        why = "1.5 times the error of the scheme's principal root, in closed form; + 64 n ε"
        rows.append(worst_row(f"{name}, 1e-3 … 0.3 rad per step", "z − closed form", errors, bounds, labels, why))
        both = [largest(each) for each in forward - reverse]
        size = 64 * EPS * STEPS * (1 + np.abs(forward[:, 0, 0]))
        rows.append(worst_row(rows[-1].extreme, "dz/dω: reverse − forward", both, size, labels, "64 n ε"))
    return rows


def driven(p):
    """A body that a driver turns by p₀ t about z, its centre at 1 m: where it is after 64 steps of 1/64 s."""
    body = lg.RigidBody(MASS, (0.1, 0.1, 0.1), position=(1.0, 0.0, 0.0))
    zero = jnp.zeros_like(p[0])
    joints = {
        "hinge": lg.RevoluteJoint(None, "arm", at=(0, 0, 0), axis=(0, 0, 1)),
        "motor": lg.RotationDriver(None, "arm", axis=(0, 0, 1), value=lg.Polynomial(jnp.stack([zero, p[0]]))),
    }
    return lg.simulate(lg.Model({"arm": body}, joints), t1=1.0, num_steps=STEPS).body("arm").position[-1, :2]


def drivers():
    per_step = np.array([1e-9, 1e-3, 0.5, 1.5, 2.5, 3.0])
    rates = per_step * STEPS
    value, forward, reverse = derivatives(driven, rates[:, None])
    exact = np.stack([np.cos(rates), np.sin(rates)], axis=1)
    slopes = np.stack([-np.sin(rates), np.cos(rates)], axis=1)
    labels = [f"{angle:g} rad per step" for angle in per_step]
    bound = 64 * EPS * (1 + rates) + 1e-12
    errors, tangents = ([largest(each) for each in of] for of in (value - exact, forward[:, :, 0] - slopes))
    why = "64 ε of the angle; + Newton's tolerance, 1e-12 of a length"
    extreme = "driver, 1e-9 … 3 rad per step"
    return [
        worst_row(extreme, "position − closed form", errors, bound, labels, why),
        worst_row(extreme, "its derivative by the rate − closed form", tangents, 16 * bound, labels, "16 times that"),
        worst_row(
            extreme, "reverse − forward", [largest(each) for each in forward - reverse], bound, labels, "round-off"
        ),
    ]


def rolled(p):
    """A disc of radius 0.5 that rolls along x at p₀ m/s, upright: where it is after 1 s."""
    zero = jnp.zeros_like(p[0])
    disc = lg.RigidBody(
        MASS,
        (0.125, 0.25, 0.125),
        position=(0.0, 0.0, 0.5),
        velocity=jnp.stack([p[0], zero, zero]),
        angular_velocity=jnp.stack([zero, p[0] / 0.5, zero]),
    )
    rolling = lg.Rolling("disc", at=(0, 0, 0.5), axis=(0, 1, 0), radius=0.5)
    forces = {"gravity": lg.Gravity((0.0, 0.0, -9.81))}
    run = lg.simulate(lg.Model({"disc": disc}, {"ground": rolling}, forces), t1=1.0, num_steps=STEPS)
    return run.body("disc").position[-1]


def rolling():
    speeds = np.array([1e-6, 1e-3, 1.0, 10.0, 32.0])  # up to one revolution in 6 steps
    value, forward, reverse = derivatives(rolled, speeds[:, None])
    exact = np.stack([speeds, 0 * speeds, 0 * speeds + 0.5], axis=1)
    labels = [f"{speed:g} m/s" for speed in speeds]
    bound = 1e-11 * (1 + speeds)
    slopes = np.array([[1.0], [0.0], [0.0]])
    extreme, why = "rolling, 1e-6 … 32 m/s", "n times Newton's tolerance, 1e-13 of a length each"
    errors = [largest(each) for each in value - exact]
    return [
        worst_row(extreme, "position − v t", errors, bound, labels, why),
        worst_row(
            extreme, "its derivative − t", [largest(each - slopes) for each in forward], 1e2 * bound, labels,
            "a hundred times that: the state's part of the derivative is relative to the speed",
        ),
        worst_row(extreme, "reverse − forward", [largest(each) for each in forward - reverse], bound, labels, "same"),
    ]  # fmt: skip


def relaxing(p):
    """A mass at 1 m/s against a Maxwell element of c = 2 N s/m and the time constant e^p₀ s: ż after 1 s."""
    damping = jnp.full_like(p[0], 2.0)
    element = lg.MaxwellElement(None, "mass", stiffness=damping * jnp.exp(-p[0]), damping=damping, **ENDS)
    return _line(p, {"element": element}, velocity=jnp.ones_like(p[0]), steps=400)


def states():
    """m ż̇ = −F, Ḟ = k ż − F/τ: from a damper alone, τ → 0, to nothing at all, τ → ∞."""
    times = np.array([1e-9, 1e-6, 1e-4, 1.0, 1e3, 1e6])
    value, forward, reverse = derivatives(relaxing, np.log(times)[:, None])
    errors, labels, bounds = [], [f"τ = {tau:g} s" for tau in times], []
    for tau, found in zip(times, value):
        stiffness = 2.0 / tau
        roots, vectors = np.linalg.eig(np.array([[0.0, -1.0 / MASS], [stiffness, -1.0 / tau]]))
        weights = np.linalg.solve(vectors, [1.0, 0.0])
        distance = np.real(vectors[0] @ (weights * (np.exp(roots) - 1) / roots))
        velocity = np.real(vectors[0] @ (weights * np.exp(roots)))
        errors.append(largest(found - [1 + distance, velocity]))
        # the start has no force, which takes τ: where a step is longer than that, it is wrong by that step
        bounds.append(5e-6 + (tau < 2.5e-3) * 2.5e-3)
    why = "(h/T)² of a motion of 1 s; a step where τ is shorter than one, as the force starts from none"
    both = [largest(each) for each in forward - reverse]
    rounded = 64 * EPS * 400 + 16 * EPS / times
    extreme = "state of a Maxwell element, τ = 1e-9 … 1e6 s"
    return [
        worst_row(extreme, "z, ż − closed form", errors, bounds, labels, why),
        worst_row(extreme, "derivative by ln τ: reverse − forward", both, rounded, labels, "64 n ε; + 16 k ε/(c v)"),
    ]


def pulled(p, curved):
    """A mass on a spring of e^p₀ N/m that is a line through three points within 1 mm, or is one; 1 m away from them."""
    rate = jnp.exp(p[0])
    if curved:
        at = jnp.asarray([-1e-3, 0.0, 1e-3])
        spring = lg.CurveSpringDamper(None, "mass", spring=lg.Sampled(at, rate * at, "monotone"), **AWAY)
    else:
        spring = lg.SpringDamper(None, "mass", stiffness=rate, **AWAY)
    return _line(p, {"spring": spring}, velocity=jnp.zeros_like(p[0]), start=2.0)


def curves():
    rates = 10.0 ** np.arange(-6, 10, 3)
    straight, curved = (derivatives(partial(pulled, curved=each), np.log(rates)[:, None]) for each in (False, True))
    labels = [f"{rate:g} N/m" for rate in rates]
    size = 1 + np.sqrt(rates / MASS)  # of ż
    bound = 1e-9 * size  # 16 ε of the slope by three points 1 mm apart, in 64 steps, times ωt
    extreme, why = (
        "curve of three points, 1000 times its width away",
        "ε/1e-3 of a slope from points 1 mm apart, n times",
    )
    errors, slopes = ([largest(each) for each in curved[i] - straight[i]] for i in (0, 1))
    return [
        worst_row(extreme, "motion − that on a straight spring", errors, bound, labels, why),
        worst_row(extreme, "derivative − that of it", slopes, bound * size, labels, why),
        worst_row(
            extreme, "reverse − forward", [largest(each) for each in curved[1] - curved[2]], bound * size, labels, why
        ),
    ]


def thrown(p):
    """A mass thrown at p₁ m/s on a stop of e^p₀ N/m whose rounding is a hundredth of its travel: ż at the end.

    60 steps for half an oscillation of the stop, so that all are alike in units of it.
    """
    rate = jnp.sqrt(jnp.exp(p[0]) / MASS)
    travel = p[1] / rate
    stop = lg.BumpStop(None, "mass", stiffness=jnp.exp(p[0]), gap=0.1 * travel, rounding=0.01 * travel, **ENDS)
    return _line(p, {"stop": stop}, velocity=-p[1], t1=4.0 / rate, steps=240)[1:]


def stops():
    points = np.array([(power * np.log(10.0), speed) for power in (2, 4, 6, 8) for speed in (1e-3, 0.1)])
    value, forward, reverse = derivatives(thrown, points)
    labels = [f"1e{round(p[0] / np.log(10.0))} N/m at {p[1]:g} m/s" for p in points]
    speed, step = points[:, 1], 4.0 / 240
    errors = np.abs(value[:, 0] - speed) / speed
    slopes = np.abs(forward[:, 0, 1] - 1.0)
    both = [largest(each[0] / [v, 1.0]) for each, v in zip(forward - reverse, speed)]
    bound = np.full(len(points), 10 * step**2)
    extreme, energy = "stop, 1e2 … 1e8 N/m", "10 (ωh)²: the energy of a scheme of order 2"
    rounded = np.full(len(points), 64 * EPS * 240 / 0.01)
    return [
        worst_row(extreme, "speed of rebound/speed − 1", errors, bound, labels, energy),
        worst_row(extreme, "its derivative by the speed − 1", slopes, bound, labels, "same: all scales with the speed"),
        worst_row(extreme, "reverse − forward, of the speed", both, rounded, labels, "64 n ε travel/rounding"),
    ]  # fmt: skip
