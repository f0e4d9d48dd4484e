"""`free` and `pivot`: notation, what is refused and why, which equations of a joint are left; the summary."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.examples import QuarterCar

ORIGIN, X, Y, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ALL = ("x", "y", "z", "rx", "ry", "rz")
TILTED = Rotation.from_rotvec([0.2, 0.0, 0.0]).as_matrix()


def body(**changes):
    return lg.RigidBody(**({"mass": 1.0, "inertia": (1.0, 1.0, 1.0)} | changes))


@pytest.mark.parametrize(
    ("given", "free"),
    [
        (ALL, ALL),
        ("z", ("z",)),
        ("x y rz", ("x", "y", "rz")),
        (["rz", "y", "x", "x"], ("x", "y", "rz")),  # the order is that of the coordinates
        ({"rx", "rz", "ry"}, ("rx", "ry", "rz")),
        ((), ()),
        ("", ()),
    ],
)
def test_notation(given, free):
    assert body(free=given).free == free
    assert body(free=given).coordinates == tuple(ALL.index(name) for name in free)


def test_default_is_all_six_and_static():
    assert body().free == ALL
    assert body().pivot is None
    assert hash(body(free="z").free) == hash(("z",))
    assert jax.tree.structure(body(free="z")) != jax.tree.structure(body())
    assert len(jax.tree.leaves(body(free="rx ry rz", pivot=X))) == len(jax.tree.leaves(body())) + 1


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"free": "heave"}, ("RigidBody: `free`: 'heave' is not one of", "'rx'", "inertial axes", "body axes")),
        ({"free": ("x", "rotation")}, ("RigidBody: `free`: 'rotation' is not one of",)),
        ({"free": "rx ry"}, ("RigidBody: `free` = ('rx', 'ry') has two rotations", "one rotation or all three")),
        ({"free": "x y z rx rz"}, ("RigidBody: `free`", "two rotations", "add a joint")),
        (
            {"free": "x y rz", "orientation": TILTED},
            ("RigidBody: `free` has the one rotation 'rz'", "z axis", "`orientation`", "add a RevoluteJoint"),
        ),
        ({"free": "ry", "pivot": (1.0, 2.0)}, ("RigidBody: `pivot`", "shape (3,)", "got shape (2,)")),
        ({"pivot": X}, ("RigidBody: `pivot` is for a body with rotations only", "'x'", "leave it out")),
        ({"free": "x rz", "pivot": X}, ("RigidBody: `pivot` is for a body with rotations only", "('x', 'rz')")),
        ({"free": (), "pivot": X}, ("RigidBody: `pivot` is for a body with rotations only", "()")),
        ({"free": "z", "velocity": X}, ("RigidBody: `velocity` [1. 0. 0.]", "`free` = ('z',)", "free the others too")),
        ({"free": "x y rz", "angular_velocity": X}, ("`angular_velocity` [1. 0. 0.]", "('x', 'y', 'rz')")),
        (
            {"free": "ry", "pivot": X, "velocity": Y},
            ("RigidBody: `velocity`", "follows from the rotation"),
        ),
    ],
)
def test_bad_input_is_named(arguments, parts):
    with pytest.raises(ValueError, match=says(*parts)):
        body(**arguments)


def test_good_input_is_not_refused():
    assert body(free="x y rz", orientation=Rotation.from_rotvec([0, 0, 2.0]).as_matrix()).free[-1] == "rz"
    assert body(free="rx", orientation=np.diag([-1.0, -1.0, 1.0])).free == ("rx",)  # along the axis, the other way
    assert body(free="z", orientation=TILTED, velocity=Z).free == ("z",)
    assert body(free="ry", pivot=X, angular_velocity=Y).free == ("ry",)
    # traced numbers cannot be looked at: the program refuses them, but for what round-off leaves of others
    traced = jax.jit(lambda v: lg.Model({"b": body(free="z", velocity=v)}).system().velocity)
    np.testing.assert_array_equal(traced(jnp.array([1e-9, 0.0, 2.0])), [2.0])
    np.testing.assert_array_equal(traced(jnp.arange(3.0)), [np.nan])


def test_a_model_needs_a_degree_of_freedom():
    with pytest.raises(ValueError, match=says("Model: no body has a degree of freedom", "`free`")):
        lg.Model({"a": body(free=()), "b": body(free="")})
    with pytest.raises(ValueError, match=says("`chassis` must be 'guided' or 'heave', got 'loose'")):
        QuarterCar.load().model(chassis="loose")
    with pytest.raises(ValueError, match=says("`links` must be 'bodies' or 'rods', got 'ropes'")):
        QuarterCar.load().model(links="ropes")


# Joints.

PLANAR = {"free": "x y rz"}
BARREL = {"pitch": 0.5, "travel": lg.Polynomial((0.0, 0.5 / (2.0 * np.pi)))}
CONNECTIONS = {
    "planar bodies on a ball": (PLANAR, PLANAR, lambda a, b: lg.SphericalJoint(a, b, at=X), 2),
    "planar bodies on a hinge": (PLANAR, PLANAR, lambda a, b: lg.RevoluteJoint(a, b, at=X, axis=(0, 0, -2.0)), 2),
    "planar bodies welded": (PLANAR, PLANAR, lambda a, b: lg.FixedJoint(a, b, at=X), 3),
    "planar body on the ground": (PLANAR, None, lambda a, b: lg.SphericalJoint(a, b, at=X), 2),
    "other planes": (PLANAR, {"free": "x z ry"}, lambda a, b: lg.SphericalJoint(a, b, at=X), 3),
    "hinge in other planes": (PLANAR, {"free": "x z ry"}, lambda a, b: lg.RevoluteJoint(a, b, at=X, axis=X), 5),
    "planar on all": (PLANAR, {}, lambda a, b: lg.RevoluteJoint(a, b, at=X, axis=X), 5),
    "heave on the ground": ({"free": "z"}, None, lambda a, b: lg.FixedJoint(a, b, at=X), 1),
    "translations": ({"free": "x y"}, {"free": "y z"}, lambda a, b: lg.FixedJoint(a, b, at=X), 3),
    "a bead on a wire": ({"free": "x y"}, None, lambda a, b: lg.PointOnLineJoint(b, a, at=X, axis=(1.0, 2.0, 0)), 1),
    "a block on a rail": (
        {"free": "x"},
        {"free": "z"},
        lambda a, b: lg.PrismaticJoint(b, a, at=X, axis=(1.0, 0, 1.0)),
        1,
    ),
    "a cross in a plane": (PLANAR, PLANAR, lambda a, b: lg.UniversalJoint(a, b, at=X, axis_a=Y, axis_b=Z), 2),
    "a barrel cam": ({"free": "rz"}, {"free": "z"}, lambda a, b: lg.ScrewJoint(a, b, at=Z, axis=Z, **BARREL), 1),
    "assembled by the user": (PLANAR, PLANAR, lambda a, b: lg.DistanceJoint(a, b, at_a=X, at_b=Y, length=1.0), 1),
}


@pytest.mark.parametrize("name", CONNECTIONS)
def test_joints_keep_the_equations_that_can_be_violated(name):
    one, other, joint, equations = CONNECTIONS[name]
    bodies = {"a": body(**one)} | ({} if other is None else {"b": body(position=(2.0, 0.0, 0.0), **other)})
    model = lg.Model(bodies, {"joint": joint("a", None if other is None else "b")})
    assert model.summary().equations == {"joint": equations}
    system = model.system()
    jacobian = np.asarray(system.constraint_jacobian(system.pose, 0.0))
    assert jacobian.shape == (equations, system.group.dim)
    assert np.abs(jacobian).max(axis=1).min() > 0.1  # arms and axes of length 1


def test_equations_that_no_body_can_violate_are_gone():
    """A joint between translating bodies that the free coordinates satisfy: no equation, no kernel, no multiplier."""
    model = lg.Model({"a": body(free="x"), "b": body(free=())}, {"slide": lg.FixedJoint("b", None, at=Z)})
    system = model.system()
    assert system.constraints == () and system.constraint_names == ()
    assert model.summary().equations == {"slide": 0}
    with pytest.raises(ValueError, match=says("Joint 'pin': `axis`", "'rz', the only rotation", "turn the axis")):
        lg.Model({"a": body(**PLANAR)}, {"pin": lg.RevoluteJoint("a", None, at=X, axis=X)}).system()
    cross = lg.UniversalJoint("a", None, at=X, axis_a=X, axis_b=Y)
    with pytest.raises(ValueError, match=says("Joint 'cross'", "one of its arms", "'rz', the only rotation")):
        lg.Model({"a": body(**PLANAR)}, {"cross": cross}).system()
    barrel = lg.ScrewJoint("a", None, at=X, axis=X, **BARREL)
    with pytest.raises(ValueError, match=says("Joint 'cam': `axis`", "'rz', the only rotation")):
        lg.Model({"a": body(**PLANAR)}, {"cam": barrel}).system()


def test_a_superfluous_guide_is_named():
    heave = lg.Model({"c": body(free="z")}, {"guide": lg.PrismaticJoint(None, "c", at=ORIGIN, axis=Z)})
    with pytest.raises(ValueError, match=says("constrain the same motion twice", "`free` coordinates", "'guide'")):
        lg.initial_state(heave)


# The summary.


def test_summary():
    bodies = {
        "chassis": body(mass=400.0, free="z"),
        "rocker": body(free="ry", pivot=X),
        "wheel": body(mass=12.5),
        "rig": body(free=()),
    }
    joints = {"ball": lg.SphericalJoint("chassis", "wheel", at=X), "hub": lg.RevoluteJoint(None, "wheel", at=X, axis=Y)}
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "strut": lg.SpringDamper("wheel", "chassis", at_a=X, at_b=Z, stiffness=1.0),
        "stay": lg.SpringDamper("rocker", None, at_a=X, at_b=Z, stiffness=1.0),
    }
    model = lg.Model(bodies, joints, forces)
    summary = model.summary()
    assert (summary.coordinates, summary.constraints, summary.degrees_of_freedom) == (8, 8, 0)
    assert summary.bodies == {"chassis": ("z",), "rocker": ("ry",), "wheel": ALL, "rig": ()}
    assert summary.equations == {"ball": 3, "hub": 5}
    assert str(summary) == (
        "Bodies (4): mass [kg], free coordinates\n"
        "  chassis  400   z\n"
        "  rocker   1     ry about its pivot\n"
        "  wheel    12.5  x y z rx ry rz\n"
        "  rig      1     held\n"
        "Joints (2): type, bodies, equations\n"
        "  ball  SphericalJoint  chassis – wheel  3\n"
        "  hub   RevoluteJoint   ground – wheel   5\n"
        "Force elements (3): type, bodies\n"
        "  gravity  Gravity       all bodies\n"
        "  strut    SpringDamper  wheel – chassis\n"
        "  stay     SpringDamper  rocker – ground\n"
        "Unknown coordinates         8\n"
        "Constraint equations        8\n"
        "Degrees of freedom          0"
    )
    inside = []
    jax.jit(lambda model: inside.append(str(model.summary())))(model)
    assert "chassis  traced  z" in inside[0]  # a mass that is traced has no value to print
    alone = lg.Model({"stone": body()}).summary()
    assert "Joints (0)" in str(alone) and alone.degrees_of_freedom == 6
