"""Block elimination against NumPy, and simulations with it against those with a dense LU."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import equations, some_quick

import lgsens as lg
from lgsens.dynamics import initial_state, is_redundant, tangents, times_tangent_operator
from lgsens.dynamics._matrices import ConstrainedMass
from lgsens.examples import QuarterCar, four_bar, spatial_chain, spinning_top
from lgsens.integrate import factorize_iteration_matrix
from lgsens.linear import LU, Elimination, Factors, Inverse
from lgsens.linear._ordering import levels, of_one_shape

H = 1e-3


def branched(links: int = 3) -> lg.Model:
    """A planar trolley with pendulums of two links each, springs between their ends, one loop closed by a rod."""
    body = lambda at, **more: lg.RigidBody(1.0, (0.02, 0.03, 0.04), position=at, **more)
    bodies = {"trolley": body((0.0, 0.0, 0.0), free="x y rz")}
    joints: dict = {}
    forces: dict = {"gravity": lg.Gravity((0.0, 0.0, -9.81))}
    for i in range(links):
        x = 0.5 * i
        bodies |= {
            f"upper{i}": body((x, 0.0, -0.25)),
            f"lower{i}": body((x, 0.0, -0.75), angular_velocity=(0.3, 0.5, 0.1)),
        }
        joints[f"hinge{i}"] = lg.RevoluteJoint("trolley", f"upper{i}", at=(x, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        joints[f"ball{i}"] = lg.SphericalJoint(f"upper{i}", f"lower{i}", at=(x, 0.0, -0.5))
        if i:
            ends = {"at_a": (x - 0.5, 0.0, -1.0), "at_b": (x, 0.0, -1.0)}
            forces[f"spring{i}"] = lg.SpringDamper(f"lower{i - 1}", f"lower{i}", stiffness=50.0, damping=1.0, **ends)
    joints["rod"] = lg.DistanceJoint(
        "lower0", f"lower{links - 1}", at_a=(0, 0, -1.0), at_b=(0.5 * links - 0.5, 0.1, -1.0)
    )
    return lg.Model(bodies, joints, forces)


SCENES = {"chain": lambda: spatial_chain(9), "four_bar": four_bar, "branched": branched}
SCENES |= {"one body": lambda: spinning_top(0.7)}


def systems(name: str):
    system = SCENES[name]().system()
    return [dataclasses.replace(system, linear_solver=solver) for solver in (lg.DenseLU(), lg.BlockSparse())]


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("chain", "four_bar")]


@pytest.fixture(scope="module", params=["one body", "branched", *SLOW])
def pair(request):
    """A system, dense and sparse, and a point off its constraints."""
    dense, sparse = systems(request.param)
    assert dense.elimination is None
    assert sparse.elimination.levels
    rng = np.random.default_rng(0)
    q, v = dense.reference()
    k, m = len(v), len(dense.constraint_names)
    q = dense.group.retract(q, jnp.asarray(0.1 * rng.normal(size=k)))
    v, vdot, lam = (jnp.asarray(rng.normal(size=size)) for size in (k, k, m))
    return dense, sparse, (q, v, vdot, lam, jnp.asarray(0.1))


def close(actual, expected, *, ulps):
    scale = max(float(np.abs(expected).max()), 1e-300)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=ulps * np.finfo(float).eps * scale)


@pytest.mark.slow
def test_matrices_and_their_products(pair):
    """M, K_t, C_t, B: as arrays, times vectors and columns from both sides, times T(x)."""
    dense, sparse, point = pair
    x = jnp.asarray(0.2 * np.random.default_rng(1).normal(size=len(point[1])))
    found, expected = tangents(sparse, *point), tangents(dense, *point)
    for matrix, array in (*zip(found, expected), (sparse.sparse_mass_matrix(), dense.mass_matrix())):
        rng = np.random.default_rng(2)
        right, left = (jnp.asarray(rng.normal(size=size)) for size in (array.shape[1], array.shape[0]))
        # sums of up to 12 terms for each of a few elements
        close(matrix.dense(), array, ulps=0)
        close(matrix.to_numpy(), array, ulps=8)
        close(matrix @ right, array @ right, ulps=64)
        close(matrix @ jnp.stack([right, -right], axis=1), array @ jnp.stack([right, -right], axis=1), ulps=64)
        close(left @ matrix, left @ array, ulps=64)
        close(matrix.T @ left, array.T @ left, ulps=64)
        close((2.0 * matrix + matrix).dense(), 3.0 * array, ulps=4)
    close(sparse.sparse_mass_matrix().trace(), np.trace(dense.mass_matrix()), ulps=16)
    turned = times_tangent_operator(sparse, x, (found.stiffness, found.constraint_jacobian))
    for actual, wanted in zip(
        turned, times_tangent_operator(dense, x, (expected.stiffness, expected.constraint_jacobian))
    ):
        close(actual.dense(), wanted, ulps=16)


@pytest.mark.parametrize("kind", [LU, Inverse])
def test_factors_solve_with_the_iteration_matrix_and_its_transpose(pair, kind):
    dense, sparse, point = pair
    scheme, rng = lg.GeneralizedAlpha(), np.random.default_rng(3)
    x = jnp.asarray(0.1 * rng.normal(size=len(point[1])))
    columns = [jnp.asarray(rng.normal(size=(size, 2))) for size in (len(point[1]), len(point[3]))]

    @eqx.filter_jit
    def solved(system, mass):
        """As it is and transposed, of two columns and of one."""
        factors = factorize_iteration_matrix(scheme, system, tangents(system, *point), mass, x, H, kind)
        of = lambda *rhs: [jnp.concatenate(factors.solve(*rhs, transposed=transposed)) for transposed in (False, True)]
        return of(*columns), of(*(c[:, 0] for c in columns))

    expected, _ = solved(dense, dense.mass_matrix())
    for wanted, actual, single in zip(expected, *solved(sparse, sparse.sparse_mass_matrix())):
        # the scaled matrix has a condition below 1e5 in these scenes
        close(actual, wanted, ulps=1e5)
        close(single, actual[:, 0], ulps=1e4)


def test_levels_grow_with_the_logarithm():
    """Twice the links, one level more or two: random neighbours leave two fifths at least."""
    plans = {n: spatial_chain(n).system().elimination for n in (32, 64, 128)}
    depth = [len(plan.levels) for plan in plans.values()]
    assert all(0 <= later - earlier <= 2 for earlier, later in itertools.pairwise(depth))
    numbers = [plan.numbers - len(plan.rest) ** 2 for plan in plans.values()]
    assert numbers[2] < 2.6 * numbers[1] < 2.6**2 * numbers[0]
    assert all(len(plan.rest) < 130 for plan in plans.values())


@pytest.mark.parametrize("first", some_quick([0, 1]))
@pytest.mark.parametrize("kind", [LU, Inverse])
def test_levels_in_a_loop(first, kind):
    """The same solutions, of S and its transpose, whether levels are split and filled up for a loop or not."""
    system, rng = systems("branched")[1], np.random.default_rng(4)
    some, size = levels(system.topology._graphs[0], early=True)[:-1], system.elimination.size
    assert len({(own.shape, boundary.shape) for own, boundary in some[first:]}) > 1
    equal = of_one_shape(some[first:], 2, size)
    assert len(equal) == len(some) - first + (first == 0)  # three clusters are two and two, one of them filled up
    plan, looped = Elimination(some, size), Elimination([*some[:first], *equal], size, len(equal))
    q, v = system.reference()
    mass, jacobian = system.sparse_mass_matrix(), system.sparse_constraint_jacobian(q, 0.0)
    # not symmetric: K and its transpose exchange X and Y
    dynamic = mass + 0.3 * tangents(system, q, v, v, jnp.ones(jacobian.shape[0]), jnp.zeros(())).stiffness
    columns = [jnp.asarray(rng.normal(size=(size, 2))) for size in (len(v), jacobian.shape[0])]

    @eqx.filter_jit
    def solved(dynamic, jacobian):
        factors = [Factors.of(dynamic, jacobian.T, jacobian, jnp.ones(()), plan=p, kind=kind) for p in (plan, looped)]
        return [
            [jnp.concatenate(f.solve(*columns, transposed=transposed)) for f in factors] for transposed in (False, True)
        ]

    for transposed, (expected, actual) in zip((False, True), solved(dynamic, jacobian)):
        close(actual, expected, ulps=1e5)  # condition, as above
        b = jacobian.dense()
        full = np.block([[dynamic.dense(), b.T], [b, np.zeros((len(b), len(b)))]])
        close((full.T if transposed else full) @ actual, np.concatenate(columns), ulps=1e5)


def test_a_long_chain_compiles_as_a_short_one():
    """What a run factorizes once has one loop for all levels, steps have one for the small levels of a long chain."""
    assert spatial_chain(8).system().elimination.once.looped == 0
    short, long = (spatial_chain(links).system().elimination for links in (64, 512))
    assert short.looped == 0 < len(short.levels) <= 4
    assert len(long.levels) - long.looped <= 4
    assert len(long.rest) == len(long.once.rest)
    for plan in (short, long):
        assert plan.once.looped == len(plan.once.levels)


@pytest.mark.parametrize("elements", [32, 256])
def test_forces_are_not_in_what_is_factorized_once(elements):
    """Nodes of a beam are coupled by its stiffness alone: at the start they go in one level, whatever their number."""
    section = lg.BeamSection([1e6, 5e5, 5e5, 1e3, 1e3, 1e3], 1.0, [0.02, 0.01, 0.01])
    beam = lg.Beam("b", section, [[0, 0, 0], [10.0, 0, 0]], elements=elements)
    hinge = {"hinge": lg.RevoluteJoint(None, "b.0", at=[0, 0, 0], axis=[0, 0, 1.0])}
    plan = lg.Model(beam.bodies, hinge, beam.forces).system().elimination
    assert len(plan.levels) > 1
    ((own, boundary),) = plan.once.levels
    assert (own.shape, boundary.size) == ((elements, 6), 0)
    assert len(plan.once.rest) == 6 + 5  # the node on the hinge, and its multipliers


def test_everything_is_eliminated_once():
    plan = systems("branched")[1].elimination
    gone = np.concatenate([level.own.ravel() for level in plan.levels] + [plan.rest])
    np.testing.assert_array_equal(np.sort(gone[gone < plan.size]), np.arange(plan.size))


@pytest.mark.parametrize("name", ["branched", "chain", "four_bar", "suspension"])
@pytest.mark.parametrize("early", [False, True])
def test_joints_go_with_bodies_that_hold_them(name, early):
    """Rows of B of joints that are gone are independent in the columns of bodies that are gone, level after level."""
    system = (SCENES | {"suspension": lambda: QuarterCar.load().model()})[name]().system()
    rows_of_all = np.asarray(system.constraint_jacobian(system.reference()[0], 0.0))
    k = rows_of_all.shape[1]
    gone, incomplete = np.zeros(0, int), False
    for own, _ in levels(system.topology._graphs[0], early=early):
        gone = np.append(gone, own[own < sum(rows_of_all.shape)])
        rows, columns = rows_of_all[gone[gone >= k] - k], gone[gone < k]
        assert np.linalg.matrix_rank(rows[:, columns]) == len(rows)
        incomplete |= bool(np.delete(rows, columns, axis=1).any())
    assert len(gone) == sum(rows_of_all.shape)
    # the bodies of the four-bar have three coordinates: a joint may take less from one of them than from both
    assert incomplete == (early and name != "four_bar")


def test_a_link_goes_with_one_of_its_joints():
    plan = QuarterCar.load().model().system().elimination
    ((own, boundary),) = plan.levels
    assert own.shape == (6, 10)  # five links with a universal joint of 4 rows, and the wheel
    # the chassis, the knuckle and the 3 rows of the joint there
    assert boundary.shape == (6, 15)
    assert len(plan.rest) == 93 - 5 * 10 - 6


def objective(body: str):
    def psi(system):
        trajectory = lg.simulate(system, t1=0.02, num_steps=10)
        motion = trajectory.body(body)
        return lg.time_integral(trajectory.t, motion.acceleration[:, 2] ** 2 + motion.position[:, 0])

    return psi


@pytest.mark.slow
@pytest.mark.parametrize(("name", "body"), [("chain", "link8"), ("branched", "lower1")])
def test_gradient_of_every_number(name, body):
    """Both solvers factorize the same matrices: value and gradient agree to round-off of the accelerations."""
    dense, sparse = systems(name)
    (value, gradient), (expected, wanted) = (
        eqx.filter_jit(eqx.filter_value_and_grad(objective(body)))(system) for system in (sparse, dense)
    )
    # accelerations carry the round-off of constraints over βh²: 1e-16/1e-6 × about ten
    np.testing.assert_allclose(value, expected, rtol=1e-8)
    largest = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(wanted) if leaf.size)
    for actual, leaf in zip(jax.tree.leaves(gradient), jax.tree.leaves(wanted)):
        np.testing.assert_allclose(actual, leaf, rtol=1e-7, atol=1e-8 * largest)


@pytest.mark.slow  # small version: test_factors_solve_with_the_iteration_matrix_and_its_transpose[one body]
def test_one_body():
    """Its only level leaves nothing for the LU of the rest."""
    top = spinning_top(0.7).system()
    body = top.body_names[0]

    def psi(system):
        trajectory = lg.simulate(system, t1=0.02, num_steps=4)
        return trajectory.body(body).position[-1, 2], trajectory.states.q

    found, expected = (
        eqx.filter_jit(eqx.filter_value_and_grad(psi, has_aux=True))(dataclasses.replace(top, linear_solver=solver))
        for solver in (lg.BlockSparse(), lg.DenseLU())
    )
    for actual, leaf in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # round-off of forces, 1e-16/βh² = 1e-11 times h², and sums of gradients with terms below a hundred
        np.testing.assert_allclose(actual, leaf, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_forward_and_reverse_mode_in_a_batch():
    """jacfwd, jacrev and AdjointVariable of the same criterion, three designs at once."""

    def psi(p, sensitivity=lg.DirectDifferentiation()):
        model = spatial_chain(6, length=p[0], tilt=p[1])
        system = dataclasses.replace(model.system(), linear_solver=lg.BlockSparse())
        trajectory = lg.simulate(system, t1=0.02, num_steps=10, sensitivity=sensitivity)
        return lg.time_integral(trajectory.t, trajectory.body("link5").position[:, 2])

    designs = jnp.asarray([[0.3, 1.0], [0.25, 0.8], [0.4, 1.2]])
    forward = jax.jit(jax.vmap(jax.jacfwd(psi)))(designs)
    # round-off of the initial accelerations, through ten steps
    near = {"rtol": 1e-9, "atol": 1e-9 * float(jnp.abs(forward).max())}
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.jacrev(psi)))(designs), forward, **near)
    explicit = jax.jit(jax.vmap(jax.grad(lambda p: psi(p, lg.AdjointVariable()))))(designs)
    np.testing.assert_allclose(explicit, forward, **near)
    one = jax.jit(jax.grad(psi))(designs[1])
    np.testing.assert_allclose(one, forward[1], **near)


def test_nothing_dense_in_a_long_chain():
    """No array of a simulation of 128 links, or of its gradient, has as many entries as K_t."""
    system = spatial_chain(128).system()
    k = system.group.dim
    program = jax.make_jaxpr(eqx.filter_value_and_grad(objective("link127")))(system)
    sizes = [
        int(np.prod(variable.aval.shape))
        for equation in equations(program.jaxpr)
        for variable in equation.outvars
        if hasattr(variable.aval, "shape")
    ]
    assert max(sizes) < k * k


def two_hinges(*, apart: bool) -> lg.Model:
    """A door on two hinges with one axis, which repeat five equations of each other; or on one."""
    hinges = {"low": lg.RevoluteJoint(None, "door", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0))}
    if not apart:
        hinges["high"] = lg.RevoluteJoint(None, "door", at=(0.0, 0.0, 2.0), axis=(0.0, 0.0, 1.0))
    bodies = {"door": lg.RigidBody(20.0, (7.0, 8.0, 2.0), position=(0.5, 0.0, 1.0))}
    chain = spatial_chain(4)
    return lg.Model(chain.bodies | bodies, chain.joints | hinges, chain.forces, linear_solver=lg.BlockSparse())


@pytest.mark.slow
def test_redundant_constraints_are_found_and_named():
    good, bad = (two_hinges(apart=apart).system() for apart in (True, False))
    assert not is_redundant(good, good.sparse_constraint_jacobian(good.pose, 0.0))
    assert is_redundant(bad, bad.sparse_constraint_jacobian(bad.pose, 0.0))
    assert int(initial_state(good, jnp.asarray(0.0)).result) == lg.RESULTS.successful
    with pytest.raises(ValueError, match=r"\['high', 'low'\]"):
        lg.simulate(bad, t1=0.1, num_steps=10)


def test_the_solver_is_chosen_by_size_and_can_be_given():
    assert spatial_chain(3).system().elimination is None
    assert spatial_chain(32).system().elimination is not None
    chain = spatial_chain(32)
    assert lg.Model(chain.bodies, chain.joints, linear_solver=lg.DenseLU()).system().elimination is None
    with pytest.raises(ValueError, match=r"`linear_solver` must be DenseLU\(\), BlockSparse\(\) or None, got 'sparse'"):
        lg.Model(chain.bodies, chain.joints, linear_solver="sparse")


@pytest.mark.slow
def test_single_precision_after_double():
    """What is kept of a topology serves both: the factors of each solve to their own round-off."""
    for enabled in (True, False):
        with jax.enable_x64(enabled):
            system = dataclasses.replace(spatial_chain(9).system(), linear_solver=lg.BlockSparse())
            q, v = system.reference()
            jacobian = system.sparse_constraint_jacobian(q, 0.0)
            mass = system.sparse_mass_matrix()
            ones, none = jnp.ones_like(v), jnp.zeros(jacobian.shape[0], v.dtype)
            x, mu = ConstrainedMass.of(system, q, 0.0).solve(mass @ ones, none)
            left = mass @ x + mu @ jacobian - mass @ ones
            # a sum of a dozen terms, through a condition below 1e3
            assert float(jnp.abs(left).max()) < 1e3 * float(jnp.finfo(v.dtype).eps) * float(jnp.abs(mass @ ones).max())
            assert v.dtype == (jnp.float64 if enabled else jnp.float32)
