"""Cars that run over random roads in time, beside the Lyapunov equation of their linear equations.

Of independent runs over R roads the mean square m_r of an output about its rest, after the transient, has the mean σ²:
the estimate of σ² is the mean of the m_r, its standard error their standard deviation over √R, and that of σ half of
it over σ. A run is that of the scheme at the step h on a road known at the steps; its σ is known exactly (`at_steps`),
so that there is no cut-off of the spectrum to be guessed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import lgsens as lg

SPEED = 20.0
SEAT = lg.FrequencyWeighting("Wk")
INTENSITY = (2 * np.pi * 0.1) ** 2 * 64e-6 * SPEED / 2  # S of a road of class B


def at_steps(linear, h, rho):
    """σ of the outputs of a linear car over a road of steps Δz, by the generalized-α scheme at the step h.

    With ỹ = y − y_s z as in `_random_road`, s = [x̃; ẋ; v̇; a] goes on by s' = F s + g Δz, P = F P Fᵀ + S h g gᵀ. The
    weighting of "felt" is more of s: its exponential, for an acceleration that is linear between the times.
    """
    n = linear.A.shape[0] // 2
    a, rest = np.asarray(linear.A), -np.linalg.solve(linear.A, linear.B)[:n, 0]
    m, f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    gamma, beta = 0.5 + f - m, 0.25 * (1 + f - m) ** 2
    one, none = np.eye(n), np.zeros((n, n))
    new = np.block(
        [
            [one, none, none, -(h**2) * beta * one],
            [none, one, none, -h * gamma * one],
            [-a[n:, :n], -a[n:, n:], one, none],
            [none, none, -(1 - f) * one, (1 - m) * one],
        ]
    )
    old = np.block(
        [
            [one, h * one, none, h**2 * (0.5 - beta) * one],
            [none, one, none, h * (1 - gamma) * one],
            [none, none, none, none],
            [none, none, f * one, -m * one],
        ]
    )
    forward, entry = np.linalg.solve(new, old), np.linalg.solve(new, np.concatenate([-rest, np.zeros(3 * n)]))
    c = np.pad(np.asarray(linear.C), ((0, 0), (0, 2 * n)))
    felt, (own, entered, shown) = c[linear.outputs.index("acceleration")], map(np.asarray, SEAT.matrices())
    size = len(entered)
    step = np.zeros((size + 2, size + 2))  # of the weighting, its input f and f' h
    step[:size, :size], step[:size, size], step[size, size + 1] = h * own, h * entered, 1.0
    step = scipy.linalg.expm(step)[:size]
    now, later = step[:, size] - step[:, size + 1], step[:, size + 1]
    into = np.outer(now, felt) + np.outer(later, felt @ forward)
    forward = np.block([[forward, np.zeros((4 * n, size))], [into, step[:, :size]]])
    entry = np.concatenate([entry, later * (felt @ entry)])
    covariance = INTENSITY * h * np.outer(entry, entry)
    for _ in range(20):  # 2²⁰ steps
        covariance, forward = covariance + forward @ covariance @ forward.T, forward @ forward
    c = scipy.linalg.block_diag(c, shown)
    return dict(zip((*linear.outputs, "felt"), np.sqrt(np.sum(c @ covariance * c, axis=1))))


def over_roads(model, outputs, t, keys, scale):
    """Outputs over time, a road of class B times `scale` for each key; "felt" is "acceleration" weighted by Wk."""

    @eqx.filter_jit
    @eqx.filter_vmap(in_axes=(0, 0, None))
    def run(key, scale, model):
        road = lg.SampledRoad.random(key, t, roughness=64e-6 * scale**2, speed=SPEED)
        model = eqx.tree_at(lambda model: model.forces["tyre"].road, model, road)
        seen = lambda instant: {name: f(instant) for name, f in outputs.items()}
        found = lg.simulate(model, t1=t[-1], num_steps=len(t) - 1, save=seen, throw=False).values
        return found | {"felt": SEAT.apply(t, found["acceleration"])}

    return {name: np.asarray(values) for name, values in run(keys, scale, model).items()}


def compared(model, linear, outputs, *, runs, t1, settled, h, low=0):
    """Runs over roads beside the Lyapunov equation: within four standard errors, each 3 % or less.

    Returns of the first `low` roads mean squares, and over (1/100)² those of runs over them, a hundred times lower.
    """
    road = {"roughness": "B", "speed": SPEED}
    plain, weighted = (lg.random_road(linear, **road, weighting=of) for of in (None, {"acceleration": SEAT}))
    expected = {name: float(plain[name]) for name in outputs} | {"felt": float(weighted["acceleration"])}
    # What steps make of it converges to it by h². At 10 ms it is less than a tenth of the errors below off, and more of
    # "felt", whose samples are linear between the times: (ωh)²/12 = 4 % of wheel hop at 70/s are lacking.
    steps = {n: at_steps(linear, h / n, 0.9) for n in (1, 4, 8)}
    off = {n: {name: found[name] - value for name, value in expected.items()} for n, found in steps.items()}
    for name, value in off[1].items():
        assert abs(value) < (0.02 if name == "felt" else 5e-4) * expected[name]
        assert off[8][name] == pytest.approx(off[4][name] / 4, rel=0.05)  # and h⁴, (70 h/4)² of it

    keys = jax.random.split(jax.random.key(0), runs)
    keys, scale = jnp.concatenate([keys, keys[:low]]), jnp.concatenate([jnp.ones(runs), jnp.full(low, 0.01)])
    found = over_roads(model, outputs, jnp.linspace(0.0, t1, round(t1 / h) + 1), keys, scale)
    squares = {name: np.mean((f[:, round(settled / h) :] - f[:, :1]) ** 2, axis=1) for name, f in found.items()}
    for name, every in squares.items():
        deviation = np.sqrt(np.mean(every[:runs]))
        error = np.std(every[:runs], ddof=1) / np.sqrt(runs) / (2 * deviation)
        assert error < 0.03 * expected[name]
        assert abs(deviation - steps[1][name]) < 4 * error, name
    return {name: (every[:low], every[runs:] / 0.01**2) for name, every in squares.items()}
