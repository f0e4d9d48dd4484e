"""`kinematics` near dead centres, where two ways to assemble a linkage come close to each other: against circles that
intersect."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import some_quick

import lgsens as lg

Z, POSITIONS, FINE = (0.0, 0.0, 1.0), 13, 400
HOME = np.array([1.0, 0.0])


def four_bar(p, planar=True):
    """Hinged at the origin, at B, at C and at D."""
    b, c, d = (jnp.append(jnp.asarray(p[k]), 0.0) for k in "BCD")
    free = "x y rz" if planar else None
    bar = lambda a, b: lg.RigidBody(1.0, (0.05, 0.05, 0.05), position=(a + b) / 2, free=free)
    pin = lambda a, b, at: lg.RevoluteJoint(a, b, at=at, axis=Z)
    joints = {"A": pin(None, "crank", jnp.zeros(3)), "B": pin("crank", "coupler", b)}
    joints |= {"C": pin("coupler", "rocker", c), "D": pin("rocker", None, d)}
    return lg.Model(
        {"crank": bar(jnp.zeros(3), b), "coupler": bar(b, c), "rocker": bar(c, d)},
        joints | {"motor": lg.RotationDriver(None, "crank", axis=Z)},
        redundant="refuse" if planar else "minimum_norm",
    )


def closed(p, angles):
    """The middle of the rocker, NaN where the circles about B and D do not intersect, for angles of the crank."""
    b, c, d = (np.asarray(p[k]) for k in "BCD")
    cross = lambda u, v: u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    turn = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    pin = np.stack([b[0] * turn[:, 0] - b[1] * turn[:, 1], b[1] * turn[:, 0] + b[0] * turn[:, 1]], axis=1)
    coupler, rocker = np.hypot(*(c - b)), np.hypot(*(c - d))
    base = np.hypot(*(d - pin).T)[:, None]
    along = (coupler**2 - rocker**2 + base**2) / (2 * base)
    with np.errstate(invalid="ignore"):
        across = np.sign(cross(d - b, c - b)) * np.sqrt(coupler**2 - along**2)
    unit = (d - pin) / base
    return (pin + along * unit + across * np.stack([-unit[:, 1], unit[:, 0]], axis=1) + d) / 2


def turned(p, angles, planar=True):
    found = lg.kinematics(four_bar(p, planar), {"motor": angles}, throw=False)
    return found.body("rocker").position[:, :2], found.result


def check(designs, planar):
    angles, fine = (np.linspace(0.0, 2.0 * np.pi, n) for n in (POSITIONS, FINE * (POSITIONS - 1) + 1))
    every = jax.jit(jax.vmap(functools.partial(turned, angles=jnp.asarray(angles), planar=planar)))
    found, results = jax.tree.map(np.asarray, every(designs))
    whole = 0
    for i, (position, result) in enumerate(zip(found, results)):
        p = {k: of[i] for k, of in designs.items()}
        lost = np.isnan(position[:, 0])
        first = int(np.argmax(lost)) if lost.any() else POSITIONS
        assert (result == lg.RESULTS.successful) == (first == POSITIONS) and lost[first:].all()
        # Newton's tolerance √eps squared, over the distance to a dead centre
        np.testing.assert_allclose(position[:first], closed(p, angles[:first]), atol=1e-8)
        if first < POSITIONS:  # there is no way to go on
            assert np.isnan(closed(p, fine[: first * FINE + 1])).any()
        whole += first == POSITIONS
    assert 0.2 * len(found) < whole < 0.5 * len(found)


def random_designs(count):
    numbers = np.random.default_rng(1).uniform(size=(3, count, 2))
    scale = np.array([[2.0, 2.0], [3.0, 3.0], [0.7, 0.6]])[:, None]
    begin = np.array([[-1.0, -1.0], [-1.5, -1.5], [0.8, -0.3]])[:, None]
    return dict(zip("BCD", begin + scale * numbers))


@pytest.mark.parametrize("count", some_quick([150, 600]))
def test_no_other_way_to_assemble_it_is_taken(count):
    """Of 600 designs a dozen would be, in steps of half a radian, by Newton's iteration from one position to the
    next."""
    check(random_designs(count), planar=True)


@pytest.mark.slow  # `test_no_other_way_to_assemble_it_is_taken` is in the quick run
def test_nor_where_two_loops_could_change_over_at_once():
    """Bars on cylinders side by side, which come within 0.1 rad of their dead centres: signs of determinants change
    twice. φ is the angle at the pin of a triangle whose third side is the cylinder."""
    foot, head = np.array([1.0, -0.5, 0.0]), np.array([2.5, 1.6, 0.0])
    bodies, joints = {}, {}
    for i, away in enumerate(np.array([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]])):
        bodies[f"bar {i}"] = lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=head / 2 + away, free="x y rz")
        joints[f"pin {i}"] = lg.RevoluteJoint(None, f"bar {i}", at=away, axis=Z)
        joints[f"cylinder {i}"] = lg.DistanceJoint(None, f"bar {i}", at_a=foot + away, at_b=head + away)
    model, near, far = lg.Model(bodies, joints), np.linalg.norm(foot), np.linalg.norm(head)
    begin = np.arctan2(head[1], head[0]) - np.arctan2(foot[1], foot[0])
    angles = np.random.default_rng(0).uniform(0.1, np.pi - 0.1, size=(40, 8))
    lengths = jnp.asarray(np.sqrt(near**2 + far**2 - 2 * near * far * np.cos(angles)))
    driven = lambda length: {f"cylinder {i}": length for i in range(2)}
    found = jax.jit(jax.vmap(lambda length: lg.kinematics(model, driven(length), throw=False).joint("pin 0").angle))
    np.testing.assert_allclose(found(lengths) + begin, angles, atol=1e-8)  # Newton's tolerance, over 0.1 rad


@pytest.mark.slow
def test_nor_with_redundant_joints():
    check(random_designs(120), planar=False)


def test_a_dead_centre_itself_is_passed_straight_on():
    """A parallelogram that lies flat twice in a turn, between positions, stays one: its rocker turns like its crank."""
    start = 0.7
    arm = 0.3 * np.array([np.cos(start), np.sin(start)])
    model = four_bar({"B": arm, "C": HOME + arm, "D": HOME})
    for angles in (np.linspace(0.0, 2.0 * np.pi, 12), np.linspace(0.4, -0.4, 12) - start):  # as far before it as behind
        found = lg.kinematics(model, {"motor": angles})
        expected = HOME + 0.15 * np.stack([np.cos(start + angles), np.sin(start + angles)], axis=1)
        np.testing.assert_allclose(found.body("rocker").position[:, :2], expected, atol=1e-10)  # Newton, near flat ones


@pytest.mark.slow
def test_an_optimum_is_that_of_one_way_to_assemble_it():
    """The largest swing of a rocker, to which designs lead that come close to a dead centre."""
    pivot = np.array([1.3, 0.0])
    angles = jnp.linspace(0.0, 2.0 * jnp.pi, 37)

    def swing(p):
        found = lg.kinematics(four_bar(p | {"D": pivot}), {"motor": angles}, throw=False)
        return -jnp.ptp(found.joint("D").angle)

    start = {"B": jnp.array([0.3, 0.2]), "C": jnp.array([1.2, 1.0])}
    best = lg.optimize.minimize(swing, start, num_steps=40, progress=False)
    middle = closed(best.x | {"D": pivot}, np.asarray(angles)) - pivot
    expected = np.ptp(np.unwrap(np.arctan2(middle[:, 1], middle[:, 0])))
    np.testing.assert_allclose(-best.objective, expected, rtol=1e-8)  # of the round-off of positions
    assert expected > 1.3


@pytest.mark.slow  # that of a rocker stays in the quick run
def test_a_coupling_that_comes_to_half_a_turn_is_named():
    """φ_c = 0.3 φ_a + 0.05 φ_a², of angles that poses tell within half a turn: behind that of φ_a is no position."""
    wheel = lambda x: lg.RigidBody(1.0, (0.01, 0.01, 0.02), position=(x, 0.0, 0.0))
    hinge = lambda name, x: lg.RevoluteJoint(None, name, at=(x, 0.0, 0.0), axis=Z)
    joints = {"a": hinge("a", 0.0), "c": hinge("c", 0.6), "motor": lg.RotationDriver(None, "a", axis=Z)}
    joints["cam"] = lg.CoordinateCoupling(hinge("c", 0.6), hinge("a", 0.0), (0.3, 0.05))
    model = lg.Model({"a": wheel(0.0), "c": wheel(0.6)}, joints)
    for count in (5, 61):
        found = lg.kinematics(model, {"motor": np.linspace(0.0, 6.0, count)}, throw=False)
        assert found.result == lg.RESULTS.angle_jumped
