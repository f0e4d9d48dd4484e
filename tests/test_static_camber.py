"""Wheels that lean and toe in at the design position: curves, rig and files, against a closure and closed forms."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.spatial.transform import Rotation
from small_axle import POINTS, small_axle
from test_rigs import ARM, STANDARD, trailing_arms
from test_suspension_curves import Closure, differences

import lgsens as lg
from lgsens import rigs
from lgsens.examples import Axle, AxleNumbers, QuarterCar, suspension_document
from lgsens.plotting._shapes import placed, shapes

CAMBER, TOE = -0.03, 0.005  # rad
TRAVEL = np.array([-0.06, 0.0, 0.05])
SIDES = {"left": 1.0, "right": -1.0}


def spin_axis(side, camber, toe):
    """y, inclined about x and then steered about z."""
    return Rotation.from_euler("xz", [-side * camber, -side * toe]).apply([0.0, 1.0, 0.0])


class Leaning(Closure):
    """The closure of the five links, of a wheel on the right whose spin axis is any."""

    def __init__(self, camber, toe):
        super().__init__()
        self.axis = spin_axis(-1.0, camber, toe)
        self.radius = self.centre[2] / np.hypot(*self.axis[:2])

    def curves(self, travel):
        unknowns = self.solve(travel)
        normal = Rotation.from_rotvec(unknowns[3:]).apply(self.axis)
        steepest = np.cross(np.cross(normal, [0.0, 0.0, 1.0]), normal)
        contact = self.centre + unknowns[:3] - self.radius * steepest / np.linalg.norm(steepest)
        return np.array([np.arcsin(normal[2]), np.arctan2(-normal[0], normal[1]), *contact])


def leaning(car, camber=CAMBER, toe=TOE):
    return eqx.tree_at(lambda car: (car.wheel.camber, car.wheel.toe), car, (jnp.asarray(camber), jnp.asarray(toe)))


@pytest.fixture(scope="module")
def car():
    return leaning(QuarterCar.load())


@pytest.mark.slow  # `test_positions_agree_with_the_closure` is in the quick run
def test_curves_agree_with_the_closure(car):
    found, closure = car.curves(TRAVEL), Leaning(CAMBER, TOE)
    expected = np.array([closure.curves(s) for s in TRAVEL]).T
    rest = closure.curves(0.0)
    assert abs(rest[4]) < 1e-15
    np.testing.assert_allclose([found.camber[1], found.toe[1]], [CAMBER, TOE], rtol=0, atol=1e-14)
    # SciPy ends at 1e-14 m of closure; over arms of 0.1 m that is 1e-13 rad. The wheel is on the right.
    for name, value in {
        "camber": expected[0],
        "toe": expected[1],
        "track_change": -2 * (expected[3] - rest[3]),
        "wheelbase_change": -(expected[2] - rest[2]),
    }.items():
        np.testing.assert_allclose(getattr(found, name), value, rtol=0, atol=1e-12, err_msg=name)
    for i, s in enumerate(TRAVEL):
        rate = differences(lambda h, s=s: closure.curves(s + h), 5e-4)
        expected = closure.curves(s)[3] * rate[3] / rate[4]
        np.testing.assert_allclose(found.roll_centre_height[i], expected, rtol=0, atol=1e-9)  # as without camber


@pytest.mark.slow
def test_derivatives_by_camber_and_toe(car):
    def curves(angles):
        found = leaning(car, *angles).curves(TRAVEL, throw=False)
        return jnp.stack([found.camber, found.toe, found.track_change])

    found = jax.jit(jax.jacfwd(curves))(jnp.array([CAMBER, TOE]))
    for i, unit in enumerate(np.eye(2)):

        def at(h, unit=unit):
            closure = Leaning(*(np.array([CAMBER, TOE]) + h * unit))
            camber, toe, _, y, _ = np.array([closure.curves(s) for s in TRAVEL]).T
            return np.stack([camber, toe, -2 * (y - closure.curves(0.0)[3])])

        np.testing.assert_allclose(found[..., i], differences(at, 1e-3), rtol=0, atol=1e-10)  # 1e-13/1e-3


@pytest.mark.slow  # a program; the axles of both sides of a file are in the quick run
def test_the_other_side_is_the_mirror_image(car):
    left, right = car.mirrored().curves(TRAVEL), car.curves(TRAVEL)
    for name, found, expected in zip(left._fields, left, right):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12, err_msg=name)


def test_the_wheel_turns_about_its_own_axis(car):
    """Through its centre, and a principal axis of its inertia: it is balanced."""
    model = car.model(wheel="hinged")
    wheel, hub = model.bodies["wheel"], model.joints["hub"]
    axis = spin_axis(-1.0, CAMBER, TOE)
    np.testing.assert_allclose(hub.axis, axis, atol=1e-15)
    np.testing.assert_allclose(jnp.cross(hub.at - wheel.position, hub.axis), 0.0, atol=1e-15)
    inertia = wheel.orientation @ jnp.diag(car.wheel.inertia) @ wheel.orientation.T
    np.testing.assert_allclose(inertia @ axis, car.wheel.inertia[1] * axis, rtol=1e-14)


def turned(model, axes):
    """A scene whose wheels have these spin axes, by side."""
    bodies = dict(model.bodies)
    for side, axis in axes.items():
        forward = np.cross(axis, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(axis, [0.0, 0.0, 1.0]))
        frame = jnp.asarray(np.stack([forward, axis, np.cross(forward, axis)], axis=1))
        bodies[f"{side}_wheel"] = eqx.tree_at(lambda body: body.orientation, bodies[f"{side}_wheel"], frame)
    return eqx.tree_at(lambda model: model.bodies, model, bodies)


AXES = {side: spin_axis(sign, CAMBER, TOE) for side, sign in SIDES.items()}


@pytest.mark.slow  # the roll angle, and contact centres that are not below wheel centres, are in the tests after it
def test_trailing_arms_in_closed_form():
    """The pads are under contact centres that are not below the wheel centres; forces at both are the same to a hinge
    along y, whose arm turns the wheel about y: e by the angle of the arm, P in the plane of the wheel."""
    model, centres = trailing_arms(ARM, compliant=False)
    sweeps = {name: STANDARD[name] for name in ("parallel", "opposite")}
    test = rigs.kc(turned(model, AXES), centres, sweeps, points=3)
    found = rigs.characteristics(test)
    radius = ARM["radius"] / np.cos(CAMBER)
    half = ARM["track"] / 2 - radius * np.sin(CAMBER) * np.cos(TOE)  # of the contact centres; the top leans inward
    back = radius * np.sin(CAMBER) * np.sin(TOE)
    rate, bar = ARM["spring"] * (ARM["spring_arm"] / ARM["length"]) ** 2, 2 * ARM["bar"] / ARM["length"] ** 2
    for name, value in {"static_camber": CAMBER, "static_toe": TOE}.items():
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-14, err_msg=name)
    curves = test.sweeps["opposite"]
    middle = jax.tree.map(lambda leaf: leaf[1], curves)
    np.testing.assert_allclose(middle.wheels.contact_y, 0.0, atol=1e-15)
    # A pad lifts its contact centre, which is by `back` off the wheel centre, and that by a share of it; the work of
    # its force says by how much the force is less than at the centre. One pad up, the other one down, the line of
    # centres turns by that share over half of the track.
    share = ARM["length"] / (ARM["length"] + back)
    force, roll = (rate + bar) * share**2, share / (ARM["track"] / 2)
    np.testing.assert_allclose(middle.roll_rate, 2 * half * force / roll, rtol=1e-8)


@pytest.mark.slow
def test_the_steering_axis_meets_the_road_beside_the_contact_centre():
    model, centres = small_axle(compliant=False)
    test = rigs.kc(turned(model, AXES), centres, {"steering": STANDARD["steering"]}, points=3)
    lower, upper, centre = (np.array(POINTS[name]) for name in ("lower_ball", "upper_ball", "centre"))
    axis = upper - lower
    road = lower - axis * lower[2] / axis[2]
    steepest = np.array([0.0, 0.0, 1.0]) - AXES["left"][2] * AXES["left"]
    apart = centre - centre[2] * steepest / steepest[2] - road
    forward = np.array([np.cos(TOE), -np.sin(TOE), 0.0])  # toe-in of the left wheel is to the right
    curves = test.sweeps["steering"]
    found = {name: getattr(curves, name)[1, 0] for name in ("caster", "trail", "scrub_radius")}
    expected = {"caster": np.arctan2(-axis[0], axis[2]), "trail": -apart @ forward}
    expected["scrub_radius"] = apart @ np.cross([0.0, 0.0, 1.0], forward)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-11, err_msg=name)  # as without camber


def test_a_wheel_that_points_elsewhere_is_refused():
    model, centres = trailing_arms(ARM, compliant=False)
    with pytest.raises(ValueError, match=says("y of the frame of 'left_wheel'", "must point to the left")):
        rigs.kc(turned(model, {"left": np.array([1.0, 0.0, 0.0])}), centres)


@pytest.fixture
def load(tmp_path):
    def load(kind=QuarterCar, name="double_wishbone", **wheel):
        document = suspension_document(name)
        document["wheel"] |= wheel
        path = tmp_path / "suspension.json"
        path.write_text(json.dumps(document), encoding="utf-8")
        return kind.load(path), document

    return load


def test_files(load):
    car, document = load(Axle, camber_deg=-1.5, toe_deg=0.2)
    for corner in (car.left, car.right):
        assert (float(corner.wheel.camber), float(corner.wheel.toe)) == pytest.approx(np.radians([-1.5, 0.2]))
    assert car.left.wheel.spin_axis[2] > 0 > car.right.wheel.spin_axis[2]  # both tops lean inward
    assert car.left.wheel.spin_axis[0] > 0 > car.right.wheel.spin_axis[0]  # both fronts too
    numbers = AxleNumbers.select(car, {"links.*": 0.01})
    again = numbers.document(document, car, numbers.of(car))
    assert again["wheel"] == document["wheel"]


def test_a_bearing_is_on_the_spin_axis(load):
    """As it stands, in or out along the axis; of a wheel thought upright the nearest point."""
    car, _ = load()
    centre, axis = np.asarray(car.wheel.centre), spin_axis(1.0, CAMBER, TOE)
    angles = dict(camber_deg=np.degrees(CAMBER), toe_deg=np.degrees(TOE))
    for bearing, along in ((centre - 0.12 * axis, -0.12), (centre - [0.0, 0.03, 0.0], -0.03 * axis[1])):
        given = [*(bearing - [0.0, 0.0, centre[2] - suspension_document("double_wishbone")["wheel"]["centre"][2]])]
        hub = load(bearing=given, **angles)[0].model(wheel="hinged").joints["hub"]
        np.testing.assert_allclose(hub.at, centre + along * axis, atol=1e-12)


def test_angles_are_numbers_of_a_design(load):
    axle, document = load(Axle, camber_deg=-1.0)
    numbers = AxleNumbers.select(axle, {"wheel.*": 0.5, "wheel.toe_deg": (-0.2, 0.3)})
    assert numbers.names == {"angles": ("wheel.camber_deg", "wheel.toe_deg")}
    np.testing.assert_allclose(numbers.lower["angles"], [-1.5, -0.2])
    np.testing.assert_allclose(numbers.upper["angles"], [-0.5, 0.3])
    x = {"angles": jnp.array([-1.2, 0.1])}
    moved = numbers.replaced(axle, x)
    np.testing.assert_allclose(numbers.of(moved)["angles"], x["angles"], rtol=1e-12)
    assert (
        numbers.document(document, axle, x)["wheel"] | {"camber_deg": -1.2, "toe_deg": 0.1}
        == (numbers.document(document, axle, x)["wheel"])
    )
    assert float(moved.left.wheel.camber) == pytest.approx(np.radians(-1.2))


@pytest.mark.slow
def test_the_roll_angle_is_that_of_the_wheel_centres():
    """Wheels that lean out from a shaft which turns about x: the camber changes by the roll angle, which no static
    camber changes, nor the stiffness over it."""
    shaft = lg.RigidBody(80.0, (9.0, 1.0, 9.0), position=(0.0, 0.0, 0.3))
    centres = {"left": jnp.array([0.0, 0.7, 0.3]), "right": jnp.array([0.0, -0.7, 0.3])}
    wheels = {f"{side}_wheel": lg.RigidBody(20.0, (0.5, 0.9, 0.5), position=at) for side, at in centres.items()}
    joints = {f"{side}_hub": lg.FixedJoint("shaft", f"{side}_wheel", at=at) for side, at in centres.items()}
    joints["slide"] = lg.PlanarJoint(None, "shaft", at=(0.0, 0.0, 0.3), axis=(1.0, 0.0, 0.0))
    springs = {
        name: lg.Bushing(None, "shaft", at=(0.0, y, 0.3), stiffness=(1.0, 1e6, 4e4))
        for name, y in (("left", 0.5), ("right", -0.5))
    }
    model = lg.Model({"shaft": shaft} | wheels, joints, springs)
    sweeps = {name: STANDARD[name] for name in ("parallel", "opposite")}
    for scene in (model, turned(model, {side: spin_axis(sign, -0.07, 0.0) for side, sign in SIDES.items()})):
        found = rigs.characteristics(rigs.kc(scene, centres, sweeps, points=3))
        np.testing.assert_allclose(found["roll_camber"], -1.0, rtol=1e-12)
        np.testing.assert_allclose(found["roll_rate"], 2 * 4e4 * 0.5**2, rtol=1e-9)


@pytest.mark.slow
def test_wheels_are_drawn_as_they_stand():
    """On the rig, and on a road: round their centres, on the contact centre, in the plane that the spin axis says."""
    axle = leaning(Axle.load("solid_axle").left)
    axle = eqx.tree_at(lambda axle: axle.left, Axle.load("solid_axle"), axle)
    wheel = axle.left.wheel
    on_road = axle.model(tyres=True, compliant=False)
    for model in (on_road, rigs.on_rig(on_road, axle.wheel_centres)):
        system = model.system()
        body = system.body_names.index("left_wheel")
        (outline,) = (of for of in shapes(system).outlines if of.body == body)
        assert outline.role == "wheel"
        points = placed(outline, *(np.asarray(array) for array in system.pose))
        points = points - np.asarray(wheel.centre)
        np.testing.assert_allclose(points @ np.asarray(wheel.spin_axis), 0.0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), wheel.stance.radius, rtol=1e-12)


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("bearing", [0.0, 0.9, 0.2], ("wheel.bearing", "off the spin axis")),
        ("inertia", [4e5, 7e5, 4e5], ("wheel.inertia", "radius of gyration", "did you mean [0.4, ")),
        ("camber_deg", 25.0, ("wheel.camber_deg", "within ±20 degrees, got 25")),
        ("toe_deg", -6.0, ("wheel.toe_deg", "within ±5 degrees, got -6")),
        ("camber", -1.5, ("wheel.camber", "is no key of this table", "camber_deg")),
    ],
)
def test_bad_keys(load, key, value, words):
    with pytest.raises(ValueError, match=says(*words)):
        load(**{key: value})
