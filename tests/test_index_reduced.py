"""The index-reduced integration against references that were computed without this library, and against formulas."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.criteria._index_reduced import integrate_index_reduced
from lgsens.dynamics import autodiff_tangents
from lgsens.examples import QuarterCar, four_bar, spinning_top
from lgsens.liegroups import Rn


def load(name):
    return json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text())


def check(found, wanted, tolerance):
    """Each row to `tolerance` of its largest entry."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    error = np.abs(found - wanted) / np.abs(wanted).max(axis=-1, keepdims=True)
    assert error.max() <= tolerance, f"{error.max():.1e} > {tolerance:.0e}"


TOP = load("spinning_top_brulls")
TOP_NAMES = ("alpha0", "m", "J11", "J22", "J33", "l", "omega0", "g")


def top(p):
    return spinning_top(p[0], mass=p[1], inertia=p[2:5], length=p[5], spin=p[6], gravity=p[7]).system()


def top_rate(p, system, state, t):
    return jnp.concatenate([state.q.position[0, :1] ** 2, jnp.zeros(6)])


def top_final(p, system, state, t):
    return jnp.concatenate([jnp.zeros(1), state.lam, state.q.position[0]])


@pytest.mark.parametrize(("case", "length"), [("l_1.0_reproduces_published_number", 1.0), ("as_printed_l_0.5", 0.5)])
def test_top(case, length):
    """Ψ = ∫ x² dt of the paper and all eight parameters; the force on the pivot, its place and ∂x/∂α₀ at the end."""
    p = jnp.array([(TOP["params"] | {"l": length})[name] for name in TOP_NAMES])
    run = integrate_index_reduced(top_rate, top_final, top, p, 0.0, 1.0)
    # Steps at 1e-12 of motions of size one, and Ψ is 1e-3 of that: the error of the gradient is 2e-12 of its largest
    # entry, and 4e-11 of its smallest, dΨ/dJ11.
    np.testing.assert_allclose(run.value[0], TOP["value"][case], rtol=1e-11)
    gradient = [TOP["gradient"][case][name] for name in TOP_NAMES]
    check(run.gradient[0], gradient, 1e-11)
    np.testing.assert_allclose(run.gradient[0], gradient, rtol=3e-10)
    assert run.drift <= 1e-12
    assert 50 < run.num_steps < 200
    if length == 1.0:
        np.testing.assert_allclose(run.gradient[0, 0], -0.0021318254254500, rtol=1e-11)  # with the paper's digits
        return
    last = TOP["states"][-1]
    assert last["t"] == 1.0
    # m ẍ + λ = m g in the file as here: λ is the force of the top on the ground.
    check(run.value[1:4], last["lam"], 1e-11)
    check(run.value[4:], last["x"], 1e-11)
    check(run.gradient[4:, 0], last["dx_dalpha0"], 1e-11)


BAR = load("four_bar_spring")
BAR_NAMES = tuple(BAR["gradient"]["Psi1"])


def bar(p):
    return four_bar(**dict(zip(BAR_NAMES, p))).system()


def bar_rate(p, system, state, t):
    index = system.body_names.index("coupler")
    offset = state.q.position[index, :2] - jnp.array([0.5, 0.45])
    acceleration = state.vdot.reshape(-1, 6)[index, :3]
    return jnp.stack([offset @ offset, acceleration @ acceleration])


def two_zeros(p, system, state, t):
    return jnp.zeros(2)


@pytest.mark.slow
def test_four_bar():
    """A closed loop: a criterion of the position and one of the acceleration, twelve parameters."""
    p = jnp.array([BAR["params"][name] for name in BAR_NAMES])
    run = integrate_index_reduced(bar_rate, two_zeros, bar, p, 0.0, 2.0)
    # as for the top; the error is at most 3e-12 of an entry, for dΨ₁/db
    np.testing.assert_allclose(run.value, [BAR["value"][name] for name in ("Psi1", "Psi2")], rtol=1e-12)
    gradient = [[BAR["gradient"][name][of] for of in BAR_NAMES] for name in ("Psi1", "Psi2")]
    np.testing.assert_allclose(run.gradient, gradient, rtol=3e-11)
    assert run.drift <= 1e-13


CAR = load("five_link_quarter_car")
CAR_NAMES = ("k", "c", "hb")
SUSPENSION = QuarterCar.load()


def car(p):
    where = lambda car: (car.spring.rate, car.damper.rate, car.bump_height)
    suspension = eqx.tree_at(where, SUSPENSION, tuple(p))
    return suspension.model(free_length=CAR["params"]["l0"], free_radius=CAR["params"]["Rf"]).system()


def car_rate(p, system, state, t):
    acceleration = state.vdot.reshape(-1, 6)[system.body_names.index("chassis"), 2]
    return acceleration**2 * jnp.array([1.0, 1e7])


@pytest.mark.slow
def test_quarter_car():
    """The comfort of the car and its derivatives; the same in another unit, 1e7 as large, costs no steps."""
    p = jnp.array([CAR["params"][name] for name in CAR_NAMES])
    run = integrate_index_reduced(car_rate, two_zeros, car, p, 0.0, 2.0, breaks=[CAR["params"]["Tb"]])
    gradient = [CAR["gradient"]["Psi0"][name] for name in CAR_NAMES]
    # The error is 4e-14; the reference states 1e-13.
    for value, slope, unit in zip(run.value, run.gradient, (1.0, 1e7)):
        np.testing.assert_allclose(value / unit, CAR["value"]["Psi0"], rtol=1e-12)
        np.testing.assert_allclose(slope / unit, gradient, rtol=1e-12)
    assert run.drift <= 1e-13  # m
    assert run.num_steps < 400


JUMP = 0.3


class Sledge(lg.AbstractSystem):
    """A mass on a line that is pushed from the time `JUMP` on; formulas for everything. `rows` times held: stuck."""

    mass: Float[Array, ""]
    push: Float[Array, ""]
    place: Float[Array, ""]
    rows: int = eqx.field(static=True, default=0)
    assembled: bool = eqx.field(static=True, default=True)

    @property
    def group(self):
        return Rn(1)

    @property
    def constraint_names(self):
        return ("stop",) * self.rows

    def reference(self):
        return self.place[None], jnp.ones(1)

    def coordinate_scale(self):
        return jnp.ones(1)

    def mass_matrix(self):
        return self.mass[None, None]

    def residual(self, q, v, vdot, lam, t):
        return self.mass * vdot - jnp.where(t > JUMP, self.push, 0.0) + jnp.sum(lam)

    def constraint(self, q, t):
        return jnp.tile(q - self.place, self.rows)

    def constraint_jacobian(self, q, t):
        return jnp.ones((self.rows, 1))

    def tangents(self, q, v, vdot, lam, t):
        return autodiff_tangents(self, q, v, vdot, lam, t)


traced = []


def sledge(p):
    traced.append("sledge")
    return Sledge(mass=p[0], push=p[1], place=p[2])


def stuck(p):
    return Sledge(mass=p[0], push=p[1], place=p[2], rows=2)


def sledge_rate(p, system, state, t):
    return state.q * jnp.array([1.0, 1e7])


def sledge_final(p, system, state, t):
    return p[3] * state.v * jnp.array([1.0, 0.0])


def integrate(p, build=sledge, **settings):
    return integrate_index_reduced(sledge_rate, sledge_final, build, p, 0.0, 1.0, **settings)


def formulas(p):
    """Ψ₁ = ∫ x dt + p₃ v(1) and Ψ₂ = 1e7 ∫ x dt for x = p₂ + t + p₁ (t − t_j)²/2 p₀ after the jump."""
    mass, push, place, weight = p
    rest = 1.0 - JUMP
    integral = place + 0.5 + push / mass * rest**3 / 6
    return jnp.stack([integral + weight * (1.0 + push / mass * rest), 1e7 * integral])


@pytest.mark.slow
def test_a_force_that_jumps():
    """With `breaks` the scheme is exact on the polynomials before and after; without, it must look for the jump.

    One parameter is zero, one is 1e-12 and hardly matters, units differ by 1e6; functions are traced once.
    """
    p = jnp.array([2e3, 5e3, 0.0, 1e-12])
    run = integrate(p, breaks=[JUMP])
    np.testing.assert_allclose(run.value, formulas(p), rtol=1e-14)
    np.testing.assert_allclose(run.gradient, jax.jacfwd(formulas)(p), rtol=1e-13, atol=1e-16)
    assert run.num_steps < 20
    assert run.drift == 0.0
    count = len(traced)
    other = p * jnp.array([1.5, 0.7, 1.0, 2.0])
    np.testing.assert_allclose(integrate(other, breaks=[JUMP]).value, formulas(other), rtol=1e-14)
    assert len(traced) == count
    searching = integrate(p)
    assert searching.num_steps > run.num_steps
    np.testing.assert_allclose(searching.value, run.value, rtol=1e-10)  # a hundred times the tolerance


def test_breaks_at_the_ends_and_outside():
    p = jnp.array([2e3, 5e3, 0.4, 2.0])
    breaks = [2.0, 1.0, JUMP, 0.0, -1.0]
    np.testing.assert_allclose(integrate(p, breaks=breaks).gradient, jax.jacfwd(formulas)(p), rtol=1e-13, atol=1e-16)


@pytest.mark.slow
def test_inside_jit_and_vmap():
    batch = jnp.array([[2e3, 5e3, 0.4, 2.0], [1e3, 2e3, 0.1, 3.0]])
    found = jax.jit(jax.vmap(lambda p: integrate(p, breaks=[JUMP]).gradient))(batch)
    np.testing.assert_allclose(found, jax.vmap(jax.jacfwd(formulas))(batch), rtol=1e-13, atol=1e-16)


def test_failures():
    p = jnp.array([2e3, 5e3, 0.4, 2.0])
    with pytest.raises(lg.SimulationError, match=r"did not reach `t1` in 3 steps.*`breaks`.*`max_steps`"):
        integrate(p, max_steps=3)
    inside = eqx.filter_jit(lambda p: integrate(p, max_steps=3))(p)
    assert np.all(np.isnan(inside.value)) and np.all(np.isnan(inside.gradient))
    with pytest.raises(ValueError, match="constrain the same motion twice"):
        integrate(p, stuck)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"p": jnp.zeros((2, 2))}, r"`p` must have shape \(p,\)"),
        ({"p": jnp.zeros(0)}, "at least one parameter"),
        ({"t1": 0.0}, "`t1` must be later than `t0`"),
        ({"rtol": 1e-16}, "`rtol` must be at least 2e-15 in float64"),
        ({"atol": 0.0}, "`atol` positive"),
        ({"max_steps": 0}, "`max_steps` must be at least 1"),
        ({"final": lambda p, system, state, t: jnp.zeros(3)}, r"shape \(c,\).*\(2,\) and \(3,\)"),
        ({"rate": lambda p, system, state, t: state.q[0]}, r"shape \(c,\).*\(\) and \(2,\)"),
    ],
)
def test_arguments(settings, message):
    arguments = {"rate": sledge_rate, "final": sledge_final, "build": sledge, "p": jnp.ones(4), "t0": 0.0, "t1": 1.0}
    with pytest.raises(ValueError, match=message):
        integrate_index_reduced(**arguments | settings)
