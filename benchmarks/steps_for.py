"""Steps for a criterion (`lg.steps_for`) beside steps for the motion (`AdaptiveSteps`), at equal error of the gradient.

    python benchmarks/steps_for.py [--cases NAME …] [--out benchmarks/results]

The quarter-car's bump: comfort Ψ₀ by stiffness, damping, height of the bump and 30 coordinates of hardpoints, and by
the hardpoints alone; the peak of the tyre's force, ∫ (force/5 kN)²⁴ dt. Scenes of `lgsens.examples.PROBLEMS`, each with
its first criterion. True errors are relative to an independent integrator (index-reduced equations, Dopri8); of a
gradient by its norm. Steps of `AdaptiveSteps` that would leave the error of the gradient that a grid of `steps_for`
does are told from its runs at tolerances 1e-3 to 1e-6: by straight lines in logarithms, and beyond them by order
two. Prints a table and writes steps_for.json.
"""

import benchmark
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from variable_steps import COMFORT, build, parameters

import lgsens as lg
from lgsens.examples import PROBLEMS, QuarterCar

TOLERANCES = (1e-2, 1e-3, 1e-4)
CONTROLLED = ((1e-3, 400), (1e-4, 400), (1e-5, 1000), (1e-6, 4000))
PEAK = lg.Criterion(integrand=lambda s, p: (s.force("tyre") / 5e3) ** 24)
SCENES = {  # and the steps of their pilots
    "spinning top": ("spinning_top_brulls.l_1.0_reproduces_published_number", 100),
    "fast top": ("lagrange_top_analytic.simo_wong", 250),
    "free body": ("free_rigid_body.asymmetric", 250),
}


def quarter_car(criterion, points: bool):
    car = QuarterCar.load()
    p = parameters(car)
    if points:
        rates = {name: p.pop(name) for name in list(p) if name != "points"}
        return criterion, lambda p: build(car, {**rates, **p}), p, 2.0, lg.GeneralizedAlpha(0.9), 250
    return criterion, lambda p: build(car, p), p, 2.0, lg.GeneralizedAlpha(0.9), 250


def scene(name: str, pilot: int):
    problem = PROBLEMS[name]
    p = {key: jnp.asarray(value, float) for key, value in problem.parameters.items()}
    criterion = next(iter(problem.criteria.values()))
    return criterion, problem.build, p, problem.t1, lg.GeneralizedAlpha(problem.rho_inf), pilot


CASES = {
    "comfort": lambda: quarter_car(COMFORT, points=False),
    "comfort by hardpoints": lambda: quarter_car(COMFORT, points=True),
    "peak of tyre force": lambda: quarter_car(PEAK, points=False),
    **{label: lambda at=at: scene(*at) for label, at in SCENES.items()},
}


def measured(label: str) -> list[dict]:
    criterion, build, p, t1, scheme, pilot = CASES[label]()
    flat, unravel = ravel_pytree(p)

    def psi(flat, integrator, num_steps):
        p = unravel(flat)
        run = lg.simulate(build(p), t1=t1, num_steps=num_steps, integrator=integrator, throw=False)
        return criterion(run, p), (run.result, run.t)

    def at(integrator, num_steps, room: int | None = None):
        """Ψ, its gradient, and the sizes of the steps; with `room` grids share a program."""
        if room is not None:
            sizes = jnp.pad(integrator.fractions, (0, room - num_steps))
            integrator, num_steps = lg.GivenSteps(sizes, scheme), room
        (value, (result, t)), gradient = run(flat, integrator, num_steps)
        if result != lg.RESULTS.successful:
            raise RuntimeError(f"{label}: {lg.RESULTS(int(result)).message}")
        sizes = np.diff(t)
        return float(value), np.asarray(gradient), sizes[sizes > 0]

    run = jax.jit(jax.value_and_grad(psi, has_aux=True), static_argnums=2)
    exact, slope, _ = at(lg.IndexReducedODE(diffrax.Dopri8()), 4 * pilot)

    def errors(value, gradient):
        return abs(value / exact - 1.0), float(np.linalg.norm(gradient - slope) / np.linalg.norm(slope))

    controlled = []
    for tolerance, most in CONTROLLED:
        value, gradient, sizes = at(lg.AdaptiveSteps(scheme, tolerance=tolerance), most)
        controlled.append((len(sizes), *errors(value, gradient)))
    rows = []
    settings = {"t1": t1, "pilot": pilot, "integrator": scheme}
    for tolerance in TOLERANCES:
        steps = lg.steps_for(criterion, build, p, tolerance=tolerance, **settings)
        room = 256 * -(-steps.num_steps // 256)
        value, gradient, _ = at(steps.integrator, steps.num_steps, room)
        found = errors(value, gradient)
        expected = (float(steps.value_error), float(steps.gradient_error))
        equal = steps_at(found[1], controlled)
        row = {"case": label, "tolerance": tolerance, "steps": steps.num_steps, "expected": expected, "errors": found}
        rows.append(row | {"controlled": controlled, "controlled_steps": equal, "share": steps.num_steps / equal})
        print(" | ".join(map(str, cells(rows[-1]))), flush=True)
    jax.clear_caches()  # a process has only so many memory maps
    return rows


def steps_at(error: float, controlled: list[tuple[int, float, float]]) -> float:
    """The steps of error control at an error of the gradient."""
    steps, of_gradient = (np.log([row[i] for row in controlled]) for i in (0, 2))
    order = np.argsort(of_gradient)
    at = np.clip(np.log(error), of_gradient.min(), of_gradient.max())
    return float(np.exp(np.interp(at, of_gradient[order], steps[order]) + (at - np.log(error)) / 2.0))


def cells(row: dict) -> list:
    errors = [f"{error:.1e}" for error in (*row["expected"], *row["errors"])]
    last = [round(row["controlled_steps"]), f"{row['share']:.2f}"]
    return [row["case"], f"{row['tolerance']:g}", row["steps"], *errors, *last]


def table(found: dict) -> str:
    head = "criterion | asked | steps | expected error of Ψ | of dΨ/dp | true error of Ψ | of dΨ/dp"
    head = f"{head} | `AdaptiveSteps` at this error of dΨ/dp | share"
    return benchmark.grid(head, map(cells, found["rows"]))


def main() -> None:
    parser = benchmark.options(__doc__, repeats=False)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = [row for label in arguments.cases for row in measured(label)]
    found = {"rows": rows}
    print(table(found))
    benchmark.write(arguments.out / "steps_for.json", found | {"environment": benchmark.environment()})


if __name__ == "__main__":
    main()
