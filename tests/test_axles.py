"""Axles: what is mirrored, what carries what, that they rest, and what their files may say."""

import json
import tomllib
from importlib import resources

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from suspension_closures import Closure, changed, corner_of

import lgsens as lg
from lgsens.examples import Axle, QuarterCar, shipped
from lgsens.examples._axle_parts import Mount
from lgsens.examples._suspension_parts import Part, Strut, reflected
from lgsens.model import Frame

DATA = resources.files("lgsens.examples") / "data"
FLIP = np.diag([1.0, -1.0, 1.0])
PLACED = ("position", "orientation")
TRAVEL = np.array([-0.04, 0.0, 0.03])


def document(name):
    return tomllib.loads((DATA / f"{name}.toml").read_text(encoding="utf-8"))


def names(axle, **settings):
    """Bodies, joints and forces of its model, of which nothing is computed."""
    model = eqx.filter_eval_shape(lambda: axle.model(**settings))
    return set(model.bodies), set(model.joints), set(model.forces)


@pytest.mark.parametrize("name", shipped())
def test_twice_mirrored_is_what_it_was(name):
    axle = Axle.load(name)
    given = {"preload": jnp.arange(3.0), "rotational_preload": jnp.arange(4.0, 7.0)}
    mounts = {key: Mount(mount.stiffness, axes=jnp.eye(2, 3), **given) for key, mount in axle.left.mounts.items()}
    axle = eqx.tree_at(lambda a: (a.left.mounts, a.left.knuckle.inertia), axle, (mounts, jnp.arange(9.0).reshape(3, 3)))
    jax.tree.map(np.testing.assert_array_equal, reflected(reflected(axle)), axle)
    assert axle.left.wheel.centre[1] > 0 > axle.right.wheel.centre[1]
    np.testing.assert_array_equal(axle.wheel_centres["right"], FLIP @ axle.wheel_centres["left"])


def test_mirror_image_of_masses_and_moments():
    """Of a body made of points, and of a moment r × f."""
    rng = np.random.default_rng(0)
    masses, places, force = rng.uniform(1, 2, 5), rng.normal(size=(5, 3)), rng.normal(size=3)

    def part(places):
        centre = masses @ places / masses.sum()
        d = places - centre
        inertia = np.einsum("n,ij->ij", masses * np.sum(d**2, axis=1), np.eye(3)) - np.einsum("n,ni,nj", masses, d, d)
        return Part(*map(jnp.asarray, (centre, masses.sum(), inertia)))

    image, wanted = reflected(part(places)), part(places @ FLIP)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-14), image, wanted)  # sums of five
    moments = [np.cross(place, push) for place, push in ((places[0], force), (FLIP @ places[0], FLIP @ force))]
    mount = Mount(jnp.ones(3), preload=jnp.asarray(force), rotational_preload=jnp.asarray(moments[0]))
    np.testing.assert_array_equal(reflected(mount).rotational_preload, moments[1])
    np.testing.assert_array_equal(reflected(mount).preload, FLIP @ force)
    # a body of a name that curves of bushings have
    ends = Strut({"chassis": jnp.asarray(force), "spring_3": jnp.asarray(force)}, jnp.ones(()))
    np.testing.assert_array_equal(reflected(ends).ends["spring_3"], FLIP @ force)


@pytest.mark.slow  # `test_twice_mirrored_is_what_it_was` is in the quick run
def test_mirror_image_of_curves(tmp_path):
    """Forces and moments of bushings with all curves in a mirrored motion are mirrored: S f, −S m; on tilted axes."""
    keys = [f"{kind}_{i}" for kind in ("spring", "damper", "rotational_spring", "rotational_damper") for i in (1, 2, 3)]
    uneven = lambda i: [[-2.0, -9.0 - i], [-0.5, -1.0], [0.0, 0.0], [0.6, 1.5 + i], [2.0, 17.0]]
    table: dict = {key: uneven(i) for i, key in enumerate(keys)}
    table |= {"stiffness": [0.0, 2.0, 0.0], "rotational_stiffness": [0.0, 1.0, 3.0]}
    rng = np.random.default_rng(0)
    x, turns, v = rng.normal(size=(2, 3)), rng.normal(size=(2, 3)) / 2, rng.normal(size=(2, 6))
    for axes in (None, [[1.0, 0.3, 0.2], [0.0, 1.0, 0.4]]):
        given = {"axes": axes} if axes else {}
        path = tmp_path / "mine.json"
        path.write_text(json.dumps(changed(document("mcpherson"), {"bushings.control_arm_chassis": table | given})))
        axle = Axle.load(path)
        found = []
        for car, s, handed in ((axle.left, np.eye(3), 1.0), (axle.right, FLIP, -1.0)):
            at = car.links["control_arm"].ends["chassis"]
            for i, (name, bushing) in enumerate(car.mounts["control_arm_chassis"].elements("it", "chassis", "arm", at)):
                assert name == f"it_{i + 1}"
                load = bushing.load(*(Frame(jnp.zeros(3), jnp.eye(3)),) * 2)
                turned = [jnp.asarray(Rotation.from_rotvec(handed * s @ turn).as_matrix()) for turn in turns]
                poses = [Frame(jnp.asarray(s @ place), turn) for place, turn in zip(0.1 * x, turned)]
                rates = [jnp.asarray(np.concatenate([s @ one[:3], handed * s @ one[3:]])) for one in v]
                f_a, m_a, f_b, m_b = jnp.split(load.force(*poses, *rates, jnp.zeros(())), 4)
                found.append(np.stack([s @ f_a, handed * s @ m_a, s @ f_b, handed * s @ m_b]))
        half = len(found) // 2
        np.testing.assert_allclose(found[half:], found[:half], rtol=1e-12, atol=1e-12)  # round-off of forces up to 30
        assert np.abs(found).max() > 1.0


def test_names_of_an_axle():
    """What the rig and its users address."""
    both = lambda *names: {f"{side}_{name}" for side in ("left", "right") for name in names}
    links = ("upper_arm", "lateral_link", "trailing_link", "tie_rod")
    bodies, joints, forces = names(Axle.load("multi_link"))
    assert bodies == {"chassis", "subframe"} | both("knuckle", "wheel", "anti_roll_bar", *links)
    at_knuckle = (f"{link}_knuckle" for link in links)
    assert joints == both("hub", "drop_link", "anti_roll_bar_subframe", *at_knuckle)
    bushings = ("upper_arm_subframe_1", "upper_arm_subframe_2", "lateral_link_subframe", "tie_rod_subframe")
    mounts = ("subframe_front", "subframe_rear", "trailing_link_chassis")
    assert forces == {"gravity", "anti_roll_bar"} | both("spring", "damper", *bushings, *mounts)

    _, joints, forces = names(Axle.load("multi_link"), compliant=False, tyres=True)
    assert joints >= {"subframe", "left_tie_rod_subframe", "right_upper_arm_subframe", "left_trailing_link_chassis"}
    assert forces == {"gravity", "anti_roll_bar"} | both("spring", "damper", "tyre")

    bodies, joints, forces = names(Axle.load("push_rod"), links="rods")
    assert bodies == {"chassis", "rack"} | both("knuckle", "wheel", "anti_roll_bar", "upper", "lower", "rocker")
    assert joints >= {"rack_chassis", "steering"} | both("tie_rod", "push_rod", "rocker_chassis")
    assert forces >= both("bump_stop", "rebound_stop", "upper_chassis_1", "lower_chassis_2")


def test_whose_the_numbers_are():
    """Of one corner for both sides, or of each; and the same where nothing is on one side only."""
    axle = Axle.load("five_link_suspension")  # its file is of the right-hand side
    jax.tree.map(np.testing.assert_array_equal, axle.right, QuarterCar.load())
    sizes = [sum(leaf.size for leaf in jax.tree.leaves(one)) for one in (axle, axle.left, axle.two_sided())]
    assert sizes == [sizes[1], sizes[1], 2 * sizes[1]]
    assert float(axle.mass) == pytest.approx(2 * float(axle.left.mass), rel=1e-15)
    steered = Axle.load("push_rod")
    assert float(steered.rack.ratio) == pytest.approx(0.06 / (2 * np.pi), rel=1e-15)
    between = steered.rack.part.mass + steered.bar.mass
    assert float(steered.mass) == pytest.approx(float(2 * steered.left.mass + between), rel=1e-15)


def driven(axle, **settings):
    """The wheels of a held axle moved up and down, each by itself."""
    model = axle.model(compliant=False, **settings)
    up = {
        side: lg.TranslationDriver(None, f"{side}_wheel", at=at, axis=(0, 0, 1))
        for side, at in axle.wheel_centres.items()
    }
    rig = lg.Model(model.bodies, model.joints | up, model.forces)
    return lambda left, right, **others: lg.kinematics(rig, {"left": left, "right": right, **others})


def turned(point, hinge, angle):
    """Rotation by SciPy about a line through two points."""
    axis = (hinge[1] - hinge[0]) / np.linalg.norm(hinge[1] - hinge[0])
    return hinge[0] + Rotation.from_rotvec(angle * axis).apply(np.asarray(point) - hinge[0])


class SemiTrailing:
    """The left side of the semi-trailing axle by its geometry: the arm's angle from the travel, then all else."""

    def __init__(self):
        file = document("semi_trailing_arm")
        over = lambda value: np.array(value) - [0.0, 0.0, file["road"]["height"]]
        self.hinge, self.centre = over(file["joints"]["pivot"]["at"]), over(file["wheel"]["centre"])
        bar = file["anti_roll_bar"]
        self.bearing, self.lever, self.end = (over(bar[key]) for key in ("bearing", "lever", "knuckle"))
        self.rate = np.pi * 79.3e9 * bar["diameter"] ** 4 / (32 * bar["length"])

    def angle(self, travel):
        height = lambda angle: turned(self.centre, self.hinge, angle)[2] - self.centre[2] - travel
        return brentq(height, -0.5, 0.5, xtol=1e-15)

    def wheel(self, travel):
        return turned(self.centre, self.hinge, self.angle(travel))

    def bar(self, travel):
        """The angle about y by which the lever has turned: the drop link keeps its length."""
        end, length = turned(self.end, self.hinge, self.angle(travel)), np.linalg.norm(self.end - self.lever)
        about = np.stack([self.bearing, self.bearing + np.array([0.0, 1.0, 0.0])])
        gap = lambda angle: np.linalg.norm(turned(self.lever, about, angle) - end) - length
        return brentq(gap, -0.3, 0.3, xtol=1e-15)


@pytest.fixture(scope="module")
def trailing():
    """A semi-trailing axle whose wheels travel alike, then opposed."""
    move = driven(Axle.load("semi_trailing_arm"))
    return move(np.concatenate([TRAVEL, TRAVEL]), np.concatenate([TRAVEL, -TRAVEL]))


def test_alike_both_wheels_move_by_the_geometry(trailing):
    left, right = (trailing.body(f"{side}_wheel") for side in ("left", "right"))
    n = len(TRAVEL)
    geometry = SemiTrailing()
    # round-off of Newton's last step, arms of 0.5 m and a condition of 1e2
    for found in (left.position[:n], right.position[:n] @ FLIP):
        np.testing.assert_allclose(found, [geometry.wheel(s) for s in TRAVEL], rtol=0, atol=1e-13)
    np.testing.assert_allclose(FLIP @ right.orientation[:n] @ FLIP, left.orientation[:n], rtol=0, atol=1e-13)


@pytest.mark.slow  # small version: test_alike_both_wheels_move_by_the_geometry
def test_alike_both_wheels_move_as_those_of_corners(trailing):
    corner, n = QuarterCar.load("semi_trailing_arm").travel(TRAVEL).body("wheel"), len(TRAVEL)
    left, right = (trailing.body(f"{side}_wheel") for side in ("left", "right"))
    # as above
    np.testing.assert_allclose(corner.position, [SemiTrailing().wheel(s) for s in TRAVEL], rtol=0, atol=1e-13)
    for found in (left.orientation[:n], FLIP @ right.orientation[:n] @ FLIP):
        np.testing.assert_allclose(found, corner.orientation, rtol=0, atol=1e-13)
    assert np.abs(np.asarray(corner.orientation) - np.eye(3)).max() > 0.05


def test_the_bar_is_twisted_by_roll_and_not_by_heave(trailing):
    """Against the lever's angle by its drop link of constant length, from SciPy; 417 N m/rad."""
    geometry, moment, n = SemiTrailing(), trailing.force("anti_roll_bar").moment, len(TRAVEL)
    np.testing.assert_allclose(moment[:n], 0.0, atol=1e-13 * geometry.rate)
    twists = np.array([geometry.bar(-s) - geometry.bar(s) for s in TRAVEL])  # of the right half from the left
    np.testing.assert_allclose(moment[n:], -geometry.rate * twists, rtol=0, atol=1e-12 * geometry.rate)
    assert np.abs(twists).max() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["five_link_suspension", "mcpherson", "multi_link", "push_rod", "twist_beam"])
@pytest.mark.parametrize("links", ["bodies", "rods"])
def test_every_axle_moves_as_its_corners(name, links):
    """Rack, subframe and bar in between change nothing where both wheels travel alike."""
    axle = Axle.load(name)
    motion, corner = driven(axle, links=links)(TRAVEL, TRAVEL), axle.left.travel(TRAVEL).body("wheel")
    for side, flip in (("left", np.eye(3)), ("right", FLIP)):
        wheel = motion.body(f"{side}_wheel")
        np.testing.assert_allclose(wheel.position @ flip, corner.position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(flip @ wheel.orientation @ flip, corner.orientation, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_rack_steers_both_wheels():
    """Rack to the left by up to 20 mm: as the closure whose tie rod begins there, on the right its mirror image."""
    way = np.array([-0.02, 0.005, 0.02])
    motion = driven(Axle.load("mcpherson"))(np.zeros(3), np.zeros(3), steering=way)

    def wheel(shift):
        closure = Closure(corner_of(document("mcpherson")))
        closure.chassis[-1] += [0.0, shift, 0.0]  # of the tie rod, which comes after the two of the control arm
        unknowns = closure.solve(0.0)
        return closure.centre + unknowns[:3], Rotation.from_rotvec(unknowns[3:]).as_matrix()

    for side, flip, sign in (("left", np.eye(3), 1.0), ("right", FLIP, -1.0)):
        found = motion.body(f"{side}_wheel")
        for i, shift in enumerate(way):
            at, turn = wheel(sign * shift)
            over = np.array([0.0, 0.0, 0.336])  # the closure's z is that of the file
            # SciPy ends at 1e-14 m of closure, over arms of 0.2 m
            np.testing.assert_allclose(found.position[i], flip @ (at + over), rtol=0, atol=1e-12)
            np.testing.assert_allclose(found.orientation[i], flip @ turn @ flip, rtol=0, atol=1e-12)
    assert np.abs(np.asarray(found.orientation[0]) - np.eye(3)).max() > 0.1


# At rest.


def pushed(axle, force=0.0, **settings):
    """Guided, on its tyres, with a force outward on the left wheel."""
    model = axle.model(chassis="guided", tyres=True, **settings)
    push = lg.AppliedForce("left_wheel", force=(0.0, force, 0.0))
    return lg.Model(model.bodies, model.joints, model.forces | {"push": push})


balance = eqx.filter_jit(lambda model: lg.equilibrium(model).q)


@eqx.filter_jit
def at_the_design(model):
    """Forces without those of joints, and B, at rest in the reference configuration."""
    system = model.system()
    q, v = system.reference()
    rest = jnp.zeros_like(v)
    lam = jnp.zeros(len(system.constraint_names))
    return system.residual(q, rest, rest, lam, 0.0), system.constraint_jacobian(q, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["twist_beam", "multi_link"])
def test_its_forces_are_in_balance(name):
    """Joints can bear what bushings, springs, tyres and weights leave: by least squares of NumPy; half to each tyre."""
    model = pushed(Axle.load(name))
    force, jacobian = at_the_design(model)
    left = force + jacobian.T @ np.linalg.lstsq(jacobian.T, -np.asarray(force))[0]
    weights = [9.81 * float(body.mass) for body in model.bodies.values()]
    np.testing.assert_allclose(left, 0.0, atol=1e-9 * sum(weights))  # N, N m: a condition of 1e6
    assert np.abs(force).max() > 100.0
    for side in ("left", "right"):
        assert float(model.forces[f"{side}_tyre"].preload) == pytest.approx(sum(weights) / 2, rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped())
def test_it_rests_where_it_was_designed(name):
    model = pushed(Axle.load(name))
    found = balance(model)
    at, axes = (np.stack([getattr(of, key) for _, of in sorted(model.bodies.items())]) for key in PLACED)
    # forces of 4 kN to round-off times a condition of 1e6, over the 1e5 N/m of a tyre; turns over a track of a metre
    np.testing.assert_allclose(found.position, at, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.orientation, axes, rtol=0, atol=1e-10)


def stiffer(axle, factor, which):
    """With rates of some bushings as many times as high."""
    rates = lambda a: [
        rate
        for name, mount in sorted(a.left.mounts.items())
        if name.startswith(which)
        for rate in (mount.stiffness, mount.rotational_stiffness)
    ]
    return eqx.tree_at(rates, axle, replace_fn=lambda rate: factor * rate)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["multi_link", "push_rod"])
def test_stiff_bushings_become_joints(name):
    """Mounts as if the subframe were the chassis, pairs of bushings as hinges: under 200 N what is left is ∝ 1/k."""
    axle = Axle.load(name)
    which = "subframe_" if axle.subframe is not None else ""
    others = {key: mount for key, mount in axle.left.mounts.items() if not key.startswith(which)}
    limit = pushed(eqx.tree_at(lambda a: a.left.mounts, axle, others), 200.0)
    at = sorted(limit.bodies).index("left_wheel")
    moved = lambda model: np.asarray(balance(model).position[at] - model.bodies["left_wheel"].position)
    factors = (1.0, 3.0, 9.0) if which else (1 / 81, 1 / 27, 1 / 9)
    left = [np.linalg.norm(moved(pushed(stiffer(axle, f, which), 200.0)) - moved(limit)) for f in factors]
    # a/k + b/k²: 2 % of the first for mounts that move the wheel by 1 % of what it moves
    assert left[1] / left[0] == pytest.approx(1 / 3, rel=0.02)
    assert left[2] / left[1] == pytest.approx(1 / 3, rel=0.02 / 3)


@pytest.mark.slow
def test_one_number_is_of_both_sides():
    """The derivative by the left corner's spring seat: that of both seats of two-sided axles, and differences."""
    axle = Axle.load("semi_trailing_arm")
    seat = lambda a: a.left.spring.ends["chassis"]
    other = lambda a: a.other.spring.ends["chassis"]
    outward = jnp.asarray([0.3, 1.0, -0.5])

    @eqx.filter_jit
    def push(axle):
        """Of the left spring and, weighted so that sides differ, of the right one."""
        forces = axle.model(compliant=False).forces
        return forces["left_spring"].preload + 0.5 * forces["right_spring"].preload

    def slope(axle, where, direction):
        moved = lambda h: push(eqx.tree_at(where, axle, where(axle) + h * direction))
        return jax.jvp(moved, (jnp.zeros(()),), (jnp.ones(()),))[1], moved

    both, moved = slope(axle, seat, outward)
    pair = axle.two_sided()
    sides = [slope(pair, where, d)[0] for where, d in ((seat, outward), (other, jnp.asarray(FLIP) @ outward))]
    # one linear system, of condition 1e4
    assert float(both) == pytest.approx(float(sum(sides)), rel=1e-10)
    assert float(sides[0]) == pytest.approx(2.0 * float(sides[1]), rel=1e-10)
    h = 1e-3
    # h⁴/30 of a fifth derivative with arms of 0.2 m: 1e-12/30/0.2⁴ = 2e-11; round-off 1e-16/h times a condition of 1e4
    points = [float(moved(i * h)) for i in (-2, -1, 1, 2)]
    difference = (points[0] - 8 * points[1] + 8 * points[2] - points[3]) / (12 * h)
    assert float(both) == pytest.approx(difference, rel=1e-8)


def test_preloads_that_are_given():
    """They stay as they are, turned into the axes of the bushing, and mirrored: forces S f, moments −S m.

    Nor do they change what springs and tyres bear.
    """
    axle = Axle.load("semi_trailing_arm")
    force, moment = jnp.asarray([100.0, 20.0, -3.0]), jnp.asarray([4.0, 5.0, 6.0])
    where = lambda a: (a.left.mounts["pivot"].preload, a.left.mounts["pivot"].rotational_preload)
    given = eqx.tree_at(where, axle, (force, moment), is_leaf=lambda leaf: leaf is None)
    for side, s in (("left", np.eye(3)), ("right", FLIP)):
        car = getattr(given, side)
        for _, bushing in car.mounts["pivot"].elements("it", "chassis", f"{side}_knuckle", car.joints["pivot"].at):
            np.testing.assert_allclose(bushing.triad @ bushing.preload, s @ force, rtol=1e-14)
            handed = np.linalg.det(s) * s @ moment
            np.testing.assert_allclose(bushing.triad @ bushing.rotational_preload, handed, rtol=1e-14)
    forces = given.model(tyres=True).forces
    np.testing.assert_array_equal(forces["right_pivot_2"].preload, bushing.preload)
    assert float(forces["left_tyre"].preload) == pytest.approx(9.81 * float(axle.mass) / 2, rel=1e-12)


# What is refused: the file, where in it, what is put there (None: it goes), and what the message says.
MISTAKES = {
    "table that is none": (
        "mcpherson",
        {"anti_rollbar": {}},
        ("key 'anti_rollbar'", "is no key of this table", "'anti_roll_bar'"),
    ),
    "bushing of no joint": (
        "multi_link",
        {"bushings.upper_arm_chassis": {"stiffness": [1.0, 1.0, 1.0]}},
        ("key 'bushings.upper_arm_chassis'", "there is no such joint", "'upper_arm_subframe'"),
    ),
    "bushing that slides": (
        "mcpherson",
        {"bushings.slider": {"stiffness": [1.0, 1.0, 1.0]}},
        ("key 'bushings.slider.stiffness'", "'slider' slides", "leave it a joint"),
    ),
    "bushing without rotations": (
        "mcpherson",
        {"bushings.strut_chassis.rotational_stiffness": None},
        ("key 'bushings.strut_chassis.rotational_stiffness'", "is missing"),
    ),
    "bushing that is free": (
        "mcpherson",
        {"bushings.strut_chassis.rotational_stiffness": [1.0, 1.0, 0.0]},
        ("key 'bushings.strut_chassis.rotational_stiffness'", "positive, else a body can move freely", "0.0]"),
    ),
    "free beside a curve": (
        "mcpherson",
        {
            "bushings.control_arm_chassis.stiffness": [0.0, 1e6, 0.0],
            "bushings.control_arm_chassis.spring_1": [[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0]],
        },
        ("key 'bushings.control_arm_chassis.stiffness'", "positive, else a body can move freely", "0.0]"),
    ),
    "curve beside zero": (
        "mcpherson",
        {"bushings.control_arm_chassis.spring_1": [[-1.0, -1.0], [0.0, 0.5], [1.0, 1.0]]},
        ("key 'bushings.control_arm_chassis.spring_1'", "must have a point [0, 0], where it rises", "`preload`"),
    ),
    "curve that falls": (
        "mcpherson",
        {"bushings.control_arm_chassis.rotational_damper_2": [[-1.0, -1.0], [0.0, 0.0], [1.0, -1.0]]},
        ("key 'bushings.control_arm_chassis.rotational_damper_2'", "x increasing and force never falling"),
    ),
    "rate below zero": (
        "mcpherson",
        {"bushings.control_arm_chassis.damping": [-1.0, 1.0, 0.0]},
        ("key 'bushings.control_arm_chassis.damping'", "zero or positive", "[-1.0, 1.0, 0.0]"),
    ),
    "two rates of one": (
        "multi_link",
        {"bushings.tie_rod_subframe.stiffness": [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]},
        ("key 'bushings.tie_rod_subframe.stiffness'", "must be three numbers"),
    ),
    "axes that are one": (
        "semi_trailing_arm",
        {"bushings.pivot.axes": [[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]},
        ("key 'bushings.pivot.axes'", "two different directions", "[2.0, 0.0, 0.0]"),
    ),
    "key of a mount": (
        "multi_link",
        {"subframe.mounts.rear.place": [0.0, 0.0, 0.0]},
        ("key 'subframe.mounts.rear.place'", "is no key of this table", "'at'"),
    ),
    "half a preload": (
        "semi_trailing_arm",
        {"bushings.pivot.preload": [1.0, 0.0, 0.0]},
        ("key 'bushings.pivot.rotational_preload'", "is missing"),
    ),
    "link on two that are one": (
        "multi_link",
        {"links.tie_rod.chassis": [-0.257, 0.2, -0.116]},
        ("key 'links.tie_rod.subframe'", "'chassis'", "one body to a corner", "hold on to one of them"),
    ),
    "link on no rack": (
        "multi_link",
        {"links.tie_rod.rack": [-0.257, 0.2, -0.116]},
        ("key 'links.tie_rod.rack'", "is no body", "'subframe'"),
    ),
    "link of a name that is taken": (
        "multi_link",
        {"links.drop_link": {"chassis": [0.0, 0.4, 0.1], "knuckle": [0.1, 0.8, 0.2], "mass": 1.0}},
        ("key 'links.drop_link'", "is a name of its own"),
    ),
    "rack on no subframe": (
        "mcpherson",
        {"rack.on": "subframe"},
        ("key 'rack.on'", "one of ['chassis']", "'subframe'"),
    ),
    "rack of two ratios": (
        "mcpherson",
        {"rack.ratio": 0.01},
        ("key 'rack.c_factor'", "2π times `ratio`", "one of them"),
    ),
    "rack without mass": ("mcpherson", {"rack.mass": None}, ("key 'rack.mass'", "is missing")),
    "twist beam of two arms": (
        "twist_beam",
        {"twist_beam.knuckle": None},
        ("key 'twist_beam.beam'", "fixed to one body of the corner", "['knuckle']", "got []"),
    ),
    "arm on a hinge": (
        "twist_beam",
        {"joints.pivot.type": "revolute", "joints.pivot.at": [[0.42, 0.5, 0.03], [0.42, 0.6, 0.03]]},
        ("key 'twist_beam.knuckle'", "on one ball joint of the chassis", "'knuckle' has none", "of type 'spherical'"),
    ),
    "twist beam without length": (
        "twist_beam",
        {"twist_beam.knuckle": [0.27, 0.0, 0.015]},
        ("key 'twist_beam.knuckle'", "is in the plane y = 0", "its mirror image", "move it"),
    ),
    "twist beam without a section": ("twist_beam", {"twist_beam.beam": None}, ("key 'twist_beam.beam'", "is missing")),
    "shear centre in mm": (
        "twist_beam",
        {"twist_beam.shear_centre": [0.0, 35.4]},
        ("key 'twist_beam.shear_centre'", "is in metres", "35.4 m are more than the 1 m", "did you mean 0.0354"),
    ),
    "twist beam on the other side": (
        "twist_beam",
        {"twist_beam.knuckle": [0.27, -0.5, 0.015]},
        ("key 'twist_beam.knuckle'", "is at y = -0.5 m", "on the other side of the car", "turn the sign"),
    ),
    "bump in mm": (
        "twist_beam",
        {"bump.height": 50.0},
        ("key 'bump.height'", "is in metres", "50 m are more than the 1 m", "did you mean 0.05"),
    ),
    "shear centre of three": (
        "twist_beam",
        {"twist_beam.shear_centre": [0.0, 0.0, 0.03]},
        ("key 'twist_beam.shear_centre'", "2 numbers", "[0.0, 0.0, 0.03]"),
    ),
    "twist beam up along it": (
        "twist_beam",
        {"twist_beam.beam.up": [0.0, 1.0, 0.0]},
        ("key 'twist_beam.beam'", "`up`", "lies along the beam"),
    ),
    "twist beam with a mass": (
        "twist_beam",
        {"twist_beam.mass": 9.0},
        ("key 'twist_beam.mass'", "is no body and no key of this table", "'shear_centre'"),
    ),
    "section of five": (
        "twist_beam",
        {"twist_beam.beam.section.stiffness": [1.0] * 5},
        ("key 'twist_beam.beam.section.stiffness'", "6 numbers"),
    ),
    "section with a material": (
        "twist_beam",
        {"twist_beam.beam.young": 2e11},
        ("key 'twist_beam.beam.young'", "is no key of this table", "'section'"),
    ),
    "section that is free": (
        "twist_beam",
        {"twist_beam.beam.section.stiffness": [1.0, 1.0, 1.0, 0.0, 1.0, 1.0]},
        ("key 'twist_beam.beam'", "must be positive"),
    ),
    "bar of two rates": (
        "mcpherson",
        {"anti_roll_bar.stiffness": 400.0},
        ("key 'anti_roll_bar.stiffness'", "follows from the bar's dimensions", "'diameter'"),
    ),
    "bar of no rate": (
        "mcpherson",
        {"anti_roll_bar.diameter": None, "anti_roll_bar.length": None},
        ("key 'anti_roll_bar.diameter'", "is missing"),
    ),
    "bar of a bore": (
        "mcpherson",
        {"anti_roll_bar.bore": 0.03},
        ("key 'anti_roll_bar.diameter'", "need `diameter` > `bore`", "0.03"),
    ),
    "bar without drop link": (
        "mcpherson",
        {"anti_roll_bar.knuckle": None},
        ("key 'anti_roll_bar.lever'", "one body of ['control_arm', 'knuckle'", "got []"),
    ),
    "lever along the bar": (
        "mcpherson",
        {"anti_roll_bar.lever": [0.33, 0.72, -0.13]},
        ("key 'anti_roll_bar.lever'", "has no length across y", "[0.33, 0.72,"),
    ),
    "drop link along the lever": (
        "mcpherson",
        {"anti_roll_bar.knuckle": [-0.2, 0.8, -0.13]},
        ("key 'anti_roll_bar.lever'", "goes along it", "cannot turn it"),
    ),
    "drop link at the hinge of an arm": (
        "mcpherson",
        {
            "anti_roll_bar.knuckle": None,
            "anti_roll_bar.control_arm": [0.03, 0.515, -0.148],
            "anti_roll_bar.lever": [0.03, 0.6, 0.1],
        },
        (
            "key 'anti_roll_bar'",
            "the end of the drop link on 'control_arm' moves by",
            "does not twist as the car rolls",
        ),
    ),
    "share of more than all": (
        "multi_link",
        {"vehicle": {"traction_share": 1.2}},
        ("key 'vehicle.traction_share'", "0 and 1", "1.2"),
    ),
    "stop on one": (
        "semi_trailing_arm",
        {"bump_stop.knuckle": [0.3, 0.8, 0.1]},
        ("key 'bump_stop.knuckle'", "one point on each of two bodies", "those of the damper"),
    ),
    "stop without rounding": (
        "semi_trailing_arm",
        {"rebound_stop.rounding": 0.0},
        ("key 'rebound_stop.rounding'", "positive", "0.0"),
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_no_axle_is(mistake, tmp_path):
    name, changes, parts = MISTAKES[mistake]
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(changed(document(name), changes)), encoding="utf-8")
    with pytest.raises(ValueError, match=says("Hardpoint file", "mine.json", *parts)):
        Axle.load(path)


def test_an_axle_that_is_not_driven(load):
    axle = load(document("multi_link") | {"vehicle": {"traction_share": 0.0}})
    assert axle.vehicle["traction_share"] == 0.0


def test_how_files_are_encoded(tmp_path):
    """With a byte-order mark, as some editors write it; in UTF-16 the message says what to do."""
    path = tmp_path / "mine.toml"
    text = (DATA / "mcpherson.toml").read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8-sig")
    assert Axle.load(path).left.links.keys() == Axle.load("mcpherson").left.links.keys()
    path.write_text(text, encoding="utf-16")
    with pytest.raises(ValueError, match=says("mine.toml", "cannot be read", "save it as UTF-8")):
        Axle.load(path)


def test_settings_that_there_are_not():
    axle = Axle.load("five_link_suspension")
    with pytest.raises(ValueError, match="`chassis` must be 'held' or 'guided', got 'heave'"):
        axle.model(chassis="heave")
    with pytest.raises(ValueError, match="`links` must be 'bodies' or 'rods', got 'ropes'"):
        axle.model(links="ropes")
