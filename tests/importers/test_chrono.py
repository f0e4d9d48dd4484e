"""Chrono's suspensions: every type assembles; with a freedom for each wheel, curves are those of a position solver.

The solver here knows points, distances and rotations only: the equations of each type are written by hand on the
numbers of the file, and SciPy solves them.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.cli import main
from lgsens.importers import chrono
from lgsens.importers._chrono_types import TYPES

DATA = Path(__file__).parent / "data" / "chrono"
NAMES = sorted(path.stem for path in DATA.glob("*.json"))
X, Y, Z = np.eye(3)
MIRROR = np.array([1.0, -1.0, 1.0])
# the left and the right spindle move by these [m]
TRAVEL = np.array([[0.02, 0.02], [0.05, 0.01], [0.03, -0.04], [-0.05, -0.05], [-0.03, 0.02]])


def points(name):
    """`at(section, key)` of the left side."""
    text = re.sub(r"//[^\n]*", "", (DATA / f"{name}.json").read_text(encoding="utf-8"))
    content = json.loads(text)
    return lambda section, key: np.array(content[section][key], float)


class Moved:
    """A body after a turn and a displacement of its origin."""

    def __init__(self, u, at=0.0):
        self.turn, self.at, self.shift = Rotation.from_rotvec(u[3:]).as_matrix(), at, u[:3]

    def __call__(self, p):
        return self.at + self.turn @ (p - self.at) + self.shift

    def axis(self, e):
        return self.turn @ e


def kept(p, q, p0, q0):
    """A distance less what it was."""
    return np.linalg.norm(p - q) - np.linalg.norm(p0 - q0)


def hinged(carrier, angle, at, axis):
    """A body that has turned about an axis of its carrier."""
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    return lambda p: carrier(at + turn @ (p - at))


# Independent suspensions: equations of the carrier of one wheel, five of them.


def wishbone(at, carrier, arm, front="Location Chassis Front", back="Location Chassis Back"):
    ball = at(arm, "Location Upright")
    return [kept(carrier(ball), at(arm, pivot), ball, at(arm, pivot)) for pivot in (front, back)]


def link(at, carrier, section, on_chassis="Location Chassis", on_carrier="Location Upright"):
    p, q = at(section, on_carrier), at(section, on_chassis)
    return [kept(carrier(p), q, p, q)]


def double_wishbone(at, c):
    arms = [*wishbone(at, c, "Upper Control Arm"), *wishbone(at, c, "Lower Control Arm")]
    return [*arms, *link(at, c, "Tierod")]


def macpherson(at, c):
    top, foot = at("Spring", "Location Chassis"), at("Spring", "Location Upright")
    across = np.cross(top - foot, X)
    beside = np.cross(top - foot, across)
    line = [c.axis(n) @ (top - c(foot)) for n in (across, beside)]
    return [*wishbone(at, c, "Control Arm"), *link(at, c, "Tierod"), *line]


def multi_link(at, c):
    rods = [row for section in ("Lateral", "Trailing Link", "Tierod") for row in link(at, c, section)]
    return [*wishbone(at, c, "Upper Arm"), *rods]


def three_links(at, c):
    pivot = at("Trailing Arm", "Location Chassis")
    rods = [row for name in ("Upper Link", "Lower Link") for row in link(at, c, name, on_carrier="Location Arm")]
    return [*(c(pivot) - pivot), *rods]


def semi_trailing(at, c):
    outer, inner = (at("Trailing Arm", f"Location Chassis {which}") for which in ("Outer", "Inner"))
    return [*(c(outer) - outer), *(c(inner) - inner)[[0, 2]]]  # the third follows from the distance


def single_wishbone(at, c):
    """The arm turns about x, the upright about z of the arm."""
    pivot, knuckle = at("Control Arm", "Location Chassis"), at("Control Arm", "Location Upright")
    ball = c(knuckle) - pivot
    lean = np.arctan2(ball[2], ball[1]) - np.arctan2(*(knuckle - pivot)[[2, 1]])
    upright = c.axis(Z)
    return [
        *(np.linalg.norm(ball) - np.linalg.norm(knuckle - pivot), ball[0] - (knuckle - pivot)[0]),
        *(upright[0], upright @ [0.0, np.cos(lean), np.sin(lean)]),
        *link(at, c, "Tierod"),
    ]


def generic(_, c):
    """The double wishbone as a list of joints: a ball on each arm, at its distance from a hinge and along it."""
    content = json.loads(re.sub(r"//[^\n]*", "", (DATA / "GenericWheeledSuspension.json").read_text(encoding="utf-8")))
    joints = {entry["Name"]: entry for entry in content["Joints"]}
    rows = []
    for arm in ("UCA", "LCA"):
        hinge, ball = joints[f"Revolute{arm}"], np.array(joints[f"Spherical{arm}"]["Position"])
        at, (w, *v) = np.array(hinge["Position"]), hinge["Rotation"]
        along = Rotation.from_quat([*v, w]).apply(Z)
        rows += [kept(c(ball), at, ball, at), along @ (c(ball) - ball)]
    (rod,) = content["Distance Constraints"]
    p, q = np.array(rod["Point2"]), np.array(rod["Point1"])
    return [*rows, kept(c(p), q, p, q)]


INDEPENDENT = {
    "GenericWheeledSuspension": generic,
    "DoubleWishbone": double_wishbone,
    "DoubleWishboneReduced": double_wishbone,
    "MacPhersonStrut": macpherson,
    "MultiLink": multi_link,
    "ThreeLinkIRS": three_links,
    "SemiTrailingArm": semi_trailing,
    "SingleWishbone": single_wishbone,
}


def independent(name, travel):
    """Centre and axis of each spindle: of the right one mirrored."""
    at = points(name)
    centre = at("Spindle", "COM")

    def one(z):
        equations = lambda u: [*INDEPENDENT[name](at, Moved(u, centre)), Moved(u, centre)(centre)[2] - centre[2] - z]
        u, *_ = fsolve(equations, np.zeros(6), xtol=1e-14, full_output=True)
        assert np.abs(equations(u)).max() < 1e-13
        return Moved(u, centre)(centre), Moved(u, centre).axis(Y)

    centre_left, axis_left = one(travel[1])
    return one(travel[0]), (centre_left * MIRROR, -axis_left * MIRROR)  # the axis that was y on both sides


# Axles: the tube has a pose u[:6]; four equations guide it. More unknowns are angles of what turns on it.


def leaves(at, tube, _):
    return [*tube(at("Axle Tube", "COM"))[:2], *tube.axis(X)[1:]]


def panhard(at, tube, _):
    p, q = at("Panhard Rod", "Location Axle"), at("Panhard Rod", "Location Chassis")
    return [tube(at("Axle Tube", "COM"))[0], *tube.axis(X)[1:], kept(tube(p), q, p, q)]


def push_pipe(at, tube, _):
    pivot = at("Axle Tube", "Location Connector Chassis")
    p, q = (at("Panhard Rod", f"Location Connector {end}") for end in ("Axle", "Chassis"))
    return [*(tube(pivot) - pivot), kept(tube(p), q, p, q)]


def watt(at, tube, angle):
    pivot = at("Axle Tube", "Location Connector Chassis")
    ends = {
        side: [at("Watt Mechanism", f"Location {side} Link to {to}") for to in ("Chassis", "Center")]
        for side in ("Left", "Right")
    }
    middle = (ends["Left"][1] + ends["Right"][1]) / 2
    centre = hinged(tube, angle[0], middle, X)
    return [*(tube(pivot) - pivot), *(kept(centre(q), p, q, p) for p, q in ends.values())]


def triangle(at, tube, _):
    apex, side = (at("Triangular Link", f"Location {end}") for end in ("Axle", "Chassis"))
    p, q = (at("Longitudinal Link", f"Location {end}") for end in ("Axle", "Chassis"))
    arms = [kept(tube(apex), s, apex, s) for s in (side, side * MIRROR)]
    return [*arms, *(kept(tube(p * m), q * m, p, q) for m in (1.0, MIRROR))]


def four_links(at, tube, _):
    ends = [[at(f"{which} Link", f"Location {end}") for end in ("Axle", "Chassis")] for which in ("Upper", "Lower")]
    return [kept(tube(p * m), q * m, p, q) for p, q in ends for m in (1.0, MIRROR)]


def knuckles(at, tube, angles):
    lower, upper = (at("Knuckle", f"Location {which}") for which in ("Lower", "Upper"))
    return [hinged(tube, angle, lower * m, (upper - lower) * m) for angle, m in zip(angles, (1.0, MIRROR))]


def toe_bar(at, tube, angles):
    left, right = knuckles(at, tube, angles)
    tie, drag, steering = (
        at("Tierod", "Location Knuckle"),
        at("Knuckle", "Location Draglink"),
        at("Draglink", "Location Chassis"),
    )
    pulled = left if drag[1] > 0 else right
    return [
        kept(left(tie), right(tie * MIRROR), tie, tie * MIRROR),
        kept(pulled(drag), steering, drag, steering),
    ]


def bell_crank(at, tube, angles):
    """A crank on the tube slides along the rod between the knuckles' ends, in a plane across the rod."""
    left, right = knuckles(at, tube, angles)
    crank = hinged(tube, angles[2], at("Bell Crank", "Location Axle"), Z)
    tie, pin = at("Tierod", "Location Knuckle"), at("Bell Crank", "Location Tierod")
    end, steering = at("Draglink", "Location Bell Crank"), at("Draglink", "Location Chassis")
    begin = right(tie * MIRROR)
    rod = (left(tie) - begin) / np.linalg.norm(left(tie) - begin)
    return [
        kept(left(tie), begin, tie, tie * MIRROR),
        rod @ (crank(pin) - begin) - (pin[1] + tie[1]),
        kept(crank(end), steering, end, steering),
    ]


def crank_and_rods(at, tube, angles):
    sides = knuckles(at, tube, angles)
    crank = hinged(tube, angles[2], at("Bellcrank", "Location Axle"), Z)
    p, q = at("Bellcrank", "Location Tierod"), at("Knuckle", "Location Tierod")
    end, steering = at("Draglink", "Location Bellcrank"), at("Draglink", "Location Steering")
    rods = [kept(crank(p * m), side(q * m), p, q) for side, m in zip(sides, (1.0, MIRROR))]
    return [*rods, kept(crank(end), steering, end, steering)]


# guide of the tube, steering, how many angles each has
AXLES = {
    "LeafspringAxle": (leaves, None, 0, 0),
    "ToeBarLeafspringAxle": (leaves, toe_bar, 0, 2),
    "RigidPanhardAxle": (panhard, None, 0, 0),
    "ToeBarRigidPanhardAxle": (panhard, toe_bar, 0, 2),
    "PushPipeAxle": (push_pipe, None, 0, 0),
    "ToeBarPushPipeAxle": (push_pipe, toe_bar, 0, 2),
    "DeDionAxle": (watt, None, 1, 0),
    "ToeBarDeDionAxle": (watt, toe_bar, 1, 2),
    "SolidThreeLinkAxle": (triangle, None, 0, 0),
    "SolidBellcrankThreeLinkAxle": (triangle, crank_and_rods, 0, 3),
    "SolidAxle": (four_links, bell_crank, 0, 3),
}


def axle(name, travel):
    at, (guide, steering, more, turning) = points(name), AXLES[name]
    centre = at("Spindle", "COM")

    def placed(u):
        tube = Moved(u[:6])
        sides = knuckles(at, tube, u[6 + more :]) if steering else (tube, tube)
        return tube, sides

    def equations(u):
        tube, sides = placed(u)
        steered = steering(at, tube, u[6 + more :]) if steering else []
        heights = [side(centre * m)[2] - centre[2] - z for side, m, z in zip(sides, (1.0, MIRROR), travel)]
        return [*guide(at, tube, u[6 : 6 + more]), *steered, *heights]

    u, *_ = fsolve(equations, np.zeros(6 + more + turning), xtol=1e-14, full_output=True)
    assert np.abs(equations(u)).max() < 1e-13
    _, sides = placed(u)
    return [(side(centre * m), side(centre * m + Y) - side(centre * m)) for side, m in zip(sides, (1.0, MIRROR))]


def driven(name):
    """The spindles of our model over the travel: centres and axes, shape (positions, sides, 2, 3)."""
    model = chrono(DATA / f"{name}.json", wheels="locked").model
    joints = dict(model.joints)
    for side in ("left", "right"):
        body = f"{side} Spindle"
        joints[f"{side} rig"] = lg.TranslationDriver(None, body, at=model.bodies[body].position, axis=Z)
    rig = lg.Model(model.bodies, joints, model.forces, redundant=model.redundant)
    motion = lg.kinematics(rig, {f"{side} rig": TRAVEL[:, i] for i, side in enumerate(("left", "right"))})
    sides = [motion.body(f"{side} Spindle") for side in ("left", "right")]
    own = [model.bodies[f"{side} Spindle"].orientation.T @ Y for side in ("left", "right")]  # y of the chassis
    return np.stack([np.stack([of.position, of.orientation @ y], axis=1) for of, y in zip(sides, own)], axis=1)


def check_curves(name):
    solver = independent if name in INDEPENDENT else axle
    expected = np.array([solver(name, travel) for travel in TRAVEL])
    assert np.ptp(expected, axis=0).max() > 0.01  # they move
    # both solve their equations to 1e-13 m; a rod of 0.2 m at a flat angle magnifies that a hundredfold at most
    assert np.abs(driven(name) - expected).max() < 1e-10


QUICK = ["DoubleWishbone", "ToeBarPushPipeAxle"]


@pytest.mark.parametrize("name", QUICK)
def test_curves_agree_with_an_independent_position_solver(name):
    check_curves(name)


@pytest.mark.slow  # five to ten seconds each
@pytest.mark.parametrize("name", sorted({*INDEPENDENT, *AXLES} - {*QUICK}))
def test_curves_of_the_other_types(name):
    check_curves(name)


# The freedoms that joints leave with locked wheels: two of an axle, one of a pinned one, none of a rigid one. In the
# model of leaf springs by links bending leaves two more; four links and parallel beams repeat an equation (below).
FREEDOMS = {name: 2 for name in NAMES} | {
    "RigidPinnedAxle": 1,
    "RigidSuspension": 0,
    "SAELeafspringAxle": 4,
    "SAEToeBarLeafspringAxle": 4,
    "HendricksonPRIMAXX": 1,
    "TranslationalDamperSuspension": 1,
}
EQUATIONS = {
    "RevoluteJoint": 5,
    "SphericalJoint": 3,
    "UniversalJoint": 4,
    "CylindricalJoint": 4,
    "FixedJoint": 6,
    "DistanceJoint": 1,
    "PlanarJoint": 3,
    "PointOnPlaneJoint": 1,
}


@pytest.mark.parametrize("name", sorted({*NAMES} - {"HendricksonPRIMAXX", "GenericWheeledSuspension"}))
def test_every_type_is_read(name):
    """As many freedoms as such an axle has, and nothing of the file but what the model has not."""
    imported = chrono(DATA / f"{name}.json", wheels="locked")
    joints = imported.report.joints
    equations = sum(EQUATIONS[kind] for kind in joints.values())
    assert 6 * len(imported.model.bodies) - equations == FREEDOMS[name]
    unused = {line.partition(":")[0].partition("/")[2] for line in imported.report.dropped}
    assert unused <= {
        *("Minimum Length", "Maximum Length", "Degressivity Compression", "Degressivity Expansion"),
        *("Inertia", "Location Wheel", "Location Spindle", "Location Stabilizer"),
    }
    assert set(TYPES) == {*NAMES} - {"GenericWheeledSuspension"}


@pytest.mark.slow  # three seconds each
@pytest.mark.parametrize("name", sorted({*NAMES} - {*INDEPENDENT, *AXLES}))
def test_every_other_type_assembles(name):
    """Its reference satisfies all equations to round-off, of points 1 m away; the rank is that of the freedoms."""
    system = chrono(DATA / f"{name}.json").model.system()
    q, _ = system.reference()
    assert np.abs(system.constraint(q, 0.0)).max(initial=0.0) < 1e-14
    jacobian = np.asarray(system.constraint_jacobian(q, 0.0))
    repeated = len(jacobian) - np.linalg.matrix_rank(jacobian, tol=1e-8)
    assert repeated == (1 if name == "HendricksonPRIMAXX" else 0)


def test_numbers_of_a_file():
    """The double wishbone: masses and points where the file says, both sides, springs, and what no body has."""
    at = points("DoubleWishbone")
    imported = chrono(DATA / "DoubleWishbone.json")
    bodies, forces = imported.model.bodies, imported.model.forces
    for side, mirror in (("left", 1.0), ("right", MIRROR)):
        np.testing.assert_allclose(bodies[f"{side} Upright"].position, at("Upright", "COM") * mirror)
        np.testing.assert_allclose(forces[f"{side} Spring"].at_b, at("Spring", "Location Arm") * mirror)
    assert float(forces["left Spring"].free_length) == at("Spring", "Free Length")
    assert float(forces["right Shock"].damping) == at("Shock", "Damping Coefficient")
    # 0.8938 > 0.4 + 0.4
    assert any("left Lower Control Arm: no body has the moments" in note for note in imported.report.notes)
    moments = np.linalg.eigvalsh(np.diag(bodies["left Lower Control Arm"].inertia))
    np.testing.assert_allclose(moments, [0.4469, 0.4469, 0.8938], rtol=1e-12)


def with_entry(tmp_path, section, key, value):
    """The double wishbone with another entry, at the top where `section` is ""."""
    content = json.loads((DATA / "DoubleWishbone.json").read_text(encoding="utf-8"))
    (content[section] if section else content)[key] = value
    (tmp_path / "file.json").write_text(json.dumps(content), encoding="utf-8")
    return chrono(tmp_path / "file.json")


def test_curves_are_carried_over_in_another_form(tmp_path):
    """Through their points, which is said."""
    rows = [[-1.0, -800.0], [0.0, 0.0], [1.0, 1200.0]]
    imported = with_entry(tmp_path, "Shock", "Damping Curve Data", rows)
    assert any("Shock: Damping Curve Data by a smooth monotone curve" in note for note in imported.report.notes)
    found = [imported.model.forces["left Shock"].damper(at) for at, _ in rows]
    np.testing.assert_allclose(found, [force for _, force in rows], rtol=1e-14, atol=1e-12)


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("Shock", "Damping Curve Data", [[0, 0, 1], [1, 2]], "Shock/Damping Curve Data must be two or more pairs"),
        ("Shock", "Damping Curve Data", [[0, 0], [0, 2]], "the first ones increasing"),
        ("Upright", "Mass", -4, r"Upright/Mass must be positive, got -4\.0 kg"),
        ("", "Camber Angle (deg)", "a", r"Camber Angle \(deg\) must be a number, got 'a'"),
        ("Spring", "Location Arm", [-0.07, 0.52, 0.27], "Spring has both ends at"),
    ],
)
def test_wrong_entries_are_named(section, key, value, message, tmp_path):
    if key == "Location Arm":
        value = json.loads((DATA / "DoubleWishbone.json").read_text(encoding="utf-8"))[section]["Location Chassis"]
    with pytest.raises(ValueError, match=message):
        with_entry(tmp_path, section, key, value)


def test_rates_of_leaves():
    """A front leaf of 0.45 m of a spring of 94748.2 N/m: 94748.2 · 0.45²/2 N m/rad, as the generic form of it says."""
    spring = chrono(DATA / "SAEToeBarLeafspringAxle.json").model.forces["left Frontleaf torsion y"]
    np.testing.assert_allclose(spring.stiffness, 9593.2, rtol=1e-4)  # printed with five digits
    np.testing.assert_allclose(spring.damping, 95.932, rtol=1e-4)


WRONG = {
    "no suspension": ('{"Type": "Tire"}', "no suspension of Chrono"),
    "no JSON": ("{", "no JSON"),
    "unknown type": ('{"Type": "Suspension", "Template": "Sled"}', "'Sled' is not one of"),
    "missing": (
        '{"Type": "Suspension", "Template": "RigidSuspension", "Spindle": {"Mass": 1, "Inertia": [1, 1, 1]}}',
        "needs 'COM' in 'Spindle'",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_input(name, tmp_path):
    text, message = WRONG[name]
    (tmp_path / "file.json").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        chrono(tmp_path / "file.json")


@pytest.mark.slow
def test_the_command_line_reports_and_animates(tmp_path, capsys):
    assert (
        main(["import", str(DATA / "RigidPinnedAxle.json"), "--simulate", "0.05", "--out", str(tmp_path / "out")]) == 0
    )
    said = capsys.readouterr().out
    assert "Not carried over (1):" in said and "Axle/Inertia: 0.4" in said and "Degrees of freedom" in said
    assert "<html" in (tmp_path / "out" / "motion.html").read_text(encoding="utf-8")
    assert len((tmp_path / "out" / "motion.csv").read_text(encoding="utf-8").splitlines()) == 52
    (tmp_path / "other.txt").write_text("nothing", encoding="utf-8")
    assert main(["import", str(tmp_path / "other.txt")]) == 2
    assert "is no MJCF" in capsys.readouterr().err
