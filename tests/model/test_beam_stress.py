"""The stress in sections of beams: closed forms, torsion solved on a grid, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
from helpers import says

import lgsens as lg
from lgsens.model import Frame

STEEL = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}
NONE, AXES = jnp.zeros(3), jnp.eye(3)


def element(section):
    """From a clamp at 0 to its tip at 1 m."""
    ends = {"at_a": [0.0, 0.0, 0.0], "at_b": [1.0, 0.0, 0.0], "axes_a": AXES, "axes_b": AXES}
    return lg.BeamElement(None, "tip", **ends, section=section)


def bent(section, screw):
    """The state of the element whose tip is at this screw from its clamp."""
    reference, clamp = Frame(AXES[0], AXES), Frame(NONE, AXES)
    pose, still = lg.liegroups.SE3().exp(screw), jnp.zeros(6)
    load = element(section).load(clamp, reference)
    return load.measure(clamp, Frame(pose.position, pose.orientation), still, still, 0.0)


def test_an_element_that_is_bent_and_twisted():
    """E (|ε| + r |κ|) and G r κ₁ of a helix, far bent; by its radius r the bending and the torsion."""
    strain, twist, bends = 1e-3, 0.5, np.array([0.7, -0.4])
    screw = jnp.asarray([1.0 + strain, 0.0, 0.0, twist, *bends])
    stress = lambda d: bent(lg.BeamSection.round(d, **STEEL), screw).stress
    young, shear, radius = 2.1e11, 2.1e11 / 2.6, 0.01
    normal, tangential = young * (strain + radius * np.hypot(*bends)), shear * radius * twist
    value, slope = jax.value_and_grad(stress)(jnp.asarray(2 * radius))
    expected = np.sqrt(normal**2 + 3 * tangential**2)
    # strains are 1e-3 of a pose to round-off
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    by_radius = (normal * young * np.hypot(*bends) + 3 * tangential * shear * twist) / expected
    np.testing.assert_allclose(slope, by_radius / 2, rtol=1e-12)


@pytest.mark.slow  # programs of statics and of its gradient
def test_a_cantilever_that_is_bent_and_twisted():
    """√((M c/I)² + 3 (T r/J)²) of F L/2, in the middle of the element, and of F times its lever; it goes as F/d³."""
    lever, force, diameter = 0.3, jnp.asarray(1.0), jnp.asarray(0.03)

    def stress(d, f):
        tip = lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=[1.0, 0.0, 0.0])
        push = lg.AppliedForce("tip", at=[1.0, lever, 0.0], force=[0.0, 0.0, -1.0])
        model = lg.Model({"tip": tip}, {}, {"arm": element(lg.BeamSection.round(d, **STEEL)), "push": push})
        return lg.statics(model, loads={"push": f[None]}).force("arm").stress[0]

    value, (by_diameter, by_force) = jax.jit(jax.value_and_grad(stress, (0, 1)))(diameter, force)
    bending, twist = 32 * 0.5 / (np.pi * 0.03**3), 16 * lever / (np.pi * 0.03**3)
    expected = np.hypot(bending, np.sqrt(3) * twist)
    # What of the force pulls, by the slope φ = 3e-5, adds φ F/A, which is 2e-7 of it and goes as F²/d⁶.
    np.testing.assert_allclose(value, expected, rtol=3e-7)
    np.testing.assert_allclose([by_diameter, by_force], [-3 * expected / 0.03, expected], rtol=1e-6)


def test_a_tube():
    """N/A + M R/I, whichever way it bends, and √3 T R/J; leading axes are rows."""
    outer, inner = 0.03, 0.024
    section = lg.BeamSection.tube(outer, (outer - inner) / 2, **STEEL)
    area, second = np.pi / 4 * (outer**2 - inner**2), np.pi / 64 * (outer**4 - inner**4)
    forces, moments = np.random.default_rng(0).normal(size=(2, 5, 3)) * [[[1e4, 1e3, 1e3]], [[100.0, 100.0, 100.0]]]
    normal = np.abs(forces[:, 0]) / area + np.hypot(moments[:, 1], moments[:, 2]) * outer / 2 / second
    shear = moments[:, 0] * outer / 2 / (2 * second)
    found = section.stress(forces, moments)
    np.testing.assert_allclose(found, np.sqrt(normal**2 + 3 * shear**2), rtol=1e-13)  # round-off
    np.testing.assert_allclose(section.stress(forces[2], moments[2]), found[2], rtol=1e-14)


def on_a_grid(width, height, force, moment, cells):
    """The largest √(σ² + 3τ²) in all of a rectangle, with torsion by ∇²φ = −2 on a grid and J = 2 ∫ φ."""
    x, y = np.linspace(-width / 2, width / 2, cells + 1), np.linspace(-height / 2, height / 2, cells + 1)
    second = lambda h: scipy.sparse.diags([1.0, -2.0, 1.0], [-1, 0, 1], shape=(cells - 1, cells - 1)) / h**2
    eye = scipy.sparse.identity(cells - 1)
    laplace = scipy.sparse.kron(second(x[1] - x[0]), eye) + scipy.sparse.kron(eye, second(y[1] - y[0]))
    phi = np.zeros((cells + 1, cells + 1))
    inside = scipy.sparse.linalg.spsolve(laplace.tocsc(), np.full((cells - 1) ** 2, -2.0))
    phi[1:-1, 1:-1] = inside.reshape(cells - 1, cells - 1)
    torsion = 2 * phi.sum() * (x[1] - x[0]) * (y[1] - y[0])
    shears = moment[0] / torsion * np.stack(np.gradient(phi, x, y, edge_order=2))
    normal = force[0] / (width * height) + moment[1] * 12 / (width * height**3) * y[None]
    normal = normal - moment[2] * 12 / (height * width**3) * x[:, None]
    return np.sqrt((normal**2 + 3 * (shears**2).sum(axis=0)).max())


def test_a_rectangle_is_that_of_a_grid():
    """Upright and flat, of random forces and moments, with normal stresses as large as those of torsion; on a grid over
    all of the section, so that no point inside has more."""
    rng = np.random.default_rng(1)
    for width, height in ((0.01, 0.025), (0.02, 0.012), (0.02, 0.02)):
        section = lg.BeamSection.rectangle(width, height, **STEEL)
        moduli = min(width, height) ** 2 * max(width, height)
        for _ in range(4):
            force, moment = rng.normal(size=3) * moduli * 300.0, rng.normal(size=3) * moduli
            expected = on_a_grid(width, height, force, moment, 120)
            # (1/120)² of the grid, times π² of the wave; 1e-3 of the places where it is looked for
            assert float(section.stress(force, moment)) == pytest.approx(expected, rel=2e-3)


def test_torsion_of_rectangles_is_that_of_the_table():
    """T/(k₂ a b²) at the middle of the long side, Timoshenko & Goodier, §109; no other point has more."""
    for ratio, k2 in ((1.0, 0.208), (1.5, 0.231), (2.0, 0.246), (3.0, 0.267), (5.0, 0.291), (10.0, 0.312)):
        section = lg.BeamSection.rectangle(0.01 * ratio, 0.01, **STEEL)
        found = float(section.stress(NONE, AXES[0])) / np.sqrt(3)
        assert 1.0 / (found * ratio * 0.01**3) == pytest.approx(k2, abs=6e-4)  # the digits of the table


def test_bending_of_rectangles():
    """N/A + M₂/W₂ + M₃/W₃, in the corner, whatever their signs."""
    section, (width, height) = lg.BeamSection.rectangle(0.02, 0.05, **STEEL), (0.02, 0.05)
    expected = 3e3 / (width * height) + 40.0 * 6 / (width * height**2) + 70.0 * 6 / (height * width**2)
    for signs in np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T:
        found = section.stress([3e3 * signs[0], 0.0, 0.0], [0.0, 40.0 * signs[1], 70.0 * signs[2]])
        np.testing.assert_allclose(found, expected, rtol=1e-14)


@pytest.mark.parametrize("kind", ["tube", "rectangle"])
def test_derivatives_are_differences(kind):
    """By both dimensions, forces and moments together; without load they are 0 and not NaN."""

    def stress(p):
        section = getattr(lg.BeamSection, kind)(*p["shape"], **STEEL)
        return section.stress(p["force"], p["moment"])

    shape = jnp.asarray([0.03, 0.004] if kind == "tube" else [0.02, 0.03])
    p = {"shape": shape, "force": jnp.asarray([2e3, 1.0, 1.0]), "moment": jnp.asarray([60.0, -50.0, 20.0])}
    value, slope = jax.jit(stress), jax.jit(jax.grad(stress))
    direction = {"shape": jnp.asarray([0.7, -0.4]) * shape, "force": p["force"], "moment": p["moment"][::-1]}
    at = lambda s: float(value(jax.tree.map(lambda x, d: x + s * d, p, direction)))
    gradient = slope(p)
    along = sum(float(jnp.sum(gradient[key] * direction[key])) for key in p)
    h = 1e-4
    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    assert along == pytest.approx(difference, rel=1e-9)  # h⁴ = 1e-16; round-off over h
    idle = slope(p | {"force": NONE, "moment": NONE})
    assert all(np.all(np.asarray(of) == 0.0) for of in idle.values())


def test_a_section_of_stiffnesses_has_no_stress():
    section = lg.BeamSection([1e7, 5e6, 5e6, 7e5, 8e5, 8e5], 1.0, [0.2, 0.1, 0.1])
    with pytest.raises(ValueError, match=says("`outline` is None", "Make the section by `round`")):
        section.stress(NONE, NONE)
    assert bent(section, jnp.asarray([1.0, 0.0, 0.0, 0.1, 0.2, 0.0])).stress is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((jnp.zeros(2), jnp.zeros(3)), says("`force` must have shape (…, 3)", "(2,)")),
        ((jnp.zeros(3), jnp.zeros((4, 3))), says("`moment` must have shape (…, 3), as `force` has", "(4, 3)")),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        lg.BeamSection.round(0.02, **STEEL).stress(*arguments)


def test_an_outline_is_one():
    with pytest.raises(ValueError, match=says("`outline` must be None or that of another section", "0.02")):
        lg.BeamSection([1.0] * 6, 1.0, [1.0] * 3, outline=0.02)
