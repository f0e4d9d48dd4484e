"""Links of suspensions that bend, and anti-roll bars that are beams: against rigid links, closed forms, differences."""

import copy
import dataclasses
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
from suspension_closures import changed

import lgsens as lg
from lgsens.examples import Axle, QuarterCar, SectionShape
from lgsens.examples._axle_numbers import places
from lgsens.examples._axle_parts import Bar
from lgsens.examples._corner_scene import corner_scene
from lgsens.examples._suspension_parts import reflected
from lgsens.model import BeamElement, lumped

DATA = resources.files("lgsens.examples") / "data"
STEEL = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}
TABLE = {"tube": {"diameter": 0.03, "thickness": 0.003}, "damping": 1e-5, **STEEL}
ROUND = {"round": {"diameter": 0.022}, **STEEL}
LEAN = {"wheel": "locked", "chassis": "heave", "links": "rods"}


def tube(diameter=0.03, thickness=0.003, young=2.1e11):
    # η = 1e-5 s: the strut's modes, thousands of rad/s, end within a bump and change its Ψ₀ by 1e-5
    shape = {"tube": {"diameter": diameter, "thickness": thickness}}
    return SectionShape(shape, STEEL | {"young": young, "damping": 1e-5})


def document(name, changes):
    return changed(copy.deepcopy(tomllib.loads((DATA / f"{name}.toml").read_text(encoding="utf-8"))), changes)


def differences(function, step):
    """Central differences of fourth order."""
    a, b, c, d = (function(i * step) for i in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * step)


@pytest.fixture
def file(tmp_path):
    def write(name, changes):
        path = tmp_path / "mine.json"
        path.write_text(json.dumps(document(name, changes)), encoding="utf-8")
        return path

    return write


def strut_as_a_beam(beam=TABLE, **more):
    return {"links.rollover_strut.mass": None, "links.rollover_strut.beam": beam, **more}


def test_a_file_says_what_bends(file):
    """As `bending` says it; nodes by shares of the way, 0.556 and 0.817 of spring and damper; masses and numbers."""
    car = QuarterCar.load(file("five_link_suspension", strut_as_a_beam(TABLE | {"elements": 5})))
    link = car.links["rollover_strut"]
    assert link.beam is not None
    nodes = dict(link.beam.nodes)
    assert (nodes["spring"], nodes["damper"], nodes["joints.rollover_strut_knuckle"]) == (3, 4, 5)
    said = QuarterCar.load().bending({"rollover_strut": tube()}, elements=5)
    assert jax.tree.structure(said.links) == jax.tree.structure(car.links)
    jax.tree.map(np.testing.assert_array_equal, said.links, car.links)

    length = np.linalg.norm(np.subtract(link.knuckle, link.chassis))
    mass = 7850.0 * np.pi * 0.027 * 0.003 * length
    assert float(car.mass - QuarterCar.load().mass) == pytest.approx(mass - 4.51 * 0.4535, rel=1e-9)  # of 450 kg
    # A rigid one is as its nodes are: a twelfth of m L² and twice that over elements² for half masses at the ends.
    part = car.rigid().links["rollover_strut"]
    across = np.linalg.eigvalsh(part.inertia)[-1]
    thin = mass * (0.03**2 + 0.024**2) / 16.0
    assert across == pytest.approx(mass * length**2 / 12.0 * (1 + 2 / 25) + thin, rel=1e-12)

    offered = {place.name for place in places(Axle(car))["rates"]}
    assert {f"links.rollover_strut.beam.tube.{key}" for key in ("diameter", "thickness")} <= offered
    scene = eqx.filter_eval_shape(lambda: corner_scene(car, wheel="locked", links="rods", side="left"))
    elements = {f"left_rollover_strut.{i}" for i in range(5)}
    assert {*scene.bodies} == {"left_knuckle", "left_wheel", *elements, "left_rollover_strut.5"}
    assert elements == {*scene.forces} - {"left_spring", "left_damper"} == {*scene.sought} - {"left_spring"}
    assert scene.joints["left_rollover_strut_knuckle"].b == "left_rollover_strut.5"
    assert {*scene.forces["left_spring"].bodies} == {"left_rollover_strut.3", "chassis"}


def test_the_mirror_image_of_a_beam():
    """Its section stands upright as in a mirror, by principal axes of the same stiffness."""
    flat = lg.BeamSection.rectangle(0.02, 0.03, **STEEL)
    car = QuarterCar.load().bending({"trailing_arm": flat}, up=(0.1, 0.2, 1.0))
    one, other = (of.links["trailing_arm"].bent("arm") for of in (car, car.mirrored()))
    flip = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(other.points, np.asarray(one.points) * flip, rtol=0, atol=1e-15)
    # axes 1 and 3 are mirrored, axis 2 closes a right-handed triad: round-off of unit vectors
    np.testing.assert_allclose(other.axes, np.asarray(one.axes) * flip[:, None] * flip, rtol=0, atol=1e-14)
    jax.tree.map(np.testing.assert_array_equal, car.mirrored().mirrored(), car)


def test_what_holds_on_to_beams_when_numbers_are_traced():
    car = QuarterCar.load()
    with pytest.raises(ValueError, match=says("nodes of 'rollover_strut'", "not known here", "let it bend")):
        jax.eval_shape(lambda p: car.with_values(hardpoints=p).bending({"rollover_strut": tube()}), car.hardpoints)
    bent = jax.eval_shape(lambda d: car.bending({"rollover_strut": tube(d)}), jnp.ones(()))
    assert dict(bent.links["rollover_strut"].beam.nodes)["spring"] == 2
    with pytest.raises(ValueError, match=says("`bending`: 'spring' is not one of", "the links with two ends")):
        car.bending({"spring": tube()})
    with pytest.raises(ValueError, match=says("'trailing_arm': must be a BeamSection or a SectionShape", "0.03")):
        car.bending({"trailing_arm": 0.03})
    with pytest.raises(ValueError, match="shape \\(6,\\), that of principal axes"):
        car.bending({"trailing_arm": lg.BeamSection(jnp.eye(6), 1.0, (1.0, 1.0, 1.0))})
    with pytest.raises(ValueError, match=says("`shape` must be one of ['rectangle', 'round', 'tube'], got ['pipe']")):
        SectionShape({"pipe": {}}, STEEL)
    with pytest.raises(ValueError, match=says("`material` must have ['density', 'poisson', 'young'], got ['young']")):
        SectionShape({"round": {"diameter": 0.02}}, {"young": 2e11})


OF_STRUT = "key 'links.rollover_strut"
MISTAKES = {
    "mass and beam": (
        {"links.rollover_strut.beam": TABLE},
        (OF_STRUT + ".mass'", "follows from the section of `beam`; leave one of the two out"),
    ),
    "two sections": (
        strut_as_a_beam(TABLE | {"round": {"diameter": 0.03}}),
        (OF_STRUT + ".beam'", "needs one section of ['rectangle', 'round', 'section', 'tube'], got ['tube', 'round']"),
    ),
    "no section": (strut_as_a_beam(STEEL), (OF_STRUT + ".beam'", "needs one section", "got []")),
    "key of another shape": (
        strut_as_a_beam(STEEL | {"tube": {"diameter": 0.03, "wall": 0.003}}),
        (OF_STRUT + ".beam.tube.wall'", "is no key of this table", "['diameter', 'thickness']"),
    ),
    "wall": (
        strut_as_a_beam(STEEL | {"tube": {"diameter": 0.03, "thickness": 0.02}}),
        (OF_STRUT + ".beam'", "`thickness` is more than the radius; take `round`"),
    ),
    "no material": (
        strut_as_a_beam({"tube": TABLE["tube"], "young": 2.1e11, "poisson": 0.3}),
        (OF_STRUT + ".beam.density'", "is missing"),
    ),
    "poisson": (strut_as_a_beam(TABLE | {"poisson": 0.7}), (OF_STRUT + ".beam'", "at most 0.5, got 0.7")),
    "elements": (
        strut_as_a_beam(TABLE | {"elements": 2.5}),
        (OF_STRUT + ".beam.elements'", "a whole number of at least 1, got 2.5"),
    ),
    "up along it": (
        strut_as_a_beam(TABLE | {"up": [4.4, -14.7, 0.5]}),
        (OF_STRUT + ".beam'", "`up`", "lies along the beam; give a direction across it"),
    ),
    "three ends": (
        strut_as_a_beam(**{"links.rollover_strut.wishbone": [0.0, -20.0, 14.0]}),
        (OF_STRUT + ".beam'", "goes between two ends", "'wishbone'", "leave it out, the link is rigid"),
    ),
}
BARS = {
    "stiffness and beam": (
        {"anti_roll_bar.beam": ROUND, "anti_roll_bar.mass": None, "anti_roll_bar.length": None},
        ("key 'anti_roll_bar.diameter'", "follows from the section of `beam`"),
    ),
    "bar of another shape": (
        {f"anti_roll_bar.{key}": None for key in ("mass", "diameter", "length")}
        | {"anti_roll_bar.beam": STEEL | {"rectangle": {"width": 0.01, "height": 0.02}}},
        ("key 'anti_roll_bar.beam.rectangle'", "is no key of this table", "'round'", "'tube'"),
    ),
    "bushing of a hinge": (
        {"anti_roll_bar.bushing": {"stiffness": [1e7] * 3, "rotational_stiffness": [10.0] * 3}},
        ("key 'anti_roll_bar.bushing'", "is of the bearings of a bar with `beam`", "leave it out"),
    ),
}


@pytest.mark.parametrize("mistake", [*MISTAKES, *BARS])
def test_what_no_beam_is(mistake, file):
    changes, parts = (MISTAKES | BARS)[mistake]
    with pytest.raises(ValueError, match=says("Hardpoint file", "mine.json", *parts)):
        Axle.load(file("mcpherson" if mistake in BARS else "five_link_suspension", changes))


def displaced(build):
    """What bodies move by, small: K x + Bᵀλ = −r₀, B x = 0 in the reference configuration; one program with the scene.

    `build`: gives the model, names of bodies, and what else is asked for of it.
    """

    @jax.jit
    def solved():
        model, bodies, more = build()
        system = model.system()
        q, v = system.reference()
        none = jnp.zeros(system.constraint(q, jnp.zeros(())).shape)
        stiffness, _, jacobian = system.tangents(q, v, v, none, jnp.zeros(()))
        matrix = jnp.block([[stiffness, jacobian.T], [jacobian, jnp.zeros((none.size,) * 2)]])
        force = -system.residual(q, v, v, none, jnp.zeros(()))
        x = jnp.linalg.solve(matrix, jnp.concatenate([force, none]))[: v.size]
        return x.reshape(-1, 6)[np.array([system.body_names.index(body) for body in bodies]), :3], more

    return jax.tree.map(np.asarray, solved())


def softness(d, a, r2, b2, length, lever=1.0, middle=1.0):
    """C of `Bar`: what either lever's end moves by per force, of round steel; shares of the bending of elements."""
    E, G, nu = 2.1e11, 2.1e11 / 2.6, 0.3
    second_moment, shear = np.pi * d**4 / 64, 6 * (1 + nu) / (7 + 6 * nu) * G * np.pi * d**2 / 4
    bending = lever * a**3 / (3 * E * second_moment) + middle * b2 * length / (6 * E * second_moment)
    return bending + a / shear + r2 * length / (4 * G * second_moment) + 2 * b2 / (shear * length)


def test_an_anti_roll_bar_bends_and_twists_as_closed_forms_say():
    """Its right lever held, its left one pushed: 2 C of `Bar` per force, of elements that take bending moments, which
    grow along them, at their middles: a lever's bending less by 1/4n², that of the middle by 1/n². Timoshenko."""
    n, along = 2, np.array([0.05, 0.0, 0.2]) / np.hypot(0.05, 0.2)  # y × lever

    def build():
        points = jnp.array([0.1, 0.45, 0.2]), jnp.array([-0.1, 0.6, 0.25])
        left = Bar(*points, {}, jnp.ones(()), {}, "chassis")
        left = left.bending(SectionShape({"round": {"diameter": 0.02}}, STEEL), elements=n)
        right = reflected(left)
        bar = left.bent(right)
        tip, first, second, last = bar.corners
        joints = {
            "left": lg.SphericalJoint(None, first, at=left.bearing),
            "right": lg.SphericalJoint(None, second, at=right.bearing),
            "held": lg.DistanceJoint(None, last, at_a=right.lever + along, at_b=right.lever),
        }
        push = {"push": lg.AppliedForce(tip, at=left.lever, force=along)}
        masses, places = zip(*((body.mass, body.position) for body in bar.bodies.values()))
        more = left.rate, left.own_mass, lumped(jnp.stack(masses), jnp.stack(places))[:2]
        return lg.Model(bar.bodies, joints, bar.forces | push), (tip,), more

    moved, (rate, own_mass, (mass, centre)) = displaced(build)
    a, r2, b2 = np.sqrt(0.0425 + 0.0225), 0.0425, 0.0225
    closed = lambda lever, middle: softness(0.02, a, r2, b2, 0.9, lever, middle)
    # of the linear equations, condition 1e9 or so of N/m along and N m across
    assert moved[0] @ along == pytest.approx(2 * closed(1 - 1 / (4 * n**2), 1 - 1 / n**2), rel=1e-7)
    assert rate == pytest.approx(r2 / (2 * closed(1.0, 1.0)), rel=1e-13)
    np.testing.assert_allclose([own_mass, mass], 7850 * np.pi * 0.01**2 * (0.9 + 2 * a), rtol=1e-13)
    np.testing.assert_allclose(centre[1], 0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("corners", "sections", "message"),
    [
        ([[0, 0, 0], [1, 0, 0]], 1, r"`corners` must have shape \(m, 3\) with m of at least 3, got \(2, 3\)"),
        (np.eye(3), 3, "`section` must be one or one of each of 2 pieces, got 3"),
    ],
)
def test_what_no_beam_with_corners_is(corners, sections, message):
    section = lg.BeamSection.round(0.02, **STEEL)
    with pytest.raises(ValueError, match=message):
        lg.BentBeam("it", section if sections == 1 else [section] * sections, corners)


@pytest.mark.slow
def test_a_leaf_spring_and_a_twist_beam_axle():
    """A leaf on its eye and its shackle: F L³/48EI, and shear. Two trailing arms with a beam between them, c behind
    their pivots, one wheel held, the other pushed up by 2 l φ: G J (2φ)²/2L of twist and, as ends of the beam do not
    tilt, 6 E I (2cφ)²/L³ of bending, and shear."""

    def build():
        leaf = lg.Beam("leaf", lg.BeamSection.rectangle(0.06, 0.02, **STEEL), [[0, 0, 0.5], [1.2, 0, 0.5]], elements=4)
        open_section = lg.BeamSection([2e8, 6e7, 6e7, 150.0, 4e4, 4e4], 5.0, [0.01, 0.005, 0.005])  # a V: G J is small
        across = lg.Beam("beam", open_section, [[-0.1, 0.5, 0], [-0.1, -0.5, 0]], elements=4)
        joints: dict = {
            "eye": lg.RevoluteJoint(None, "leaf.0", at=[0, 0, 0.5], axis=[0, 1.0, 0]),
            "shackle": lg.DistanceJoint(None, "leaf.4", at_a=[1.2, 0, 0.6], at_b=[1.2, 0, 0.5]),
            "held": lg.DistanceJoint(None, "beam.4", at_a=[-0.4, -0.6, 1.0], at_b=[-0.4, -0.6, 0]),
        }
        for node, y in (("beam.0", 0.6), ("beam.4", -0.6)):  # and the arms, which are rigid
            joints[node] = lg.RevoluteJoint(None, node, at=[0, y, 0], axis=[0, 1.0, 0])
        forces = {
            "axle": lg.AppliedForce("leaf.2", at=[0.6, 0, 0.5], force=[0, 0, 1.0]),
            "push": lg.AppliedForce("beam.0", at=[-0.4, 0.6, 0], force=[0, 0, 1.0]),
        }
        model = lg.Model(leaf.bodies | across.bodies, joints, leaf.forces | across.forces | forces)
        return model, ("leaf.2", "beam.0"), leaf.section.stiffness

    moved, section = displaced(build)
    half = 2  # elements in either half of the leaf, whose bending they lack 1/4n² of
    expected = 1.2**3 / (48 * section[4]) * (1 - 1 / (4 * half**2)) + 1.2 / (4 * section[2])
    np.testing.assert_allclose(moved[0], [0.0, 0.0, expected], rtol=1e-8, atol=1e-8 * expected)
    arm, c, n = 0.4, 0.1, 4
    s_shape = 1 / (12 * 4e4) * (1 - 1 / n**2) + 1 / 6e7  # what ends of the beam move apart by per force
    roll = 4 * 150.0 + 4 * c**2 / s_shape  # of both wheels [N m/rad]
    # F l φ is half of φ² roll/2, of both ends; linear equations of 1e8 and 1e2
    np.testing.assert_allclose(moved[1, 2], c * 2 * (2 * arm / roll), rtol=1e-6)


@pytest.mark.slow
def test_the_lightest_tube_that_bears_a_load():
    """A cantilever of one element, its mass least under a limit of stress: the thinnest wall, and the diameter with
    which F L/2, the moment in the middle of the element, over the section's modulus is at the limit."""
    load, limit = 200.0, 2e8

    def mass_and_stress(x):
        section = lg.BeamSection.tube(x["diameter"], x["thickness"], **STEEL)
        axes = {"axes_a": jnp.eye(3), "axes_b": jnp.eye(3)}
        arm = BeamElement(None, "tip", at_a=[0, 0, 0], at_b=[1.0, 0, 0], section=section, **axes)
        push = lg.AppliedForce("tip", at=[1.0, 0, 0], force=[0.0, 0.0, -load])
        tip = lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=[1.0, 0, 0])
        held, _ = lg.static_preload(lg.Model({"tip": tip}, {}, {"arm": arm, "push": push}), ["arm"])
        preload = held.forces["arm"].preload
        return section.mass, section.stress(preload[:3], preload[3:])[None] / limit - 1.0

    start = {"diameter": jnp.asarray(0.05), "thickness": jnp.asarray(0.003)}
    bounds = {"lower": {"diameter": 0.01, "thickness": 0.001}, "upper": {"diameter": 0.1, "thickness": 0.004}}
    found = lg.optimize.minimize(mass_and_stress, start, **bounds, log_scale=True, num_steps=60, progress=False)
    left = lambda d: 32.0 * load / 2.0 * d / (np.pi * (d**4 - (d - 0.002) ** 4)) - limit
    assert float(found.x["thickness"]) == pytest.approx(0.001, rel=1e-6)  # a bound
    # the constraint is kept to 1e-6 or better, and stress goes by 1/d²
    assert float(found.x["diameter"]) == pytest.approx(brentq(left, 0.005, 0.1), rel=1e-5)


def comfort(model):
    run = lg.simulate(model, t1=0.3, num_steps=150)
    return lg.time_integral(run.t, run.body("chassis").acceleration[:, 2] ** 2), run


STRUT = QuarterCar.load().bending({"rollover_strut": tube()}, elements=2)


def with_strut(section, hardpoints=None):
    car = eqx.tree_at(lambda car: car.links["rollover_strut"].beam.of, STRUT, section)
    return car.with_values(hardpoints=hardpoints).model(**LEAN)


@pytest.mark.slow  # the quarter-car with a beam, compiled, and with its gradient
def test_a_stiff_link_is_a_rigid_one_and_derivatives_are_differences():
    """Over the bump Ψ₀ goes to that of the rigid strut, of the same mass and inertia, by 1/EI; its gradient by the
    diameter and along a random direction of all hardpoints is that of differences of fourth order."""
    psi = lambda p: comfort(with_strut(tube(p["diameter"], 0.003, p["young"]), p["hardpoints"]))[0]
    p = {"diameter": jnp.asarray(0.03), "young": jnp.asarray(2.1e11), "hardpoints": STRUT.hardpoints}
    value = jax.jit(psi)
    rigid = float(jax.jit(lambda model: comfort(model)[0])(STRUT.rigid().model(**LEAN)))
    apart = [float(value(p | {"young": stiffer * p["young"]})) - rigid for stiffer in (10.0, 100.0, 1000.0)]
    assert abs(apart[0]) > 1e-3 * rigid
    # the next term is that of (1/EI)²: the first 0.3 %, the second a tenth of it, and Ψ₀ is solved to 1e-7 or so
    np.testing.assert_allclose(np.divide(apart[1:], apart[:-1]), 0.1, rtol=0.02)

    gradient = jax.jit(jax.grad(psi))(p)
    direction = np.random.default_rng(0).normal(size=p["hardpoints"].shape)
    for key, along in (("diameter", 1.0), ("hardpoints", direction)):
        slope = differences(lambda h, key=key, along=along: float(value(p | {key: p[key] + h * along})), 1e-4)
        # h⁴/30 f⁽⁵⁾, by h = 1e-3: 2e-7 and 3e-5; Ψ₀ solved to 1e-8 over h is what is left, of slopes of 18 and 144
        assert float(jnp.sum(gradient[key] * along)) == pytest.approx(slope, rel=1e-7)


@pytest.mark.slow  # a search on the quarter-car with a beam
def test_the_lightest_strut_that_bears_the_bump():
    """Least mass under a limit of the stress in the strut over the bump, by wall and diameter: the thinnest wall, a
    stress that is at its limit, and beyond it with one per mille less of diameter."""
    limit = 6e8  # the tube of 30 × 3 mm has 5.4e8

    def mass_and_stress(x):
        section = tube(x["diameter"], x["thickness"])
        run = lg.simulate(with_strut(section), t1=0.3, num_steps=150, throw=False)
        stress = [run.force(f"rollover_strut.{i}").stress for i in range(2)]
        return section.section.mass, jnp.concatenate(stress) / limit - 1.0

    start = {"diameter": jnp.asarray(0.036), "thickness": jnp.asarray(0.003)}
    bounds = {"lower": {"diameter": 0.02, "thickness": 0.0015}, "upper": {"diameter": 0.06, "thickness": 0.005}}
    found = lg.optimize.minimize(mass_and_stress, start, **bounds, log_scale=True, num_steps=60, progress=False)
    assert float(found.x["thickness"]) == pytest.approx(0.0015, rel=1e-6)
    compiled = jax.jit(mass_and_stress)
    mass, stress = compiled(found.x)
    assert float(jnp.max(stress)) == pytest.approx(0.0, abs=1e-4)
    assert float(jnp.max(compiled(found.x | {"diameter": 0.999 * found.x["diameter"]})[1])) > 1e-3
    assert float(mass) < 0.9 * float(compiled(start)[0])


@pytest.mark.slow  # three axles, two of them on a rig
def test_an_axle_whose_bar_is_a_beam(file):
    """A front axle with a bar of 22 mm rests; and one wheel up, one down, its drop links, upright here, bear what they
    do of halves that twist with r²/2C, of elements."""
    keys = ("mass", "diameter", "length")
    changes = {f"anti_roll_bar.{key}": None for key in keys} | {"anti_roll_bar.knuckle": [0.03, 0.72, 0.15]}
    rubber = {"stiffness": [1e9] * 3, "damping": [0.0] * 3, "rotational_stiffness": [1e-2] * 3}
    axle = Axle.load(file("mcpherson", changes | {"anti_roll_bar.beam": ROUND, "anti_roll_bar.bushing": rubber}))
    bent = axle.model(links="rods", chassis="guided", tyres=True)
    assert {"anti_roll_bar.12", "anti_roll_bar.11", "left_anti_roll_bar_chassis"} <= {*bent.bodies, *bent.forces}
    # N and N m that are balanced to 1e-9, on nodes of 0.1 kg and 1e-5 kg m²
    assert np.abs(lg.initial_state(bent).vdot).max() < 1e-3

    n = 4
    closed = softness(0.022, np.sqrt(0.09 + 0.0729), 0.09, 0.0729, 0.9, 1 - 1 / (4 * n**2), 1 - 1 / n**2)
    rate = jnp.asarray(0.09 / (2 * closed))
    halves = dataclasses.replace(axle.bar, beam=None, mount=None, mass=axle.bar.own_mass, section={"stiffness": rate})
    found = []
    for bar in (dataclasses.replace(axle.bar, mount=None), halves):
        of = dataclasses.replace(axle, bar=bar)
        model = of.model(links="rods")
        up = {
            side: lg.TranslationDriver(None, f"{side}_wheel", at=at, axis=(0, 0, 1))
            for side, at in of.wheel_centres.items()
        }
        run = lg.statics(
            lg.Model(model.bodies, model.joints | up, model.forces), {"left": [0.0, 0.005], "right": [0.0, -0.005]}
        )
        found.append([float(run.multiplier(f"{side}_drop_link")[-1, 0]) for side in ("left", "right")])
    assert min(np.abs(found[1])) > 100.0
    # levers and links turn by 1°, whose cosine is 1.5e-4 less than 1, and links lean against what the bar does not bear
    np.testing.assert_allclose(found[0], found[1], rtol=5e-3)
