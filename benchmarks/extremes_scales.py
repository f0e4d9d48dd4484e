"""The extremes of size: steps from 1e-7 to 5e-2 s at any damping, masses and inertias 1e6 apart, any units."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from extremes_rows import EPS, Row, by_differences, derivatives, largest, linear_error, multiplier_noise, worst_row
from scipy.special import ellipj, ellipk

import lgsens as lg

STEP_SIZES = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 2e-2, 5e-2)
DAMPINGS = (0.0, 0.5, 0.9, 0.999)
STEPS = 64
MASS, ARM, INERTIA, GRAVITY, ANGLE = 2.0, 0.8, 0.3, 9.81, 0.5
LEVER = MASS * ARM**2 + INERTIA
# ln h and ln g are differentiated; x, z, and the force on the joint along x and z are looked at
PLACE, FORCE = slice(0, 2), slice(2, 4)


def pendulum(p, rho_inf):
    """A pendulum of steps e^p₀, under gravity e^p₁, released at 0.5 rad: where it is, and what its joint bears."""
    h, zero = jnp.exp(p[0]), jnp.zeros_like(p[0])
    centre = ARM * jnp.asarray([np.sin(ANGLE), 0.0, -np.cos(ANGLE)], p.dtype)
    body = lg.RigidBody(MASS, (INERTIA, INERTIA, INERTIA), position=centre)
    joint = lg.SphericalJoint(None, "bob", at=jnp.zeros_like(centre))
    scene = lg.Model({"bob": body}, {"pivot": joint}, {"g": lg.Gravity(jnp.stack([zero, zero, -jnp.exp(p[1])]))})
    run = lg.simulate(scene, t1=STEPS * h, num_steps=STEPS, integrator=lg.GeneralizedAlpha(rho_inf))
    return jnp.concatenate([run.body("bob").position[-1, ::2], run.multiplier("pivot")[-1, ::2]])


def exact_pendulum(p):
    """The same by elliptic functions: sin(φ/2) = k sn(K + ωt), k = sin(φ₀/2)."""
    time, gravity = STEPS * np.exp(p[0]), np.exp(p[1])
    rate, k = np.sqrt(MASS * gravity * ARM / LEVER), np.sin(ANGLE / 2)
    sn, cn, _, _ = ellipj(ellipk(k**2) + rate * time, k**2)
    phi, speed = 2 * np.arcsin(k * sn), 2 * k * rate * cn
    along, across = np.array([np.sin(phi), -np.cos(phi)]), np.array([np.cos(phi), np.sin(phi)])
    acceleration = ARM * (-(rate**2) * np.sin(phi) * across - speed**2 * along)
    return np.concatenate([ARM * along, MASS * (np.array([0.0, -gravity]) - acceleration)])


def exact_slopes(p, step=1e-3):
    """Central differences of sixth order; 1e-13 of a function this smooth."""
    stencil = ((1, 45.0), (-1, -45.0), (2, -9.0), (-2, 9.0), (3, 1.0), (-3, -1.0))
    columns = [sum(w * exact_pendulum(p + k * step * e) for k, w in stencil) / (60 * step) for e in np.eye(2)]
    return np.stack(columns, axis=1)


def step_sizes(rho_inf: float) -> list[Row]:
    points = np.array([(np.log(h), np.log(GRAVITY)) for h in STEP_SIZES])
    value, forward, reverse = derivatives(partial(pendulum, rho_inf=rho_inf), points)
    exact, slopes = np.stack([exact_pendulum(p) for p in points]), np.stack([exact_slopes(p) for p in points])
    h = np.array(STEP_SIZES)
    phase = h * np.sqrt(MASS * GRAVITY * ARM / LEVER)
    turned = STEPS * phase
    scheme = 2 * (linear_error(rho_inf, phase, STEPS) + phase**2)
    place = ANGLE * ARM * scheme + 4 * EPS * STEPS
    # The joint is closed to round-off of the arm.
    noise = 4 * EPS * ARM * MASS * multiplier_noise(rho_inf, h, STEPS)
    force = MASS * GRAVITY * scheme + noise
    extreme, labels = f"steps of 1e-7 … 5e-2 s, ρ∞ = {rho_inf:g}", [f"h = {size:g}" for size in h]
    worst = lambda errors, part: [largest(error[part]) for error in errors]
    of_scheme = "twice the scheme's error for the linear oscillation, from its 3 × 3 step; elliptic functions"
    of_noise = "that, + 4 ε l of the joint, times m/(βh²) Σ |c_k|, what λ makes of such errors at this ρ∞"
    grown = 3 + turned
    return [
        worst_row(extreme, "position", worst(value - exact, PLACE), place, labels, of_scheme),
        worst_row(extreme, "λ", worst(value - exact, FORCE), force, labels, of_noise),
        worst_row(
            extreme,
            "position by ln h, ln g",
            worst(forward - slopes, PLACE),
            grown * place,
            labels,
            "(3 + ωt) times that of the position: the phase is differentiated",
        ),
        worst_row(
            extreme,
            "λ by ln h, ln g",
            worst(forward - slopes, FORCE),
            grown * force,
            labels,
            "(3 + ωt) times that of λ",
        ),
        worst_row(
            extreme,
            "position, reverse − forward",
            worst(reverse - forward, PLACE),
            grown * 16 * EPS * STEPS,
            labels,
            "16 n ε (3 + ωt)",
        ),
    ]


CHAIN_STEPS, CHAIN_TIME = 40, 0.02
LINK, ACROSS = 0.3, 0.02  # m; moment of inertia across the axis, of 1 kg


def chain(p):
    """Three links on ball joints, of masses e^p₀₁₂ kg and moments of inertia about their axes of e^p₃ of the others."""
    length, bodies, joints = LINK, {}, {}
    rate = jnp.asarray([0.5, 1.0, -2.0], p.dtype)
    for i in range(3):
        centre = jnp.asarray([(i + 0.5) * length, 0.0, 0.0], p.dtype)
        across = ACROSS * jnp.exp(p[i])
        bodies[f"link{i}"] = lg.RigidBody(
            jnp.exp(p[i]),
            jnp.stack([across * jnp.exp(p[3]), across, across]),
            position=centre,
            velocity=jnp.cross(rate, centre),
            angular_velocity=rate,
        )
        at = jnp.asarray([i * length, 0.0, 0.0], p.dtype)
        joints[f"ball{i}"] = lg.SphericalJoint(f"link{i - 1}" if i else None, f"link{i}", at=at)
    scene = lg.Model(bodies, joints, {"g": lg.Gravity((0.0, 0.0, -9.81))})
    run = lg.simulate(scene, t1=CHAIN_TIME, num_steps=CHAIN_STEPS)
    places = [run.body(name).position[-1] for name in bodies]
    turns = [run.body(name).orientation[-1, 1] for name in bodies]
    return jnp.concatenate([*places, *turns, *(run.multiplier(name)[-1] for name in joints)])


CHAIN_PLACE, CHAIN_FORCE = slice(0, 18), slice(18, 27)
MASS_POWERS = [(0, 0, 0), (6, 0, -6), (-6, 0, 6), (0, 6, 0), (0, -6, 0), (-6, 6, -6), (6, -6, 6), (0, 0, 6)]
INERTIA_POWERS = (-6, -3, 0)
CASES = [(*powers, 0) for powers in MASS_POWERS] + [(0, 0, 0, power) for power in INERTIA_POWERS]


def mass_ratios() -> list[Row]:
    points = np.log(10.0) * np.array(CASES, float)
    _, forward, reverse = derivatives(chain, points)
    step = 1e-3
    slopes, uncertain = by_differences(chain, points, step)
    labels = [f"10^{case[:3]} kg, axial inertia 10^{case[3]}" for case in CASES]
    size = np.array([largest(each[CHAIN_FORCE]) for each in forward])
    worst = lambda errors, part: np.array([largest(error[part]) for error in errors])
    extreme = "masses 1e-6 … 1e6 in one chain, inertias 1e-6"
    # Joint forces are rounded to ε mg at half a link, a moment that turns a link about its own light axis.
    light = 9.81 * LINK / 2 / (ACROSS * 10.0 ** np.array([float(case[3]) for case in CASES]))
    noise = 64 * EPS * CHAIN_STEPS + 4 * EPS * light * CHAIN_TIME**2 / 2
    # λ follows the round-off of the joints, relative to accelerations of 10 m/s².
    rough = 4 * EPS * multiplier_noise(0.9, CHAIN_TIME / CHAIN_STEPS, CHAIN_STEPS) / 9.81
    of_place = worst(uncertain, CHAIN_PLACE) + noise / step
    of_force = worst(uncertain, CHAIN_FORCE) / size + rough / step
    return [
        worst_row(
            extreme,
            "place and turn by ln m, ln J: forward − differences",
            worst(forward - slopes, CHAIN_PLACE),
            of_place,
            labels,
            "the last two orders of the differences, + that of both modes/10⁻³, their round-off",
        ),
        worst_row(
            extreme,
            "the same: reverse − forward",
            worst(reverse - forward, CHAIN_PLACE),
            noise,
            labels,
            "64 n ε, + 4 ε mgl/J · t²/2: round-off of joint forces turns a link about its own axis",
        ),
        worst_row(
            extreme,
            "λ by ln m, ln J, relative: forward − differences",
            worst(forward - slopes, CHAIN_FORCE) / size,
            of_force,
            labels,
            "as above, + round-off of the joint in λ, 4 ε l/(βh²) Σ |c_k| of g, /10⁻³",
        ),
        worst_row(
            extreme,
            "λ, relative: reverse − forward",
            worst(reverse - forward, CHAIN_FORCE) / size,
            rough * np.ones(len(CASES)),
            labels,
            "round-off of λ as above",
        ),
    ]


UNIT_STEPS, UNIT_TIME = 100, 0.2
UNITS = {"m, kg": (0, 0), "mm, t": (3, -3), "µm, kg": (6, 0), "µm, µg": (6, 9), "km, kg": (-3, 0), "km, kt": (-3, -6)}


def in_units(length, mass):
    """A top with a spring-damper in units of which a metre has `length` and a kilogram `mass`; the answer in SI."""
    force, one = mass * length, jnp.ones_like(length)

    def answer(p):
        rate, at = jnp.asarray([0.5, 1.0, 6.0], p.dtype), jnp.asarray([0.4, 0.0, 0.7], p.dtype)
        centre = length * p[0] * jnp.asarray([0.6, 0.0, 0.8], p.dtype)
        moments = mass * length**2 * jnp.asarray([0.1, 0.12, 0.05], p.dtype)
        body = lg.RigidBody(
            mass * 2.0 * p[1], moments, position=centre, velocity=jnp.cross(rate, centre), angular_velocity=rate
        )
        spring = lg.SpringDamper(
            None,
            "top",
            at_a=length * jnp.asarray([1.0, 0.0, 0.0], p.dtype),
            at_b=length * at,
            stiffness=mass * 300.0 * p[2],
            damping=mass * 5.0,
            preload=force * 3.0,
        )
        gravity = lg.Gravity(length * jnp.asarray([0.0, 0.0, -9.81], p.dtype))
        joint = lg.SphericalJoint(None, "top", at=jnp.zeros_like(centre))
        scene = lg.Model({"top": body}, {"pivot": joint}, {"g": gravity, "s": spring})
        run = lg.simulate(scene, t1=UNIT_TIME, num_steps=UNIT_STEPS)
        top = run.body("top")
        parts = [top.position[-1] / length, top.orientation[-1, 0], top.angular_velocity[-1]]
        return jnp.concatenate([*parts, run.multiplier("pivot")[-1] / force])

    p = jnp.stack([one, one, one])
    forward, value = jax.jacfwd(lambda p: (answer(p),) * 2, has_aux=True)(p)
    return value, forward, jax.jacrev(answer)(p)


UNIT_MOTION, UNIT_FORCE = slice(0, 9), slice(9, 12)
every_unit = jax.jit(lambda units: jax.lax.map(lambda unit: in_units(unit[0], unit[1]), units))


def unit_rows(powers, labels, extreme) -> list[Row]:
    """Powers of ten (or not) of units per metre and per kilogram; the first are SI."""
    value, forward, reverse = map(np.asarray, every_unit(jnp.asarray(10.0 ** np.array(powers, float))))
    noise = 64 * EPS * UNIT_STEPS
    rough = 4 * EPS * multiplier_noise(0.9, UNIT_TIME / UNIT_STEPS, UNIT_STEPS) / 9.81
    rows = []
    # A derivative solves with S once more in each step: of 1,000 units drawn, motions were off by up to 0.3 of that
    # noise (in the median 0.1), derivatives by up to 1.9 (0.2).
    digits = "64 n ε, of derivatives 256, relative to the largest: other digits are rounded"
    for part, name, bound, solves, why in (
        (UNIT_MOTION, "motion", noise, 4, digits),
        (UNIT_FORCE, "λ", rough, 1, "4 ε l/(βh²) Σ |c_k| of g: round-off of the joint in λ"),
    ):
        sizes, slopes = largest(value[0][part]), largest(forward[0][part])
        bounds = bound * np.ones(len(labels))
        of_value = [largest(each[part] - value[0][part], sizes) for each in value]
        of_slope = [largest(each[part] - forward[0][part], slopes) for each in forward]
        of_modes = [largest((a - b)[part], slopes) for a, b in zip(forward, reverse)]
        rows += [
            worst_row(extreme, f"{name}, relative to SI", of_value, bounds, labels, why),
            worst_row(extreme, f"derivatives of {name}, relative to SI", of_slope, solves * bounds, labels, why),
            worst_row(extreme, f"derivatives of {name}, reverse − forward", of_modes, solves * bounds, labels, why),
        ]
    return rows


def units() -> list[Row]:
    return unit_rows(list(UNITS.values()), list(UNITS), "units: m, mm, µm, km; kg, t, µg, kt")
