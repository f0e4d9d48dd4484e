"""Steps that end where a signal breaks, of a mass on a spring whose foot follows a signal, against its convolution."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import says, some_quick

import lgsens as lg
from lgsens.dynamics import breaks_of
from lgsens.integrate import MANY, piece_lengths
from lgsens.simulation import aligned

MASS, STIFFNESS, T1 = 2.0, 200.0, 1.0
OMEGA = np.sqrt(STIFFNESS / MASS)
START, DURATION = 0.313, 0.171  # on no time of 50, 100, … equal steps
EDGES = (START, START + DURATION)
BUMP = lg.BumpRoad(height=0.1, duration=DURATION, start=START)


def on(road) -> lg.Model:
    """At rest, without gravity."""
    tyre = lg.TyreSpring("mass", at=(0.0, 0.0, 0.0), stiffness=STIFFNESS, road=road)
    return lg.Model({"mass": lg.RigidBody(mass=MASS, inertia=None, free="z")}, forces={"tyre": tyre})


NODES, WEIGHTS = np.polynomial.legendre.leggauss(40)  # to round-off here


def integral(f, a, b):
    return (b - a) / 2.0 * sum(w * f(a + (b - a) * (x + 1.0) / 2.0) for x, w in zip(NODES, WEIGHTS))


def bump(t, start=START, duration=DURATION):
    return 0.1 * np.sin(np.pi * (t - start) / duration) ** 2


def height(t, start=START, duration=DURATION):
    """x(t) = ω ∫ sin ω(t − s) z(s) ds over the bump, as far as t."""
    load = lambda s: OMEGA * np.sin(OMEGA * (t - s)) * bump(s, start, duration)
    return integral(load, start, min(t, start + duration))


END = height(T1)
SQUARES = OMEGA**4 * (  # ∫ ẍ² dt, ẍ = ω² (z − x)
    integral(lambda t: (bump(t) - height(t)) ** 2, *EDGES) + integral(lambda t: height(t) ** 2, EDGES[1], T1)
)


def end(integrator, num_steps, road=BUMP, **settings):
    run = lg.simulate(on(road), t1=T1, num_steps=num_steps, integrator=integrator, **settings)
    return run.body("mass").position[-1, 2], run


def laid(road, num_steps):
    return np.diff(np.asarray(end(lg.AlignedSteps(), num_steps, road)[1].t))


def test_steps_end_at_breaks_and_are_equal_between_them():
    sizes = laid(BUMP, 100)
    t = np.cumsum(sizes)
    for edge in EDGES:
        assert np.abs(t - edge).min() < 1e-15 * 100  # a sum of 100 sizes
    pieces = [
        sizes[t < EDGES[0] + 1e-9],
        sizes[(t > EDGES[0] + 1e-9) & (t < EDGES[1] + 1e-9)],
        sizes[t > EDGES[1] + 1e-9],
    ]
    for piece, length in zip(pieces, (START, DURATION, T1 - EDGES[1])):
        np.testing.assert_allclose(piece, piece[0], rtol=1e-12)
        assert abs(len(piece) - 100 * length) < 4.0  # of 50 steps two each, the others by rounding; then halved
    np.testing.assert_allclose(np.repeat(sizes / 2.0, 2), laid(BUMP, 200), rtol=1e-12)
    np.testing.assert_allclose(np.repeat(sizes / 4.0, 4), laid(BUMP, 400), rtol=1e-12)


@pytest.mark.parametrize(
    "road",
    [
        lg.FlatRoad(height=0.0),
        lg.BumpRoad(height=0.1, duration=0.2, start=1.1),
        lg.SampledRoad(np.linspace(0.0, 1.0, 40), np.zeros(40)),
    ],
    ids=["none", "later", "more pieces than steps"],
)
def test_equal_steps_where_there_is_nothing_to_end_at(road):
    np.testing.assert_allclose(laid(road, 30), 1.0 / 30.0, rtol=1e-12)


def test_breaks_are_those_of_all_signals_of_a_scene():
    class Sum(lg.AbstractSignal):
        parts: tuple

        def __call__(self, t):
            return sum(part(t) for part in self.parts)

    ramp = lg.Ramp(end=0.1, t_start=0.2, duration=0.3)
    table = lg.Sampled([0.0, 0.4, 0.9], [0.0, 1.0, 0.5], kind="cubic")
    both = Sum((ramp, lg.Harmonic(amplitude=0.1, frequency=1.0), table))
    np.testing.assert_allclose(np.sort(breaks_of(both)), [0.0, 0.2, 0.4, 0.5, 0.9])
    model = on(BUMP)
    model = lg.Model(
        model.bodies | {"cart": lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0))},
        {
            "rail": lg.PrismaticJoint(None, "cart", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0)),
            "drive": lg.TranslationDriver(None, "cart", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), value=both),
        },
        model.forces,
    )
    for scene in (model, model.equations()):
        np.testing.assert_allclose(np.unique(breaks_of(scene)), [0.0, 0.2, START, 0.4, EDGES[1], 0.5, 0.9])
    lengths = np.asarray(piece_lengths(model, jnp.asarray(0.25), jnp.asarray(0.45)))
    np.testing.assert_allclose(lengths[lengths > 0.0], [START - 0.25, 0.4 - START, 0.05])


def test_breaks_of_one_s_own():
    class Step(lg.AbstractSignal):
        at: float = eqx.field(static=True)

        @property
        def breaks(self):
            return self.at, self.at + 1.0  # numbers, not an array

        def __call__(self, t):
            return jnp.where(t < self.at, 0.0, 1.0)

    class Wrong(Step):
        @property
        def breaks(self):
            return "at 0.3"

    np.testing.assert_allclose(breaks_of(Step(0.3)), [0.3, 1.3])
    np.testing.assert_allclose(breaks_of(lg.Delayed(Step(0.3), delay=0.2)), [0.5, 1.5])
    with pytest.raises(ValueError, match=says("`breaks` of a Wrong", "array of numbers", "at 0.3")):
        breaks_of(Wrong(0.3))


def test_delayed():
    """Of a bump, a table and many of a kind: the rear wheel on the road of the front one."""
    for signal in (BUMP, lg.Sampled([0.0, 0.4, 0.9], [0.0, 1.0, 0.5], kind="cubic")):
        later = lg.Delayed(signal, delay=0.25)
        for t in (0.1, 0.3, 0.6, 0.9):
            np.testing.assert_allclose(later(jnp.asarray(t)), signal(jnp.asarray(t - 0.25)), rtol=1e-12)
    model = on(lg.Delayed(BUMP, delay=0.25))
    wheels = {"mass": model.bodies["mass"], "other": model.bodies["mass"]}
    rear = lg.TyreSpring("other", at=(0.0, 0.0, 0.0), stiffness=STIFFNESS, road=lg.Delayed(BUMP, delay=0.4))
    system = lg.Model(wheels, forces=model.forces | {"rear": rear}).system()
    np.testing.assert_allclose(np.unique(breaks_of(system)), np.sort([e + d for e in EDGES for d in (0.25, 0.4)]))
    with pytest.raises(ValueError, match=says("Delayed: `signal`", "0.3")):
        lg.Delayed(0.3, delay=0.1)
    assert lg.Delayed(lg.SampledRoad([0.0, 1.0], [0.0, 1.0]), delay=0.1).straight


def test_curves_over_anything_but_time_have_none():
    curve = lg.Sampled([-0.3, 0.2, 0.5], [-30.0, 20.0, 60.0], kind="monotone")
    at, far, x = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    body = lambda: lg.RigidBody(mass=1.0, inertia=(1.0, 1.0, 1.0))
    axes = (curve, None, None)
    forces = {
        "curve": lg.CurveSpringDamper(None, "a", at_a=far, at_b=at, spring=curve, damper=curve),
        "bushing": lg.Bushing(
            None, "b", at=at, springs=axes, dampers=axes, rotational_springs=axes, rotational_dampers=axes
        ),
        "straight": lg.Bushing(None, "b", at=at, springs=axes),
        "stop": lg.BumpStop(None, "a", at_a=far, at_b=at, gap=0.3, stiffness=1e4, rounding=1e-3),
    }
    screw = lg.ScrewJoint(None, "c", at=at, axis=x, pitch=0.1, travel=curve)
    model = lg.Model({"a": body(), "b": body(), "c": body()}, {"screw": screw}, forces)
    for scene in (model, model.system()):
        assert breaks_of(scene).size == 0


@pytest.mark.slow  # four programs
def test_extrapolation_has_its_order_at_edges():
    """Errors of h⁴, where equal steps have the kinks inside of them."""
    of = lambda kind, n: abs(float(end(lg.Richardson(kind), n)[0]) - END)
    errors = [of(lg.AlignedSteps(), n) for n in (100, 200)]
    assert errors[0] > 10.0 * errors[1], errors  # 16, less h³ of ρ∞ = 0.9
    assert of(lg.GeneralizedAlpha(), 200) > 5.0 * errors[1]


@pytest.mark.slow
def test_the_finer_run_is_in_the_halves_of_the_steps_of_the_other():
    value, run = end(lg.Richardson(lg.AlignedSteps()), 30)  # 60 aligned steps are others
    given = end(lg.Richardson(lg.GivenSteps(np.diff(np.asarray(run.t)))), 30)[0]
    np.testing.assert_allclose(given, value, rtol=1e-12)


@pytest.mark.slow  # `test_richardson` has those of equal steps
def test_integrals_of_extrapolated_runs_have_it_too():
    criterion = lg.Criterion(integrand=lambda s, p: s.body("mass").acceleration[2] ** 2)  # has a kink at each edge
    errors = [abs(float(criterion(end(lg.Richardson(lg.AlignedSteps()), n)[1]) / SQUARES - 1.0)) for n in (100, 200)]
    assert errors[1] < 1e-5 and errors[0] > 10.0 * errors[1], errors  # 16, less h³ of ρ∞ = 0.9


@pytest.mark.slow  # `test_to_accuracy` has one in the quick run
@pytest.mark.parametrize("accuracy", [1e-4, 1e-7])
def test_an_accuracy_is_reached_by_them(accuracy):
    run = lg.simulate(on(BUMP), t1=T1, accuracy=accuracy)
    assert run.reached.integrator == lg.AlignedSteps() and "aligned steps" in str(run.reached)
    length = float(jnp.max(run.system.coordinate_scale()))
    assert abs(float(run.body("mass").position[-1, 2]) - END) <= accuracy * length
    assert run.reached.num_steps <= 1024  # in equal steps 1e-7 takes 32768


@pytest.mark.slow
def test_an_accuracy_of_a_derivative_by_the_time_of_a_break():
    """At 0.5 s, where equal steps end as well, which stay there: it is of first order then."""
    criterion = lg.Criterion(integrand=lambda s, p: s.body("mass").acceleration[2] ** 2)
    build = lambda at: on(lg.SampledRoad(jnp.stack([0.0 * at, at, 1.0 + 0.0 * at]), jnp.asarray([0.0, 0.1, 0.0])))
    found = lg.differentiate(criterion, build, 0.5, t1=T1, accuracy=1e-4)
    assert found.reached.integrator == lg.AlignedSteps() and found.reached.num_steps <= 512  # equal: more than 131072
    beside = lg.differentiate(criterion, build, 0.4999, t1=T1, accuracy=1e-6)
    # both accuracies, and 1e-4 s of curvature of order 1/T
    np.testing.assert_allclose(found.gradient, beside.gradient, rtol=1e-3)


def test_where_they_are_taken_and_how_many_at_first():
    table = lambda n: on(lg.SampledRoad(np.linspace(0.0, 1.0, n), np.zeros(n)))
    plain, of = lg.GeneralizedAlpha(0.8), lg.AlignedSteps(lg.GeneralizedAlpha(0.8))
    assert aligned(plain, on(BUMP), 0.0, T1, None) == (of, 64)
    assert aligned(plain, on(BUMP), 0.0, T1, 200) == (of, 200)
    assert aligned(plain, on(BUMP), 0.0, 0.2, None) == (plain, None)  # before it
    assert aligned(plain, table(41), 0.0, T1, 100) == (of, 100)  # on times of 400 steps, which do not move
    assert aligned(plain, table(42), 0.0, T1, None) == (of, 82)  # two for each piece
    assert aligned(of, table(41), 0.0, T1, 30) == (of, 80)
    assert aligned(plain, table(MANY + 2), 0.0, T1, None) == (plain, None)


CONTROLLED = {
    "generalized-α": (lg.AdaptiveSteps(tolerance=1e-7), 1000, 1e-3),
    "Radau IIA": (lg.AdaptiveSteps(lg.RadauIIA(), tolerance=1e-8, longest=1.0), 200, 1e-6),
    "diffrax": (lg.IndexReducedODE(rtol=1e-9), 3, 1e-6),
}


@pytest.mark.parametrize("name", some_quick(CONTROLLED))
def test_error_control_sees_what_comes(name):
    """A bump of 20 ms in 10 s, before which nothing moves: no step of its own would look at it."""
    integrator, num_steps, tolerance = CONTROLLED[name]
    road = lg.BumpRoad(height=0.1, duration=0.02, start=5.013)
    run = lg.simulate(on(road), t1=5.5, num_steps=num_steps, integrator=integrator)
    expected = height(5.5, 5.013, 0.02)
    swing = 0.1 * OMEGA * 0.02 / 2.0
    assert abs(float(run.body("mass").position[-1, 2]) - expected) < tolerance * swing
    if name != "diffrax":
        for edge in (5.013, 5.033):
            assert np.abs(np.asarray(run.t) - edge).min() < 1e-12


def test_tables_of_many_samples_are_left_to_the_error_control():
    n = MANY + 10
    road = lg.SampledRoad(np.linspace(0.0, 1.0, n), 1e-3 * np.sin(np.linspace(0.0, 6.0, n)))
    run = end(lg.AdaptiveSteps(tolerance=1e-4), 200, road)[1]
    assert int(run.stats.steps) < 100
    run = end(lg.IndexReducedODE(rtol=1e-6), 2, lg.Sampled(road.times, road.heights, kind="cubic"))[1]
    assert int(np.max(run.stats.steps)) < n // 2


def of_road(p, integrator, num_steps=60, **settings):
    """A number of the motion that all parameters change: height and begin of a bump."""
    road = lg.BumpRoad(height=p[0], duration=DURATION, start=p[1])
    return jnp.sum(end(integrator, num_steps, road, **settings)[1].body("mass").position[:, 2] ** 2)


@pytest.mark.parametrize(
    "integrator",
    [lg.AlignedSteps(), lg.Richardson(lg.AlignedSteps())],
    ids=["one", "two"],
)
@pytest.mark.slow  # `test_moving_steps` has derivatives by the times of breaks in the quick run
def test_derivatives_are_those_on_the_grid(integrator):
    p = jnp.array([0.1, START])
    run = end(integrator, 60)[1]
    fixed = lg.GivenSteps.of(run)
    fixed = lg.Richardson(fixed) if integrator.extrapolated else fixed
    value = of_road(p, integrator)
    adjoint = jax.grad(functools.partial(of_road, integrator=integrator, sensitivity=lg.AdjointVariable()))(p)
    forward = jax.jacfwd(functools.partial(of_road, integrator=integrator))(p)
    np.testing.assert_allclose(forward, adjoint, rtol=1e-10)
    np.testing.assert_allclose(of_road(p, fixed), value, rtol=1e-12)
    # central differences at 1e-5, of steps that end at the edges wherever these are
    for steps in (fixed, integrator):
        differences = [central(lambda s, e=e, i=steps: of_road(p + s * e, i), 1e-5) for e in jnp.eye(2)]
        np.testing.assert_allclose(forward, differences, rtol=1e-7)


def test_each_lane_has_its_own_steps():
    begins = jnp.array([START, 0.42])
    of = lambda begin: end(lg.AlignedSteps(), 60, lg.BumpRoad(height=0.1, duration=DURATION, start=begin))[1]
    runs = jax.vmap(of)(begins)
    for lane, begin in enumerate(begins):
        np.testing.assert_allclose(runs.t[lane], of(begin).t, rtol=1e-12)
        assert np.abs(np.asarray(runs.t[lane]) - float(begin)).min() < 1e-13


def test_bad_input():
    with pytest.raises(ValueError, match=says("AlignedSteps", "must be a scheme", "Richardson")):
        lg.AlignedSteps(lg.Richardson())
    for wrong in (lg.AdaptiveSteps(), lg.Richardson(), "given"):
        with pytest.raises(ValueError, match=says("Richardson: `integrator`", "AlignedSteps()", repr(wrong))):
            lg.Richardson(wrong)
    with pytest.raises(ValueError, match=says("`num_steps` = 3", "has 2")):
        end(lg.Richardson(lg.GivenSteps([1.0, 2.0])), 3)
