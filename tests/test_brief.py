"""Reprs of results: one screen, whatever is in them, and what one wants to know first."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.accuracy import Reference, Setting
from lgsens.accuracy._table import Row
from lgsens.analysis import Growth, ModeShape
from lgsens.integrate import Stats
from lgsens.model import LineForce, SlidingFriction, Summary
from lgsens.optimize import GradientCheck, LeastSquaresResult, MultiStartResult, OptimizationResult
from lgsens.optimize._minimize import History

MANY, WIDE = np.linspace(-1.0, 3.0, 5000), np.zeros((5000, 60))
TREE = {f"parameter_{i}": MANY for i in range(40)}


def chain(count=50) -> lg.Model:
    names = [f"link_{i}" for i in range(count)]
    bodies = {name: lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(i + 0.5, 0.0, 0.0)) for i, name in enumerate(names)}
    ends = zip([None, *names], names)
    return lg.Model(bodies, {f"joint_{b}": lg.SphericalJoint(a, b, at=(i, 0, 0)) for i, (a, b) in enumerate(ends)})


def trajectory(model, result=0, batch=()) -> lg.Trajectory:
    system, t = model.system(), jnp.broadcast_to(jnp.linspace(0.5, 2.0, 101), (*batch, 101))
    state = lg.State(system.pose, *(jnp.zeros((*t.shape, n)) for n in (system.group.dim,) * 2), jnp.zeros(9), None)
    result = jnp.broadcast_to(jnp.asarray(result, jnp.int32), batch)
    return lg.Trajectory(t=t, states=state, result=result, stats=None, system=system)


VECTORS = dict.fromkeys(("position", "velocity", "acceleration"), WIDE)
RESULTS = {
    "minimize": lambda: OptimizationResult(
        TREE, 3.25, MANY, True, "converged", 41, History(*[MANY] * 4, TREE), MANY, 6.0, 1.5
    ),
    "multi_start": lambda: MultiStartResult(TREE, TREE, MANY, MANY, MANY > 0, MANY.astype(str), MANY, 3, 6.0, 1.5),
    "least_squares": lambda: LeastSquaresResult(TREE, MANY, WIDE, WIDE, TREE, jnp.asarray(True), jnp.asarray(7)),
    "gradient": lambda: GradientCheck(tuple(TREE), MANY, MANY, MANY, 6e-6),
    "sweep": lambda: lg.SweepResult(TREE, {"values": WIDE}, MANY > 0, 256, 6.0, 1.5),
    "sensitivities": lambda: lg.Sensitivities(TREE, TREE, lg.AdjointVariable(), jnp.asarray(0)),
    "extrapolated": lambda: lg.Extrapolated(TREE, TREE),
    "growth": lambda: Growth(jnp.asarray(MANY), jnp.exp(MANY), jnp.asarray(False), jnp.asarray(np.inf)),
    "row": lambda: Row(Setting(100, lg.GeneralizedAlpha()), gradient=MANY),
    "reference": lambda: Reference(1.0, MANY, 1e-9, 1e-9, ("two routes agree",), True),
    "summary": lambda: chain().summary(),
    "body": lambda: lg.BodyMotion(*[WIDE] * 6),
    "point": lambda: lg.PointMotion(**VECTORS),
    "joint": lambda: lg.JointMotion(TREE, TREE, TREE, *[WIDE] * 7),
    "error": lambda: lg.StateError(*[WIDE] * 4),
    "stats": lambda: Stats(*[MANY] * 5),
    "linearization": lambda: lg.Linearization(
        *[WIDE] * 7, MANY * 1j, WIDE, MANY > 0, None, jnp.asarray(0.5), jnp.asarray(0), None, ("push",), tuple(TREE)
    ),
    "force": lambda: LineForce(MANY, MANY, MANY),
    "friction": lambda: SlidingFriction(MANY, WIDE, WIDE),
    "mode": lambda: ModeShape({name: WIDE for name in TREE}, {name: WIDE for name in TREE}),
    "saved": lambda: lg.Saved(jnp.asarray(MANY), TREE, None, jnp.asarray(0), None),
    "model": chain,
    "trajectory": lambda: trajectory(chain()),
    "batch": lambda: trajectory(chain(), batch=(20,)),
    "instant": lambda: lg.Instant(t=jnp.asarray(0.5), state=trajectory(chain()).states, system=chain().system()),
}


@pytest.mark.parametrize("name", RESULTS)
def test_fits_on_a_screen(name):
    lines = repr(RESULTS[name]()).splitlines()
    assert len(lines) <= 31 and all(len(line) <= 120 for line in lines)
    if name != "growth":
        assert lines[0].isidentifier() and all(line.startswith("  ") for line in lines[1:])


def test_says_what_one_wants_to_know():
    model = chain(2)
    shown = str(trajectory(model))
    for line in (
        "steps   100",
        "t       float64[101], 0.5 to 2 s",
        "result  successful",
        "bodies  2: link_0, link_1",
        "joints  2: joint_link_0, joint_link_1",
        "forces  none",
        "states  12 coordinates, 9 multipliers of MultibodySystem",
    ):
        assert f"  {line}" in shown
    assert "newton_failed" in repr(trajectory(model, result=3))
    some = jnp.asarray([0, 0, 3])
    assert "successful 2, newton_failed 1" in repr(trajectory(model, result=some, batch=(3,)))
    shown = repr(RESULTS["minimize"]())
    assert "reason           'converged'" in shown and "objective        3.25" in shown
    assert "float64[5000], -1 to 3" in shown
    broken = np.where(MANY < 2.9, np.inf, MANY)
    assert "float64[5000], 2.901 to 3, 4875 not finite" in repr(lg.PointMotion(broken, broken, broken))
    assert "[0.25, 0.5 ]" in repr(lg.PointMotion(*[np.array([0.25, 0.5])] * 3))
    assert "bodies         2: link_0, link_1" in repr(model)
    assert "Trajectory(" in repr(jax.tree.map(lambda _: None, trajectory(model)))  # as it is elsewhere
    said = []
    jax.jit(lambda run: said.append(repr(run)))(trajectory(model))
    assert "traced float64[101]" in said[0] and "result  traced" in said[0]
    assert isinstance(model.summary(), Summary) and "coordinates  12" in repr(model.summary())


def test_elements_are_shown_as_they_are_made():
    """With their numbers, in lines that fit; of traced ones and of many their shapes."""
    hinge = lg.RevoluteJoint(None, "door", at=(0.0, 0.25, 0.0), axis=(0.0, 0.0, 1.0))
    assert repr(hinge) == "RevoluteJoint(a=None, b='door', at=[0. , 0.25, 0. ], axis=[0., 0., 1.])"
    ends = {"at_a": (1 / 3, 2 / 3, 1 / 7), "at_b": (-0.0, 0.0, 1.0)}
    spring = lg.SpringDamper("a", "door", **ends, stiffness=3.0, damping=0.5, preload=7.0)
    lines = repr(spring).splitlines()
    assert lines[0] == "SpringDamper(" and lines[-1] == ")" and all(len(line) <= 110 for line in lines)
    for part in ("a='a', b='door',", "at_b=[0., 0., 1.],", "damping=0.5,", "preload=7.,"):
        assert part in repr(spring)
    assert "free_length" not in repr(spring)
    assert "orientation=[[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]]" in repr(lg.RigidBody(2.0, (0.1, 0.2, 0.3)))
    said = []
    jax.jit(lambda joint: said.append(repr(joint)))(hinge)
    assert said == ["RevoluteJoint(a=None, b='door', at=traced float64[3], axis=traced float64[3])"]
    many = jax.vmap(lambda x: lg.Harmonic(amplitude=x, frequency=1.0))(jnp.arange(20.0))
    assert "amplitude=float64[20], 0 to 19" in repr(many)
    motor = lg.RotationDriver(None, "door", axis=(0.0, 0.0, 1.0), value=lg.Polynomial((0.0, 2.0)))
    assert "value=Polynomial(coefficients=[0., 2.])" in repr(motor)
