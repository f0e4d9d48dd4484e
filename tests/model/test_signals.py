"""Signals against their formulas, SciPy's spline and differences, by time twice and by every number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick
from scipy.interpolate import CubicSpline, PchipInterpolator

import lgsens as lg
from lgsens.dynamics import told_breaks
from lgsens.model._signals import prepared

TIMES, VALUES = np.array([-0.4, 0.1, 0.35, 1.0, 1.3]), np.array([0.2, -0.5, 0.3, 0.1, 0.6])
SMOOTH = {
    "constant": lg.Constant(value=0.7),
    "harmonic": lg.Harmonic(amplitude=0.3, frequency=1.4, phase=0.2, offset=-0.1),
    "polynomial": lg.Polynomial((0.2, -0.3, 0.5, 0.1)),
    "ramp": lg.Ramp(start=0.2, end=1.1, t_start=-0.1, duration=0.8),
    "spline": lg.Sampled(TIMES, VALUES, "cubic"),
    "prepared spline": prepared(lg.Sampled(TIMES, VALUES, "cubic")),
}
# within, outside, and at the breaks of ramp and spline
POINTS = np.array([-1.1, -0.7, -0.4, -0.1, 0.1, 0.23, 0.35, 0.6, 0.7, 0.97, 1.0, 1.3, 1.9])


def jet(signal, points=POINTS):
    """The signal and its first two derivatives by time."""
    rate = lambda t: jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
    found = jax.vmap(lambda t: (signal(t), rate(t), jax.jvp(rate, (t,), (jnp.ones_like(t),))[1]))(jnp.asarray(points))
    return [np.asarray(each) for each in found]


@pytest.mark.parametrize("name", SMOOTH)
def test_two_derivatives_by_time(name):
    """Central differences, of which each value lies on both sides of a break: C² where they agree to O(h)."""
    value, rate, acceleration = jet(SMOOTH[name])
    h = 1e-5
    after, before = jet(SMOOTH[name], POINTS + h), jet(SMOOTH[name], POINTS - h)
    # third derivatives of up to 250: h²/6 of it for a rate, h/2 for its rate where it jumps; round-off ε/h = 2e-11
    np.testing.assert_allclose(rate, (after[0] - before[0]) / (2 * h), rtol=0, atol=1e-7)
    np.testing.assert_allclose(acceleration, (after[1] - before[1]) / (2 * h), rtol=0, atol=2e-3)
    np.testing.assert_allclose(after[2], before[2], rtol=0, atol=5e-3)
    np.testing.assert_allclose(value, (after[0] + before[0]) / 2, rtol=0, atol=1e-8)


def test_values():
    t = POINTS
    at = {name: jet(signal) for name, signal in SMOOTH.items()}
    np.testing.assert_array_equal(at["constant"], [np.full_like(t, 0.7), 0 * t, 0 * t])
    angle = 2 * np.pi * 1.4 * t + 0.2
    np.testing.assert_allclose(at["harmonic"][0], -0.1 + 0.3 * np.sin(angle), rtol=0, atol=1e-15)
    np.testing.assert_allclose(at["polynomial"][0], 0.2 - 0.3 * t + 0.5 * t**2 + 0.1 * t**3, rtol=0, atol=1e-15)
    x = np.clip((t + 0.1) / 0.8, 0.0, 1.0)
    np.testing.assert_allclose(at["ramp"][0], 0.2 + 0.9 * (10 * x**3 - 15 * x**4 + 6 * x**5), rtol=0, atol=1e-14)
    spline = CubicSpline(TIMES, VALUES, bc_type="natural")
    inside = (t >= TIMES[0]) & (t <= TIMES[-1])
    for order in range(3):
        # some ten operations on numbers of up to 30
        np.testing.assert_allclose(at["spline"][order][inside], spline(t[inside], order), rtol=0, atol=1e-13)
        np.testing.assert_allclose(at["prepared spline"][order], at["spline"][order], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(at["spline"][2][~inside], 0.0)
    linear = jax.vmap(lg.Sampled(TIMES, VALUES))(jnp.asarray(t))
    np.testing.assert_allclose(linear, np.interp(t, TIMES, VALUES), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(linear, jax.vmap(lg.SampledRoad(TIMES, VALUES))(jnp.asarray(t)))


@pytest.mark.parametrize(
    "values",
    [
        (-3.0, -2.5, 0.0, 0.4, 6.0),  # rising
        (0.2, -0.5, 0.3, 0.1, 0.6),  # turning: slopes of zero at samples
        (0.0, 0.0, 1.0, 1.0, 0.9),  # flat parts, and a parabola at the end that would overshoot
    ],
)
def test_monotone_cubic(values):
    """Value and slope of SciPy's; outside of the samples straight on; no value outside of its two neighbours."""
    signal, scipy = lg.Sampled(TIMES, values, "monotone"), PchipInterpolator(TIMES, values)
    t = np.union1d(np.linspace(TIMES[0], TIMES[-1], 201), TIMES)
    value, slope, _ = jet(signal, t)
    # some ten operations on numbers of up to 30
    np.testing.assert_allclose(value, scipy(t), rtol=0, atol=1e-13)
    np.testing.assert_allclose(slope, scipy(t, 1), rtol=0, atol=1e-12)
    for outside, end in ((np.array([-1.7, -0.5]), 0), (np.array([1.31, 4.0]), -1)):
        value, slope, _ = jet(signal, outside)
        np.testing.assert_allclose(slope, scipy(TIMES[end], 1), rtol=0, atol=1e-12)
        straight = values[end] + scipy(TIMES[end], 1) * (outside - TIMES[end])
        np.testing.assert_allclose(value, straight, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", some_quick(["cubic", "linear", "monotone"]))
@pytest.mark.parametrize("size", [7, pytest.param(3, marks=pytest.mark.slow)])
def test_periods(kind, size):
    """Value and slope of SciPy's through three periods of samples, within the middle one; the same after periods; and
    value and rate by samples and times, those of the seam as well, against central differences."""
    rng = np.random.default_rng(size)
    times, values = np.cumsum(rng.uniform(0.2, 1.0, size)) - 0.4, rng.normal(size=size)
    values[-1] = values[0]
    period = times[-1] - times[0]
    signal = lg.Sampled(times, values, kind, periodic=True)
    t = np.concatenate([times, times[0] + period * rng.uniform(size=9)])
    many = np.concatenate([times[:-1] - period, times[:-1], times[:-1] + period, times[-1:] + period])
    over = np.tile(values[:-1], 3)
    through = {
        "linear": lambda: lambda t, order: np.interp(t, many, [*over, over[0]]),
        "cubic": lambda: CubicSpline(times, values, bc_type="periodic"),
        "monotone": lambda: PchipInterpolator(many, [*over, over[0]]),
    }[kind]()
    for shift in (0.0, -2.0, 5.0):
        value, slope, bend = jet(signal, t + shift * period)
        # round-off of the time and of some ten operations, times slopes of up to 50
        np.testing.assert_allclose(value, through(t, 0), rtol=0, atol=1e-12)
        if kind == "linear":
            continue
        inner = slice(size, None)  # at samples the time may be of either side, where slope or bend jumps or bends
        np.testing.assert_allclose(slope[inner], through(t, 1)[inner], rtol=0, atol=1e-11)
        np.testing.assert_allclose(bend[inner], through(t, 2)[inner], rtol=0, atol=1e-9)
    assert told_breaks(signal).shape == (0,)

    def numbers(x):
        signal = lg.Sampled(x[0], x[1].at[-1].set(x[1, 0]), kind, periodic=True)
        rate = lambda t: jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
        return jax.vmap(lambda t: jnp.stack([signal(t), rate(t)]))(jnp.asarray(t[size:] + 2.0 * period))

    x, h, numbers = np.stack([times, values]), 1e-6, jax.jit(numbers)
    forward, backward = (np.asarray(jax.jit(mode(numbers))(jnp.asarray(x))) for mode in (jax.jacfwd, jax.jacrev))
    basis = np.eye(2 * size).reshape(-1, 2, size)
    difference = [(numbers(jnp.asarray(x + h * e)) - numbers(jnp.asarray(x - h * e))) / (2 * h) for e in basis]
    expected = np.moveaxis(np.asarray(difference), 0, -1).reshape(forward.shape)
    # round-off ε/h of slopes of up to 50; h² times a third derivative, by a time of 3!/d³ of what is found, d > 0.2 s
    np.testing.assert_allclose(forward, expected, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-10)


def test_periods_that_do_not_close():
    for values, message in (
        ((0.1, 0.5, 0.3), "`values` of one period end as they begin, so that it closes; got 0.1 and 0.3"),
        ((0.1, 0.1), "a period has three samples or more"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            lg.Sampled(np.arange(len(values)), values, "cubic", periodic=True)
    with pytest.raises(ValueError, match=says("Sampled: `periodic` must be True or False, got 2.0")):
        lg.Sampled((0.0, 1.0, 2.0), (0.0, 1.0, 0.0), periodic=2.0)


def test_monotone_cubic_of_two_samples_is_a_line():
    value, slope, _ = jet(lg.Sampled((0.0, 2.0), (1.0, 5.0), "monotone"))
    np.testing.assert_allclose(value, 1.0 + 2.0 * POINTS, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(slope, 2.0)


@pytest.mark.parametrize("name", some_quick([*SMOOTH, "linear", "monotone"], 3))
def test_derivatives_by_every_number(name):
    """Value, rate and acceleration by each leaf, away from breaks, against central differences, in both modes."""
    signal = SMOOTH[name] if name in SMOOTH else lg.Sampled(TIMES, VALUES, name)
    leaves, structure = jax.tree.flatten(signal)
    x, sizes = np.concatenate([np.ravel(leaf) for leaf in leaves]), [leaf.size for leaf in leaves]

    def numbers(x):
        pieces = jnp.split(x, np.cumsum(sizes)[:-1])
        signal = jax.tree.unflatten(structure, [p.reshape(leaf.shape) for p, leaf in zip(pieces, leaves)])
        return jnp.stack(jet_of(signal))

    def jet_of(signal):
        rate = lambda t: jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]
        at = lambda t: (signal(t), rate(t), jax.jvp(rate, (t,), (jnp.ones_like(t),))[1])
        return jax.vmap(at)(jnp.asarray([-0.7, 0.02, 0.23, 0.68, 1.9]))

    numbers, h = jax.jit(numbers), 1e-6
    forward, backward = (np.asarray(jax.jit(mode(numbers))(jnp.asarray(x))) for mode in (jax.jacfwd, jax.jacrev))
    difference = [(numbers(jnp.asarray(x + h * e)) - numbers(jnp.asarray(x - h * e))) / (2 * h) for e in np.eye(x.size)]
    # round-off ε/h of accelerations of up to 100, and h² times a third derivative of up to 1e4
    np.testing.assert_allclose(forward, np.moveaxis(np.asarray(difference), 0, -1), rtol=0, atol=1e-7)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: lg.Ramp(end=1.0, duration=0.0), says("Ramp: `duration` must be positive", "0.0 s")),
        (lambda: lg.Polynomial(()), says("Polynomial: `coefficients`", "(0,)")),
        (lambda: lg.Sampled((0.0, 1.0), (1.0,)), says("Sampled: `times` and `values`", "(2,) and (1,)")),
        (lambda: lg.Sampled((0.0, 0.0), (1.0, 1.0)), says("Sampled: `times` must increase")),
        (lambda: lg.Sampled((0.0, 1.0), (1.0, 2.0), "quintic"), says("`kind` must be one of", "'quintic'")),
        (
            lambda: lg.TranslationDriver("a", "b", at=(0, 0, 0), axis=(0, 0, 1), value=lg.Sampled((0, 1), (1, 2))),
            says("follows straight lines"),
        ),
        (
            lambda: lg.RotationDriver(None, "b", axis=(0, 0, 1), value=lg.SampledRoad((0.0, 1.0), (1.0, 2.0))),
            says("`value` follows straight lines"),
        ),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()
