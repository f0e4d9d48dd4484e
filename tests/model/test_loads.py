"""Force elements: tangents against autodiff, forces against potentials, power against energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    Drag,
    DragForce,
    central_difference,
    close,
    moved,
    moved_without_library,
    random_body,
    random_point,
    random_rotation,
)

import lgsens as lg
from lgsens.model import AbstractForce, AbstractLoad, Attached, BushingLoad, Frame, SpringDamperLoad, TyreLoad
from lgsens.model._curves import CurveLoad
from lgsens.model._loads import PointForce, Weight
from lgsens.testing import check_force

COUNT = 20
# Stiffnesses, lengths and forces are of order 1 to 10 and |d| is at least 1: some tens of round-offs of the
# largest entry.
ULPS = 300

SIGNALS = {
    "flat": lambda: lg.FlatRoad(height=0.3),
    "bump": lambda: lg.BumpRoad(height=0.4, duration=0.5, start=0.2),
    "sampled": lambda: lg.SampledRoad([0.0, 0.3, 0.7, 1.0], [0.1, -0.2, 0.4, 0.0]),
}
LOADS = {
    "weight": lambda v: Weight(v(), v(3)),
    "spring": lambda v: SpringDamperLoad(v(3), v(3), v(), v(), v(), v()),
    "curve": lambda v: CurveLoad(v(3), v(3), lg.Polynomial(v(4)), lg.Polynomial(v(3)), v(), v()),
    "bushing": lambda v: BushingLoad(v(3), v(3), v(3, 3), v(3, 3), v(3)),
    **{f"tyre-{n}": lambda v, s=s: TyreLoad(v(3), v(), v(), v(), s()) for n, s in SIGNALS.items()},
    "force": lambda v: PointForce(v(3), v(3), v(3), SIGNALS["bump"]()),
}


def sample(name, seed=0):
    """`COUNT` loads of one kind, with two frames four metres apart, two twists and a time for each."""
    rng = np.random.default_rng(seed)

    def batched(make):
        loads = [make(lambda *shape: jnp.asarray(rng.uniform(0.5, 1.5, shape))) for _ in range(COUNT)]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *loads)

    load = batched(LOADS[name])
    frames = []
    for offset in (0.0, 4.0):
        position = rng.normal(scale=0.5, size=(COUNT, 3)) + np.array([offset, 0.0, 0.0])
        frames.append(Frame(jnp.asarray(position), jnp.asarray([random_rotation(rng) for _ in range(COUNT)])))
    va, vb = (jnp.asarray(rng.normal(size=(COUNT, 6))) for _ in range(2))
    return load, *frames, va, vb, jnp.asarray(rng.uniform(0.0, 1.0, COUNT))


@eqx.filter_jit
@eqx.filter_vmap
def closed_form(load, a, b, va, vb, t):
    return load.force(a, b, va, vb, t), load.tangents(a, b, va, vb, t)


@eqx.filter_jit
@eqx.filter_vmap
def differentiated(load, a, b, va, vb, t):
    zero = jnp.zeros(12, a.position.dtype)
    by_position = jax.jacfwd(lambda x: load.force(moved(a, x[:6]), moved(b, x[6:]), va, vb, t))(zero)
    by_velocity = jax.jacfwd(lambda x: load.force(a, b, va + x[:6], vb + x[6:], t))(zero)
    return by_position, by_velocity


@pytest.mark.parametrize("name", LOADS)
def test_tangents_equal_autodiff(name):
    arguments = sample(name)
    force, tangents = closed_form(*arguments)
    assert force.shape == (COUNT, 12)
    assert np.abs(force).max() > 0.1
    for actual, expected in zip(tangents, differentiated(*arguments)):
        if actual is None:  # says that it is identically zero
            np.testing.assert_array_equal(expected, np.zeros((COUNT, 12, 12)))
        else:
            assert np.abs(expected).max() > 0.1  # else it should have said None
            close(actual, expected, ULPS)


@pytest.mark.parametrize("name", LOADS)
def test_position_tangent_equals_central_differences(name):
    load, a, b, va, vb, t = jax.tree.map(lambda leaf: leaf[:1], sample(name, seed=1))
    _, tangents = closed_form(load, a, b, va, vb, t)
    actual = np.zeros((12, 12)) if tangents.position is None else tangents.position[0]

    def force(x):
        frames = [moved_without_library(Frame(*(leaf[0] for leaf in f)), w) for f, w in ((a, x[:6]), (b, x[6:]))]
        frames = [Frame(*(jnp.asarray(leaf)[None] for leaf in f)) for f in frames]
        return closed_form(load, *frames, va, vb, t)[0][0]

    # Forces and their third derivatives are below 100: 4e-11 × 100 (see `central_difference`), with a
    # margin of 5.
    np.testing.assert_allclose(actual, central_difference(force, 12), rtol=0, atol=2e-8)


# Potential energies, written from the definition of the elements and not from their code.


def spring_energy(load, a, b, t):
    length = jnp.linalg.norm(b.point(load.point_b) - a.point(load.point_a))
    return load.preload * length + load.stiffness * (length - load.free_length) ** 2 / 2


def curve_energy(load, a, b, t):
    length = jnp.linalg.norm(b.point(load.point_b) - a.point(load.point_a))
    extension, rising = length - load.free_length, jnp.arange(1.0, 5.0)
    return load.preload * length + jnp.sum(load.spring.coefficients / rising * extension**rising)


def tyre_energy(load, a, b, t):
    deflection = load.road(t) + load.free_radius - b.point(load.point_b)[2]
    return load.stiffness * deflection**2 / 2 - load.preload * b.point(load.point_b)[2]


def weight_energy(load, a, b, t):
    return -load.mass * jnp.dot(load.acceleration, b.position)


def force_energy(load, a, b, t):
    return -load.signal(t) * jnp.dot(load.vector, b.point(load.point_b))


def bushing_energy(load, a, b, t):
    u = a.local_point(b.point(load.point_b)) - load.point_a
    return load.preload @ u + u @ load.stiffness @ u / 2


def energy_of(name):
    family = name.partition("-")[0]
    return {
        "spring": spring_energy,
        "curve": curve_energy,
        "bushing": bushing_energy,
        "tyre": tyre_energy,
        "weight": weight_energy,
        "force": force_energy,
    }[family]


def without(load, field):
    return eqx.tree_at(lambda load: getattr(load, field), load, jnp.zeros_like(getattr(load, field)))


@pytest.mark.parametrize("name", LOADS)
def test_force_is_minus_the_gradient_of_the_potential(name):
    load, a, b, va, vb, t = sample(name, seed=2)
    if name in ("spring", "bushing"):
        load = without(load, "damping")
    if name == "curve":
        load = eqx.tree_at(lambda load: load.damper, load, jax.tree.map(jnp.zeros_like, load.damper))
    if name == "bushing":  # a symmetric stiffness
        load = eqx.tree_at(lambda load: load.stiffness, load, load.stiffness + jnp.swapaxes(load.stiffness, 1, 2))
    if name == "force":
        load = without(load, "moment")  # a moment fixed in the body has no potential
    energy = energy_of(name)

    @eqx.filter_vmap
    def gradient(load, a, b, t):
        zero = jnp.zeros(12, a.position.dtype)
        return jax.grad(lambda x: energy(load, moved(a, x[:6]), moved(b, x[6:]), t))(zero)

    close(closed_form(load, a, b, va, vb, t)[0], -eqx.filter_jit(gradient)(load, a, b, t), ULPS)


def test_power_of_a_spring_damper():
    """Q·v = −dE/dt − c ℓ̇², with E and ℓ̇ differentiated along the motion of the two bodies."""
    load, a, b, va, vb, t = sample("spring", seed=3)
    force, _ = closed_form(load, a, b, va, vb, t)

    @eqx.filter_jit
    @eqx.filter_vmap
    def rates(load, a, b, va, vb, t):
        def along(s):
            first, second = moved(a, s * va), moved(b, s * vb)
            length = jnp.linalg.norm(second.point(load.point_b) - first.point(load.point_a))
            return spring_energy(load, first, second, t), length

        return jax.jvp(along, (jnp.zeros_like(t),), (jnp.ones_like(t),))[1]

    energy_rate, length_rate = rates(load, a, b, va, vb, t)
    power = np.sum(force * np.concatenate([va, vb], axis=1), axis=1)
    dissipated = load.damping * length_rate**2
    assert np.min(dissipated) > 0
    close(power, -energy_rate - dissipated, ULPS, scale=np.abs(force).max() * np.abs(vb).max())


def test_spring_damper_with_curves():
    """Length, rate and tension by hand: a body moves away from the ground along the line, at a slant."""
    body = lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 3.0, 4.0), velocity=(0.0, 0.6, 0.8))
    spring, damper = lg.Polynomial((0.0, 10.0, 0.0, 50.0)), lg.Polynomial((0.0, 2.0, 0.5))
    element = lg.CurveSpringDamper(
        None, "body", at_a=(0.0, 0.0, 0.0), at_b=(0.0, 3.0, 4.0), spring=spring, damper=damper, preload=-7.0
    )

    def residual(element):
        system = lg.Model({"body": body}, forces={"strut": element}).system()
        q, v = system.reference()
        q = q._replace(position=1.2 * q.position)  # from 5 to 6 m
        return -system.residual(q, v, jnp.zeros(6), jnp.zeros(0), jnp.zeros(()))[:3]

    expected = -7.0 + (10.0 + 50.0) + (2.0 + 0.5)
    close(residual(element), -expected * np.array([0.0, 0.6, 0.8]), 20)
    free = lg.CurveSpringDamper(None, "body", at_a=np.zeros(3), at_b=(0.0, 3.0, 4.0), spring=spring, free_length=5.5)
    close(residual(free), -(10.0 * 0.5 + 50.0 * 0.125) * np.array([0.0, 0.6, 0.8]), 20)
    more = free.with_preload(jnp.asarray(-3.0))  # at all lengths
    close(residual(more), (3.0 - 10.0 * 0.5 - 50.0 * 0.125) * np.array([0.0, 0.6, 0.8]), 20)


@pytest.mark.slow  # small versions: test_tangents_equal_autodiff[curve], test_spring_damper_with_curves
def test_every_number_of_spring_and_damper_curves():
    """Points and values of the curves, ends, free length and preload: derivatives, balance, dissipation."""
    spring = lg.Sampled((-1.0, -0.2, 0.3, 1.0), (-5.0, -1.0, 1.0, 9.0), "monotone")
    damper = lg.Sampled((-3.0, 0.0, 2.0), (-2.0, 0.0, 3.0), "monotone")
    ends = {"at_a": (0.1, 0.2, -0.1), "at_b": (0.5, 0.2, 0.9)}
    report = check_force(lg.CurveSpringDamper("a", "b", **ends, spring=spring, damper=damper, free_length=1.1))
    assert report, report


@pytest.mark.parametrize("curves", [{}, {"spring": 3.0}, {"spring": lg.Polynomial((0.0, 1.0)), "damper": 2.0}])
def test_what_is_no_curve(curves):
    with pytest.raises(ValueError, match=r"CurveSpringDamper: `spring` and `damper` must be .*; with two numbers"):
        lg.CurveSpringDamper(None, "body", at_a=np.zeros(3), at_b=np.ones(3), **curves)


@pytest.mark.parametrize("ends", [(None, "body"), ("body", None)])
def test_bushing_of_a_model(ends):
    """Body moved by δ and with the velocity w: diag(k) δ + diag(c) w, and the preload, whatever its frame and point."""
    rng = np.random.default_rng(6)
    k, c, preload, moved_by, velocity = rng.uniform(1.0, 2.0, (5, 3))
    body = lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), orientation=random_rotation(rng), velocity=velocity)
    bushing = lg.Bushing(*ends, at=rng.normal(size=3), stiffness=k, damping=c, preload=preload)
    system = lg.Model({"body": body}, forces={"bushing": bushing}).system()
    q, v = system.reference()
    q = q._replace(position=q.position + moved_by[None])
    residual = system.residual(q, v, jnp.zeros(6), jnp.zeros(0), jnp.zeros(()))
    sign = 1.0 if ends[1] == "body" else -1.0
    close(residual[:3], k * moved_by + c * velocity + sign * preload, ULPS)


def test_moment_of_an_applied_force_is_fixed_in_the_body():
    load, a, b, va, vb, t = sample("force", seed=4)
    force, _ = closed_form(load, a, b, va, vb, t)
    factor = np.asarray(jax.vmap(lambda signal, t: signal(t))(load.signal, t))
    arm = np.einsum("nij,nj->ni", b.orientation, load.point_b)
    moment = np.einsum("nij,nj->ni", np.swapaxes(b.orientation, 1, 2), np.cross(arm, load.vector)) + load.moment
    close(force[:, 6:9], factor[:, None] * load.vector, ULPS)
    close(force[:, 9:], factor[:, None] * moment, ULPS)
    np.testing.assert_array_equal(force[:, :6], np.zeros((COUNT, 6)))


def test_spring_of_coinciding_points_is_finite():
    """At rest no direction, no force; value, tangents and the derivative by every number are finite."""
    zero, one = jnp.zeros(3), jnp.ones(())
    load = SpringDamperLoad(zero, zero, one, one, one, one)
    frame, twist, t = Frame(zero, jnp.eye(3)), jnp.ones(6), jnp.zeros(())
    np.testing.assert_array_equal(load.force(frame, frame, twist, twist, t), np.zeros(12))

    def everything(load, frame):
        return load.force(frame, frame, twist, -twist, t), load.tangents(frame, frame, twist, -twist, t)

    derivative = jax.jit(jax.jacrev(everything))(load, frame)
    values = jax.tree.leaves((everything(load, frame), derivative))
    assert all(np.all(np.isfinite(leaf)) for leaf in values)


def test_points_that_meet_and_part_have_the_force_of_a_moment_later():
    """Value and tangents are those at a distance along the way, to that distance: F₀ + k (0 − ℓ₀) + c |ḋ| along ḋ; and
    of the force by autodiff at the point itself."""
    rng = np.random.default_rng(3)
    arms, numbers = jnp.asarray(rng.normal(size=(2, 3))), jnp.asarray([7.0, 3.0, 0.2, 0.9])
    load = SpringDamperLoad(*arms, *numbers)
    a, b = (Frame(jnp.zeros(3), jnp.asarray(random_rotation(rng))) for _ in range(2))
    for _ in range(2):  # the second removes the round-off of the first
        b = Frame(b.position + (a.point(arms[0]) - b.point(arms[1])), b.orientation)
    assert np.all(a.point(arms[0]) == b.point(arms[1]))
    va, vb, none = jnp.asarray(rng.normal(size=6)), jnp.asarray(rng.normal(size=6)), jnp.zeros(())
    speed = b.orientation @ jnp.cross(vb[3:], arms[1]) + vb[:3] - a.orientation @ jnp.cross(va[3:], arms[0]) - va[:3]
    size, n = np.linalg.norm(speed), speed / np.linalg.norm(speed)
    found = load.measure(a, b, va, vb, none)
    expected = 0.9 - 7.0 * 0.2 + 3.0 * size
    np.testing.assert_allclose([found.length, found.rate, found.tension], [0.0, size, expected], rtol=1e-14)
    force = load.force(a, b, va, vb, none)
    np.testing.assert_allclose(force[6:9], -expected * n, rtol=0, atol=1e-13)
    later = Frame(b.position + 1e-7 * n, b.orientation)
    np.testing.assert_allclose(load.force(a, later, va, vb, none), force, rtol=0, atol=1e-5)
    by_autodiff = jax.jacfwd(lambda v: load.force(a, b, va, v, none))(vb)
    np.testing.assert_allclose(load.tangents(a, b, va, vb, none).velocity[:, 6:], by_autodiff, rtol=0, atol=1e-13)


@pytest.mark.parametrize("start", [0.0, 1e-9])
def test_a_damper_between_points_that_part_keeps_the_order(start):
    """m ẍ + c ẋ + k x = 0 from x = 0 with ẋ = 1: e^(−2t) sin(√96 t)/√96, in steps of 5 and 2.5 ms: h² times 5."""

    def end(steps):
        body = lg.RigidBody(2.0, None, velocity=(1.0, 0.0, 0.0), position=(start, 0.0, 0.0), free="x")
        ends = {"at_a": (0.0, 0.0, 0.0), "at_b": (start, 0.0, 0.0)}
        spring = lg.SpringDamper(None, "b", **ends, free_length=0.0, stiffness=200.0, damping=8.0)
        run = lg.simulate(lg.Model({"b": body}, forces={"spring": spring}), t1=0.25, num_steps=steps)
        return run.body("b").position[-1, 0]

    exact = np.exp(-0.5) * np.sin(np.sqrt(96.0) / 4) / np.sqrt(96.0)
    coarse, fine = (abs(end(steps) - exact) for steps in (50, 100))
    assert coarse < 5 * 0.005**2 and 3.8 < coarse / fine < 4.2


def test_spring_of_no_length_has_its_tangent_where_its_points_meet():
    """With tension k |d| it pulls with k d: the tangent on translations is k [−I, I], by formula and by autodiff."""
    k, zero = jnp.asarray(7.0), jnp.zeros(3)
    none = jnp.zeros(())
    load = SpringDamperLoad(zero, zero, k, none, none, none)
    frame, twist = Frame(zero, jnp.eye(3)), jnp.zeros(6)
    closed = load.tangents(frame, frame, twist, twist, none).position
    moved = lambda x: load.force(frame, Frame(x, frame.orientation), twist, twist, none)
    by_autodiff = jax.jacfwd(moved)(zero)
    assert closed is not None
    for force_a, force_b in ((closed[:3, 6:9], closed[6:9, 6:9]), (by_autodiff[:3], by_autodiff[6:9])):
        np.testing.assert_array_equal(force_a, 7.0 * np.eye(3))
        np.testing.assert_array_equal(force_b, -7.0 * np.eye(3))


# Roads.

TIMES = np.array([-0.5, 0.0, 0.2, 0.21, 0.3, 0.45, 0.699, 0.7, 0.9, 5.0])


def test_bump_is_the_raised_cosine():
    phase = np.clip((TIMES - 0.2) / 0.5, 0.0, 1.0)
    road = jax.vmap(SIGNALS["bump"]())
    close(road(jnp.asarray(TIMES)), 0.4 * (1 - np.cos(2 * np.pi * phase)) / 2, 8, scale=0.4)


def test_sampled_road_is_linear_between_samples_and_constant_outside():
    road = jax.vmap(SIGNALS["sampled"]())
    close(road(jnp.asarray(TIMES)), np.interp(TIMES, [0.0, 0.3, 0.7, 1.0], [0.1, -0.2, 0.4, 0.0]), 8)


@pytest.mark.parametrize("name", SIGNALS)
def test_every_number_of_a_road_has_a_derivative(name):
    """By reverse mode against central differences of each entry: 4e-11 × values of order 10, margin of 10."""
    signal, t = SIGNALS[name](), jnp.asarray(0.41)
    flat, rebuild = jax.flatten_util.ravel_pytree(signal)
    gradient, _ = jax.flatten_util.ravel_pytree(jax.grad(lambda s: s(t))(signal))
    shifted = lambda x: rebuild(flat + jnp.asarray(x))(t)
    np.testing.assert_allclose(gradient, central_difference(shifted, flat.size), rtol=0, atol=4e-9)
    assert np.abs(gradient).max() > 0.1


# Loads as a user writes them.


class UserSpring(AbstractLoad):
    point_a: jax.Array
    point_b: jax.Array
    stiffness: jax.Array
    damping: jax.Array

    def force(self, a, b, va, vb, t):
        arm_a, arm_b = a.orientation @ self.point_a, b.orientation @ self.point_b
        line = b.position + arm_b - a.position - arm_a
        length = jnp.sqrt(jnp.sum(line**2))
        n = line / length
        speed_a = va[:3] + jnp.cross(a.orientation @ va[3:], arm_a)
        speed_b = vb[:3] + jnp.cross(b.orientation @ vb[3:], arm_b)
        pull = (self.stiffness * (length - 1.0) + self.damping * jnp.dot(n, speed_b - speed_a)) * n
        moments = a.orientation.T @ jnp.cross(arm_a, pull), -b.orientation.T @ jnp.cross(arm_b, pull)
        return jnp.concatenate([pull, moments[0], -pull, moments[1]])


class UserSpringForce(AbstractForce):
    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: jax.Array
    at_b: jax.Array
    stiffness: jax.Array
    damping: jax.Array

    @property
    def bodies(self):
        return (self.a, self.b)

    def loads(self, bodies):
        def local(name, at):
            return at if name is None else bodies[name].orientation.T @ (at - bodies[name].position)

        points = local(self.a, self.at_a), local(self.b, self.at_b)
        return (Attached(UserSpring(*points, self.stiffness, self.damping), self.a, self.b),)


def springs(own: bool):
    rng = np.random.default_rng(5)
    bodies = {name: random_body(rng) for name in ("one", "two")}
    forces = {}
    for name, ends in {
        "between": ("two", "one"),
        "to ground": ("one", None),
        "from ground": (None, "two"),
    }.items():
        numbers = {
            "at_a": rng.uniform(1, 2, 3),
            "at_b": rng.uniform(-2, -1, 3),
            "stiffness": 5.0,
            "damping": 2.0,
        }
        numbers = {key: jnp.asarray(value, dtype=float) for key, value in numbers.items()}
        forces[name] = UserSpringForce(*ends, **numbers) if own else lg.SpringDamper(*ends, **numbers, free_length=1.0)
    return lg.Model(bodies, {}, forces)


@eqx.filter_jit
def evaluate(model, point):
    system = model.system()
    return system.residual(*point), system.tangents(*point)


def test_load_without_tangents_gets_them():
    own, library = springs(own=True), springs(own=False)
    for seed in range(3):
        point = random_point(library.system(), np.random.default_rng(seed))
        jax.tree.map(lambda x, y: close(x, y, ULPS), evaluate(own, point), evaluate(library, point))


def test_tangents_of_a_users_drag():
    """C_t of −c|ẋ|ẋ is c (|ẋ| I + ẋẋᵀ/|ẋ|); its moment −c Rᵀ(sin t x) gives K_t = c sin t [Rᵀ, (Rᵀx)~]."""
    rng = np.random.default_rng(6)
    model = lg.Model({"kite": random_body(rng)}, {}, {"drag": DragForce("kite", jnp.asarray(0.3, dtype=float))})
    system = model.system()
    point = random_point(system, rng)
    _, (stiffness, damping, _) = evaluate(model, point)
    u, c = np.asarray(point.v[:3]), 0.3
    speed = np.linalg.norm(u)
    close(damping[:3, :3], c * (speed * np.eye(3) + np.outer(u, u) / speed), ULPS)
    np.testing.assert_array_equal(damping[:3, 3:], np.zeros((3, 3)))
    rotation = np.asarray(point.q.orientation[0])
    x, y, z = rotation.T @ np.asarray(point.q.position[0])
    factor = c * np.sin(float(point.t))
    close(stiffness[3:, :3], factor * rotation.T, ULPS)
    close(stiffness[3:, 3:], factor * np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), ULPS)
    assert isinstance(system.loads[0].elements, Drag)
