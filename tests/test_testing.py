"""`lgsens.testing`: right rules pass, and every kind of wrong rule is found, with its place."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick

import lgsens as lg
from lgsens.examples import spinning_top
from lgsens.model import (
    AbstractClosedFormLoad,
    AbstractConstraint,
    AbstractForce,
    AbstractJoint,
    AbstractLoad,
    Attached,
    Coincidence,
    LoadTangents,
    Orthogonality,
    SpringDamperLoad,
)
from lgsens.model._loads import Weight
from lgsens.testing import CheckError, check_force, check_joint, check_sensitivities

POINT, AXIS = (0.3, -0.7, 1.1), (1.0, 2.0, -0.5)


def failed(report):
    """What failed, as (name, ways)."""
    return {(check.name, check.compared) for check in report.failures}


# Joints.


def wrong(kind, **methods):
    """A final class like `kind` but for some methods."""
    own = {name: getattr(kind, name) for name in ("num_rows", "value", "jacobian", "force", "geometric_stiffness")}
    if kind is Orthogonality:
        own["_row"] = kind._row
    return type(
        f"Wrong{kind.__name__}",
        (lg.model.AbstractClosedFormConstraint,),
        own
        | methods
        | {
            "__annotations__": {field.name: jax.Array for field in dataclasses.fields(kind)},
            "__module__": __name__,
        },
    )


def wrong_sign(self, a, b, t):
    """B of `Coincidence`, but for the sign of one entry."""
    return Coincidence.jacobian(self, a, b, t).at[1, 4].multiply(-1.0)


def wrong_force(self, a, b, lam, t):
    return Orthogonality.force(self, a, b, lam, t).at[10].set(0.0)


def unsymmetric(self, a, b, lam, t):
    return Coincidence.geometric_stiffness(self, a, b, lam, t).T


NUMBERS = {
    Coincidence: {"point_a": jnp.asarray(POINT), "point_b": jnp.asarray(AXIS)},
    Orthogonality: {"axis_a": jnp.asarray(POINT), "axis_b": jnp.asarray(AXIS)},
}
WRONG_CONSTRAINTS = {
    "sign of one entry of B": (Coincidence, {"jacobian": wrong_sign}, {"B"}, "[1, ry_a]"),
    "an entry of the force": (Orthogonality, {"force": wrong_force}, {"Bᵀλ"}, "[ry_b]: 0, not"),
    "a coupling left out": (
        Orthogonality,
        {"coupled": property(lambda self: ((3, 4, 5), (9, 10, 11)))},
        {"K = ∂(Bᵀλ)/∂x"},
        "_b]: 0, not",
    ),
    "a column left out": (
        Coincidence,
        {"acts_on": property(lambda self: (3, 4, 5, 9, 10, 11))},
        {"B", "Bᵀλ"},
        "[0, x_a]: 0, not",
    ),
    "stiffness transposed": (Coincidence, {"geometric_stiffness": unsymmetric}, {"K = ∂(Bᵀλ)/∂x"}, "K = ∂(Bᵀλ)/∂x"),
}


@pytest.mark.slow  # `test_wrong_joint` is in the quick run
@pytest.mark.parametrize("mistake", some_quick(WRONG_CONSTRAINTS))
def test_wrong_rule_of_a_constraint(mistake):
    kind, methods, names, note = WRONG_CONSTRAINTS[mistake]
    report = check_joint(wrong(kind, **methods)(**{f: jnp.asarray(x) for f, x in NUMBERS[kind].items()}))
    assert failed(report) == {(name, "given, autodiff") for name in names}
    with pytest.raises(CheckError, match=says("checks failed", "FAILED", note)):
        report.raise_if_failed()
    assert check_joint(kind(**NUMBERS[kind]))  # the right one


class Hinge(AbstractJoint):
    """A ball joint at `at` and, with `rows`, more equations; `assembled` is what one says of it."""

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: jax.Array
    make: object = eqx.field(static=True)

    @property
    def assembled(self):
        return True

    def constraints(self, a, b):
        return self.make(self.at, a, b)


def ball(at, a, b):
    return (Coincidence(a.local_point(at), b.local_point(at)),)


def misplaced(at, a, b):
    return (Coincidence(a.local_point(at), b.local_point(at + 1e-9)),)


def twice(at, a, b):
    return ball(at, a, b) + ball(at, a, b)[:1]


def lost(at, a, b):
    """The hardpoint is a constant for derivatives."""
    return ball(jax.lax.stop_gradient(at), a, b)


WRONG_JOINTS = {
    "not assembled": (misplaced, {("Φ", "reference, 0")}),
    "redundant": (twice, {("rank of B", "reference, equations")}),
    "lost number": (lost, {("at", "forward, differences"), ("all leaves", "rate of the remainder: 2")}),
}


@pytest.mark.parametrize("mistake", some_quick(WRONG_JOINTS))
def test_wrong_joint(mistake):
    make, expected = WRONG_JOINTS[mistake]
    assert failed(check_joint(Hinge(None, "b", jnp.asarray(POINT), make))) == expected
    assert check_joint(Hinge(None, "b", jnp.asarray(POINT), ball))


class Rod(AbstractConstraint):
    """|d| − L with a rule of its own for the root."""

    length: jax.Array
    root: object = eqx.field(static=True)

    @property
    def num_rows(self):
        return 1

    def value(self, a, b, t):
        return self.root(jnp.sum((b.position - a.position) ** 2))[None] - self.length


@jax.custom_jvp
def wrong_root(square):
    return jnp.sqrt(square)


@wrong_root.defjvp
def _(primals, tangents):
    (square,), (change,) = primals, tangents
    return jnp.sqrt(square), change / jnp.sqrt(square)  # twice the derivative


def test_autodiff_of_a_value_is_checked_too():
    """A constraint without tangents has those of autodiff, which a custom rule can make wrong."""
    report = check_joint(Rod(jnp.asarray([1.0]), wrong_root))
    assert failed(report) == {("B", "autodiff, differences")}
    assert check_joint(Rod(jnp.asarray([1.0]), jnp.sqrt))


def test_number_of_rows():
    class Wrong(AbstractConstraint):
        @property
        def num_rows(self):
            return 2

        def value(self, a, b, t):
            return b.position - a.position

    with pytest.raises(ValueError, match=says("Wrong: `value` has shape (3,), `num_rows` is 2")):
        check_joint(Wrong())


# Forces.


class Kite(AbstractClosedFormLoad):
    """A force −c ẋ on b, whose tangents are those of `rule`."""

    drag: jax.Array
    rule: str = eqx.field(static=True)

    def force(self, a, b, va, vb, t):
        pull = self.drag * (vb[:3] - va[:3])
        if self.rule == "feeds energy":
            pull = -pull
        zero = jnp.zeros(3, pull.dtype)
        moment_a, moment_b = (f.local_axis(jnp.cross(b.position - f.position, pull)) for f in (a, b))
        if self.rule == "not balanced":
            moment_a = zero
        return jnp.concatenate([pull, moment_a, -pull, -moment_b])

    def tangents(self, a, b, va, vb, t):
        if self.rule == "velocity missing":
            return LoadTangents(self._position(a, b, va, vb, t), None)
        velocity = jax.jacfwd(lambda v: self.force(a, b, v[:6], v[6:], t))(jnp.concatenate([va, vb]))
        if self.rule == "velocity transposed":
            velocity = velocity.T
        position = None if self.rule == "position missing" else self._position(a, b, va, vb, t)
        return LoadTangents(position, velocity)

    def _position(self, a, b, va, vb, t):
        moved = lambda x: (lg.model.moved(a, x[:6]), lg.model.moved(b, x[6:]))
        return jax.jacfwd(lambda x: self.force(*moved(x), va, vb, t))(jnp.zeros(12, va.dtype))


GIVEN = "given, autodiff"
WRONG_LOADS = {
    "right": set(),
    "velocity missing": {("∂Q/∂v", GIVEN)},
    "position missing": {("∂Q/∂q", GIVEN)},
    "velocity transposed": {("∂Q/∂v", GIVEN)},
    "not balanced": {("moment of both", "action, reaction")},
    "feeds energy": {("power of velocities", "at most 0")},
}


@pytest.mark.parametrize("rule", some_quick(WRONG_LOADS, 2))
def test_wrong_load(rule):
    no_energy = lambda load, a, b, t: 0.0 * t
    assert failed(check_force(Kite(jnp.asarray(0.3), rule), potential=no_energy)) == WRONG_LOADS[rule]


class Level(Weight):
    """A weight that forgets its vertical component."""

    @property
    def acts_on(self):
        return (6, 7)


@pytest.mark.slow  # `test_wrong_load` is in the quick run
def test_wrong_potential():
    spring = SpringDamperLoad(*map(jnp.asarray, (POINT, AXIS, 3.0, 0.2, 0.4, 1.0)))

    def energy(factor):
        def potential(load, a, b, t):
            length = jnp.linalg.norm(b.point(load.point_b) - a.point(load.point_a))
            return load.preload * length + factor * load.stiffness * (length - load.free_length) ** 2

        return potential

    assert check_force(spring, potential=energy(0.5))
    assert failed(check_force(spring, potential=energy(1.0))) == {("Q at rest", "given, −∂E/∂q")}


@pytest.mark.slow  # small version: test_wrong_load
def test_what_has_no_reaction_or_varies():
    assert check_force(lg.Gravity((0.0, 0.0, -9.81)))
    assert failed(check_force(Level(jnp.asarray(2.0), jnp.asarray(AXIS)), balanced=False)) == {("Q", "elsewhere, 0")}
    assert check_force(lg.AppliedForce("b", at=POINT, force=AXIS, signal=lg.BumpRoad(height=0.1, duration=0.5)))


class Push(AbstractLoad):
    size: jax.Array

    def force(self, a, b, va, vb, t):
        return jnp.zeros(6, self.size.dtype)


class PushForce(AbstractForce):
    size: jax.Array

    @property
    def bodies(self):
        return ("b",)

    def loads(self, bodies):
        return (Attached(Push(self.size), None, "b"),)


def test_shape_of_a_force():
    with pytest.raises(ValueError, match=says("1 Push: `force` must have shape (12,), got (6,)")):
        check_force(PushForce(jnp.ones(())))


# Sensitivities.


def end(model):
    """Where the top is after a few steps, and its reaction."""
    trajectory = lg.simulate(model, t1=0.1, num_steps=4)
    return trajectory.body("top").position[-1], trajectory.multiplier("pivot")[-1]


def turned_top():
    """The top with a reference orientation that is not the identity, so that every leaf matters."""
    model, (s, c) = spinning_top(0.7), (np.sin(0.3), np.cos(0.3))
    turn = jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    where = lambda m: (m.bodies["top"].orientation, m.bodies["top"].angular_velocity)
    return eqx.tree_at(where, model, (turn, jnp.array([1.0, 6.0, 7.0])))


@pytest.mark.slow  # eight leaves; those of functions are in the quick run
def test_every_leaf_of_a_simulation():
    report = check_sensitivities(end, turned_top()).raise_if_failed()
    names = {check.name for check in report.checks}
    assert names >= {"bodies.top.mass", "bodies.top.orientation", "joints.pivot.at", "forces.gravity.acceleration"}
    assert len(report.checks) == 2 * 8 + 1  # eight leaves in two ways, and the remainder
    assert "bodies.top.inertia" in str(report)


def value(p):
    return p["k"] ** 2 * jnp.sin(p["c"])


@jax.custom_jvp
def drops(p):
    return value(p)


@drops.defjvp
def _(primals, tangents):
    (p,), (d,) = primals, tangents
    return value(p), 2 * p["k"] * jnp.sin(p["c"]) * d["k"]  # and nothing of c


@jax.custom_vjp
def drops_in_reverse(p):
    return value(p)


drops_in_reverse.defvjp(lambda p: (value(p), p), lambda p, w: ({"k": w * 2 * p["k"] * jnp.sin(p["c"]), "c": 0.0 * w},))


@jax.custom_jvp
def slightly_off(x):
    return jnp.exp(x)


@slightly_off.defjvp
def _(primals, tangents):
    return jnp.exp(primals[0]), (1 + 1e-8) * jnp.exp(primals[0]) * tangents[0]


def not_transposed(x):
    """Right forward; the reverse of a linear map that is not its transpose."""
    matrix = jnp.array([[1.0, 2.0], [0.0, 1.0]])
    solve = lambda _, b: jnp.linalg.solve(matrix, b)
    return jax.lax.custom_linear_solve(lambda y: matrix @ y, x, solve, transpose_solve=solve)


P = {"k": 1.3, "c": 0.4}
REMAINDER = ("all leaves", "rate of the remainder: 2")
WRONG_CRITERIA = {
    "drops a parameter": (drops, P, {}, {("c", "forward, differences"), REMAINDER}),
    "drops it in reverse": (drops_in_reverse, P, {"modes": ("reverse",)}, {("c", "reverse, differences")}),
    "off by 1e-8": (slightly_off, 0.3, {}, {("x", "forward, differences")}),
    "not transposed": (not_transposed, np.array([0.3, 0.7]), {}, {("x", "reverse, forward")}),
    # the corner lies between the points of the differences; those of the remainder lead away from it
    "a corner": (lambda x: jnp.abs(x - 1.0), 1.0 + 1e-4, {}, {("x", "forward, differences")}),
    "a corner ahead": (lambda x: jnp.abs(x - 1.0), 1.0 - 1e-4, {}, {("x", "forward, differences"), REMAINDER}),
}


@pytest.mark.parametrize("mistake", WRONG_CRITERIA)
def test_wrong_derivative_of_a_criterion(mistake):
    fn, at, options, expected = WRONG_CRITERIA[mistake]
    report = check_sensitivities(fn, at, **options)
    assert failed(report) == expected
    assert not report
    with pytest.raises(CheckError) as raised:
        report.raise_if_failed()
    assert raised.value.report is report
    assert "FAILED" in str(raised.value)


@pytest.mark.parametrize("modes", [("forward",), ("reverse",), ("forward", "reverse")])
def test_right_derivatives(modes):
    """Also where the function is linear, constant in a leaf, zero, of many values, or of a leaf that is zero."""
    for fn, at in (
        (value, P),
        (lambda x: 3.0 * x, np.array([1.0, 2.0])),
        (lambda p: {"one": p["k"] ** 3, "large": 1e6 + p["k"], "none": 0.0 * p["c"]}, P),
        (jnp.sin, np.zeros(3)),
    ):
        check_sensitivities(fn, at, modes=modes).raise_if_failed()


def test_round_off_of_a_straight_line():
    """A moment in its arm: differences are as exact as the derivative, whose own few operations remain."""
    rng = np.random.default_rng(33)
    turn = jnp.asarray(np.linalg.qr(rng.standard_normal((3, 3)))[0])
    force = jnp.asarray(1e7 * rng.standard_normal(3))
    assert check_sensitivities(lambda arm: jnp.cross(arm, turn.T @ force), np.array([0.1, 0.0, 0.0]), seed=33)


def test_scale_and_step():
    """With a step of 1 differences say nothing of sin(30 x); the scale of x sets what a step is."""
    fn = lambda x: jnp.sin(30.0 * x)
    report = check_sensitivities(fn, 0.5, step=1.0)
    assert "undecided" in report.failures[0].note
    assert check_sensitivities(fn, 0.5, step=1.0, scale=1e-3)


def test_bad_arguments():
    with pytest.raises(ValueError, match=says("`modes` must be among", "got ('sideways',)")):
        check_sensitivities(jnp.sin, 1.0, modes=("sideways",))
    with pytest.raises(ValueError, match=says("`fn` must be finite at `at`", "nan")):
        check_sensitivities(jnp.log, -1.0)
    with pytest.raises(ValueError, match=says("`at` has no arrays")):
        check_sensitivities(lambda x: 1.0, {})


class Vibrating(AbstractConstraint):
    """A point that a support holds, which moves by A (sin(ωt + φ) − sin φ): by nothing in A at t = 0."""

    point: jax.Array
    amplitude: jax.Array
    rate: jax.Array
    num_rows = 3

    def value(self, a, b, t):
        way = self.amplitude * jnp.sin(self.rate * t + 0.3) - self.amplitude * jnp.sin(0.3)
        return b.point(self.point) - jnp.stack([way, 0.0 * way, 0.0 * way])


@pytest.mark.parametrize("amplitude", [0.3, pytest.param(0.7, marks=pytest.mark.slow)])
def test_a_derivative_that_vanishes_by_cancellation_passes(amplitude):
    check_joint(Vibrating(jnp.asarray(POINT), jnp.asarray(amplitude), jnp.asarray(4.0))).raise_if_failed()
