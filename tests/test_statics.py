"""Equilibria along a path against closed forms and SciPy on hand-written equations, their derivatives, bad input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRAVITY, close, factorizations, says, some_quick
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

import lgsens as lg
from lgsens.analysis._driven import Drive, drivers
from lgsens.dynamics import static_path

PUSH = np.linspace(0.0, 600.0, 7)
ANCHOR, WEIGHT = np.array([0.4, 1.0]), 2.0 * 9.81


def lever(stiffness=5000.0, arm=0.4):
    """A bar of 1 m hinged at one end, a spring from above at `arm`, a load of 1 N downward at the other end."""
    bar = lg.RigidBody(mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0), free="x z ry")
    forces = {
        "spring": lg.SpringDamper(
            None,
            "bar",
            at_a=(ANCHOR[0], 0.0, ANCHOR[1]),
            at_b=jnp.stack([jnp.asarray(arm), *jnp.zeros(2)]),
            stiffness=stiffness,
            damping=7.0,
        ),
        "push": lg.AppliedForce("bar", at=(1.0, 0.0, 0.0), force=(0.0, 0.0, -1.0)),
        "gravity": lg.Gravity(GRAVITY),
    }
    hinge = lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return lg.Model({"bar": bar}, {"hinge": hinge}, forces)


def angle(push, stiffness=5000.0, arm=0.4):
    """How far the bar turns downward, where the moments of spring, weight and load vanish."""
    free = np.hypot(arm - ANCHOR[0], ANCHOR[1])

    def moment(angle):
        point = arm * np.array([np.cos(angle), -np.sin(angle)])
        d = point - ANCHOR
        length = np.hypot(*d)
        turned = arm * np.array([-np.sin(angle), -np.cos(angle)])
        return (WEIGHT / 2 + push) * np.cos(angle) - stiffness * (length - free) * (d @ turned) / length

    return brentq(moment, -0.3, 0.9, xtol=1e-15, rtol=1e-15)


def of_lever(numbers):
    """Height of the centre of mass, its derivative by the load, and the spring's."""
    found = lg.statics(lever(*numbers), loads={"push": PUSH})
    along = found.along()
    return found.body("bar").position[:, 2], along.body("bar").velocity[:, 2], along.force("spring").rate


NUMBERS = jnp.array([5000.0, 0.4])


@pytest.fixture(scope="module")
def found():
    return of_lever(NUMBERS)


def differences(function, step):
    """Central differences of fourth order."""
    a, b, c, d = (np.asarray(function(i * step)) for i in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * step)


def test_positions_and_responses(found):
    """Large turns, 0.2 rad, of a spring that goes round its anchor."""
    angles = np.array([angle(push) for push in PUSH])
    assert angles[-1] > 0.2
    close(found[0], -0.5 * np.sin(angles), 16, scale=1.0)
    # h⁴/30 f⁽⁵⁾, measured as 1.4e-12 at h = 5 N, so 2e-15 at 1 N; round-off 1e-16/h
    rates = np.array([differences(lambda h, p=p: -0.5 * np.sin(angle(p + h)), 1.0) for p in PUSH])
    np.testing.assert_allclose(found[1], rates, rtol=0, atol=1e-14)


@pytest.mark.parametrize("modes", some_quick([[jax.jacrev], [jax.jacfwd, jax.jacrev]]))
def test_derivatives_of_equilibria_and_responses(found, modes):
    derivative, *others = (jax.jit(mode(of_lever))(NUMBERS) for mode in modes)
    for i, step in enumerate((10.0, 1e-3)):
        numbers = lambda h, i=i: np.asarray(NUMBERS.at[i].add(h))
        height = lambda h, numbers=numbers: [-0.5 * np.sin(angle(p, *numbers(h))) for p in PUSH]
        slope = lambda h, numbers=numbers: [
            differences(lambda d, p=p: -0.5 * np.sin(angle(p + d, *numbers(h))), 2.0) for p in PUSH
        ]
        for value, expected in zip(derivative, (height, slope)):
            # Differences leave (h/p)⁴ = (1e-3/0.4)⁴, 4e-11, by the load 3e-10, and 1e-16/h of round-off twice.
            scale = np.abs(value[:, i]).max()
            np.testing.assert_allclose(value[:, i], differences(expected, step), rtol=0, atol=1e-8 * scale)
    for one, other in [pair for same in others for pair in zip(derivative, same)]:
        close(one, other, 100)  # one linear operator and its transpose, of condition 10


@pytest.mark.parametrize("starts", some_quick([((3,),), ((),)]))
def test_series_parallel_and_starts(starts):
    """Springs in series and parallel, driven: λ = −k₁(k₂ + k₃)/(k₁ + k₂ + k₃) s, whichever point each begins from."""
    stiffness = {"one": 3e4, "two": 5e4, "three": 2e4}
    bodies = {
        name: lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(0.0, 0.0, z), free="z")
        for name, z in (("low", 1.0), ("high", 2.0))
    }
    ends = {"one": (None, "low", 0.0, 1.0), "two": ("low", "high", 1.0, 2.0), "three": ("low", "high", 1.0, 2.0)}
    forces = {
        name: lg.SpringDamper(a, b, at_a=(0.0, 0.0, za), at_b=(0.0, 0.0, zb), stiffness=stiffness[name])
        for name, (a, b, za, zb) in ends.items()
    }
    driver = lg.TranslationDriver(None, "high", at=(0.0, 0.0, 2.0), axis=(0.0, 0.0, 1.0))
    model = lg.Model(bodies, {"driver": driver}, forces)
    way = np.array([0.0, 0.1, 0.2, -0.1, -0.2])
    rate = 1.0 / (1.0 / 3e4 + 1.0 / 7e4)
    found = lg.statics(model, {"driver": way}, starts=starts, rates=[{"driver": 1.0}, {"driver": 2.0}])
    np.testing.assert_allclose(found.multiplier("driver")[:, 0], -rate * way, rtol=0, atol=1e-8 * rate * 0.2)
    for i in (0, 1):
        slopes = found.along(i).multiplier("driver")[:, 0]
        np.testing.assert_allclose(slopes, np.full(5, -(i + 1) * rate), rtol=1e-8)
    assert found.body("low").velocity.max() == 0.0  # at rest


def test_one_factorization_for_all_parameters():
    """The derivative by every number of the model adds one factorization, of a loop over the points."""
    model = lever()
    push = model.forces["push"].with_factor(jnp.zeros(()))
    system = lg.Model(model.bodies, model.joints, model.forces | {"push": push}).system()
    where = (drivers(system, "loads")["push"],)
    values, rates = jnp.asarray(PUSH[:, None]), jnp.ones((len(PUSH), 1, 1))
    zero = jnp.zeros(())
    place = lambda system: static_path(Drive(system, where), values, rates, zero).q.position[:, 0, 2]
    forward = jax.make_jaxpr(place)(system).jaxpr
    backward = jax.make_jaxpr(lambda s: jax.vjp(place, s)[1](jnp.ones(len(PUSH))))(system).jaxpr
    assert factorizations(backward) == factorizations(forward) + 1


def test_what_is_free_is_named():
    model = lever()
    wheel = lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0), position=(1.0, 0.0, 0.0))
    hub = lg.RevoluteJoint("bar", "wheel", at=(1.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    scene = lg.Model(model.bodies | {"wheel": wheel}, model.joints | {"hub": hub}, model.forces)
    with pytest.raises(ValueError, match=says("can move without any force", "What moves freely: wheel.", "point 0")):
        lg.statics(scene, loads={"push": PUSH})


def test_out_of_reach():
    driver = lg.TranslationDriver(None, "bar", at=(1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    model = lever()
    driven = lg.Model(model.bodies, model.joints | {"driver": driver}, model.forces)
    way = {"driver": [0.0, 0.5, 1.5]}
    with pytest.raises(lg.SimulationError, match=says("No static equilibrium", "at point 2", "driver = 1.5")):
        lg.statics(driven, way)
    found = lg.statics(driven, way, throw=False)
    assert found.result == lg.RESULTS.statics_failed
    assert np.isfinite(found.states.lam[:2]).all() and np.isnan(found.states.lam[2]).all()


@pytest.mark.slow  # that of positions that there are not is in the quick run, in test_kinematics.py
def test_out_of_reach_there_is_no_derivative():
    """Of a sum with NaN: it had that of the others."""
    driver = lg.TranslationDriver(None, "bar", at=(1.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    model = lever()

    def force(end, mass):
        bodies = {"bar": dataclasses.replace(model.bodies["bar"], mass=mass)}
        driven = lg.Model(bodies, model.joints | {"driver": driver}, model.forces)
        found = lg.statics(driven, {"driver": end * jnp.array([0.0, 1.0])}, throw=False)
        return jnp.sum(found.multiplier("driver")), found.result == lg.RESULTS.successful

    of_each = jax.vmap(jax.grad(force, argnums=1, has_aux=True), (0, None))
    slopes, known = jax.jit(of_each)(jnp.array([0.5, 1.5]), 2.0)
    np.testing.assert_array_equal(known, [True, False])
    np.testing.assert_allclose(slopes[0], -9.81, rtol=1e-12)  # half of the weight at either place: −g per mass
    assert np.isnan(slopes[1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"loads": {}}, says("`driven` and `loads` are empty", "['push']")),
        ({"loads": {"spring": [1.0]}}, says("`loads`: 'spring' is not one of ['push']", "AppliedForce")),
        ({"driven": {"hinge": [1.0]}}, says("`driven`: 'hinge' is not one of the drivers", "there are none")),
        ({"loads": {"push": 1.0}}, says("must hold vectors of one length", "()")),
        ({"rates": {"pull": 1.0}}, says("`rates`: ['pull'] are not among the driven ones ['push']")),
        ({"starts": (9,)}, says("`starts` must be indices of the 7 points, got [9]")),
        ({"starts": [(3,)]}, says("`starts` must be indices of the 7 points, got [(3,)]")),
        ({"model": 3.0}, says("`model` must be a Model, got float")),
    ],
)
def test_bad_input(arguments, message):
    settings = {"loads": {"push": PUSH}} | arguments
    model = settings.pop("model", None) or lever()
    with pytest.raises(ValueError, match=message):
        lg.statics(model, **settings)


@pytest.mark.slow
def test_a_fixed_moment_is_a_load():
    """About the axis of a hinge it turns the bar as the moment that turns with it does, and both add to a force."""
    axis, fixed = {"axis": (0.0, 1.0, 0.0)}, {"fixed_moment": (0.0, 1.0, 0.0)}
    up = {"at": (0.5, 0.0, 0.0), "force": (0.0, 0.0, 1.0), "follows": True}  # −0.5 N m about y, however it turns
    loads, moments = {"one": fixed, "other": up | fixed}, {"one": 1.0, "other": 0.5}
    bodies, joints, forces = {}, {}, {}
    for bar, load in loads.items():  # two bars that have nothing to do with each other
        bodies[bar] = lg.RigidBody(2.0, (0.1, 0.1, 0.1), position=(0.5, 0.0, 0.0), free="x z ry")
        joints[bar] = lg.RevoluteJoint(None, bar, at=(0.0, 0.0, 0.0), **axis)
        forces[f"spring of {bar}"] = lg.TorsionSpringDamper(None, bar, stiffness=100.0, **axis)
        forces[bar] = lg.AppliedForce(bar, **load)
    found = lg.statics(lg.Model(bodies, joints, forces), loads=dict.fromkeys(loads, np.array([0.0, 10.0])))
    along, table = found.along(), found.to_pandas()
    assert table["one.factor"].tolist() == table["other.factor"].tolist() == [0.0, 10.0] and table["stable"].all()
    for bar, moment in moments.items():
        # round-off of angles of 0.1 rad in rotations and their logarithm, a few
        np.testing.assert_allclose(found.joint(bar).angle, [0.0, 0.1 * moment], atol=1e-13)
        np.testing.assert_allclose(along.joint(bar).rate, [0.01 * moment] * 2, rtol=1e-11)


@pytest.mark.slow
def test_points_that_start_anew_are_told_from_the_first():
    """Upwards to 3 rad and then downwards to −3 rad, 6 rad apart: the moment is that of the spring all the way."""
    axis = {"axis": (0.0, 0.0, 1.0)}
    joints = {"drive": lg.RotationDriver(None, "rotor", **axis)}
    spring = {"spring": lg.TorsionSpringDamper(None, "rotor", stiffness=2.0, **axis)}
    model = lg.Model({"rotor": lg.RigidBody(1.0, (0.1, 0.1, 0.2), free="rz")}, joints, spring)
    angles = np.array([0.0, 1.5, 3.0, -1.5, -3.0])
    found = lg.statics(model, driven={"drive": angles}, starts=(3,))
    np.testing.assert_allclose(-found.multiplier("drive")[:, 0], 2.0 * angles, atol=1e-11)  # round-off of Newton
    with pytest.raises(lg.SimulationError, match=says("passes half a turn", "before position 3")):
        lg.statics(model, driven={"drive": angles})


@pytest.mark.slow
@pytest.mark.parametrize("thickness", [0.01, 1e-4])
def test_a_beam_that_is_bent_by_three_radians_at_once(thickness):
    """To an arc, of which the end is known; along the tangent it would be stretched by half of its length."""
    section = lg.BeamSection.rectangle(0.03, thickness, young=2.1e11, poisson=0.3, density=7850.0)
    beam = lg.Beam("beam", section, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], elements=8)
    joints = {
        "clamp": lg.FixedJoint(None, "beam.0", at=(0.0, 0.0, 0.0)),
        "turn": lg.RotationDriver(None, "beam.8", axis=(0.0, 1.0, 0.0)),
    }
    found = lg.statics(lg.Model(beam.bodies, joints, beam.forces), {"turn": [0.0, 3.0]})
    end = np.array([np.sin(3.0), 0.0, np.cos(3.0) - 1.0]) / 3.0
    # exact for any number of elements; of round-off 1e-16 times the condition, EA L²/EI of 1e9
    np.testing.assert_allclose(found.body("beam.8").position[1], end, rtol=0, atol=1e-7)


@pytest.mark.slow  # an assembled column of rods
@pytest.mark.parametrize("points", [2, 4])
def test_a_column_does_not_jump_to_a_branch_that_is_unstable(points):
    """At three times Euler's load, with 2 % of E I aside; against the elastica of a cantilever."""
    length, bending = 1.0, 4.0
    section = lg.BeamSection([1e6, 1e6, 1e6, bending, bending, bending], mass=1.0, inertia=(1e-3, 1e-3, 1e-3))
    beam = lg.Beam("beam", section, [[0.0, 0.0, 0.0], [length, 0.0, 0.0]], elements=10)
    critical = np.pi**2 * bending / (4.0 * length**2)
    loads = {
        "down": lg.AppliedForce("beam.10", at=(length, 0.0, 0.0), force=(-critical, 0.0, 0.0)),
        "aside": lg.AppliedForce("beam.10", at=(length, 0.0, 0.0), force=(0.0, 0.0, 0.02 * bending)),
    }
    joints = {"clamp": lg.FixedJoint(None, "beam.0", at=(0.0, 0.0, 0.0))}
    model = lg.Model(beam.bodies, joints, beam.forces | loads)
    way = {"down": np.linspace(0.0, 3.0, points), "aside": np.ones(points)}
    found = np.asarray(lg.statics(model, loads=way).body("beam.10").position[-1])

    def tip(moment):
        """The end of E I θ″ = −P sin θ − S cos θ from the clamp, θ = 0, with this moment there."""
        P, S = 3.0 * critical, 0.02 * bending
        slope = lambda s, y: [y[1], (-P * np.sin(y[0]) - S * np.cos(y[0])) / bending, np.cos(y[0]), np.sin(y[0])]
        return solve_ivp(slope, (0.0, length), [0.0, moment / bending, 0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]

    moment = brentq(lambda moment: tip(moment)[1], 10.0, 40.0)
    # the mesh's error: 1/(12·10²) of the curvature, largest 5 rad/m, over the length
    np.testing.assert_allclose(found[[0, 2]], tip(moment)[2:], atol=5e-3)


@pytest.mark.slow  # `test_out_of_reach` is in the quick run
def test_lengths_that_cannot_be_closed_are_out_of_reach():
    """Not something that moves freely, as K is singular where the triangle closes. The path is lost there."""
    rods = {
        name: lg.DistanceJoint(None, "point", at_a=at, at_b=(0.0, 0.0, 0.5))
        for name, at in (("left", (-0.3, 0.0, 0.0)), ("right", (0.3, 0.0, 0.0)))
    }
    point = {"point": lg.RigidBody(1.0, None, position=(0.0, 0.0, 0.5), free="x z")}
    model = lg.Model(point, rods, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    lengths = np.array([0.58, 0.4, 0.31, 0.2, 0.4, 0.45])
    way = {"left": lengths, "right": lengths}
    with pytest.raises(lg.SimulationError, match=says("No static equilibrium", "at point 3", "left = 0.2")):
        lg.statics(model, way)
    for moved in (lg.statics, lg.kinematics):
        with pytest.raises(ValueError, match=says("`driven['left']` is the distance", "must be positive, got -0.1 m")):
            moved(model, {"left": [0.58, -0.1], "right": [0.58, 0.58]})
    found = lg.statics(model, way, starts=[5], throw=False)
    height = np.sqrt(lengths**2 - 0.3**2, where=lengths > 0.3, out=np.full(6, np.nan))
    height[4] = np.nan  # after it, and before the next start
    np.testing.assert_allclose(found.body("point").position[:, 2], height, rtol=1e-12)


@pytest.mark.parametrize("off", [0.0, 0.5])
def test_what_weight_alone_holds_is_held(off):
    """A pendulum under a force aside, tan θ = F/mg, from below its pivot or from elsewhere; and by its mass."""
    at = np.array([np.sin(off), 0.0, -np.cos(off)])

    def angles(mass):
        body = {"bob": lg.RigidBody(mass, (0.1, 0.1, 0.1), position=at)}
        hinge = {"hinge": lg.RevoluteJoint(None, "bob", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))}
        forces = {"aside": lg.AppliedForce("bob", at=at, force=(9.81, 0.0, 0.0)), "g": lg.Gravity((0.0, 0.0, -9.81))}
        found = lg.statics(lg.Model(body, hinge, forces), loads={"aside": [0.0, 0.5, 1.0]}).body("bob").position
        return jnp.arctan2(found[:, 0], -found[:, 2])

    found, by_mass = jax.jvp(angles, (1.0,), (1.0,))
    tangent = np.array([0.0, 0.5, 1.0])
    np.testing.assert_allclose(found, np.arctan(tangent), atol=1e-13)  # round-off
    np.testing.assert_allclose(by_mass, -tangent / (1.0 + tangent**2), atol=1e-12)


RISE, HALF, RATE = 0.2, 1.0, 1e4  # m, m, N/m


def shallow_truss() -> lg.Model:
    """A point over the middle of two springs that lean against each other, under a load downwards."""
    top = (0.0, 0.0, RISE)
    springs = {
        name: lg.SpringDamper(None, "top", at_a=(x, 0.0, 0.0), at_b=top, stiffness=RATE)
        for name, x in (("left", -HALF), ("right", HALF))
    }
    load = {"load": lg.AppliedForce("top", at=top, force=(0.0, 0.0, -1.0))}
    return lg.Model({"top": lg.RigidBody(1.0, None, position=top, free="z")}, {}, springs | load)


def truss_load(z):
    """The load that it carries at a height, from the lengths of its springs."""
    length = np.hypot(HALF, z)
    return 2.0 * RATE * (np.hypot(HALF, RISE) - length) * z / length


@pytest.mark.parametrize("points", some_quick([5, 3, 20]))
def test_a_truss_snaps_through_and_back_where_its_load_has_its_extremes(points):
    """Whatever the number of points, and it is said of the point behind the limit."""
    peak = minimize_scalar(lambda z: -truss_load(z), bounds=(0.0, RISE), method="bounded", options={"xatol": 1e-12})
    limit, loads = -peak.fun, np.linspace(0.0, 1.5 * -peak.fun, points)
    loads = np.concatenate([loads, -loads[1:]]) if points > 3 else loads
    found = lg.statics(shallow_truss(), loads={"load": loads})
    below = np.maximum.accumulate(loads > limit) & ~np.maximum.accumulate(loads < -limit)
    far = 2.0 * RISE
    height = [
        brentq(lambda z, load=load: truss_load(z) - load, *((-far, -peak.x) if low else (peak.x, far)), xtol=1e-14)
        for load, low in zip(loads, below)
    ]
    np.testing.assert_allclose(found.body("top").position[:, 2], height, atol=1e-12)  # round-off over the slope
    np.testing.assert_array_equal(found.snapped, np.diff(below, prepend=False))
    assert found.stable.all()


@pytest.mark.slow  # `test_a_truss_snaps_through_and_back_where_its_load_has_its_extremes` is in the quick run
def test_a_snap_is_said_however_loads_are_spaced():
    """Close to the limit the tangent has no bound, and may point past the other branch, or by chance right at it."""
    limit = -minimize_scalar(lambda z: -truss_load(z), bounds=(0.0, RISE), method="bounded").fun
    model, rng = shallow_truss(), np.random.default_rng(1)
    for _ in range(100):
        loads = np.concatenate([[0.0], rng.uniform(0.1, 0.999, 1), rng.uniform(1.001, 10.0, 1)]) * limit
        found = lg.statics(model, loads={"load": loads})
        assert found.body("top").position[1, 2] > 0.0 > found.body("top").position[2, 2]
        np.testing.assert_array_equal(found.snapped, [False, False, True])


@pytest.mark.slow
def test_a_perfect_column_stays_straight_and_is_said_to_be_unstable():
    """Above its critical load, that of a chain of `elements` with a hinge's stiffness E I/h and rigid in shear."""
    elements, bending = 6, 4.0
    section = lg.BeamSection([1e8, 1e8, 1e8, bending, bending, bending], mass=1.0, inertia=(1e-3, 1e-3, 1e-3))
    beam = lg.Beam("beam", section, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], elements=elements)
    load = {"down": lg.AppliedForce(f"beam.{elements}", at=(1.0, 0.0, 0.0), force=(-1.0, 0.0, 0.0))}
    clamp = {"clamp": lg.FixedJoint(None, "beam.0", at=(0.0, 0.0, 0.0))}
    critical = np.pi**2 * bending / 4.0
    loads = critical * np.array([0.0, 0.97, 1.03, 1.2])
    found = lg.statics(lg.Model(beam.bodies, clamp, beam.forces | load), loads={"down": loads})
    # the mesh's load is another by (π/2)²/(12·6²) = 0.6 %
    np.testing.assert_array_equal(found.stable, [True, True, False, False])
    assert not found.snapped.any()
    np.testing.assert_allclose(found.body(f"beam.{elements}").position[:, [1, 2]], 0.0, atol=1e-12)
