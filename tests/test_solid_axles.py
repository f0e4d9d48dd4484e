"""Solid axles: positions by a closure of lengths, roll axis and anti-squat in closed form, halves, and their files."""

import copy
import dataclasses
import json
import tomllib
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.optimize import root
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens import rigs
from lgsens.examples import Axle, AxleNumbers, QuarterCar

FILE = tomllib.loads((resources.files("lgsens.examples") / "data" / "solid_axle.toml").read_text(encoding="utf-8"))
FLIP = np.array([1.0, -1.0, 1.0])
ROAD, TRACK, RADIUS = 0.33, 1.44, 0.33  # m, of the file
LEVER = 2.7 / 0.55  # wheelbase over height of the centre of mass, of `Vehicle()`
SWEEPS = rigs.standard_sweeps()
# A Watt's linkage: a crank upright in the middle of the axle, rods of one length to either side of the chassis.
WATT = {
    "crank": {
        "solid_axle": [[-0.14, 0.0, 0.05], [-0.18, 0.0, 0.05]],
        "centre_of_mass": [-0.16, 0.0, 0.05],
        "mass": 1.5,
        "inertia": [2e-3, 2e-3, 1e-3],
    },
    "left_rod": {"chassis": [-0.16, 0.46, 0.11], "crank": [-0.16, 0.0, 0.11], "mass": 1.0},
    "right_rod": {"chassis": [-0.16, -0.46, -0.01], "crank": [-0.16, 0.0, -0.01], "mass": 1.0},
}


def scene(own=None, **tables):
    """The document of the file without bushings, with other links of the axle and other tables."""
    found = {**copy.deepcopy(FILE), "bushings": {}, **tables}
    if own is not None:
        found["solid_axle"] = {**found["solid_axle"], "links": own}
    return found


def on_the_rig(axle, *names, compliant=False, points=3):
    sweeps = {name: SWEEPS[name] for name in names}
    return rigs.kc(axle.model(compliant=compliant), axle.wheel_centres, sweeps, points=points)


@pytest.fixture(scope="module")
def rigid(tmp_path_factory):
    """What the axle of the file does on ball joints."""
    path = tmp_path_factory.mktemp("file") / "rigid.json"
    path.write_text(json.dumps(scene()), encoding="utf-8")
    return on_the_rig(Axle.load(path), "parallel", "opposite", "lateral")


def stands(left, right):
    """Contact centres and spin axis with both pads at these heights: SciPy's root of four lengths and two heights."""
    lower, own = FILE["links"]["lower_link"], FILE["solid_axle"]["links"]
    rods = [(np.array(lower["chassis"]) * side, np.array(lower["knuckle"]) * side) for side in (np.ones(3), FLIP)]
    rods += [(np.array(link["chassis"]), np.array(link["solid_axle"])) for link in own.values()]
    start = np.array([end for _, end in rods])
    base = np.array([end for end, _ in rods])
    length = np.linalg.norm(start - base, axis=1)
    centres = np.array([[0.0, TRACK / 2, 0.0], [0.0, -TRACK / 2, 0.0]])

    def placed(x):
        turn = Rotation.from_rotvec(x[3:])
        axis = turn.apply([0.0, 1.0, 0.0])
        down = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        contact = x[:3] + turn.apply(centres) - RADIUS * down / np.linalg.norm(down)
        return turn, axis, contact

    def misses(x):
        turn, _, contact = placed(x)
        apart = np.linalg.norm(x[:3] + turn.apply(start) - base, axis=1) - length
        return np.concatenate([apart, contact[:, 2] + ROAD - [left, right]])

    found = root(misses, np.zeros(6), tol=1e-15)
    assert np.abs(misses(found.x)).max() < 1e-13
    return placed(found.x)[1:]


@pytest.mark.parametrize("name", ["parallel", "opposite"])
def test_it_stands_where_its_lengths_say(name, rigid):
    """At the ends and in the middle of both sweeps: contact centres, toe and camber."""
    curves = rigid.sweeps[name]
    shares = SWEEPS[name].shares
    for i, value in enumerate(np.asarray(curves.value)):
        axis, contact = stands(*(value * shares[f"{side}_pad"] for side in ("left", "right")))
        # equilibria and closure end at 1e-13 m; over the length of the links, turned into angles by half the track
        tight = {"rtol": 0, "atol": 1e-11}
        np.testing.assert_allclose(curves.wheels.contact_x[i], contact[:, 0], **tight)
        np.testing.assert_allclose(curves.wheels.contact_y[i], contact[:, 1] - [TRACK / 2, -TRACK / 2], **tight)
        steer = np.arctan2(-axis[0], axis[1])
        np.testing.assert_allclose(curves.wheels.steer[i], [steer] * 2, **tight)
        np.testing.assert_allclose(curves.wheels.camber[i], np.arcsin(axis[2]) * np.array([-1.0, 1.0]), **tight)
    if name == "parallel":  # the arc of the rod
        assert abs(float(curves.wheels.contact_y[-1, 0])) > 1e-3
    else:
        assert abs(float(curves.wheels.steer[-1, 0])) > 5e-3


def roll_axis(lower, panhard):
    """Height at the wheels and slope of the line about which the axle rolls: through the places where the lower links,
    and the rod across, meet the plane y = 0 (Reimpell, Stoll & Betzler 2001, §3.4.3.4)."""

    def in_the_middle(a, b):
        return a + (b - a) * a[1] / (a[1] - b[1])

    apex, rod = in_the_middle(*lower), in_the_middle(*panhard)
    slope = (apex[2] - rod[2]) / (apex[0] - rod[0])
    return jnp.stack([rod[2] - slope * rod[0], slope])


def of_roll_axis(axle, points):
    """Roll centre and roll steer with other hardpoints."""
    lower, rod = axle.left.links["lower_link"].knuckle, axle.solid_axle.links["panhard_rod"].ends["solid_axle"]
    height, slope = roll_axis((points[0], lower), (points[1], rod))
    return jnp.stack([height, height, slope])


def rolled(test):
    of = rigs.characteristics(test)
    return jnp.stack([of["roll_centre_height"], of["force_roll_centre_height"], -of["roll_steer"]])


def test_roll_centre_and_roll_steer_are_those_of_the_roll_axis(rigid, load):
    """Kinematic and by forces."""
    axle = load(scene())
    assert axle.hardpoint_names == ["lower_link", "panhard_rod", "upper_link"]
    found = rolled(rigid)
    # linear equations with springs of 3e4 N/m and forces of constraints: condition 1e5
    np.testing.assert_allclose(found, of_roll_axis(axle, axle.hardpoints), rtol=1e-9)
    assert float(found[0]) == pytest.approx(0.3905, abs=1e-4)


@pytest.mark.slow
def test_derivatives_of_the_roll_axis(load):
    """By the hardpoints on the chassis, the Panhard rod's among them."""
    axle = load(scene())

    def found(points):
        moved = axle.with_hardpoints(points)
        sweeps = {name: SWEEPS[name] for name in ("parallel", "opposite", "lateral")}
        model = moved.model(compliant=False)
        return rolled(rigs.kc(model, moved.wheel_centres, sweeps, points=3, throw=False))

    # The upper link stays in the middle, y = 0, where it does not lead in roll.
    points = axle.hardpoints
    direction = jnp.asarray(np.random.default_rng(0).normal(size=points.shape)).at[2, 1].set(0.0)
    along = lambda of: jax.jvp(of, (points,), (direction,))[1]
    expected = along(lambda points: of_roll_axis(axle, points))
    np.testing.assert_allclose(jax.jit(lambda: along(found))(), expected, rtol=1e-8)


def anti_squat(drop):
    """The slope from below the wheel centre to where the links meet in side view, over that of all the inertia."""
    lines = []
    for link in (FILE["links"]["lower_link"], FILE["solid_axle"]["links"]["upper_link"]):
        points = np.array([point for point in link.values() if isinstance(point, list)])
        lines.append(np.polyfit(points[:, 0], points[:, 2], 1))
    x = (lines[1][1] - lines[0][1]) / (lines[0][0] - lines[1][0])
    return (np.polyval(lines[0], x) + drop) / x * LEVER


@pytest.mark.slow  # two more sweeps
def test_anti_squat_is_the_slope_to_the_side_view_centre(load):
    """From the contact centre of a live axle, under braking too, which has half of all forces."""
    of = rigs.characteristics(on_the_rig(load(scene()), "parallel", "braking", "traction"))
    assert float(of["anti_squat"]) == pytest.approx(anti_squat(RADIUS), rel=1e-9)
    assert float(of["anti_lift"]) == pytest.approx(anti_squat(RADIUS) / 2, rel=1e-9)


@pytest.mark.slow
def test_traction_of_a_de_dion_axle_is_at_the_wheel_centre(load):
    document = scene()
    document["solid_axle"]["final_drive"] = "chassis"
    of = rigs.characteristics(on_the_rig(load(document), "braking", "traction"))
    assert float(of["anti_squat"]) == pytest.approx(anti_squat(0.0), rel=1e-9)
    assert float(of["anti_lift"]) == pytest.approx(anti_squat(RADIUS) / 2, rel=1e-9)


@pytest.mark.slow
def test_a_watts_linkage_leads_straight(load):
    """The axle rolls about the pivot, and stays in the middle as a Panhard rod does not: to the fourth order."""
    links = {"upper_link": FILE["solid_axle"]["links"]["upper_link"], **WATT}
    axle = load(scene(links))
    assert axle.solid_axle.along == ("upper_link",)
    test = on_the_rig(axle, "parallel", "lateral")
    lower = [jnp.asarray(FILE["links"]["lower_link"][body]) for body in ("chassis", "knuckle")]
    pivot = jnp.array([-0.16, 0.0, 0.05])
    height, _ = roll_axis(lower, (pivot, pivot + jnp.array([0.0, 1.0, 0.0])))
    of = rigs.characteristics(test)
    assert float(of["roll_centre_height"]) == pytest.approx(float(height) + ROAD, rel=1e-9)
    assert float(of["force_roll_centre_height"]) == pytest.approx(float(height) + ROAD, rel=1e-9)
    # at 80 mm of travel; a rod of 0.94 m: 80²/2/940 = 3.4 mm; with a crank of 60 mm at rods of 460 mm about its height
    # to the fourth power over eight times lengths cubed, 80⁴/8/460²/60 = 0.4 mm
    assert 0 < np.abs(test.sweeps["parallel"].wheels.contact_y).max() < 4e-4


def modes(model):
    return np.asarray(jax.jit(lambda model: lg.linearize(model, throw=False).eigenvalues)(model))


@pytest.mark.slow
def test_a_half_moves_as_the_whole(load):
    """Its eigenvalues are among those of the whole axle on its tyres: with a triangle of an upper link, on bushings, of
    which the half has half in the middle, and stops far away."""
    soft = {"stiffness": [8e6, 6e6, 4e6], "damping": [2e3] * 3, "rotational_stiffness": [150.0] * 3}
    links = {
        "upper_link": {
            "chassis": [[0.45, 0.2, 0.17], [0.45, -0.2, 0.17]],
            "solid_axle": [0.0, 0.0, 0.14],
            "mass": 4.0,
            "centre_of_mass": [0.28, 0.0, 0.16],
            "inertia": [0.06, 0.09, 0.14],
        }
    }
    axle = load(scene(links, bushings={"lower_link_chassis": soft, "upper_link_chassis": soft}))
    half = modes(axle.half(links="bodies"))
    whole = modes(axle.model(chassis="guided", tyres=True))
    assert len(half) < len(whole)
    apart = np.sort(np.abs(half[:, None] - whole[None]).min(axis=1) / np.abs(half))
    # Two of its modes have the half of the triangle go sideways on its bushing, which nothing in the plane drives. Of
    # the others round-off, of eigenvalues from 8 to 2e3 rad/s; the rod to the wheel hardly turns about itself (1e-5).
    assert len(half) == 20 and apart[-4] > 0.05
    np.testing.assert_allclose(apart[:-4], 0.0, atol=1e-7)


def test_a_corner_has_half_of_what_goes_along_the_car(load):
    """And of the rod across nothing; the axle has both sides and everything once."""
    car, axle = load(scene(), QuarterCar), load(scene())
    assert sorted(car.links) == ["lower_link", "upper_link"] and car.hardpoint_names == ["lower_link", "upper_link"]
    assert sorted(axle.left.links) == ["lower_link"] and not axle.left.joints
    assert float(axle.mass) == pytest.approx(2 * float(car.mass) + 3.5 + 4.0, rel=1e-14)  # rod and anti-roll bar
    model = axle.model(compliant=False)
    assert {"live_axle", "panhard_rod_chassis", "upper_link_solid_axle"} <= set(model.joints)
    assert {"panhard_rod", "upper_link"} <= set(model.bodies) and "left_upper_link" not in model.bodies
    assert "left_solid_axle" in axle.half().joints


def test_a_file_of_the_right_side_is_the_same_axle(load):
    """Links that there are once stay where they are."""

    def turned(value):
        return [turned(one) for one in value] if isinstance(value[0], list) else (np.array(value) * FLIP).tolist()

    document = scene()
    for table in (
        document["links"]["lower_link"],
        *(document[key] for key in ("knuckle", "wheel", "spring", "damper")),
    ):
        table |= {key: turned(value) for key, value in table.items() if isinstance(value, list) and key != "inertia"}
    bar = document["anti_roll_bar"]
    bar |= {key: turned(value) for key, value in bar.items() if isinstance(value, list)}
    axle = load(document)
    assert axle.left.axes.mirrored and not axle.right.axes.mirrored
    expected = load(scene())
    left = dataclasses.replace(axle.left, axes=expected.left.axes)
    jax.tree.map(np.testing.assert_array_equal, dataclasses.replace(axle, left=left), expected)


@pytest.mark.slow
def test_a_subframe_may_carry_it_on_bushings(load):
    """Four links along and a rod across bind, but for bushings, wherever these are; asymmetric links have no half."""
    own = FILE["solid_axle"]["links"]
    lower = {"subframe": [0.62, 0.44, 0.02], "knuckle": [0.02, 0.5, -0.06], "mass": 4.0}
    upper = {"chassis": [0.45, 0.3, 0.2], "knuckle": [0.0, 0.35, 0.14], "mass": 3.0}
    bushing = {"stiffness": [5e6] * 3, "rotational_stiffness": [200.0] * 3}
    frame = {"centre_of_mass": [0.3, 0.0, 0.1], "mass": 15.0, "inertia": [1.0, 1.0, 1.0]}
    links = {"lower_link": lower, "upper_link": upper}
    rod = {"panhard_rod": own["panhard_rod"]}
    axle = load(scene(rod, links=links, subframe=frame, bushings={"lower_link_subframe": bushing}))
    assert "left_lower_link_subframe" in axle.model().forces
    two = {**own, "upper_link": {"chassis": [0.4, 0.3, 0.2], "solid_axle": [0.0, 0.1, 0.14], "mass": 3.0}}
    two["other"] = {"chassis": [0.5, -0.3, 0.18], "solid_axle": [0.0, -0.1, 0.15], "mass": 3.0}
    del two["panhard_rod"]
    axle = load(scene(two))  # what leads sideways are two upper links, which are not alike
    assert {"upper_link", "other"} <= set(axle.model(compliant=False).bodies)


def test_motion_ratios_are_of_both_wheels(rigid):
    """Wheel rate of spring, tyre apart, is k i² in heave and what weight does by angles."""
    of = rigs.characteristics(rigid)
    assert 0.97 < float(of["spring_motion_ratio"]) < 1.0
    assert float(of["wheel_rate"]) == pytest.approx(27e3 * float(of["spring_motion_ratio"]) ** 2, rel=0.02)


@pytest.mark.slow
def test_half_of_it_has_no_roll_centre(load):
    curves = load(scene(), QuarterCar).curves([-0.02, 0.0, 0.02])
    assert np.isnan(curves.roll_centre_height).all() and not np.isnan(curves.spring_motion_ratio).any()


@pytest.mark.slow
def test_its_numbers_have_their_keys(load):
    axle = Axle.load("solid_axle")
    patterns = ("solid_axle.links.panhard_rod.chassis.z", "bushings.panhard_rod_chassis.stiffness.2", "links")
    numbers = AxleNumbers.select(axle, dict.fromkeys(patterns, 0.02))
    assert {*patterns[:2]} < {*numbers.names["hardpoints"], *numbers.names["rates"]}
    x = numbers.of(axle)
    i = numbers.names["hardpoints"].index(patterns[0])
    moved = numbers.replaced(axle, {**x, "hardpoints": x["hardpoints"].at[i].add(0.01)})
    before, after = (of.solid_axle.links["panhard_rod"].chassis for of in (axle, moved))
    np.testing.assert_allclose(after - before, [0.0, 0.0, 0.01], atol=1e-16)
    on = scene(subframe={"centre_of_mass": [0.3, 0.0, 0.1], "mass": 15.0, "inertia": [1.0, 1.0, 1.0]})
    rod = on["solid_axle"]["links"]["panhard_rod"]
    rod["subframe"] = rod.pop("chassis")
    axle = load(on)
    assert axle.model(compliant=False).joints["panhard_rod_subframe"].a == "subframe"
    assert (
        "solid_axle.links.panhard_rod.subframe.y" in AxleNumbers.select(axle, {"solid_axle": 0.01}).names["hardpoints"]
    )


@pytest.mark.slow
def test_bad_files_say_what_is_wrong(load):
    own = FILE["solid_axle"]["links"]
    lower = FILE["links"]["lower_link"]
    upper = {"chassis": [0.45, 0.3, 0.2], "knuckle": [0.0, 0.35, 0.14], "mass": 3.0}
    bushing = {"stiffness": [5e6] * 3, "rotational_stiffness": [200.0] * 3}
    four = scene({"panhard_rod": own["panhard_rod"]}, links={"lower_link": lower, "upper_link": upper})
    fails = lambda *parts: pytest.raises(ValueError, match=says(*parts))
    with fails("has 1 degrees of freedom", "heave and roll", "bushings"):
        load(four).model()
    four["bushings"] = {"lower_link_chassis": bushing}
    assert "left_lower_link_chassis" in load(four).model().forces
    with fails("has 1 degrees of freedom"):
        load(four).model(compliant=False)
    free = scene({"upper_link": own["upper_link"]})
    with fails("has 3 degrees of freedom", "upper_link"):
        load(free).model()
    # At the apex of the lower links, which move nothing there.
    x, z = 0.62 + 0.6 * 0.44 / 0.06, 0.02 + 0.08 * 0.44 / 0.06
    rod = {"chassis": [x, -0.4, z], "solid_axle": [x, 0.4, z], "mass": 3.0}
    with fails("repeat each other", "across the car"):
        load(scene({"upper_link": own["upper_link"], "panhard_rod": rod})).model()
    other = {"chassis": [0.45, 0.3, 0.2], "solid_axle": [0.0, 0.3, 0.15], "mass": 3.0}
    both = {**own, "other": other}
    with fails("has 1 degrees of freedom"):
        load(scene(both))
    with fails("half of the solid axle", "has 0 degrees of freedom", "upper_link", "whole axle"):
        load(scene(both), QuarterCar)
    across = {**own, "panhard_rod": {"chassis": [-0.14, 0.1, 0.5], "solid_axle": [-0.14, 0.1, 0.03], "mass": 3.0}}
    with fails("repeat each other", "across the car"):
        load(scene(across))
    rod = {"chassis": [-0.1, 0.4, 0.0], "solid_axle": [-0.1, -0.4, 0.0]}
    for compliant in (False, True):
        weak = scene(None, bushings=FILE["bushings"] if compliant else {})
        weak["spring"]["stiffness"] = 27.0
        with fails("'spring.stiffness'", "pressed by", "did you mean 27000?"):
            load(weak)
    level = scene()
    level["damper"]["chassis"] = [-0.08, 0.14, -0.02]
    with fails("'damper'", "its motion ratio"):
        load(level)
    beam = {"tube": {"diameter": 0.03, "thickness": 0.003}, "young": 2.1e11, "poisson": 0.3, "density": 7850.0}
    for change, parts in (
        ({"final_drive": "wheel"}, ("final_drive", "['axle', 'chassis']")),
        ({"live": True}, ("live", "no key of this table")),
        ({"links": {**own, "lower_link": own["upper_link"]}}, ("lower_link", "something else")),
        ({"links": {**own, "left_wheel": own["upper_link"]}}, ("left_wheel", "something else", "after left_")),
        ({"links": {**own, "right_lower_link": own["upper_link"]}}, ("right_lower_link", "something else")),
        ({"links": {**own, "upper_link": {**own["upper_link"], "knuckle": [0.0, 0.0, 0.0]}}}, ("knuckle", "no body")),
        ({"links": {**own, "panhard_rod": {**rod, "beam": beam}}}, ("panhard_rod.beam", "rigid")),
    ):
        document = scene()
        document["solid_axle"] |= change
        with fails(*parts):
            load(document)
    with fails("bushings", "panhard", "panhard_rod_chassis"):
        load(scene(bushings={"panhard": bushing}))
    with fails("leave one"):
        load(scene(twist_beam={"knuckle": [0.1, 0.4, 0.0]}))
