"""Hardpoint files that cannot be read, are incomplete, or describe what cannot stand."""

import re
from importlib import resources

import equinox as eqx
import jax
import numpy as np
import pytest
from helpers import says

from lgsens.examples import QuarterCar

# Hardpoint files.

FILE = (resources.files("lgsens.examples") / "data" / "five_link_suspension.toml").read_text(encoding="utf-8")
FORMAT = "see lgsens/examples/data/five_link_suspension.toml for the format"


def line(pattern):
    """The lines of the shipped file that match."""
    found = re.search(pattern, FILE, re.MULTILINE)
    assert found, pattern
    return found.group(0)


# What is replaced by what, and the key and the reason in the message.
FILES = {
    "missing number": (r"^stiffness = 150000.*$", "", ("key 'tyre.stiffness'", "is missing", FORMAT)),
    "missing point": (r"^bearing = .*$", "", ("key 'wheel.bearing'", "is missing", FORMAT)),
    "missing table": (r"^\[damper\]$", "[dampr]", ("key 'damper'", "is missing (is 'dampr' meant for it?)", FORMAT)),
    "missing point of a link": (
        r"^chassis = \[-8.8.*$",
        "",
        ("key 'links.track_strut.chassis'", "is missing", FORMAT),
    ),
    "table that is a number": (
        r"^\[links.wishbone\]\n.*\n.*\n.*\n.*$",
        "[links]\nwishbone = 1",
        ("key 'links.wishbone'", "a table"),
    ),
    "number of text": (
        r"^damping = 4900.0",
        'damping = "firm"',
        ("key 'damper.damping'", "must be a finite number", "'firm'"),
    ),
    "number that is true": (
        r"^radius = 0.0125",
        "radius = true",
        ("key 'link_section.radius'", "a finite number", "True"),
    ),
    "negative rate": (
        r"^stiffness = 109000.0",
        "stiffness = -1.0",
        ("key 'spring.stiffness'", "positive", "-1.0"),
    ),
    "zero mass": (r"^mass = 83.5", "mass = 0", ("key 'wheel.mass'", "must be positive", "got 0")),
    "mass nan": (r"^mass = 83.5", "mass = nan", ("key 'wheel.mass'", "must be", "got nan")),
    "mass infinite": (r"^mass = 83.5", "mass = inf", ("key 'wheel.mass'", "must be", "got inf")),
    "point with two numbers": (
        r"^bearing = .*$",
        "bearing = [0.0, 1.0]",
        ("key 'wheel.bearing'", "three numbers [x, y, z]", "[0.0, 1.0]"),
    ),
    "point with text": (
        r"^bearing = .*$",
        'bearing = [0.0, 1.0, "up"]',
        ("key 'wheel.bearing'", "three numbers", "'up'"),
    ),
    "point that is a number": (
        r"^bearing = .*$",
        "bearing = 3.0",
        ("key 'wheel.bearing'", "three numbers", "3.0"),
    ),
    "point with nan": (
        r"^bearing = .*$",
        "bearing = [0.0, nan, 1.0]",
        ("key 'wheel.bearing'", "three numbers", "nan"),
    ),
    "unknown link": (
        r'^link = "rollover_strut"',
        'link = "tie_rod"',
        ("key 'spring.link'", "one of ['guide_link'", "'tie_rod'"),
    ),
    "link as a list": (
        r'^link = "rollover_strut"',
        'link = ["rollover_strut"]',
        ("key 'spring.link'", "must be one of"),
    ),
    "four links": (
        r"^\[links.guide_link\]\n.*\n.*\n.*\n.*$",
        "",
        (
            "key 'links'",
            "the wheel has 2 degrees of freedom to the chassis, and needs one, its travel",
            "['rollover_strut', 'track_strut', 'trailing_arm', 'wishbone']",
        ),
    ),
    "link without length": (
        r"^chassis = \[-2.0, -15.8, 16.7\]",
        "chassis = [-0.4, -25.6, 16.3]",
        ("key 'links.wishbone.knuckle'", "must differ from 'chassis'"),
    ),
    "spring without length": (
        r"^link_point = \[-4.4, -18.4, 5.2\]",
        "link_point = [-4.9, -17.6, 16.0]",
        ("key 'spring.chassis_point'", "must differ from 'link_point'"),
    ),
    "unphysical inertia": (
        r"^inertia = \[0.75, 1.2, 0.75\]",
        "inertia = [0.75, 12.0, 0.75]",
        ("key 'wheel.inertia'", "12.", "each principal moment at most the sum"),
    ),
    "not TOML": (
        r"^\[tyre\]$",
        "[tyre",
        ("is not valid TOML", f"line {FILE[: FILE.index('[tyre]')].count(chr(10)) + 1}"),
    ),
}


@pytest.mark.parametrize("mistake", FILES)
def test_hardpoint_file(mistake, tmp_path):
    pattern, replacement, parts = FILES[mistake]
    path = tmp_path / "mine.toml"
    path.write_text(FILE.replace(line(pattern), replacement, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=says(f"Hardpoint file {str(path)!r}", *parts)):
        QuarterCar.load(path)


def test_hardpoint_file_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match=says("Hardpoint file", "nowhere.toml", "cannot be read", "No such file")):
        QuarterCar.load(tmp_path / "nowhere.toml")
    with pytest.raises(ValueError, match=says("Hardpoint file", "cannot be read", "directory")):
        QuarterCar.load(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=says("Hardpoint file", "binary.toml", "cannot be read", "utf-8")):
        QuarterCar.load(tmp_path / "binary.toml")
    (tmp_path / "scene.py").write_text("import lgsens as lg\n", encoding="utf-8")
    with pytest.raises(ValueError, match=says("scene.py", "is not valid TOML", "`lgsens doctor` take scenes")):
        QuarterCar.load(tmp_path / "scene.py")


def test_shipped_hardpoint_file_reads_as_a_users_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(FILE, encoding="utf-8")
    jax.tree.map(np.testing.assert_array_equal, QuarterCar.load(path), QuarterCar.load())


def test_kind_of_wheel():
    with pytest.raises(ValueError, match=says("`wheel` must be 'hinged' or 'locked'", "'flat'")):
        QuarterCar.load().model(wheel="flat")


def test_spring_without_leverage():
    """A spring whose lower end is the link's pivot on the chassis never changes its length."""
    car = QuarterCar.load()
    pivot = car.links[car.spring.link].chassis
    car = eqx.tree_at(lambda car: car.spring.link_point, car, pivot)
    with pytest.raises(ValueError, match=r"key 'spring': its motion ratio at the design position.*is 0; no car"):
        car.model()


def test_a_file_is_read_inside_of_jit():
    """Its numbers are constants there too."""
    assert jax.jit(lambda scale: scale * QuarterCar.load().spring.rate)(2.0) == 2.0 * QuarterCar.load().spring.rate


def test_numbers_of_a_car_are_replaced_by_name():
    car = QuarterCar.load()
    points = car.hardpoints + 0.01
    changed = car.with_values(stiffness=1e5, bump_height=0.02, hardpoints=points)
    assert (changed.spring.rate, changed.bump_height, changed.damper.rate) == (1e5, 0.02, car.damper.rate)
    np.testing.assert_array_equal(changed.hardpoints, points)
    assert jax.tree.all(jax.tree.map(np.array_equal, car.with_values(), car))
    with pytest.raises(ValueError, match=says("`hardpoints` must have shape (5, 3)", "(6, 3)")):
        car.with_values(hardpoints=np.zeros((6, 3)))
