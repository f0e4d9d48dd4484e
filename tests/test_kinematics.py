"""Driven mechanisms against closed solutions in the plane, differences of those, power balance, and bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRAVITY, close, factorizations, random_body, random_rotation, says, some_quick

import lgsens as lg
from lgsens.dynamics import positions
from lgsens.examples import four_bar

LENGTHS = {"a": 0.3, "b": 0.8, "c": 0.7, "d": 0.9}
START = 1.2  # angle of the crank in the reference configuration [rad]
ANGLES = np.linspace(0.0, 4 * np.pi, 61)  # two turns
RATE = 5.0
# Newton ends where Φ, of order 1 m, is at round-off; the transmission angle of this linkage stays above 30°.
ULPS = 64


def driven_four_bar(**lengths) -> lg.Model:
    model = four_bar(**lengths)
    motor = lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0))
    return lg.Model(model.bodies, model.joints | {"motor": motor}, model.forces)


class Linkage:
    """The four-bar as every textbook closes it: C is where two circles meet, above the line BD."""

    def __init__(self, angle, a=0.3, b=0.8, c=0.7, d=0.9):
        angle = np.asarray(angle, float) + START
        self.b = a * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        span = np.array([d, 0.0]) - self.b
        distance = np.linalg.norm(span, axis=-1, keepdims=True)
        along = (b**2 - c**2 + distance**2) / (2 * distance)
        height = np.sqrt(b**2 - along**2)
        unit = span / distance
        self.c = self.b + along * unit + height * unit[..., ::-1] * [-1.0, 1.0]
        self.d = np.broadcast_to(np.array([d, 0.0]), self.b.shape)
        self.coupler = (self.b + self.c) / 2

    def energy(self, time):
        """Kinetic energy, weight and the spring's energy of a motion over time, and the power of its damper."""
        rate = lambda x: np.gradient(x, time, axis=0, edge_order=2)
        kinetic = potential = 0.0
        for mass, start, end in ((1.0, 0 * self.b, self.b), (2.0, self.b, self.c), (1.5, self.d, self.c)):
            # a slender rod: m/6 (v₁² + v₁·v₂ + v₂²)
            one, two = rate(start), rate(end)
            kinetic = kinetic + mass / 6 * np.sum(one**2 + one * two + two**2, axis=1)
            potential = potential + mass * 9.81 * (start + end)[:, 1] / 2
        length = np.linalg.norm(self.coupler - [0.45, 1.1], axis=1)
        return kinetic + potential + 100.0 * (length - 0.4) ** 2, 2.0 * rate(length) ** 2


@pytest.fixture(scope="module")
def turning():
    return lg.kinematics(driven_four_bar(), {"motor": ANGLES}, rates={"motor": RATE})


def test_positions_of_the_four_bar(turning):
    expected = Linkage(ANGLES)
    assert turning.result == lg.RESULTS.successful
    np.testing.assert_array_equal(turning.values["motor"], ANGLES)
    found = turning.body("coupler").position
    close(found[:, :2], expected.coupler, ULPS, scale=1.0)
    close(found[:, 2], np.zeros(len(ANGLES)), ULPS, scale=1.0)
    axis = turning.body("rocker").orientation[:, :2, 0]  # the body frame of the rocker is the inertial one at first
    reference = Linkage(0.0)
    turned = lambda v: np.arctan2(v[..., 1], v[..., 0])
    angle = turned(expected.c - expected.d) - turned(reference.c - reference.d)
    close(axis, np.stack([np.cos(angle), np.sin(angle)], axis=1), ULPS, scale=1.0)


def test_velocities_and_accelerations_of_the_four_bar(turning):
    """Central differences of fourth order of the closed solution: h⁴/30 f⁽⁵⁾ + ε/h, ε/h² for the second."""
    h = 1e-3
    at = [Linkage(ANGLES + i * h).coupler for i in range(-2, 3)]
    first = (at[0] - 8 * at[1] + 8 * at[3] - at[4]) / (12 * h)
    second = (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * h**2)
    motion = turning.body("coupler")
    np.testing.assert_allclose(motion.velocity[:, :2], RATE * first, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.acceleration[:, :2], RATE**2 * second, rtol=0, atol=1e-7)


def test_the_motor_does_the_work():
    """−λ θ̇ = d(T + V)/dt + power of the damper, by differences of the energies of the closed solution."""
    time = np.linspace(0.0, 1.0, 20_001)
    angle = RATE * time
    energy, damper = Linkage(angle).energy(time)
    power = np.gradient(energy, time, edge_order=2) + damper
    chosen = slice(1000, -1000, 2000)  # away from the ends, where differences are one-sided
    found = lg.kinematics(driven_four_bar(), {"motor": angle[chosen]}, rates={"motor": RATE})
    moment = -found.multiplier("motor")[:, 0]
    # Two differences over h = 5e-5 s of a motion with rates of some 20 rad/s: (20 h)²/3 = 3e-7 of the powers, 90 W.
    np.testing.assert_allclose(moment * RATE, power[chosen], rtol=0, atol=1e-4)


def test_without_rates_the_forces_are_those_at_rest():
    """The moment that holds the crank is the derivative of weight and spring energy by its angle."""
    model = driven_four_bar()
    found = lg.kinematics(model, {"motor": ANGLES}, rates={})

    def potential(angle):
        closed = Linkage(angle)
        weight = 9.81 * (closed.b[:, 1] / 2 + closed.b[:, 1] + closed.c[:, 1] + 0.75 * closed.c[:, 1])
        return weight + 100.0 * (np.linalg.norm(closed.coupler - [0.45, 1.1], axis=1) - 0.4) ** 2

    h = 1e-3
    slope = (
        8 * (potential(ANGLES + h) - potential(ANGLES - h)) - potential(ANGLES + 2 * h) + potential(ANGLES - 2 * h)
    ) / (12 * h)
    np.testing.assert_array_equal(found.body("coupler").velocity, np.zeros((len(ANGLES), 3)))
    # Fourth-order differences of some 40 J: ε·40/h = 1e-11, h⁴/30 f⁽⁵⁾ with f⁽⁵⁾ of order 1e3.
    np.testing.assert_allclose(-found.multiplier("motor")[:, 0], slope, rtol=0, atol=1e-9)


def coupler(lengths, angles):
    model = driven_four_bar(**lengths)
    return lg.kinematics(model, {"motor": angles}).body("coupler").position[:, :2]


@pytest.mark.parametrize("mode", some_quick([jax.jacrev, jax.jacfwd]))
def test_gradients_equal_differences_of_the_closed_solution(mode):
    angles = jnp.asarray(ANGLES[:7])
    lengths = {name: jnp.asarray(value) for name, value in LENGTHS.items()}
    by_length, by_angle = jax.jit(mode(coupler, argnums=(0, 1)))(lengths, angles)
    h = 1e-3
    along = lambda change: Linkage(ANGLES[:7] + change.pop("angle", 0.0), **(LENGTHS | change)).coupler
    for name in (*LENGTHS, "angle"):
        base = LENGTHS.get(name, 0.0)
        shifted = [along({name: base + i * h}) for i in (-2, -1, 1, 2)]
        expected = (shifted[0] - 8 * shifted[1] + 8 * shifted[2] - shifted[3]) / (12 * h)
        if name == "angle":  # each position depends on its own angle only
            found = by_angle[np.arange(7), :, np.arange(7)]
            others = np.asarray(by_angle).copy()
            others[np.arange(7), :, np.arange(7)] = 0.0
            assert not others.any()
        else:
            found = by_length[name]
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-10, err_msg=name)  # h⁴/30 f⁽⁵⁾, f⁽⁵⁾ to 1e3


@pytest.mark.slow
def test_second_derivatives_and_batches():
    """A Hessian through the rule, and the rule under vmap: differences of the gradient, one design at a time."""
    angles = jnp.asarray(ANGLES[:3])

    def height(x):
        lengths = dict(zip(sorted(LENGTHS), x))
        return jnp.sum(coupler(lengths, angles)[:, 1] ** 2)

    x = jnp.asarray([LENGTHS[name] for name in sorted(LENGTHS)])
    gradient = jax.jit(jax.grad(height))
    hessian = jax.jit(jax.hessian(height))(x)
    h = 1e-5
    columns = [(gradient(x + h * e) - gradient(x - h * e)) / (2 * h) for e in jnp.eye(4)]
    # h²/6 f‴ + ε/h, third derivatives of some 100
    np.testing.assert_allclose(hessian, np.stack(columns, axis=1), rtol=0, atol=1e-7)
    designs = x[None] + 0.02 * jnp.asarray(np.random.default_rng(0).normal(size=(4, 4)))
    batched = jax.jit(jax.vmap(jax.grad(height)))(designs)
    close(
        batched, np.stack([gradient(each) for each in designs]), 1000
    )  # of order 1, Newton's end differs by round-off


def test_one_factorization_for_all_parameters():
    """The derivative by every number of the model adds one factorization, a batch over the positions."""
    from lgsens.analysis._driven import Drive, drivers

    system = driven_four_bar().system()
    values = jnp.asarray(ANGLES[:5, None])
    where = (drivers(system)["motor"],)
    place = lambda system: positions(Drive(system, where), values, jnp.zeros(5)).q.position[:, 1]
    forward = jax.make_jaxpr(place)(system).jaxpr
    backward = jax.make_jaxpr(lambda s: jax.vjp(place, s)[1](jnp.ones((5, 3))))(system).jaxpr
    assert factorizations(backward) == factorizations(forward) + 1


def lifted(height, **free):
    """A bar of 2 m hinged at its left end, and a cylinder from 0.5 m below the hinge to its middle."""
    bar = lg.RigidBody(mass=3.0, inertia=(0.01, 1.0, 1.0), position=(1.0, 0.0, 0.0))
    joints = {
        "hinge": lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        "cylinder": lg.DistanceJoint(None, "bar", at_a=(0.0, 0.0, -height), at_b=(1.0, 0.0, 0.0), **free),
    }
    return lg.Model({"bar": bar}, joints, {"gravity": lg.Gravity(GRAVITY)})


def test_a_cylinder_lifts_a_bar():
    """Law of cosines: ℓ² = 1 + ½² + sin φ for the slope φ; its force is m g times dz/dℓ of the centre."""
    lengths = np.linspace(1.0, 1.4, 9)
    found = lg.kinematics(lifted(0.5), {"cylinder": lengths}, rates={"cylinder": 0.0})
    sine = lengths**2 - 1.25
    close(found.body("bar").position[:, 2], sine, ULPS, scale=1.0)
    # the tension is minus the thrust m g dz/dℓ = m g 2ℓ
    close(found.multiplier("cylinder")[:, 0], -3.0 * 9.81 * 2 * lengths, ULPS)


@pytest.mark.slow  # what it lifts is in the quick run
def test_forces_of_a_cylinder_are_those_of_its_length():
    """Its force from the moments about the hinge, at lengths of 1.4 times the reference; with the hinge it carries the
    weight."""
    foot, head, weight = np.array([1.0, -0.5]), np.array([2.5, 1.6]), 98.1
    bar = lg.RigidBody(10.0, (1.0, 1.0, 1.0), position=(2.5, 1.0, 0.0), free="x y rz")
    joints = {
        "pin": lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        "cylinder": lg.DistanceJoint(None, "bar", at_a=(*foot, 0.0), at_b=(*head, 0.0)),
    }
    model = lg.Model({"bar": bar}, joints, {"gravity": lg.Gravity((0.0, -9.81, 0.0))})

    def thrust(length):
        near, far = np.hypot(*foot), np.hypot(*head)
        cosine = (near**2 + far**2 - length**2) / (2 * near * far)
        turn = np.arccos(cosine) + np.arctan2(*foot[::-1]) - np.arctan2(*head[::-1])
        arm = near * far * np.sqrt(1 - cosine**2) / length
        return weight * (2.5 * np.cos(turn) - 1.0 * np.sin(turn)) / arm

    lengths = np.array([2.6, 3.0, 3.6])
    for run in (lg.kinematics(model, {"cylinder": lengths}, rates={}), lg.statics(model, {"cylinder": lengths})):
        close(np.abs(run.joint("cylinder").axial_force), thrust(lengths), ULPS, scale=200.0)
        close(run.joint("cylinder").force[:, 1] + run.joint("pin").force[:, 1], np.full(3, weight), ULPS, scale=200.0)


@pytest.mark.slow
def test_two_drivers_move_a_body_as_they_say():
    """A slide along an axis of a tilted body, and a turn beyond a whole one about another: the products of both."""
    rng = np.random.default_rng(5)
    tilt = random_rotation(rng)
    stage = random_body(rng, orientation=tilt, free=())
    axis = tilt @ np.array([0.0, 0.0, 2.0])
    tool = random_body(rng, position=(0.3, 0.2, -0.1))
    joints = {
        "sleeve": lg.CylindricalJoint("stage", "tool", at=(0.3, 0.2, -0.1), axis=axis),
        "lift": lg.TranslationDriver("stage", "tool", at=(0.3, 0.2, -0.1), axis=axis),
        "turn": lg.RotationDriver("stage", "tool", axis=axis),
    }
    model = lg.Model({"stage": stage, "tool": tool}, joints)
    angles, lifts = np.linspace(0.3, 9.0, 12), np.linspace(0.1, -0.6, 12)
    found = lg.kinematics(model, {"turn": angles, "lift": lifts}, rates={"turn": 2.0, "lift": 0.5})
    unit = axis / 2.0
    close(found.body("tool").position, np.array([0.3, 0.2, -0.1]) + lifts[:, None] * unit, ULPS, scale=1.0)
    for i, angle in enumerate(angles):
        close(found.body("tool").orientation[i], about(unit, angle) @ np.asarray(tool.orientation), ULPS)
    close(found.body("tool").velocity, np.broadcast_to(0.5 * unit, (12, 3)), ULPS, scale=1.0)
    inertial = np.einsum("nij,nj->ni", found.body("tool").orientation, found.body("tool").angular_velocity)
    close(inertial, np.broadcast_to(2.0 * unit, (12, 3)), ULPS, scale=2.0)


def about(unit, angle):
    """Rodrigues' formula."""
    cross = np.array([[0.0, -unit[2], unit[1]], [unit[2], 0.0, -unit[0]], [-unit[1], unit[0], 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.mark.slow
def test_a_driver_with_a_value_is_assembled_there():
    """In dynamics a driver holds its coordinate: with a value, where it says, and the moment is that at rest."""
    model = driven_four_bar()
    motor = {"motor": lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0), value=0.4)}
    still = lambda body: lg.RigidBody(body.mass, body.inertia, body.position, body.orientation)
    held = lg.Model({name: still(body) for name, body in model.bodies.items()}, model.joints | motor, model.forces)
    state = lg.initial_state(held)
    expected = lg.kinematics(model, {"motor": [0.4]}, rates={})
    close(state.q.position, expected.states.q.position[0], ULPS, scale=1.0)
    close(state.lam[held.system().multiplier_rows("motor")], expected.multiplier("motor")[0], 1000, scale=10.0)


def test_out_of_reach():
    """With a crank of 0.7 m B comes too far from D; what was found before stands, and behind it the way is lost: the
    linkage can be closed on either side."""
    angles = np.linspace(0.0, 3.0, 31)
    model = driven_four_bar(a=0.7)
    distance = np.linalg.norm(
        np.array([0.9, 0.0]) - 0.7 * np.stack([np.cos(angles + START), np.sin(angles + START)], 1), axis=1
    )
    reached = distance < 0.8 + 0.7
    first = int(np.argmin(reached))
    assert first > 0 and reached[-1]
    message = says("No position satisfies", f"at position {first}", "driven values", "largest in joint")
    with pytest.raises(ValueError, match=message):
        lg.kinematics(model, {"motor": angles})
    found = lg.kinematics(model, {"motor": angles}, throw=False)
    assert found.result == lg.RESULTS.position_failed
    np.testing.assert_array_equal(np.isfinite(found.body("coupler").position[:, 0]), np.arange(31) < first)
    close(found.body("coupler").position[:first, :2], Linkage(angles[:first], a=0.7).coupler, 1000, scale=1.0)


@pytest.mark.parametrize("derivative", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.jacrev])
@pytest.mark.parametrize("begin", some_quick([1.5, 0.0]))
def test_what_is_asked_of_positions_that_there_are_not_has_no_derivative(begin, derivative):
    """Nor is it zero where all rows are NaN: at 1.5 rad a crank of 0.7 m and the rocker are too far apart at once. Of a
    batch the others have theirs, by what all of them share."""
    angles = jnp.asarray(begin + np.linspace(0.0, 2.0, 3))

    def swing(a, rocker):
        found = lg.kinematics(driven_four_bar(a=a, c=0.7 * rocker), {"motor": angles}, throw=False)
        return jnp.sum(found.body("rocker").position), found.result == lg.RESULTS.successful

    def masked(a, rocker):
        value, known = swing(a, rocker)
        return jnp.where(known, value, 0.0)

    cranks = jnp.array([0.3, 0.7])
    of_each = jax.vmap(derivative(swing, argnums=1, has_aux=True), (0, None))
    of_all = derivative(lambda rocker: jnp.sum(jax.vmap(masked, (0, None))(cranks, rocker)))
    (slopes, known), together = jax.jit(lambda rocker: (of_each(cranks, rocker), of_all(rocker)))(1.0)
    np.testing.assert_array_equal(known, [True, False])
    np.testing.assert_array_equal(np.isnan(slopes), [False, True])
    close(together, slopes[0], ULPS)
    assert abs(slopes[0]) > 0.01


def test_a_singular_position_is_named():
    """At ℓ = 1.5 m the bar stands upright above the cylinder: dφ/dℓ = 2ℓ/cos φ is infinite. With cos φ = 2e-4 it is
    not, the force is still m g 2ℓ; cos φ comes from 1 − sin φ, round-off over 2e-8."""
    near = np.sqrt(2.25 - 2e-8)
    message = says("singular", "at position 2", "cylinder = 1.5", "another coordinate")
    with pytest.raises(ValueError, match=message):
        lg.kinematics(lifted(0.5), {"cylinder": [1.4, near, 1.5, 1.4]})
    found = jax.jit(lambda lengths: lg.kinematics(lifted(0.5), {"cylinder": lengths}))([1.4, near, 1.5, 1.4])
    assert found.result == lg.RESULTS.singular_configuration
    with pytest.raises(lg.SimulationError, match="singular"):
        lg.raise_if_failed(found)
    found = lg.kinematics(lifted(0.5), {"cylinder": [1.4, near, 1.5, 1.4]}, throw=False)
    np.testing.assert_array_equal(np.isfinite(found.multiplier("cylinder")[:, 0]), [True, True, False, False])
    slope = -found.body("bar").angular_velocity[1, 1]
    np.testing.assert_allclose(slope, 2 * near / np.sqrt(1 - (1 - 2e-8) ** 2), rtol=ULPS * 2.3e-16 / 2e-8)


@pytest.mark.slow  # `test_a_singular_position_is_named` is in the quick run
def test_a_reference_that_is_singular_is_named():
    """Nothing says which way an upright bar falls when the cylinder becomes shorter."""
    bar = lg.RigidBody(mass=3.0, inertia=(0.01, 1.0, 1.0), position=(0.0, 0.0, 1.0), free="x z ry")
    joints = {
        "hinge": lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0)),
        "cylinder": lg.DistanceJoint(None, "bar", at_a=(0.0, 0.0, -0.5), at_b=(0.0, 0.0, 1.0)),
    }
    model = lg.Model({"bar": bar}, joints, redundant="minimum_norm")
    for length in (1.4, 1.5):
        with pytest.raises(ValueError, match=says("its reference", "at position 0", f"cylinder = {length}")):
            lg.kinematics(model, {"cylinder": [length]})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"driven": {}}, says("`driven` is empty", "['motor']")),
        ({"driven": {"B": [0.0]}}, says("`driven`: 'B' is not one of ['motor']", "drivers and distance joints")),
        ({"driven": {"motor": 0.0}}, says("`driven` must hold vectors of one length", "()")),
        ({"driven": {"motor": []}}, says("`driven` must hold vectors of one length", "(0,)")),
        ({"rates": {"moter": 1.0}}, says("`rates`: 'moter' is not one of ['motor']")),
        ({"driven": {"motor": [0.0, np.nan]}}, says("`driven['motor']` must be finite, got nan at place [1]")),
        ({"rates": {"motor": [1.0, 2.0, 3.0]}}, says("`rates` must have shape () or (1,)", "(3,)")),
        ({"t": [0.0]}, says("`rates`: with `t`", "['motor']", "rates={}")),
        ({"model": 3.0}, says("`model` must be a Model, got float")),
    ],
)
def test_bad_input(arguments, message):
    arguments = {"model": driven_four_bar(), "driven": {"motor": [0.0]}} | arguments
    with pytest.raises(ValueError, match=message):
        lg.kinematics(**arguments)


def test_degrees_of_freedom_must_be_driven():
    loose = lifted(0.5)
    bar, hinge = loose.bodies["bar"], loose.joints["hinge"]
    motor = {name: lg.RotationDriver(None, "bar", axis=(0.0, y, 0.0)) for name, y in (("one", 1.0), ("two", 2.0))}
    over = lg.Model({"bar": bar}, {"hinge": hinge, **motor})
    with pytest.raises(ValueError, match=says("6 coordinates and 7 equations", "Drive fewer")):
        lg.kinematics(over, {"one": [0.1]})
    under = lg.Model({"bar": bar}, {"one": motor["one"]})
    with pytest.raises(ValueError, match=says("6 coordinates and 1 equations", "['one'] included", "Drive more")):
        lg.kinematics(under, {"one": [0.1]})


def hinged_four_bar(length, *, planar: bool) -> lg.Model:
    """Of four hinges with parallel axes: three of their equations are redundant where bodies are not `planar`."""
    at = jnp.asarray([[0.0, 0.0, 0.0], [0.1, 0.3, 0.0], [0.7, 0.5, 0.0], [0.8, 0.0, 0.0]])
    at, axis = at.at[2, 0].add(length), (0.0, 0.0, 1.0)
    names, free = ("crank", "coupler", "rocker"), "x y rz" if planar else None
    bodies = {
        name: lg.RigidBody(1.0, (0.01, 0.02, 0.025), position=(at[i] + at[i + 1]) / 2, free=free)
        for i, name in enumerate(names)
    }
    ends = [(None, "crank"), ("crank", "coupler"), ("coupler", "rocker"), ("rocker", None)]
    joints = {f"hinge{i}": lg.RevoluteJoint(*pair, at=at[i], axis=axis) for i, pair in enumerate(ends)}
    joints["motor"] = lg.RotationDriver(None, "crank", axis=axis)
    redundant = "refuse" if planar else "minimum_norm"
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, -9.81, 0.0))}, redundant=redundant)


@jax.jit
def looked_at(found):
    rocker = found.body("rocker")
    parts = rocker.position, rocker.orientation, rocker.acceleration, found.multiplier("motor")
    return jnp.concatenate([part.ravel() for part in parts])


def run_hinged(length, *, planar):
    angles = np.linspace(0.0, 1.5, 4)
    return lg.kinematics(hinged_four_bar(length, planar=planar), {"motor": angles}, rates={"motor": RATE})


@pytest.mark.slow
def test_redundant_hinges():
    """The motion and what is unique of the forces are those of the same mechanism without the equations too many."""
    found = run_hinged(0.0, planar=False)
    # round-off in bars of 0.3 to 1 m, times ω² of up to 15² 1/s² in accelerations
    np.testing.assert_allclose(looked_at(found), looked_at(run_hinged(0.0, planar=True)), rtol=1e-11, atol=1e-11)
    # what hinges share they need not bear: no moments, and no forces out of the plane
    forces = jnp.stack([found.multiplier(f"hinge{i}") for i in range(4)])
    np.testing.assert_allclose(forces[..., 2:], 0.0, atol=1e-11 * float(jnp.max(jnp.abs(forces))))


@pytest.mark.slow  # two more programs; gradients by lengths are in the quick run, those of redundant joints of the door
def test_gradients_of_redundant_hinges_are_those_of_differences():
    step = 1e-5
    gradient = jax.jacrev(lambda length: looked_at(run_hinged(length, planar=False)))(0.0)
    after, before = (looked_at(run_hinged(sign * step, planar=True)) for sign in (1.0, -1.0))
    # h² times third derivatives over the 0.1 m of the shortest distance, cubed, and round-off over h
    np.testing.assert_allclose(gradient, (after - before) / (2 * step), rtol=1e-6, atol=1e-6)


@pytest.mark.slow  # two more programs
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradients_of_redundant_hinges_are_exact(mode):
    redundant, planar = (mode(lambda length, of=of: looked_at(run_hinged(length, planar=of)))(0.0) for of in (0, 1))
    np.testing.assert_allclose(redundant, planar, rtol=1e-11, atol=1e-11)  # as above


def test_redundant_hinges_are_refused_unless_asked_for():
    model = hinged_four_bar(0.0, planar=False)
    refusing = lg.Model(model.bodies, model.joints, model.forces)
    with pytest.raises(
        ValueError, match=says("18 coordinates and 21 equations", "free='x y rz'", "redundant='remove'")
    ):
        lg.kinematics(refusing, {"motor": [0.1]})


@pytest.mark.slow
@pytest.mark.parametrize("offset", [1e4, pytest.param(1e5, marks=pytest.mark.slow)])
def test_far_from_the_origin(offset):
    """A quick return whose bodies turn about fixed points: the rate of its lever in closed form."""
    crank, distance, rate = 0.1, 0.05, 3.0
    o = offset * np.array([1.0, 1.0, 0.0])
    bodies = {
        "crank": lg.RigidBody(1.0, (0.01,) * 3, free="rz", pivot=o + np.array([distance, 0.0, 0.0])),
        "lever": lg.RigidBody(1.0, (0.02,) * 3, free="rz", pivot=o),
    }
    pin = lg.PointOnLineJoint("lever", "crank", at=o + np.array([distance + crank, 0.0, 0.0]), axis=(1.0, 0.0, 0.0))
    joints = {"pin": pin, "motor": lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0))}
    angles = np.linspace(0.0, 2.0 * np.pi, 13)
    found = lg.kinematics(lg.Model(bodies, joints), {"motor": angles}, rates={"motor": rate})
    square = crank**2 + distance**2 + 2.0 * crank * distance * np.cos(angles)
    expected = rate * crank * (crank + distance * np.cos(angles)) / square
    # hardpoints are rounded, 1e-16 of the distance, which is so much of the arm of 0.05 m
    np.testing.assert_allclose(found.body("lever").angular_velocity[:, 2], expected, rtol=20 * 2e-16 * offset / 0.05)
