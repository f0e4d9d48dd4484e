"""Every JAX transformation of the top, the four-bar and the quarter-car, against finite differences."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import lgsens as lg
from lgsens.examples import QuarterCar, four_bar, spinning_top
from lgsens.integrate import EqualGrid
from lgsens.linear import tuned
from lgsens.model import AbstractForce, AbstractLoad, Attached
from lgsens.sensitivity import Parameters

CAR = QuarterCar.load()
STEPS = 12


def top(x):
    model = spinning_top(x[0], mass=15.0 * x[1])
    trajectory = lg.simulate(model, t1=0.1, num_steps=STEPS)
    pivot = trajectory.multiplier("pivot")
    return jnp.stack(
        [
            lg.time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2) * 1e3,
            lg.time_integral(trajectory.t, jnp.sum(pivot**2, axis=1)) * 1e-3,
        ]
    )


def linkage(x):
    trajectory = lg.simulate(four_bar(a=0.3 * x[0], m3=2.0 * x[1]), t1=0.2, num_steps=STEPS)
    coupler = trajectory.body("coupler")
    return jnp.stack(
        [
            coupler.position[-1, 0],
            lg.time_integral(trajectory.t, jnp.sum(coupler.acceleration**2, axis=1)),
        ]
    )


def car(x):
    design = eqx.tree_at(
        lambda car: (car.damper.rate, car.links["wishbone"].chassis),
        CAR,
        (4900.0 * x[0], CAR.links["wishbone"].chassis * jnp.stack([1.0 + 0.0 * x[1], x[1], x[1]])),
    )
    trajectory = lg.simulate(design.model(), t1=0.12, num_steps=STEPS)
    return jnp.stack(
        [
            lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2),
            trajectory.force("tyre")[-1] * 1e-3,
        ]
    )


SCENES = {"top": (top, (0.7, 1.0)), "four_bar": (linkage, (1.0, 1.0)), "quarter_car": (car, (1.0, 1.0))}


class Scene:
    """A function of two design parameters with two criteria, its point, and its derivatives by differences."""

    def __init__(self, name):
        self.function, x = SCENES[name]
        self.x = jnp.array(x)
        self.value = jax.jit(self.function)
        # One compilation for all first derivatives by the rule: rows of the Jacobian, criterion by criterion
        self.jacobian = jax.jit(jax.jacrev(self.function))

    def differences(self, function, step):
        """Columns of the Jacobian by central differences of fourth order."""
        columns = []
        for e in jnp.eye(2) * step:
            f = [function(self.x + k * e) for k in (1, -1, 2, -2)]
            columns.append((8.0 * (f[0] - f[1]) - (f[2] - f[3])) / (12.0 * step))
        return np.stack(columns, axis=-1)


@pytest.fixture(
    scope="module", params=["top", *(pytest.param(name, marks=pytest.mark.slow) for name in SCENES if name != "top")]
)
def scene(request):
    return Scene(request.param)


@pytest.mark.slow
def test_reverse_and_forward(scene):
    """jacrev, jacfwd, jvp and vjp under jit, against differences and each other."""
    expected = scene.differences(scene.value, 1e-3)
    scale = np.abs(expected).max()
    jacobian = scene.jacobian(scene.x)
    # δ⁴ × the fifth derivative (lengths of 0.3–1 m): 1e-12 × 1e2; round-off 1e-15/1e-3
    np.testing.assert_allclose(jacobian, expected, rtol=0, atol=1e-8 * scale)

    @jax.jit
    def others(x, d, w):
        along = jax.jvp(scene.function, (x,), (d,))[1]
        return jax.jacfwd(scene.function)(x), along, jax.vjp(scene.function, x)[1](w)[0]

    direction, weights = jnp.array([0.3, -0.7]), jnp.array([0.4, 0.9])
    by_columns, along, pulled_back = others(scene.x, direction, weights)
    np.testing.assert_allclose(by_columns, jacobian, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(along, jacobian @ direction, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(pulled_back, weights @ jacobian, rtol=0, atol=1e-11 * scale)


@pytest.mark.slow
def test_vmap(scene):
    """vmap(grad) lane by lane, and grad(vmap): the same numbers as one by one."""
    designs = scene.x[None, :] * jnp.array([[1.0, 1.0], [1.02, 1.0], [1.0, 0.97]])
    one_by_one = np.stack([scene.jacobian(x)[1] for x in designs])
    scale = np.abs(one_by_one).max()

    @jax.jit
    def both(designs):
        criterion = lambda x: scene.function(x)[1]
        lanes = jax.vmap(jax.grad(criterion))(designs)
        total = jax.grad(lambda xs: jnp.sum(jax.vmap(criterion)(xs)))(designs)
        return lanes, total

    lanes, total = both(designs)
    # a batched LU rounds differently: round-off × condition 5e2 × 12 steps
    np.testing.assert_allclose(lanes, one_by_one, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(total, one_by_one, rtol=0, atol=1e-11 * scale)


@pytest.mark.slow  # a Hessian is in the quick run with every integrator
def test_hessian(scene):
    """Forward over reverse: symmetric, and the differences of the gradient."""
    criterion = lambda x: scene.function(x)[1]
    hessian = np.asarray(jax.jit(jax.hessian(criterion))(scene.x))
    expected = scene.differences(lambda x: scene.jacobian(x)[1], 1e-3)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(hessian, expected, rtol=0, atol=1e-7 * scale)  # as above, one order higher
    np.testing.assert_allclose(hessian, hessian.T, rtol=0, atol=1e-10 * scale)


@pytest.mark.slow
def test_all_orders_of_second_derivatives():
    """Forward and reverse nested in every order, on the top."""
    criterion = lambda a: top(jnp.stack([a, jnp.ones_like(a)]))[1]
    modes = (jax.grad, jax.jacfwd)
    values = [float(jax.jit(outer(inner(criterion)))(0.7)) for outer in modes for inner in modes]
    np.testing.assert_allclose(values, values[0], rtol=1e-10)  # condition of the second derivative, a few digits more


def test_explicit_adjoint_is_reverse_only():
    model = spinning_top(0.7)

    def value(mass):
        moved = eqx.tree_at(lambda m: m.bodies["top"].mass, model, mass)
        return jnp.sum(lg.simulate(moved, t1=0.1, num_steps=2, sensitivity=lg.AdjointVariable()).states.lam)

    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(value, (jnp.array(15.0),), (jnp.array(1.0),))


@pytest.mark.parametrize("sensitivity", [lg.DirectDifferentiation(), lg.AdjointVariable()], ids=["direct", "adjoint"])
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_closed_over_parameter_is_never_silently_constant(sensitivity, mode):
    """A force whose method closes over the design parameter: differentiation raises, it does not return zero."""

    def value(parameter):
        class Push(AbstractLoad):
            unit: jax.Array

            def force(self, a, b, va, vb, t):
                return jnp.zeros(12).at[6].set(parameter * self.unit)

        class PushForce(AbstractForce):
            unit: jax.Array

            @property
            def bodies(self):
                return ("top",)

            def loads(self, bodies):
                return (Attached(Push(self.unit), None, "top"),)

        base = spinning_top(0.7)
        model = lg.Model(base.bodies, base.joints, {"push": PushForce(jnp.asarray(1.0))})
        return jnp.sum(lg.simulate(model, t1=0.1, num_steps=2, sensitivity=sensitivity).states.v)

    with pytest.raises(Exception, match=r"No constant handler|closed-over|[Ll]eak"):
        mode(value)(3.0)


@pytest.mark.slow  # small version: test_eager_gradients_share_their_programs
def test_optimizer_loop_compiles_once():
    """A whole model is optimized; the update keeps every leaf's dtype and strong type."""
    traces = 0

    @eqx.filter_jit
    def step(model, state):
        nonlocal traces
        traces += 1

        def value(model):
            trajectory = lg.simulate(model, t1=0.1, num_steps=3)
            return jnp.sum(trajectory.body("top").velocity[-1] ** 2)

        psi, gradient = jax.value_and_grad(value)(model)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies floats by an integer count
            updates, state = optimizer.update(gradient, state)
        return optax.apply_updates(model, updates), state, psi

    optimizer = optax.adam(1e-3)
    model = spinning_top(0.7)
    state = optimizer.init(model)
    values = []
    for _ in range(5):
        model, state, psi = step(model, state)
        values.append(float(psi))
    assert traces == 1
    assert values[-1] < values[0]


@pytest.mark.slow  # small version: test_one_factorization_for_all_parameters_and_criteria
def test_one_unbatched_factorization_per_step(monkeypatch):
    """Forward: one LU in Newton's loop, modified or full; each sweep: one for its block of four steps, whatever the
    number of parameters or criteria."""
    monkeypatch.setattr(tuned, "ELIMINATED_ROWS", 0)  # small inverses by LAPACK too, by whose name they are found
    jax.clear_caches()  # of what has been traced with another number
    model = spinning_top(0.7)
    system = model.system()
    state0 = lg.initial_state(model)
    h, zero = jnp.asarray(0.01), jnp.zeros(())

    def run(system):
        states, _ = lg.DirectDifferentiation().trajectory(
            lg.GeneralizedAlpha(0.9), state0, Parameters(system, EqualGrid(zero, h, 4))
        )
        return states.v

    leaves, structure = jax.tree.flatten(system)
    many = jax.tree.unflatten(structure, [jnp.stack([jnp.ones_like(x)] * 7) for x in leaves])

    def forward(system, many):
        return jax.vmap(lambda d: jax.jvp(run, (system,), (d,))[1])(many)

    def reverse(system, many):
        _, pull_back = jax.vjp(run, system)
        return jax.vmap(pull_back)(many)

    criteria = jnp.ones((7, *run(system).shape))
    for function, argument in ((forward, many), (reverse, criteria)):
        program = jax.jit(function).lower(system, argument).compile().as_text()
        factorized = re.findall(r"\((f64\[[\d,]*\])[^=]*custom-call\([^\n]*lapack_dgetrf_ffi", program)
        assert sorted(factorized) == ["f64[4,9,9]", "f64[9,9]"]
