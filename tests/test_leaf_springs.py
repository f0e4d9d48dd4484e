"""Axles on leaf springs: rates in closed form, what files may say, half of it and the whole, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens import rigs
from lgsens.examples import AxleNumbers, QuarterCar, SuspensionDesign, suspension_document

SEAT, RADIUS = 0.5, 0.35  # m, from the middle of the car, and of the wheels
NAMES = ("parallel", "opposite", "braking")
SWEEPS = rigs.standard_sweeps(travel=1e-3, roll=1e-3, braking=10.0)


def flat(front=0.6, rear=0.6, **numbers):
    """A flat spring through the wheel centre, on pins, its shackle upright: what its closed form is of."""
    found = suspension_document("leaf_springs")
    del found["bushings"], found["bump_stop"]
    eyes = {"front": [front, SEAT, 0.0], "rear": [-rear, SEAT, 0.0], "shackle": [-rear, SEAT, 0.6]}
    found["leaf_spring"] |= eyes | {"seat": [0.0, SEAT, 0.0]} | numbers
    return found


def closed_form(leaf, a, b):
    """Vertical rate with a seat that turns as it likes and with one that does not, stiffness of the seat in roll about
    its own axis, and what turns a free seat, of Euler's beam with shear."""
    one, n, full = leaf.leaf, leaf.leaves, leaf.full_length
    _, _, shear, torsion, bending, _ = np.asarray(one.stiffness)
    x = np.linspace(0.0, 1.0, 20001)  # from the eye
    count = full + (n - full) * x
    cantilever = lambda length: length**3 / bending * np.trapezoid(x**2 / count, x)
    through = lambda length: length * np.trapezoid(1.0 / count, x)
    at_seat = lambda of: (b**2 * of(a) + a**2 * of(b)) / (a + b) ** 2
    free = 1.0 / (at_seat(cantilever) + at_seat(through) / shear)
    held = sum(1.0 / (cantilever(length) + through(length) / shear) for length in (a, b))
    twist = torsion * (1.0 / through(a) + 1.0 / through(b))
    return free, held, twist, at_seat(cantilever) * (a + b) ** 2 / (a * b) ** 2


def check_rates(axle, a, b, left):
    """On the rig, with errors of `left` relative to that of the elements, 1/4m²."""
    leaf, m = axle.left.leaf_spring, axle.left.leaf_spring.elements
    test = rigs.kc(axle.model(compliant=False), axle.wheel_centres, {name: SWEEPS[name] for name in NAMES}, points=3)
    found = rigs.characteristics(test)
    rate, held, twist, _ = closed_form(leaf, a, b)
    load = float(test.sweeps["parallel"].wheels.force[1, 0])
    assert load == pytest.approx(9.81 * float(axle.left.mass), rel=1e-9)  # it rests where it was designed
    assert abs(float(found["wheel_rate"]) / rate - 1.0) < (1.0 + left) / (4 * m**2)
    # Springs of unequal halves turn their seats as they rise, in roll against each other, and the axle is stiff.
    # Contact centres, RADIUS below the axis about which it rolls, are moved sideways with their loads.
    roll = held * (2 * SEAT) ** 2 / 2 + 2 * twist - 2 * load * RADIUS
    assert abs(float(found["roll_rate"]) / roll - 1.0) < (1.0 + left) / (4 * m**2)
    return test, rate


@pytest.mark.slow  # `test_a_flat_leaf_is_a_beam_on_two_supports` is in the quick run
def test_a_flat_spring_is_a_beam_on_two_supports(load):
    """And winds up by M L/12 E I under a moment in its middle."""
    axle = load(flat(leaves=3, full_length=3))
    leaf = axle.left.leaf_spring
    test, rate = check_rates(axle, 0.6, 0.6, 0.1)
    np.testing.assert_allclose(leaf.rate, 48 * 3 * leaf.leaf.stiffness[4] / 1.2**3, rtol=1e-12)
    np.testing.assert_allclose(leaf.rate, rate, rtol=3e-3)  # shear
    turned = np.asarray(test.statics.body("left_wheel").orientation)[:, 0, 2]
    wound = 10.0 * RADIUS * 1.2 / (12 * 3 * leaf.leaf.stiffness[4])
    assert abs(np.ptp(turned[-3:]) / (2 * wound) - 1.0) < 1.1 / leaf.elements**2  # 1/m² of a half with a moment


@pytest.mark.slow  # other numbers of the test before
@pytest.mark.parametrize("elements", [4, 8])
def test_graduated_leaves(load, elements):
    axle = load(flat(0.5, 0.7, leaves=4, full_length=2, elements=elements))
    _, rate = check_rates(axle, 0.5, 0.7, 0.2)
    np.testing.assert_allclose(axle.left.leaf_spring.rate, rate, rtol=3e-3)


@pytest.mark.parametrize("leaves, full", [(5, 1), (4, 2), (3, 3)])
def test_masses_and_rates_of_packs(load, leaves, full):
    """Mass and moment of the nodes are those of the leaves; `rate` is the integral along them."""
    axle = load(flat(0.5, 0.7, leaves=leaves, full_length=full, elements=10))
    leaf = axle.left.leaf_spring
    bodies, elements = leaf.parts("")
    nodes = {name: body for name, body in bodies.items() if name != "shackle"}
    assert len(nodes) == 21 and len(elements) == 20
    mass = float(sum(body.mass for body in nodes.values()))
    assert mass == pytest.approx(float(leaf.leaf.mass) * 1.2 * (full + leaves) / 2, rel=1e-12)
    assert mass + 1.2 == pytest.approx(float(leaf.own_mass), rel=1e-12)
    one = 100.0 * leaf.leaf.stress(jnp.array([0.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    for count, element in zip(leaf.counts, elements.values()):  # of each leaf by its share of the moment
        moment = jnp.array([0.0, 100.0 * count, 0.0])
        np.testing.assert_allclose(element.section.stress(jnp.zeros(3), moment), one, rtol=1e-12)
    shear_free = closed_form(leaf, 0.5, 0.7)[3]
    np.testing.assert_allclose(leaf.rate, 1.2**2 / (0.5 * 0.7) ** 2 / shear_free, rtol=1e-8)


@pytest.mark.slow  # two programs; half of a solid axle on links is in the quick run
def test_half_of_it_moves_as_the_whole(load):
    """Both sides alike: the slow eigenvalues of the half are among those of the whole."""
    axle = load(flat(leaves=3, full_length=3, elements=1))
    half = lg.linearize(axle.half(compliant=False)).eigenvalues
    whole = lg.linearize(axle.model(chassis="guided", tyres=True, compliant=False)).eigenvalues
    slow = [value for value in half if abs(value.imag) < 200.0 and value.imag > 0]
    assert len(slow) >= 2  # heave of chassis and axle
    for value in slow:
        assert np.min(np.abs(whole - value)) < 1e-6 * abs(value)


@pytest.mark.slow  # a gradient of the rig
def test_gradients_of_rates(load):
    """k ∝ w t³ but for shear and what the preloads do; against differences."""
    axle = load(flat(leaves=3, full_length=3, elements=2))
    numbers = AxleNumbers.select(axle, {"leaf_spring.thickness": 0.1, "leaf_spring.front.x": 0.1})
    x = numbers.of(axle)

    def rate(x):
        model = numbers.replaced(axle, x).model(compliant=False)
        test = rigs.kc(model, axle.wheel_centres, {"parallel": SWEEPS["parallel"]}, points=3, throw=False)
        return rigs.characteristics(test)["wheel_rate"]

    found = jax.jit(jax.grad(rate))(x)
    rate = jax.jit(rate)
    for kind, values in x.items():
        h = 1e-4 * values
        expected = (rate(x | {kind: values + h}) - rate(x | {kind: values - h})) / (2 * h)
        np.testing.assert_allclose(found[kind], expected, rtol=1e-6)
    k, t = rate(x), x["rates"]
    np.testing.assert_allclose(found["rates"], 3 * k / t, rtol=0.01)


def test_curves_and_designs_without_a_spring():
    car = QuarterCar.load("leaf_springs")
    assert car.hardpoint_names == ["leaf_spring_front", "leaf_spring_shackle"]
    moved = car.with_values(hardpoints=car.hardpoints + 0.01, damping=1.0)
    np.testing.assert_allclose(moved.leaf_spring.ends["shackle"], car.leaf_spring.ends["shackle"] + 0.01)
    for of, words in (
        (lambda: car.curves([0.0]), ("guided by leaf springs", "lgsens kc")),
        (lambda: car.with_values(stiffness=1.0), ("`stiffness`", "on leaf springs")),
        (lambda: car.model(free_length=1.0), ("`free_length`", "on leaf springs")),
        (lambda: SuspensionDesign.load("leaf_springs"), ("leaf springs", "--vary")),
    ):
        with pytest.raises(ValueError, match=says(*words)):
            of()


def without(document, key):
    del document[key]
    return document


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda d: d | {"spring": {}}, ("key 'spring'", "on leaf springs")),
        (lambda d: without(d, "solid_axle"), ("key 'leaf_spring'", "solid_axle")),
        (lambda d: d["leaf_spring"].update(seat=[1.0, 0.5, 0.0]), ("leaf_spring.seat", "between the two eyes")),
        (lambda d: d["leaf_spring"].update(shackle=[-0.6, 0.5, 0.0]), ("leaf_spring.shackle", "cannot swing")),
        (lambda d: d["leaf_spring"].update(seat=[0.0, -0.5, 0.0]), ("leaf_spring.seat", "no further from their line")),
        (lambda d: d["leaf_spring"].update(shackle=[-0.6, -0.5, 0.1]), ("leaf_spring.shackle", "nor across the car")),
        (lambda d: d["leaf_spring"].update(width=0.008, thickness=0.06), ("leaf_spring.thickness", "exchanged")),
        (lambda d: d["leaf_spring"].update(thickness=8.0), ("leaf_spring.thickness", "did you mean 0.008")),
        (lambda d: d["leaf_spring"].update(thickness=1e-3), ("leaf_spring.thickness", "would be pressed by")),
        (lambda d: d["leaf_spring"].update(young=2e5), ("leaf_spring.young", "did you mean 2e+11")),
        (lambda d: d["leaf_spring"].update(full_length=5), ("leaf_spring.leaves", "at least `full_length`, 5")),
        (lambda d: d["leaf_spring"].update(camber=0.1), ("leaf_spring.camber", "is no key of this table")),
        (lambda d: d["leaf_spring"].pop("leaves"), ("leaf_spring.leaves", "is missing")),
        (lambda d: d.update(bushings={"leaf_spring_eye": {}}), ("bushings.leaf_spring_eye", "'leaf_spring_front'")),
        (lambda d: d.update(links={"leaf_spring": {}}), ("links.leaf_spring", "is a name of its own")),
    ],
)
def test_bad_input(load, change, words):
    document = flat()
    changed = change(document)
    with pytest.raises(ValueError, match=says(*words)):
        load(changed if isinstance(changed, dict) and "units" in changed else document)
