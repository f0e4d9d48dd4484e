"""The five-link quarter-car: mechanism, reference values, every leaf, memory."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import every_leaf

import lgsens as lg
from lgsens.examples import QuarterCar

REFERENCE = json.loads((Path(__file__).parents[1] / "data" / "five_link_quarter_car.json").read_text())
FREE = {name: REFERENCE["params"][key] for name, key in (("free_length", "l0"), ("free_radius", "Rf"))}
CAR = QuarterCar.load()


def car_with(k, c, hb):
    return eqx.tree_at(lambda car: (car.spring.rate, car.damper.rate, car.bump_height), CAR, (k, c, hb))


def comfort(trajectory):
    """Ψ₀ of eq. (47)."""
    return lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)


@pytest.mark.parametrize(("wheel", "constraints", "freedoms"), [("hinged", 45, 3), ("locked", 46, 2)])
def test_mechanism(wheel, constraints, freedoms):
    system = CAR.model(wheel=wheel).system()
    q, _ = system.reference()
    jacobian = np.asarray(system.constraint_jacobian(q, 0.0))
    assert jacobian.shape == (constraints, 48)
    assert 48 - np.linalg.matrix_rank(jacobian) == freedoms


def test_static_preload_is_the_reference():
    """The springs hold the car: tension and tyre force of the reference, found there by another route."""
    forces = CAR.model().forces
    # The reference's free length and radius are printed with 12 digits: 1e-12 m × 1.5e5 N/m
    np.testing.assert_allclose(forces["spring"].preload, REFERENCE["states"][0]["spring_force_tension"], rtol=1e-10)
    np.testing.assert_allclose(forces["tyre"].preload, REFERENCE["states"][0]["tire_normal_force"], rtol=1e-10)


@pytest.fixture(scope="module", params=[pytest.param(wheel, marks=pytest.mark.slow) for wheel in ("hinged", "locked")])
def runs(request):
    """Trajectories and gradients of Ψ₀ at 500 and 1000 steps over 2 s, one wheel kind."""
    wheel = request.param

    def value(x, num_steps):
        model = car_with(*x).model(wheel=wheel, **FREE)
        trajectory = lg.simulate(model, t1=2.0, num_steps=num_steps)
        return comfort(trajectory), trajectory

    x = tuple(jnp.asarray(REFERENCE["params"][name]) for name in ("k", "c", "hb"))
    compute = jax.jit(jax.value_and_grad(value, has_aux=True), static_argnums=1)
    return wheel, {n: compute(x, n) for n in (500, 1000)}


def test_matrices_serve_many_steps(runs):
    """Margins are known where a matrix is made: the clock asks for one in 20 steps, the bump for some more."""
    _, found = runs
    for num_steps, ((_, trajectory), _) in found.items():
        assert num_steps / 20 <= np.sum(np.isfinite(trajectory.stats.margin)) <= 2 * num_steps / 20


def test_converges_to_the_reference_at_second_order(runs):
    wheel, results = runs
    name = "Psi0" if wheel == "hinged" else "Psi0_locked_wheel"
    wanted = np.array([REFERENCE["value"][name], *(REFERENCE["gradient"][name][p] for p in ("k", "c", "hb"))])
    found = np.array([[float(value), *map(float, gradient)] for (value, _), gradient in results.values()])
    error = found / wanted - 1.0
    # the h⁴ term at 500 steps: (h ω)² = 0.1 with the wheel hop's 80 rad/s, times a coefficient below 1
    np.testing.assert_allclose(np.log2(np.abs(error[0] / error[1])), 2.0, atol=0.05)
    # Richardson's extrapolation removes h²; what is left is h⁴: 1e-4 × (h ω)² at 1000 steps, a few 1e-6
    extrapolated = (4.0 * found[1] - found[0]) / 3.0
    np.testing.assert_allclose(extrapolated, wanted, rtol=1e-5)


def test_joints_hold(runs):
    _, results = runs
    for (_, trajectory), _ in results.values():
        violation = jax.vmap(trajectory.system.constraint)(trajectory.states.q, trajectory.t)
        assert float(jnp.abs(violation).max()) <= 1e-10  # m; the constraint is solved at position level


@pytest.mark.slow
@pytest.mark.parametrize("runs", ["hinged"], indirect=True)  # the reference has the states of this one
def test_states_of_the_reference(runs):
    """Spring length, tyre force and wheel centre at the reference's times, second order."""
    _, results = runs
    (_, trajectory), _ = results[1000]
    spring, tyre = trajectory.force("spring"), trajectory.force("tyre")
    for state in REFERENCE["states"]:
        n = round(state["t"] / 2e-3)
        # error at h = 2e-3: (h ω)²/12 = 2e-3 of the motion's amplitudes (0.05 m, 1 m/s, 4 kN)
        np.testing.assert_allclose(spring.length[n], state["spring_length"], atol=1e-4)
        np.testing.assert_allclose(spring.rate[n], state["spring_rate"], atol=2e-3)
        np.testing.assert_allclose(tyre[n], state["tire_normal_force"], atol=8.0)
        np.testing.assert_allclose(trajectory.body("wheel").position[n], state["wheel_centre"], atol=1e-4)


# What cannot matter: the chassis heaves only, so its rotational inertia, its place in the heaving body and its
# initial rotation (projected away) have no effect; nor has the place of the heave axis.
WITHOUT_EFFECT = {
    ".bodies['chassis'].inertia",
    ".bodies['chassis'].position",
    ".bodies['chassis'].orientation",
    ".bodies['chassis'].angular_velocity",
    ".joints['heave'].at",
}
ROUND_OFF = 1e-13  # of Ψ₀: 60 steps, each 1e-15


def difference_step(name, leaf):
    """The distance of differences: δ⁶ below 1e-7 on the leaf's own length, and round-off 1e-13/δ small."""
    largest = float(jnp.abs(leaf).max())
    if name.endswith(("mass", "stiffness", "damping", "preload")):
        return 1e-3 * largest if largest > 0 else 100.0
    if name.endswith("inertia"):
        return 3e-2 * largest
    if name.endswith(("velocity", "acceleration")):
        return 3e-2
    if name.endswith(("orientation", "axis")):
        return 5e-3
    if name.endswith(("axis_a", "axis_b")):
        return 1.5e-2  # the weakest leaves: round-off shows first
    if name.endswith(("duration", "start")):
        return 5e-5  # the bump's ends are half a step from the grid
    return 3e-4  # points and lengths [m]


@pytest.mark.slow
def test_gradient_of_every_leaf():
    """Ψ₀ with respect to every number of the model: masses, inertias, hardpoints, axes, rates, road, initial state.

    The scene is in motion from the start, so that everything matters. The differences are those of full Newton, which
    leaves less than the 1e-12 of Ψ that modified Newton does.
    """
    car = eqx.tree_at(lambda c: (c.bump_height, c.bump_duration), CAR, (jnp.asarray(0.08), jnp.asarray(0.1225)))
    model = car.model(**FREE)
    moving = {"chassis": (0.0, 0.0, 1.0), "knuckle": (0.0, 0.0, -3.0), "wheel": (1.0, 2.0, -3.0)}
    model = eqx.tree_at(
        lambda m: [m.bodies[name].velocity for name in moving], model, [jnp.array(v) for v in moving.values()]
    )
    model = eqx.tree_at(
        lambda m: (m.bodies["wheel"].angular_velocity, m.forces["tyre"].road.start),
        model,
        (jnp.array([3.0, 20.0, -5.0]), jnp.asarray(0.0113)),
    )

    def value(model, factor_every=20):
        integrator = lg.GeneralizedAlpha(factor_every=factor_every)
        return comfort(lg.simulate(model, t1=0.15, num_steps=60, integrator=integrator))

    compiled = jax.jit(lambda model: value(model, factor_every=0))
    gradient = jax.jit(jax.grad(value))(model)
    psi = float(compiled(model))
    found = every_leaf(compiled, model, gradient, difference_step)
    assert len(found) == len(jax.tree.leaves(model))
    leaves = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(model)}
    silent = set()
    for name, (exact, estimate) in found.items():
        noise = ROUND_OFF * psi / difference_step(name, leaves[name])
        scale = np.abs(estimate).max()
        if scale <= 10 * noise:
            silent.add(name)
        np.testing.assert_allclose(exact, estimate, rtol=0, atol=max(1e-6 * scale, noise), err_msg=name)
    assert silent == WITHOUT_EFFECT


@pytest.mark.slow
def test_forward_and_reverse_agree():
    """jacfwd, and grad through AdjointVariable, for k, c and the fifteen chassis hardpoints, the preload re-solved."""
    names = sorted(CAR.links)

    def value(x, sensitivity):
        k, c, points = x
        car = eqx.tree_at(
            lambda car: [car.spring.rate, car.damper.rate, *(car.links[name].chassis for name in names)],
            CAR,
            [k, c, *points],
        )
        return comfort(lg.simulate(car.model(), t1=0.2, num_steps=100, sensitivity=sensitivity))

    points = jnp.stack([CAR.links[name].chassis for name in names])
    x = (CAR.spring.rate, CAR.damper.rate, points)
    forward = jax.jit(jax.jacfwd(lambda x: value(x, lg.DirectDifferentiation())))(x)
    reverse = jax.jit(jax.grad(lambda x: value(x, lg.AdjointVariable())))(x)
    for a, b in zip(jax.tree.leaves(reverse), jax.tree.leaves(forward)):
        # 100 steps × condition 5e2 × round-off
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * float(jnp.abs(b).max()))


@pytest.mark.slow
def test_reverse_mode_keeps_states_only():
    """Temporary memory of the compiled gradient at 1000 steps: within 3 × the stored trajectory."""
    model = CAR.model()

    def run(model):
        return lg.simulate(model, t1=1.0, num_steps=1000)

    stored = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(jax.eval_shape(run, model).states))
    compiled = jax.jit(jax.grad(lambda model: comfort(run(model)))).lower(model).compile()
    analysis = compiled.memory_analysis()
    assert analysis is not None
    assert analysis.temp_size_in_bytes <= 3 * stored
