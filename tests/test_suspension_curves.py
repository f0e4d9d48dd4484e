"""The curves of the five-link suspension against a position solver that shares nothing with the library."""

import dataclasses
import tomllib
from importlib import resources
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from lgsens.examples import QuarterCar, SuspensionCurves

FILE = resources.files("lgsens.examples") / "data" / "five_link_suspension.toml"
DOCUMENT = tomllib.loads(FILE.read_text(encoding="utf-8"))
METRE = DOCUMENT["units"]["length"]
TRAVEL = np.linspace(-0.08, 0.08, 17)
NAMES = sorted(DOCUMENT["links"])
X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass
class Closure:
    """The five-link closure: the knuckle keeps five distances to the chassis, the wheel centre its height.

    Unknowns are the translation of the wheel centre and the rotation vector of the knuckle. `shift` moves the chassis
    ends of the links (sorted by name), shape (5, 3).
    """

    shift: Any = 0.0

    def __post_init__(self):
        points = lambda key: np.array([DOCUMENT["links"][name][key] for name in NAMES]) * METRE
        self.chassis, self.knuckle = points("chassis") + self.shift, points("knuckle")
        self.centre = np.array(DOCUMENT["wheel"]["centre"]) * METRE
        self.lengths = np.linalg.norm(self.knuckle - self.chassis, axis=1)

    def place(self, unknowns, points):
        turned = Rotation.from_rotvec(unknowns[3:]).apply(points - self.centre)
        return self.centre + unknowns[:3] + turned

    def equations(self, unknowns, travel):
        ends = self.place(unknowns, self.knuckle)
        return np.append(np.linalg.norm(ends - self.chassis, axis=1) - self.lengths, unknowns[2] - travel)

    def solve(self, travel):
        """Outward from the design position in steps of a centimetre at most."""
        unknowns = np.zeros(6)
        for target in np.linspace(0.0, travel, 1 + max(1, round(abs(travel) / 0.01))):
            found = root(self.equations, unknowns, args=(target,), method="hybr", options={"xtol": 1e-15})
            unknowns = found.x
        assert np.abs(self.equations(unknowns, travel)).max() < 1e-14
        return unknowns

    def line(self, unknowns, strut):
        """Length of a spring or damper: its link turns about x and across, never about its own axis."""
        data = DOCUMENT[strut]
        link = NAMES.index(data["link"])
        start = self.chassis[link]

        def triad(end):
            along = (end - start) / np.linalg.norm(end - start)
            across = np.cross(X, along) / np.linalg.norm(np.cross(X, along))
            return np.stack([along, across, np.cross(along, across)], axis=1)

        before, after = triad(self.knuckle[link]), triad(self.place(unknowns, self.knuckle[link]))
        point = start + after @ before.T @ (np.array(data["link_point"]) * METRE - start)
        return np.linalg.norm(point - np.array(data["chassis_point"]) * METRE)

    def curves(self, travel):
        """Camber, toe, contact centre, length of spring and damper of the wheel on the right."""
        unknowns = self.solve(travel)
        turn = Rotation.from_rotvec(unknowns[3:]).as_matrix()
        normal = turn[:, 1]  # points left
        # From behind, the top of the wheel leans out, to −y, by the angle of its steepest line to the vertical; from
        # above, its front points in, to +y.
        steepest = Z - (Z @ normal) * normal
        steepest /= np.linalg.norm(steepest)
        trace = np.cross(normal, Z)
        camber = np.sign(-steepest[1]) * np.arctan2(np.linalg.norm(steepest[:2]), steepest[2])
        contact = self.centre + unknowns[:3] - self.centre[2] * steepest
        return np.array(
            [camber, np.arctan2(trace[1], trace[0]), *contact]
            + [self.line(unknowns, strut) for strut in ("spring", "damper")]
        )


def differences(function, step):
    """Central differences of fourth order."""
    a, b, c, d = (function(i * step) for i in (-2, -1, 1, 2))
    return (a - 8 * b + 8 * c - d) / (12 * step)


@pytest.fixture(scope="module")
def car():
    return QuarterCar.load()


@pytest.fixture(scope="module")
def curves(car) -> SuspensionCurves:
    return car.curves(TRAVEL)


@pytest.fixture(scope="module")
def closure():
    return np.stack([Closure().curves(s) for s in TRAVEL], axis=1)


def test_positions_agree_with_the_closure(curves, closure):
    camber, toe, x, y, _, spring, _ = closure
    middle = len(TRAVEL) // 2
    # SciPy ends at 1e-14 m of closure; over arms of 0.1 m that is 1e-13 rad.
    for found, expected in (
        (curves.camber, camber),
        (curves.toe, toe),
        (curves.track_change, -2 * (y - y[middle])),  # on the right outward is −y
        (curves.wheelbase_change, -(x - x[middle])),  # a rear wheel that moves forward shortens the wheelbase
        (curves.spring_length, spring),
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert np.abs(np.rad2deg(camber)).max() > 0.5 and np.abs(np.rad2deg(toe)).max() > 0.5  # they do move


def test_rates_agree_with_differences_of_the_closure(curves):
    """Motion ratios −dℓ/ds, and the roll centre where the normal to the path of the contact centre meets y = 0."""
    for i in (0, 5, 8, 16):
        rate = differences(lambda h, i=i: Closure().curves(TRAVEL[i] + h), 5e-4)
        _, _, _, y, _, _, _ = Closure().curves(TRAVEL[i])
        # h⁴/30 f⁽⁵⁾ with arms of 0.1 m: 6e-14/30/0.1⁴ = 2e-11, and 1e-14/h of round-off as much; the lever of 0.8 m
        np.testing.assert_allclose(curves.spring_motion_ratio[i], -rate[5], rtol=0, atol=1e-9)
        np.testing.assert_allclose(curves.damper_motion_ratio[i], -rate[6], rtol=0, atol=1e-9)
        np.testing.assert_allclose(curves.roll_centre_height[i], y * rate[3] / rate[4], rtol=0, atol=1e-9)


@pytest.mark.slow  # `test_kinematics` has gradients of a closed solution in the quick run
@pytest.mark.parametrize("modes", [[jax.jacrev], [jax.jacfwd, jax.jacrev]])
def test_gradients_agree_with_differences_of_the_closure(car, modes):
    """Each of the 15 coordinates of the hardpoints on the chassis, both modes."""
    travel = jnp.asarray(TRAVEL[[2, 11]])

    def of(points):
        moved = eqx.tree_at(lambda c: [c.links[name].chassis for name in NAMES], car, list(points))
        found = moved.curves(travel, throw=False)
        return jnp.stack([found.camber, found.toe, found.track_change, found.spring_length, found.roll_centre_height])

    points = jnp.stack([car.links[name].chassis for name in NAMES])
    found, *others = (jax.jit(mode(of))(points) for mode in modes)
    for other in others:
        close(found, other, 1000)  # one linear operator and its transpose, of condition 1e2
    assert found.shape == (5, 2, 5, 3)

    def at(shift):
        closure = Closure(shift)
        rows = []
        for s in travel:
            camber, toe, _, y, _, spring, _ = closure.curves(float(s))
            rate = differences(lambda h, s=s, closure=closure: closure.curves(float(s) + h), 2e-3)
            rest = closure.centre[1]
            rows.append([camber, toe, -2 * (y - rest), spring, y * rate[3] / rate[4]])
        return np.array(rows).T

    for link, axis in ((0, 1), (1, 2), (2, 0), (3, 2), (4, 0), (4, 1)):
        unit = np.zeros((5, 3))
        unit[link, axis] = 1.0
        expected = differences(lambda h, unit=unit: at(h * unit), 2e-3)
        # As above, per metre: 1e-12/h of round-off; the roll centre's own differences, 5e-9, over h in the last row.
        np.testing.assert_allclose(found[:4, :, link, axis], expected[:4], rtol=0, atol=1e-7)
        np.testing.assert_allclose(found[4, :, link, axis], expected[4], rtol=0, atol=1e-5)


@pytest.mark.slow  # two programs; both against the closure and the files' curves are in the quick run
def test_links_as_bodies_or_rods_move_alike(car):
    rods, bodies = (car.travel(TRAVEL[::4], links=links) for links in ("rods", "bodies"))
    for quantity in ("position", "orientation", "velocity", "angular_velocity"):
        close(getattr(rods.body("wheel"), quantity), getattr(bodies.body("wheel"), quantity), 500)
    assert "wishbone" not in rods.system.body_names and "wishbone" in bodies.system.body_names


def test_the_other_side_is_the_mirror_image(car, curves):
    """On the left all curves are the same."""
    mirrored = car.mirrored()
    np.testing.assert_array_equal(mirrored.wheel.centre, car.wheel.centre * jnp.asarray([1.0, -1.0, 1.0]))
    for name, found, expected in zip(SuspensionCurves._fields, mirrored.curves(TRAVEL), curves):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12, err_msg=name)


def test_the_front_axle_has_the_other_wheelbase(car, curves):
    front = car.curves(TRAVEL, axle="front")
    np.testing.assert_array_equal(front.wheelbase_change, -curves.wheelbase_change)
    np.testing.assert_array_equal(front.toe, curves.toe)


def test_bad_input(car):
    with pytest.raises(ValueError, match="`axle` must be 'rear' or 'front', got 'middle'"):
        car.curves(TRAVEL, axle="middle")
    with pytest.raises(ValueError, match=r"No position satisfies.* at position 1, driven values travel = 0.5"):
        car.curves([0.0, 0.5])
