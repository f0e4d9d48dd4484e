"""Suspensions of other kinds than five links: positions, motion ratios, and what their files may say."""

import copy
import dataclasses
import json
import tomllib
from importlib import resources

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import says
from scipy.interpolate import PchipInterpolator
from suspension_closures import Closure, changed, corner_of, motion_ratio

from lgsens.cli._main import main
from lgsens.examples import QuarterCar, shipped
from lgsens.examples._leverage import motion_ratios
from lgsens.examples._suspension_file import members

DATA = resources.files("lgsens.examples") / "data"
TRAVEL = np.linspace(-0.05, 0.05, 11)


def document(name):
    return corner_of(tomllib.loads((DATA / f"{name}.toml").read_text(encoding="utf-8")))


SCENES = ("double_wishbone", "multi_link", "mcpherson", "push_rod", "semi_trailing_arm")


@pytest.fixture
def load(tmp_path):
    def load(scene):
        path = tmp_path / "mine.json"
        path.write_text(json.dumps(scene), encoding="utf-8")
        return QuarterCar.load(path)

    return load


def differences(function, step):
    """Central differences of fourth order."""
    a, b, c, d = (function(i * step) for i in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * step)


@pytest.mark.slow  # `test_suspension_curves` has those of one in the quick run
@pytest.mark.parametrize("name", SCENES[:4])
def test_curves_agree_with_the_closure(name, load):
    """Positions by SciPy's root of hand-written distances, motion ratios by its differences and by virtual work."""
    scene = document(name)
    curves, closure = load(scene).curves(TRAVEL), Closure(scene)
    camber, toe, x, y, _, spring, _ = np.stack([closure.curves(s) for s in TRAVEL], axis=1)
    middle = len(TRAVEL) // 2
    # SciPy ends at 1e-14 m of closure; over arms of 0.2 m, turned into lengths by others of 0.5 m
    for found, expected in (
        (curves.camber, camber),
        (curves.toe, toe),
        (curves.track_change, 2 * (y - y[middle])),
        (curves.wheelbase_change, -(x - x[middle])),
        (curves.spring_length, spring),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-12)
    assert min(np.ptp(camber), np.ptp(toe)) > np.radians(0.15)  # they do move
    for i in (0, middle):
        rate = differences(lambda h, i=i: closure.curves(TRAVEL[i] + h), 1e-3)
        # h⁴/30 f⁽⁵⁾ with arms of 0.2 m: 1e-12/30/0.2⁴ = 2e-11; round-off 1e-14/h; the roll centre's lever of 0.9 m
        np.testing.assert_allclose(curves.spring_motion_ratio[i], -rate[5], rtol=0, atol=1e-9)
        np.testing.assert_allclose(curves.damper_motion_ratio[i], -rate[6], rtol=0, atol=1e-9)
        np.testing.assert_allclose(curves.roll_centre_height[i], y[i] * rate[3] / rate[4], rtol=0, atol=2e-9)
    # by virtual work at the design position: linear equations of condition 1e3
    for key, found in (("spring", curves.spring_motion_ratio), ("damper", curves.damper_motion_ratio)):
        assert float(found[middle]) == pytest.approx(motion_ratio(scene, key), rel=1e-11)


def test_the_ratio_of_the_trailing_link_is_that_of_its_arms():
    """0.773 with the maker's, 0.595 with those that follow the link. What arms along x give is refused, see below."""
    scene = document("multi_link")
    assert motion_ratio(scene, "spring") == pytest.approx(0.7733, abs=1e-4)
    for key in ("arm", "link_arm"):
        del scene["links"]["trailing_link"][key]
    assert motion_ratio(scene, "spring") == pytest.approx(0.595, abs=1e-3)


@pytest.mark.parametrize("name", SCENES)
def test_ratios_before_anything_is_compiled(name, load):
    """What a file is checked by, velocities, against virtual work, forces."""
    scene = document(name)
    car = load(scene)
    found = motion_ratios("it", car.wheel.centre, car.links, car.joints, {"spring": car.spring, "damper": car.damper})
    for key, ratio in found.items():
        assert ratio == pytest.approx(motion_ratio(scene, key), rel=1e-11)  # linear equations of condition 1e3


def test_arms_follow_the_link():
    """Level, across it and across each other whichever way it points; of an upright one along x as far as they can."""
    scene = document("mcpherson")
    del scene["links"]["tie_rod"]
    for name, end in {"trailing": [0.0, 0.9, 0.0], "leading": [1.4, 0.9, 0.0], "upright": [0.7, 0.9, 0.3]}.items():
        scene["links"][name] = {"chassis": [0.7, 0.9, 0.0], "knuckle": end, "mass": 1.0}
    for name, link in members(scene, "mine")["links"].items():
        if link.first is None:
            continue
        arm, link_arm = map(np.asarray, link.arms())
        along = np.asarray(link.direction())
        np.testing.assert_allclose([arm @ link_arm, arm @ along, link_arm @ along], 0.0, atol=1e-15)
        assert name in ("upright", "strut") or arm[2] == 0.0
        assert np.linalg.norm(arm) > 0.01


@pytest.mark.parametrize("name", ["double_wishbone", "five_link_suspension"])
def test_the_origin_of_z_changes_nothing(name, load):
    """All points and the road a quarter of a metre lower: the same car to round-off of its coordinates."""
    scene = document(name)
    down = 0.25 / scene["units"]["length"]

    def lowered(value, key=""):
        if isinstance(value, dict):
            return {k: lowered(v, k) for k, v in value.items()}
        if key in ("inertia", "arm", "link_arm", "curve") or not isinstance(value, list):
            return value
        if isinstance(value[0], list):
            return [lowered(point) for point in value]
        return [value[0], value[1], value[2] - down] if len(value) == 3 else value

    moved = lowered(copy.deepcopy(scene))
    moved["road"]["height"] = scene["road"]["height"] - down
    assert moved["wheel"]["centre"] != scene["wheel"]["centre"]
    one, other = load(scene), load(moved)
    assert other.axes.road == pytest.approx(one.axes.road - 0.25)
    other = dataclasses.replace(other, axes=one.axes)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15), one, other)
    assert float(one.wheel.centre[2]) == pytest.approx(
        (scene["wheel"]["centre"][2] - scene["road"]["height"]) * scene["units"]["length"], rel=1e-15
    )


@pytest.mark.slow
def test_a_wishbone_is_two_links(load):
    """Its hinge and ball joint hold the ball as two bars of no length change do: the same curves."""
    scene = document("double_wishbone")
    body = load(scene).curves(TRAVEL)
    wishbone = scene["links"].pop("upper_wishbone")
    for name, start in zip(("front", "rear"), wishbone["chassis"]):
        scene["links"][name] = {"chassis": start, "knuckle": wishbone["knuckle"], "mass": 2.9}
    car = load(scene)
    assert car.hardpoints.shape == (5, 3)
    for name, found, expected in zip(body._fields, car.curves(TRAVEL), body):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12, err_msg=name)


def test_hardpoints_of_hinges_and_joints(load):
    """Links in sorted order, then joints, two points of a hinge; replaced in that order."""
    car = QuarterCar.load("mcpherson")
    assert car.hardpoint_names == ["control_arm 1", "control_arm 2", "strut", "tie_rod"]
    moved = car.with_values(hardpoints=car.hardpoints + np.arange(12.0).reshape(4, 3))
    for points, row in (
        (lambda c: c.links["control_arm"].chassis[1], 3.0),
        (lambda c: c.links["tie_rod"].chassis, 9.0),
    ):
        np.testing.assert_array_equal(points(moved), points(car) + np.array([row, row + 1, row + 2]))
    arm = QuarterCar.load("semi_trailing_arm")
    assert arm.hardpoint_names == ["pivot 1", "pivot 2"]
    np.testing.assert_array_equal(arm.hardpoints[1], [0.42, 0.6, -0.05 + 0.292])
    assert arm.with_values(hardpoints=np.zeros((2, 3))).joints["pivot"].at.shape == (2, 3)


def test_curves_of_spring_and_damper(load):
    """Tension over extension by SciPy's monotone cubic, turned from push over compression; scaled by the rate."""
    scene = document("double_wishbone")
    curve = [[-0.1, -4000.0], [-0.02, 8000.0], [0.03, 15000.0], [0.06, 24000.0], [0.08, 40000.0]]
    del scene["spring"]["stiffness"]
    scene["spring"]["curve"] = curve
    car = load(scene)
    x, push = np.array(curve).T
    scipy = PchipInterpolator(x, push)
    assert float(car.spring.rate) == pytest.approx(float(scipy(0.0, 1)), rel=1e-12)
    element = car.with_values(stiffness=2 * car.spring.rate).spring.element("spring")
    for compression in (-0.07, 0.0, 0.045):
        assert float(element.spring(-compression)) == pytest.approx(-2 * scipy(compression), rel=1e-12)
    damper = car.damper.element("damper")
    points = np.array(scene["damper"]["curve"])
    found = np.array([float(damper.damper(-speed)) for speed in points[:, 0]])
    np.testing.assert_allclose(found, -points[:, 1], rtol=1e-14, atol=1e-11)
    assert damper.damper(1.0) == pytest.approx(1.0 * 14973.3 / 0.666667, rel=1e-3)  # straight on

    length = float(np.linalg.norm(np.subtract(scene["spring"]["chassis"], scene["spring"]["lower_wishbone"])))
    scene["spring"]["free_length"] = length + 0.03
    car = load(scene)
    assert float(car.spring.rate) == pytest.approx(float(scipy(0.03, 1)), rel=1e-12)
    assert float(car.spring.push()) == pytest.approx(15000.0, rel=1e-9)


@pytest.mark.slow  # preloads of axles are in the quick run
def test_preloads_of_rods_and_curves(load):
    """Bars as bodies or as rods on other bodies, springs with and without curves, carry the same weights."""
    scene = document("push_rod")
    car = load(scene)
    wanted, *others = (car.model(wheel="locked", chassis="heave", links=links).forces for links in ("bodies", "rods"))
    assert "push_rod" not in car.model(links="rods", free_length=1.0).bodies
    del scene["spring"]["stiffness"]
    scene["spring"]["curve"] = [[-0.1, 0.0], [0.02, 9e3], [0.1, 3e4]]
    forces = load(scene).model(wheel="locked", chassis="heave", links="rods").forces
    tension = forces["spring"].preload + forces["spring"].spring(0.0)  # at the design position
    others.append(forces | {"spring": forces["spring"].with_preload(tension)})
    for forces in others:
        for name in ("spring", "tyre"):
            # linear equations of condition 1e4 or so, N and N m with inertias of 1e-3 and 1e2 kg m²
            assert float(forces[name].preload) == pytest.approx(float(wanted[name].preload), rel=1e-10)
    assert float(wanted["tyre"].preload) == pytest.approx(9.81 * float(car.mass), rel=1e-12)
    weight = 9.81 * float(car.chassis.mass)  # that of links and their way between comes on top of it
    ratio = motion_ratio(document("push_rod"), "spring")
    assert -float(wanted["spring"].preload) * ratio == pytest.approx(weight, rel=0.05)


def test_shipped_suspensions():
    assert shipped() == [*sorted((*SCENES, "five_link_suspension", "leaf_springs", "solid_axle", "twist_beam"))]
    five = QuarterCar.load("quarter-car")
    assert jax.tree.all(jax.tree.map(np.array_equal, five, QuarterCar.load()))


# What is refused: the scene, where in it, what is put there (None: it goes), and what the message says.

CHRONO_CURVE = [[0.0, 0.0], [0.02, 3629.923], [0.06, 17818.165], [0.08, 31840.681], [0.1, 52791.592], [0.12, 82402.997]]
SPRING = {"chassis": [0.104, 0.51, 0.197], "lower_wishbone": [0.097, 0.543, -0.047]}
RISING = [[-0.1, -9e3], [0.1, 9e3]]
FORMAT = "see lgsens/examples/data/five_link_suspension.toml for the format"
MISTAKES = {
    "arms along x": (
        "multi_link",
        {"links.trailing_link.arm": [1.0, 0.0, 0.0], "links.trailing_link.link_arm": None},
        ("key 'spring'", "motion ratio", "-0.00", "no car has one outside of 0.1 to 3", "their hinges and arms"),
    ),
    "arm along the link": (
        "multi_link",
        {"links.trailing_link.arm": [-0.72, 0.26, -0.08], "links.trailing_link.link_arm": None},
        ("key 'links.trailing_link.arm'", "[-0.72  0.26 -0.08]", "singular", "degrees", "leave them out"),
    ),
    "link arm along the link": (
        "multi_link",
        {"links.trailing_link.link_arm": [-0.72, 0.26, -0.08]},
        ("key 'links.trailing_link.arm'", "is singular"),
    ),
    "arms along each other": (
        "multi_link",
        {"links.trailing_link.link_arm": [0.272, -0.962, 0.01]},
        ("key 'links.trailing_link.link_arm'", "[ 0.272 -0.962  0.01 ]", "lies along the other arm", "turn one"),
    ),
    "no arm": ("multi_link", {"links.lateral_link.arm": [0, 0, 0]}, ("key 'links.lateral_link.arm'", "got zero")),
    "arm of a hinge": (
        "double_wishbone",
        {"links.upper_wishbone.arm": [1.0, 0.0, 0.0]},
        ("key 'links.upper_wishbone.arm'", "no universal joint; leave it out"),
    ),
    "spring that pulls": (
        "multi_link",
        {"spring.chassis": [0.181, 0.419, -0.4]},
        ("key 'spring'", "motion ratio", "is -0.", "it would have to pull", "Check its two points"),
    ),
    "spring without leverage": (
        "double_wishbone",
        {"spring.lower_wishbone": [0.0, 0.307, 0.0]},
        ("key 'spring'", "Does it change its length as the wheel moves?", "'lower_wishbone' and 'chassis'"),
    ),
    "damper without leverage": (
        "double_wishbone",
        {"damper.lower_wishbone": [0.0, 0.32, 0.0]},
        ("key 'damper'", "motion ratio", "no car has one outside"),
    ),
    "damper with too much": (
        "push_rod",
        {"links.push_rod.rocker": [0.1, 0.45, 0.325], "damper.rocker": [0.1, 0.4, 1.4]},
        ("key 'damper'", "motion ratio", "no car has one outside of 0.1 to 3"),
    ),
    "a link too few": (
        "double_wishbone",
        {"links.tie_rod": None},
        ("key 'links'", "the wheel has 2 degrees of freedom", "needs one", "['lower_wishbone', 'upper_wishbone']"),
    ),
    "a link too many": (
        "double_wishbone",
        {"links.second": {"chassis": [0.2, 0.4, 0.1], "knuckle": [0.2, 0.8, 0.1], "mass": 1.0}},
        ("key 'links'", "the wheel has 0 degrees of freedom", "A link with two ball joints takes one"),
    ),
    "two links that are one": (
        "multi_link",
        {"links.tie_rod": {"chassis": [0.036, 0.188, -0.133], "knuckle": [0.029, 0.692, -0.093], "mass": 1.0}},
        ("key 'links'", "joints repeat each other", "condition", "move a hardpoint"),
    ),
    "road that is not said": (
        "double_wishbone",
        {"road": None},
        ("key 'wheel.centre'", "is -0.026 m over the road, which is at z = 0", "0.1 to 2.0 m", "'road.height'"),
    ),
    "road of text": ("double_wishbone", {"road.height": "low"}, ("key 'road.height'", "a finite number", "'low'")),
    "body that is not there": (
        "double_wishbone",
        {"links.tie_rod.knukle": [0.0, 0.8, 0.0]},
        ("key 'links.tie_rod.knukle'", "is no body", "bodies are ['chassis', 'knuckle', 'lower_wishbone'", "'arm'"),
    ),
    "link on itself": (
        "double_wishbone",
        {"links.tie_rod.tie_rod": [0.0, 0.8, 0.0]},
        ("key 'links.tie_rod.tie_rod'", "is no body"),
    ),
    "link with one end": (
        "double_wishbone",
        {"links.tie_rod.chassis": None},
        ("key 'links.tie_rod.chassis'", "is missing, or a point on another one of [", FORMAT),
    ),
    "wheel on the other side": (
        "push_rod",
        {"wheel.centre": [-0.04, -0.91, -0.026], "wheel.bearing": [-0.04, -0.91, -0.026]},
        ("key 'wheel.centre'", "is at y = -0.91 m", "on the other side of the car", "turn the sign"),
    ),
    "arm on the other side": (
        "double_wishbone",
        {
            "links.upper_wishbone.chassis": [[-0.1, -0.4, 0.3], [0.1, -0.4, 0.3]],
            "links.upper_wishbone.knuckle": [0.0, -0.7, 0.3],
        },
        ("key 'links.upper_wishbone'", "all its points on the other side", "turn the sign of their y"),
    ),
    "radius in millimetres": ("double_wishbone", {"link_section.radius": 10.0}, ("is in metres", "did you mean 0.01?")),
    "gap in millimetres": (
        "push_rod",
        {"bump_stop": {"gap": 30.0, "stiffness": 1e5, "rounding": 1e-3}},
        ("did you mean 0.03?",),
    ),
    "point in millimetres": (
        "double_wishbone",
        {"links.tie_rod.chassis": [118.0, 412.0, 51.0]},
        ("key 'links.tie_rod'", "[118.0, 412.0, 51.0] m", "from the wheel's centre", "'units.length'"),
    ),
    "arm that swings": (
        "double_wishbone",
        {"links.upper_wishbone.knuckle": None, "links.upper_wishbone.inertia": [0.01, 0.01, 0.01]}
        | {"links.upper_wishbone.centre_of_mass": [-0.1, 0.6, 0.2]},
        ("degrees of freedom", "'upper_wishbone' holds on to one body alone"),
    ),
    "link with three ends": (
        "push_rod",
        {"links.push_rod.knuckle": [0.0, 0.8, 0.0]},
        ("key 'links.push_rod.centre_of_mass'", "is missing"),
    ),
    "centre without inertia": (
        "double_wishbone",
        {"links.tie_rod.centre_of_mass": [0.0, 0.6, 0.0]},
        ("key 'links.tie_rod.inertia'", "is missing"),
    ),
    "hinge without line": (
        "double_wishbone",
        {"links.upper_wishbone.chassis": [[0.1, 0.4, 0.2], [0.1, 0.4, 0.2]]},
        ("key 'links.upper_wishbone.chassis'", "two points must differ", "[0.1, 0.4, 0.2] twice"),
    ),
    "three points": (
        "double_wishbone",
        {"links.upper_wishbone.chassis": [[0.1, 0.4, 0.2]] * 3},
        ("key 'links.upper_wishbone.chassis'", "must be three numbers [x, y, z], or two points"),
    ),
    "link of a name that is taken": (
        "double_wishbone",
        {"links.mass": {"chassis": [0.1, 0.4, 0.2], "knuckle": [0.1, 0.8, 0.2], "mass": 1.0}},
        ("key 'links.mass'", "is a name of its own", "choose another"),
    ),
    "joint of a name that is taken": (
        "mcpherson",
        {"joints.hub": {"type": "fixed", "between": ["strut", "knuckle"], "at": [0.0, 0.8, 0.2]}},
        ("key 'joints.hub'", "another joint of the scene has this name", "'strut_chassis'"),
    ),
    "joint of a kind that there is not": (
        "mcpherson",
        {"joints.slider.type": "sliding"},
        (
            "key 'joints.slider.type'",
            "one of ['cylindrical', 'fixed', 'prismatic', 'revolute', 'spherical']",
            "'sliding'",
        ),
    ),
    "joint at a point": (
        "mcpherson",
        {"joints.slider.at": [0.0, 0.8, 0.2]},
        ("key 'joints.slider.at'", "must be two points, its line, of a cylindrical joint"),
    ),
    "joint between one": (
        "mcpherson",
        {"joints.slider.between": ["strut", "strut"]},
        ("key 'joints.slider.between'", "must be two of", "['strut', 'strut']"),
    ),
    "spring on three": (
        "double_wishbone",
        {"spring.knuckle": [0.0, 0.7, 0.0]},
        ("key 'spring.link'", "one point on each of two bodies", "['chassis', 'knuckle', 'lower_wishbone']"),
    ),
    "spring from a line": (
        "double_wishbone",
        {"spring.chassis": [[0.1, 0.5, 0.2], [0.2, 0.5, 0.2]]},
        ("key 'spring.link'", "one point on each of two bodies"),
    ),
    "spring without length": (
        "double_wishbone",
        {"spring.chassis": SPRING["lower_wishbone"]},
        ("key 'spring.", "the two points coincide"),
    ),
    "curve and number": (
        "double_wishbone",
        {"spring.curve": RISING},
        ("key 'spring.stiffness'", "give one of `curve` and this key"),
    ),
    "free length of a number": (
        "double_wishbone",
        {"spring.free_length": 0.339},
        ("key 'spring.free_length'", "belongs to a `curve`"),
    ),
    "curve that falls": (
        "double_wishbone",
        {"damper.curve": [[-1.0, -2.0], [0.0, 0.0], [1.0, -1.0]]},
        ("key 'damper.curve'", "x increasing and force never falling", "[1.0, -1.0]"),
    ),
    "curve elsewhere": (
        "double_wishbone",
        {"spring": SPRING | {"curve": [[0.1, 0.0], [0.2, 1e4]]}},
        ("key 'spring.curve'", "goes from 0.1 to 0.2", "does not contain the design position, 0"),
    ),
    "curve that is flat": (
        "double_wishbone",
        {"spring": SPRING | {"curve": [[-0.1, 0.0], [0.1, 0.0], [0.2, 1e4]]}},
        ("key 'spring.curve'", "must rise at", "slope of"),
    ),
    "damper that pushes at rest": (
        "double_wishbone",
        {"damper.curve": [[-1.0, -2.0], [0.5, 1.0], [1.0, 2.0]]},
        ("key 'damper.curve'", "must have a point [0, 0] and some on both sides"),
    ),
    "spring of another car": (
        "double_wishbone",
        {"spring": SPRING | {"curve": CHRONO_CURVE, "free_length": 0.339}},
        (
            "key 'spring.curve'",
            "pushes with 4",
            "N at the design position, and must bear about 11",
            "leave `free_length` out",
        ),
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_no_suspension_is(mistake, load):
    name, changes, parts = MISTAKES[mistake]
    with pytest.raises(ValueError, match=says("Hardpoint file", "mine.json", *parts)):
        load(changed(document(name), changes))


def test_a_car_that_was_changed_is_checked_where_it_is_preloaded():
    """Hardpoints that come in after the file: the message says which suspension. Its curves show what it does."""
    car = QuarterCar.load("double_wishbone")
    moved = eqx.tree_at(lambda c: c.spring.ends["lower_wishbone"], car, car.links["lower_wishbone"].chassis[0])
    with pytest.raises(ValueError, match=says("Suspension 'double wishbone", "key 'spring'", "motion ratio")):
        moved.model()
    assert "spring" in moved.model(free_length=0.3).forces  # asks for no preload
    with pytest.raises(ValueError, match=says("`bushings`: 'rim' is not one of", "'tie_rod'", "a ball joint at the")):
        car.model(bushings=("rim",))
    with pytest.raises(ValueError, match=says("`bushings`: 'strut' is not one of ['control_arm', 'tie_rod']")):
        QuarterCar.load("mcpherson").model(bushings=("strut",))


@pytest.mark.parametrize(("text", "message"), [("{", "is not valid JSON"), ("[1]", "must hold tables, got a list")])
def test_what_is_no_document(text, message, tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        QuarterCar.load(path)


def test_the_commands_take_files(tmp_path, capsys):
    """A name, a file, not both; of a file that is wrong one line."""
    out = tmp_path / "out"
    assert main(["curves", "nowhere.toml", "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "'nowhere.toml' cannot be read" in said and "'double_wishbone'" in said and said.count("\n") == 1
    assert main(["optimize", "multi_link", "--hardpoints", "mine.toml", "--out", str(out)]) == 2
    assert "--hardpoints: 'multi_link' is a suspension already" in capsys.readouterr().err
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(document("multi_link") | {"design": {}}), encoding="utf-8")
    assert main(["optimize", str(path), "--out", str(out)]) == 2
    assert "mine.json', key 'design.minimum_spring_length': is missing" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_curves_of_a_file(tmp_path, load):
    path, out = tmp_path / "rod.json", tmp_path / "out"
    path.write_text(json.dumps(document("push_rod")), encoding="utf-8")
    assert main(["curves", str(path), "--out", str(out), "--travel", "0.04", "--points", "5", "--quiet"]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["curves.csv", "curves.png", "travel.html"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_wishbone", "multi_link", "mcpherson"])
def test_design_of_a_shipped_suspension(name, tmp_path):
    """`lgsens optimize` on wishbones, trailing links and struts, a damper with a curve among them: the way down."""
    out = tmp_path / "out"
    short = ["--parameters", "k,c,hardpoints", "--t1", "1", "--dt", "4e-3", "--steps", "8", "--quiet"]
    assert main(["optimize", name, "--out", str(out), *short]) == 0
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert result["objective"]["reduction"] > 0.2
    assert all(row["after"]["violation_over_scale"] <= 1e-3 for row in result["constraints"])
    assert list(result["design"]["hardpoints"]["after"]) == QuarterCar.load(name).hardpoint_names
    for check in result["gradient_check"].values():
        # round-off of Psi_0 over the step, 1e-12/3e-5, times 10; where it has fallen to a tenth, ten times that
        assert max(check["relative_error"]) < 1e-4
