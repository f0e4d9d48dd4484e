"""The extremes of forces: stiffness to the rigid joint, damping to a thousand times critical, nothing, dry friction."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from extremes_rows import EPS, Row, by_differences, derivatives, largest, linear_error, worst_row

import lgsens as lg

POWERS = tuple(range(2, 13))
LIMIT = 6  # from 1e6 N/m on the motion on the bushing is that on the joint
STEPS, TIME, MASS = 200, 0.4, 2.0
RATE = (0.3, 0.5, 1.0)


def swing(p, rigid):
    """A body on a ball joint, or on a bushing of e^p₂ N/m that bears the joint's force from the beginning.

    p₀ is the length [m] and p₁ gravity [m/s²].
    """
    zero = jnp.zeros_like(p[0])
    centre, rate = jnp.stack([p[0], zero, zero]), jnp.asarray(RATE, p.dtype)
    body = lg.RigidBody(
        MASS, (0.1, 0.2, 0.25), position=centre, angular_velocity=rate, velocity=jnp.cross(rate, centre)
    )
    gravity = {"g": lg.Gravity(jnp.stack([zero, zero, -p[1]]))}
    at = jnp.zeros_like(centre)
    scene = lg.Model({"bob": body}, {"pivot": lg.SphericalJoint(None, "bob", at=at)}, gravity)
    if not rigid:
        stiffness = jnp.exp(p[2]) * jnp.ones_like(centre)
        bushing = lg.Bushing(None, "bob", at=at, stiffness=stiffness, preload=lg.initial_state(scene).lam)
        scene = lg.Model({"bob": body}, {}, gravity | {"bushing": bushing})
    bob = lg.simulate(scene, t1=TIME, num_steps=STEPS).body("bob")
    return jnp.concatenate([bob.position[-1], bob.angular_velocity[-1]])


def stiffness() -> list[Row]:
    points = np.array([(1.0, 9.81, power * np.log(10.0)) for power in POWERS])
    value, forward, reverse = derivatives(partial(swing, rigid=False), points)
    (joint,), (joint_slopes,), _ = derivatives(partial(swing, rigid=True), points[:1])
    soft = [i for i, power in enumerate(POWERS) if power <= 4]
    slopes, uncertain = by_differences(partial(swing, rigid=False), points[soft], 1e-3)
    labels, weight = [f"1e{power} N/m" for power in POWERS], MASS * 9.81
    k = 10.0 ** np.array(POWERS)
    sag = 20 * weight / k
    # ε of a metre is K ε newtons: what the spring force is rounded to, and so its geometric stiffness in K_t.
    rounded = 16 * EPS * k / weight
    motion = np.array([largest(each - joint) for each in value])
    motion_slopes = np.array([largest((each - joint_slopes)[:, :2]) for each in forward])
    stiff, stiff_labels = np.array(POWERS) >= LIMIT, [f"1e{power} N/m" for power in POWERS if power >= LIMIT]
    extreme, soft_extreme = "stiffness 1e2 … 1e12 N/m", "stiffness 1e2 … 1e4 N/m"
    return [
        worst_row(
            extreme,
            "motion on a bushing − motion on the ball joint, from 1e6 N/m",
            motion[stiff],
            (sag + rounded)[stiff],
            stiff_labels,
            "20 mg/K: the sag under 2.5 mg, in rates of up to 4 rad/s; + 16 K ε/(mg), round-off of the spring's force",
        ),
        worst_row(
            extreme,
            "its derivative by length and gravity − that of the joint, from 1e6 N/m",
            motion_slopes[stiff],
            (3 * sag + rounded)[stiff],
            stiff_labels,
            "3 times that sag, which depends on length and gravity itself; + the same round-off",
        ),
        worst_row(
            extreme,
            "derivative by length, gravity, ln K: reverse − forward",
            [largest(each) for each in forward - reverse],
            64 * EPS * STEPS + rounded,
            labels,
            "64 n ε, + 16 K ε/(mg)",
        ),
        worst_row(
            soft_extreme,
            "derivative by length, gravity, ln K: forward − differences",
            [largest(each) for each in forward[soft] - slopes],
            [largest(each) + 64 * EPS * STEPS / 1e-3 for each in uncertain],
            [labels[i] for i in soft],
            "the last two orders of the differences, + 64 n ε/10⁻³",
        ),
    ]


RATIOS = (0.0, 1e-3, 0.1, 0.9, 1.1, 10.0, 100.0, 1000.0)
CART_STEPS, CART_TIME, FREQUENCY = 200, 1.0, 5.0


def cart(p):
    """z of a mass on a spring and damper, of ω = e^p₀ and damping ratio p₁, released 0.1 m above its rest."""
    one, zero = jnp.ones_like(p[0]), jnp.zeros_like(p[0])
    rate = jnp.exp(p[0])
    body = lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=jnp.stack([zero, zero, one + 0.1]), free="z")
    spring = lg.SpringDamper(
        None,
        "cart",
        at_a=jnp.stack([zero, zero, zero]),
        at_b=jnp.stack([zero, zero, one + 0.1]),
        stiffness=rate**2,
        damping=2.0 * p[1] * rate,
        free_length=one,
    )
    run = lg.simulate(lg.Model({"cart": body}, {}, {"spring": spring}), t1=CART_TIME, num_steps=CART_STEPS)
    return run.body("cart").position[-1, 2:]


def exact_cart(p):
    """z₀ (s₁ e^{s₂t} − s₂ e^{s₁t})/(s₁ − s₂), with s₁ s₂ = ω² so that the slow root keeps its digits."""
    rate, ratio = np.exp(p[0]), p[1]
    fast = -rate * (ratio + np.sqrt(complex(ratio**2 - 1)))
    slow = rate**2 / fast
    return 1.0 + 0.1 * ((fast * np.exp(slow * CART_TIME) - slow * np.exp(fast * CART_TIME)) / (fast - slow)).real


def damping() -> list[Row]:
    points = np.array([(np.log(FREQUENCY), ratio) for ratio in RATIOS])
    value, forward, reverse = derivatives(cart, points)
    exact = np.array([exact_cart(p) for p in points])
    # By ln ω, and by ln c, whose size does not depend on the ratio; central differences of the closed form: 1e-9.
    d, scales = 1e-5, np.array([(1.0, max(ratio, 1.0)) for ratio in RATIOS])
    move = [np.array([(d, 0.0), (0.0, d * s[1])]) for s in scales]
    slopes = np.array([[(exact_cart(p + m) - exact_cart(p - m)) / (2 * d) for m in ms] for p, ms in zip(points, move)])
    h = CART_TIME / CART_STEPS
    phase, turned = h * FREQUENCY, CART_TIME * FREQUENCY
    ratios = np.maximum(np.array(RATIOS), 1.0)
    # Oscillating: the scheme's error. Overdamped: in the first steps z lags by as much as its slow rate ω/(2ζ) moves it
    # in the 1/(1 − ρ∞) steps that damp the fast rate.
    bounds = 0.1 * (
        2 * (linear_error(0.9, phase, CART_STEPS)[0] + phase**2) + phase / (2 * ratios) / (1 - 0.9) * (ratios > 1)
    )
    why = "0.1 m times: 2 (the scheme's error at hω + (hω)²), + overdamped hω/(2ζ)/(1 − ρ∞), first steps; closed form"
    labels, extreme = [f"ζ = {ratio:g}" for ratio in RATIOS], "damping 0 … 1000 times critical"
    errors = [largest(each) for each in ((forward[:, 0] * scales) - slopes)]
    modes = [largest(each) for each in (forward - reverse)[:, 0] * scales]
    return [
        worst_row(extreme, "z", np.abs(value[:, 0] - exact), bounds, labels, why),
        worst_row(extreme, "z by ln ω, ln c", errors, (3 + turned) * bounds, labels, "(3 + ωt) times that of z"),
        worst_row(
            extreme,
            "the same, reverse − forward",
            modes,
            64 * EPS * CART_STEPS * np.ones(len(RATIOS)),
            labels,
            "64 n ε",
        ),
    ]


ZERO_STEPS, ZERO_TIME, ZERO_STIFFNESS = 100, 1.0, 25.0


def at_its_anchor(p):
    """z of a body at p₀ with speed p₁, held by a spring from (0, 0, p₂) to the origin, free in this configuration."""
    zero = jnp.zeros_like(p[0])
    place, speed, anchor = (jnp.stack([zero, zero, value]) for value in (p[0], p[1], p[2]))
    body = lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=place, velocity=speed)
    spring = lg.SpringDamper(None, "b", at_a=anchor, at_b=jnp.zeros_like(place), stiffness=ZERO_STIFFNESS)
    run = lg.simulate(lg.Model({"b": body}, {}, {"spring": spring}), t1=ZERO_TIME, num_steps=ZERO_STEPS)
    return run.body("b").position[-1, 2:]


def no_length() -> list[Row]:
    points = np.array([(0.0, 0.0, 0.0), (0.0, 0.3, 0.0), (0.1, 0.0, 0.0)])
    rate = np.sqrt(ZERO_STIFFNESS)
    # z = z₀ + v₀ sin ωt/ω + a (1 − cos ωt): where both points are one there is no length, and |b − a| has derivative 0
    exact = np.array([1.0, np.sin(rate * ZERO_TIME) / rate, 1.0 - np.cos(rate * ZERO_TIME)])
    phase = rate * ZERO_TIME / ZERO_STEPS
    bound = 2 * (linear_error(0.9, phase, ZERO_STEPS)[0] + phase**2)
    value, forward, reverse = derivatives(at_its_anchor, points)
    extreme = "a spring of no length: at rest, moving, beside its body"
    why = "the scheme's error at hω; z = z₀ + v₀ sin ωt/ω + a (1 − cos ωt)"
    return [
        Row(extreme, "z", largest(value[:, 0] - points @ exact), 0.3 * bound, why),
        Row(extreme, "z by z₀, v₀ and the anchor a", largest(forward[:, 0] - exact), bound, why),
        Row(extreme, "the same, reverse − forward", largest(forward - reverse), 16 * EPS * ZERO_STEPS, "16 n ε"),
    ]


def nothing() -> list[Row]:
    """One body, no joint, no force, no velocity; gravity zero; joints only; one step."""
    body = lg.RigidBody(2.0, (0.3, 0.4, 0.5), position=(0.1, -0.2, 0.3))
    ball = lg.SphericalJoint(None, "b", at=(0.0, 0.0, 1.0))
    scenes = {
        "one body": lg.Model({"b": body}),
        "zero gravity": lg.Model({"b": body}, {}, {"g": lg.Gravity((0.0, 0.0, 0.0))}),
        "joint only": lg.Model({"b": body}, {"ball": ball}),
        "held by a joint": lg.Model({"b": body}, {"weld": lg.FixedJoint(None, "b", at=(0.0, 0.0, 0.0))}),
    }
    rows = []
    for name, scene in scenes.items():

        def place(start, scene=scene):
            moved = lg.Model({"b": lg.RigidBody(2.0, (0.3, 0.4, 0.5), position=start)}, scene.joints, scene.forces)
            run = lg.simulate(moved, t1=0.5, num_steps=1)
            return jnp.concatenate([run.body("b").position[-1], run.states.vdot[-1], run.states.lam[-1]])

        start = np.asarray(body.position)
        value, forward, reverse = derivatives(place, start[None])
        expected = np.concatenate([start, np.zeros(value.shape[1] - 3)])
        slopes = np.concatenate([np.eye(3), np.zeros((value.shape[1] - 3, 3))])
        error = max(largest(value[0] - expected), largest(forward[0] - slopes), largest(reverse[0] - slopes))
        # at rest nothing is computed but zeros and the joint, whose round-off is divided by βh² = 0.07 s²
        rows.append(Row("one step of a body at rest", f"{name}: place, v̇, λ and derivatives", error, 64 * EPS, "64 ε"))
    return rows


SLIPS, SLOPE, RUBBED, RUB_STEPS = (1e-9, 1e-6, 1e-4, 1e-2), 0.2, 0.4, 100  # slip speeds [m/s], radians, s


def block(p):
    """The way of a block down a slope, from speed p₂, with friction μ = p₀ in its rail and the slip speed e^p₁."""
    down = jnp.asarray((np.cos(SLOPE), 0.0, -np.sin(SLOPE)), p.dtype)
    body = lg.RigidBody(MASS, (0.1, 0.2, 0.25), velocity=p[2] * down)
    rail = lg.PrismaticJoint(None, "block", at=jnp.zeros_like(down), axis=down)
    friction = lg.JointFriction("rail", coefficient=p[0], slip_speed=jnp.exp(p[1]), load_rounding=1e-6)
    forces = {"g": lg.Gravity(jnp.asarray((0.0, 0.0, -9.81), p.dtype)), "friction": friction}
    run = lg.simulate(lg.Model({"block": body}, {"rail": rail}, forces), t1=RUBBED, num_steps=RUB_STEPS)
    return jnp.dot(run.body("block").position[-1:], down)


def friction() -> list[Row]:
    mu, steep, slips = 0.3, np.tan(SLOPE), np.array(SLIPS)
    creep = slips * steep / np.sqrt(mu**2 - steep**2)  # where friction holds the weight
    fast = [(mu, np.log(slip), 1.0) for slip in slips]
    value, forward, reverse = derivatives(block, np.array([*fast, *zip(np.full(4, mu), np.log(slips), creep)]))
    pull = 9.81 * np.cos(SLOPE)
    gain = (steep - mu) * pull
    exact, by_mu = RUBBED + gain * RUBBED**2 / 2, -pull * RUBBED**2 / 2
    # the slowest it becomes is 1 m/s + gain · t; force and load are less by half the square of the rounding over them
    rounded = mu * pull * RUBBED**2 / 2 * (slips / (1.0 + gain * RUBBED)) ** 2 / 2 + 64 * RUB_STEPS * EPS
    labels, extreme = [f"w₀ = {slip:g} m/s" for slip in slips], "friction, slip speed 1e-9 … 1e-2 m/s"
    slid, crept, modes = value[:4, 0], value[4:, 0], np.abs(forward - reverse)[:, 0]
    why = "μ g t²/4 (w₀/w)² of the rounding, + 64 n ε; closed form of constant deceleration"
    return [
        worst_row(extreme, "way down a slope, sliding", np.abs(slid - exact), rounded, labels, why),
        worst_row(
            extreme,
            "the way by μ",
            np.abs(forward[:4, 0, 0] - by_mu),
            rounded * 8 / mu,
            labels,
            "8/μ times that of the way: w changes by μ too",
        ),
        worst_row(
            extreme,
            "way of its creep where it is held, over the creep",
            np.abs(crept / (creep * RUBBED) - 1.0),
            64 * RUB_STEPS * EPS * (1.0 + 1.0 / creep),
            labels,
            "64 n ε of a metre, and of itself",
        ),
        worst_row(
            extreme,
            "reverse − forward, sliding, by μ",
            modes[:4, 0],
            64 * RUB_STEPS * EPS * np.ones(4),
            labels,
            "64 n ε",
        ),
    ]
