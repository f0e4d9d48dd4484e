"""One suite for all groups: each operation against its definition on the matrix representation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import some_quick
from hypothesis import given, settings, strategies as st
from scipy.linalg import expm

from lgsens.liegroups import SE3, SO3, AbstractLieGroup, Pose, Poses, Power, Product, R3xSO3, RigidMotions, Rn

GROUPS = {
    "Rn": Rn(3),
    "SO3": SO3(),
    "R3xSO3": R3xSO3(),
    "SE3": SE3(),
    "Product": Product((Rn(2), SO3(), Rn(1))),
    "Power": Power(R3xSO3(), 3),
    # in turn: rotation, heave only, planar motion, all, nothing
    "Poses": Poses(((3, 4, 5), (2,), (0, 2, 4), (0, 1, 2, 3, 4, 5), ())),
    "RigidMotions": RigidMotions(((0, 1, 2, 3, 4, 5), (0, 2, 4), ())),
}
DTYPES = [np.float32, np.float64]
METHODS = ["exp", "log", "wedge", "vee", "matrix", "ad", "compose", "inverse", "retract"]
METHODS += ["Ad_inv", "Ad_inv_mv", "Ad_inv_rmv", "tangent", "tangent_mv", "tangent_rmv"]
METHODS += ["tangent_inv", "tangent_inv_mv", "to_ambient", "from_ambient"]

# Coordinates are of order 1 and formulas are short: a few eps of error per entry, more where a product in a
# reference sums up to 21 of them. 32 eps (7e-15) tells that from any wrong coefficient.
ULPS = 32


def compiled(function):
    function = jax.jit(function)
    return lambda *args: jax.tree.map(np.asarray, function(*args))


class Jitted:
    """A group with compiled methods and NumPy results: what a test then does with these compiles nothing."""

    def __init__(self, group):
        self.group, self.dim = group, group.dim
        for name in METHODS:
            setattr(self, name, compiled(getattr(group, name)))


JITTED = {name: Jitted(group) for name, group in GROUPS.items()}


@pytest.fixture(params=GROUPS)
def group(request):
    return JITTED[request.param]


def coordinates(group, count=1, dtype=np.float64, seed=0, scale=0.7):
    x = np.random.default_rng(seed).normal(scale=scale, size=(count, group.dim)).astype(dtype)
    return x[0] if count == 1 else tuple(x)


def close(actual, expected, dtype=np.float64, ulps=ULPS):
    jax.tree.map(
        lambda a, e: np.testing.assert_allclose(a, e, rtol=0, atol=ulps * np.finfo(dtype).eps),
        actual,
        expected,
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_exp_is_the_matrix_exponential(group, dtype):
    x = coordinates(group, dtype=dtype)
    close(group.matrix(group.exp(x)), expm(group.wedge(x.astype(np.float64))), dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_inverts_exp(group, dtype):
    for scale in (0.0, 1e-6, 0.7):
        x = coordinates(group, dtype=dtype, scale=scale)
        close(group.log(group.exp(x)), x, dtype)


@given(data=st.data())
@settings(max_examples=60, deadline=None)
@pytest.mark.parametrize("name", GROUPS)
def test_log_inverts_exp_everywhere_below_pi(name, data):
    group = JITTED[name]
    # |x_i| ≤ 1.8 keeps every rotation vector below 1.8 √3 = 3.12 < π.
    entry = st.floats(-1.8, 1.8, allow_subnormal=False)
    x = np.array(data.draw(st.lists(entry, min_size=group.dim, max_size=group.dim)))
    close(group.log(group.exp(x)), x)


@pytest.mark.parametrize("dtype", DTYPES)
def test_group_axioms(group, dtype):
    p, q, r = (group.exp(x) for x in coordinates(group, 3, dtype))
    e = jax.tree.map(np.asarray, group.group.identity(dtype))
    close(group.compose(group.compose(p, q), r), group.compose(p, group.compose(q, r)), dtype)
    close(group.compose(q, e), q, dtype)
    close(group.compose(e, q), q, dtype)
    close(group.compose(q, group.inverse(q)), e, dtype)
    close(group.compose(group.inverse(q), q), e, dtype)
    close(group.matrix(group.compose(p, q)), group.matrix(p) @ group.matrix(q), dtype)
    close(group.matrix(e), np.eye(len(group.matrix(e))), dtype)


def test_retract_is_composition_with_exp(group):
    x, y = coordinates(group, 2)
    q = group.exp(x)
    close(group.matrix(group.retract(q, y)), group.matrix(q) @ expm(group.wedge(y)))


def test_vee_inverts_wedge(group):
    x = coordinates(group)
    close(group.vee(group.wedge(x)), x, ulps=0)


def test_Ad_inv_is_conjugation(group):
    x, w = coordinates(group, 2)
    q = group.exp(x)
    expected = group.vee(group.matrix(group.inverse(q)) @ group.wedge(w) @ group.matrix(q))
    close(group.Ad_inv_mv(q, w), expected)
    close(group.Ad_inv(q), expm(-group.ad(x)))


def test_ad_is_the_commutator(group):
    x, y = coordinates(group, 2)
    X, Y = group.wedge(x), group.wedge(y)
    close(group.wedge(group.ad(x) @ y), X @ Y - Y @ X)


@pytest.mark.parametrize("method", ["Ad_inv", "tangent"])
def test_rmv_is_the_transpose_of_mv(group, method):
    x, y, z = coordinates(group, 3)
    point = group.exp(x) if method == "Ad_inv" else x
    mv, rmv = getattr(group, method + "_mv"), getattr(group, method + "_rmv")
    matrix = getattr(group, method)(point)
    close(mv(point, y), matrix @ y)
    close(rmv(point, y), matrix.T @ y)
    close(np.vdot(z, mv(point, y)), np.vdot(rmv(point, z), y))


@pytest.mark.parametrize("scale", [0.0, 1e-7, 0.7])
def test_tangent_is_the_derivative_of_exp(group, scale):
    x, y = coordinates(group, 2, scale=scale)[0], coordinates(group, seed=1)
    exp = group.group.exp
    q, dq = compiled(lambda x, y: jax.jvp(exp, (x,), (y,)))(x, y)
    close(group.from_ambient(q, dq), group.tangent_mv(x, y))
    close(group.to_ambient(q, group.tangent_mv(x, y)), dq)


@pytest.mark.parametrize("scale", [0.0, 1e-7, 0.7])
def test_tangent_inverse(group, scale):
    x, y = coordinates(group, 2, scale=scale)[0], coordinates(group, seed=1)
    close(group.tangent_inv(x) @ group.tangent(x), np.eye(group.dim))
    close(group.tangent_inv_mv(x, group.tangent_mv(x, y)), y)


def tangent_series(ad, x):
    """T(x) = Σ_k (-ad x)^k / (k+1)!, which holds on every Lie group; 40 terms suffice for |x| ≤ 5."""
    A = -ad(x)
    one = jnp.eye(len(A), dtype=A.dtype)

    def add(carry, k):
        term, total = carry
        term = term @ A / (k + 1.0)
        return (term, total + term), None

    return jax.lax.scan(add, (one, one), jnp.arange(1.0, 40.0))[0][1]


def test_tangent_and_two_derivatives_match_the_series(group):
    def derivatives(T, x, y, z):
        def first(x):
            return jax.jvp(T, (x,), (y,))[1]

        return T(x), first(x), jax.jvp(first, (x,), (z,))[1]

    def series(x):
        return tangent_series(group.group.ad, x)

    both = compiled(lambda *args: (derivatives(group.group.tangent, *args), derivatives(series, *args)))
    close(*both(*coordinates(group, 3)))


@pytest.mark.parametrize("scale", [0.0, 0.7])
def test_derivative_of_the_tangent_satisfies_the_commutation_rule(group, scale):
    """Eq. (6), `δu - d(δq)/ds = ad(u) δq`, with `u = T(x) y` and `δq = T(x) z`."""
    x, (y, z) = coordinates(group, scale=scale), coordinates(group, 2, seed=1)
    T = group.group.tangent_mv
    derivative = compiled(lambda x, y, z: jax.jvp(lambda x: T(x, y), (x,), (z,))[1])
    expected = group.ad(group.tangent_mv(x, y)) @ group.tangent_mv(x, z)
    close(derivative(x, y, z) - derivative(x, z, y), expected)


def test_taylor_remainder_of_the_tangent_has_rate_two(group):
    x, y = coordinates(group, 2)
    q = group.exp(x)
    steps = 0.1 * 0.5 ** np.arange(5)

    def remainder(h):
        moved = group.log(group.compose(group.inverse(q), group.exp(x + h * y)))
        return np.linalg.norm(moved - h * group.tangent_mv(x, y))

    remainders = np.array([remainder(h) for h in steps])
    if isinstance(group.group, Rn):
        assert remainders.max() < 1e-14  # linear: nothing remains but the rounding of numbers of order 1
    else:
        rates = np.log2(remainders[:-1] / remainders[1:])
        # Rate 2 up to O(h): 0.1 at h = 0.1, halved at each step.
        np.testing.assert_allclose(rates[-2:], 2.0, atol=0.1)


def test_ambient_and_algebra_coordinates_are_inverse(group):
    x, w = coordinates(group, 2)
    q = group.exp(x)
    dq = group.to_ambient(q, w)
    assert jax.tree.structure(dq) == jax.tree.structure(q)
    close(group.from_ambient(q, dq), w)
    # δq = q w~ of eq. (3), on matrices. `matrix` is affine in the arrays of q, so its tangent is exact.
    tangent = compiled(lambda q, dq: jax.jvp(group.group.matrix, (q,), (dq,))[1])(q, dq)
    close(tangent, group.matrix(q) @ group.wedge(w))


def test_conversions_can_be_transposed(group):
    """What reverse mode does with a cotangent: ⟨c, D w⟩ = ⟨Dᵀ c, w⟩ for either conversion, along each coordinate."""
    q = group.exp(coordinates(group))
    to = lambda w: group.group.to_ambient(q, w)
    back = lambda dq: group.group.from_ambient(q, dq)
    units = jnp.eye(group.dim)

    @jax.jit
    def both(cotangent, w):
        dq = jax.vmap(to)(units)
        pair = lambda c, rows: sum(jnp.tensordot(row, x, x.ndim) for x, row in zip(*map(jax.tree.leaves, (c, rows))))
        return (
            (jax.linear_transpose(to, w)(cotangent)[0], pair(cotangent, dq)),
            (jax.vmap(lambda row: pair(jax.linear_transpose(back, q)(w)[0], row))(dq), jax.vmap(back)(dq) @ w),
        )

    random = np.random.default_rng(3)
    cotangent = jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)), q)
    for found, expected in jax.tree.map(np.asarray, both(cotangent, coordinates(group, seed=4))):
        close(found, expected)


def test_from_ambient_projects_on_the_tangent_space():
    group = JITTED["SO3"]
    q = group.exp(np.array([0.3, -0.5, 0.8]))
    w = np.array([1.0, -2.0, 0.5])
    symmetric = np.array([[1.0, 2.0, 3.0], [2.0, -1.0, 0.5], [3.0, 0.5, 4.0]])
    close(group.from_ambient(q, group.to_ambient(q, w) + q @ symmetric), w)


@pytest.mark.parametrize(
    ("name", "dtype"), some_quick([("SO3", np.float32), *((name, np.float64) for name in GROUPS)], 4)
)
def test_derivatives_through_exp_and_log_at_zero(name, dtype):
    """Under jit, vmap and both modes, at the point where θ = |x| has no derivative."""
    group = JITTED[name]
    weights, y, z = coordinates(group, 3, dtype, seed=2)
    p = group.exp(z)

    def f(x):  # log(exp(x)) = x: linear, with gradient `weights` and no curvature
        return jnp.vdot(weights, group.group.log(group.group.exp(x)))

    def g(x):  # log(p exp(x)), whose derivative at 0 is T^{-1}(log p)
        return group.group.log(group.group.retract(p, x))

    def derivatives(x):
        first = jax.jvp(g, (x,), (y,))[1], jax.vjp(g, x)[1](y)[0], jax.grad(f)(x)
        if name != "SO3" or dtype != np.float64:  # elsewhere only bookkeeping differs: not worth the compilation
            return first
        return *first, jax.jvp(jax.grad(f), (x,), (y,))[1]

    T_inv = group.tangent_inv(group.log(p))
    expected = (T_inv @ y, T_inv.T @ y, weights, np.zeros_like(y))
    actual = compiled(jax.vmap(derivatives))(np.zeros((2, group.dim), dtype))
    close(actual, tuple(np.stack([e, e]) for e in expected[: len(actual)]), dtype)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_method_follows_the_dtype_and_vmaps(group, dtype):
    x, y = coordinates(group, 2, dtype)
    q, p = group.exp(x), group.exp(y)
    X, dq = group.wedge(x), group.to_ambient(q, y)
    arguments = {"exp": (x,), "log": (q,), "wedge": (x,), "vee": (X,), "matrix": (q,), "ad": (x,)}
    arguments |= {"compose": (p, q), "inverse": (q,), "retract": (q, x), "Ad_inv": (q,)}
    arguments |= {"tangent": (x,), "tangent_inv": (x,), "to_ambient": (q, y), "from_ambient": (q, dq)}
    arguments |= dict.fromkeys(["Ad_inv_mv", "Ad_inv_rmv"], (q, y))
    arguments |= dict.fromkeys(["tangent_mv", "tangent_rmv", "tangent_inv_mv"], (x, y))
    assert set(arguments) == set(METHODS)
    for name, args in arguments.items():
        method = getattr(group.group, name)
        single = jax.eval_shape(method, *args)
        assert all(leaf.dtype == dtype for leaf in jax.tree.leaves(single)), name
        batch = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((4, *leaf.shape), leaf.dtype), (args, single))
        assert jax.eval_shape(jax.vmap(method), *batch[0]) == batch[1], name


@pytest.mark.parametrize("dtype", [*DTYPES, None])
def test_identity_has_the_dtype_asked_for(group, dtype):
    e = group.group.identity(dtype)
    assert all(leaf.dtype == (dtype or np.float64) for leaf in jax.tree.leaves(e))
    assert jax.tree.structure(e) == jax.tree.structure(group.exp(coordinates(group)))


def test_groups_are_static_values(group):
    assert isinstance(group.group, AbstractLieGroup)
    assert not jax.tree.leaves(group.group)
    assert len({group.group, jax.tree.map(lambda leaf: leaf, group.group)}) == 1
    assert group.log(group.group.identity()).shape == (group.dim,)


def test_shapes_and_order_of_coordinates():
    x = np.arange(1.0, 7.0)
    group = JITTED["R3xSO3"]
    q = group.exp(x)
    assert isinstance(q, Pose)
    np.testing.assert_array_equal(q.position, x[:3])
    close(q.orientation, JITTED["SO3"].exp(x[3:]))
    # The direct product, not SE(3): conjugation leaves the translation alone.
    np.testing.assert_array_equal(group.Ad_inv_mv(q, x)[:3], x[:3])
    # Eq. (20): the rotation first, then the translation in the last column.
    matrix = group.matrix(q)
    np.testing.assert_array_equal(matrix[:3, :3], q.orientation)
    np.testing.assert_array_equal(matrix[3:6, 6], q.position)
    powers = JITTED["Power"].exp(np.concatenate([x, -x, x]))
    assert powers.position.shape == (3, 3) and powers.orientation.shape == (3, 3, 3)
    np.testing.assert_array_equal(powers.position[1], -x[:3])


def test_poses_are_the_power_with_coordinates_left_out():
    """Eᵀ A E for every operator, with the E of the free coordinates; poses outside the subgroup move alike."""
    group, power = JITTED["Poses"], Jitted(Power(R3xSO3(), 5))
    E = np.eye(30)[:, [3, 4, 5, 8, 12, 14, 16, *range(18, 24)]]
    np.testing.assert_array_equal(group.group.rows(jnp.arange(13.0)).ravel(), E @ np.arange(13.0))
    x, y = coordinates(group, 2)
    q = group.exp(x)
    close(q, power.exp(E @ x), ulps=2)  # the same formulas, compiled for other shapes
    for method, point, full in (
        ("ad", x, E @ x),
        ("Ad_inv", q, q),
        ("tangent", x, E @ x),
        ("tangent_inv", x, E @ x),
    ):
        close(getattr(group, method)(point), E.T @ getattr(power, method)(full) @ E, ulps=4)
    elsewhere = power.exp(coordinates(power))
    close(group.retract(elsewhere, x), power.retract(elsewhere, E @ x), ulps=4)
    close(group.to_ambient(elsewhere, y), power.to_ambient(elsewhere, E @ y), ulps=4)


def test_poses_compute_no_rotation_that_no_body_has():
    """Translations and one rotation commute: nothing is left of T and D; without rotations nothing of exp."""
    planar, sliding = Poses(((0, 1, 5), (2,))), Poses(((0,), (1, 2)))
    x = jnp.arange(1.0, 5.0)
    for method in (planar.tangent_mv, planar.tangent_rmv, planar.tangent_inv_mv):
        assert not jax.make_jaxpr(method)(x, x).eqns
    assert not jax.make_jaxpr(planar.Ad_inv_mv)(planar.exp(x), x).eqns
    np.testing.assert_array_equal(planar.ad(x), np.zeros((4, 4)))
    assert "sin" in str(jax.make_jaxpr(planar.exp)(x))
    assert "sin" not in str(jax.make_jaxpr(sliding.exp)(x[:3]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Rn(-1), "`n` is the dimension"),
        (lambda: Rn(2.0), "`n` is the dimension"),
        (lambda: Product([SO3()]), "`groups` is a non-empty tuple"),
        (lambda: Product(()), "`groups` is a non-empty tuple"),
        (lambda: Product((SO3(), 3)), r"`groups\[1\]` is not a Lie group"),
        (lambda: Power(SO3, 2), "`group` is not a Lie group"),
        (lambda: Power(SO3(), 0), "`n` is the number of copies"),
        (lambda: Poses(((3, 4),)), r"`free\[0\]` = \(3, 4\) has two rotations"),
        (lambda: Poses(((0,), (2, 1))), r"`free\[1\]` must be increasing"),
        (lambda: Poses(((0, 6),)), r"`free\[0\]` must be increasing integers from 0 to 5"),
        (lambda: Poses(((), ())), "leaves no coordinate"),
        (lambda: Product((SO3(), Rn(1))).exp(jnp.zeros(5)), r"expected \(4,\)"),
    ],
)
def test_wrong_arguments_are_named(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("method", ["exp", "retract", "to_ambient", "log"])
def test_large_batches_equal_small_ones(method, dtype):
    """XLA's CPU compiler splits loops past 32768 results, and once got the signs of `exp` wrong there."""
    group = SO3()
    x, y = jnp.asarray(np.random.default_rng(0).normal(scale=0.5, size=(2, 8000, 3)), dtype)

    @jax.jit
    @jax.vmap
    def apply(x, y):
        q = group.exp(x)
        arguments = {"exp": (x,), "log": (q,), "retract": (q, y), "to_ambient": (q, y)}
        return getattr(group, method)(*arguments[method])

    pieces = [np.asarray(apply(x[i : i + 80], y[i : i + 80])) for i in range(0, 8000, 80)]
    # The same formulas, perhaps contracted differently to fused multiply-adds: a few eps.
    close(np.asarray(apply(x, y)), np.concatenate(pieces), dtype)
