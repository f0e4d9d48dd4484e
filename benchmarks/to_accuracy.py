"""`accuracy=`: is what is asked for reached, and does the setting found cost more than the best one?

    python benchmarks/to_accuracy.py [--problems NAME …] [--out benchmarks/results]

Eight reference problems × 1e-2 … 1e-8: value and gradient of their criteria by `differentiate(…, accuracy=…)`. True
errors (of values, and of gradients by their norm) are those against an explicit scheme of order 8 on the index-reduced
equations. Beside it the cheapest settings that meet the accuracy by their true errors, of three ladders: one run of
generalized-α, or two or three that are extrapolated, in 64, 96, 128, 192, … equal steps, the same in `AlignedSteps`,
and `RadauIIA` in 16, 24, 32, … aligned steps. Times are medians of 5 calls after a warm-up, of the settings alone;
`work` is what the search takes in steps, in those of the setting found. Writes to_accuracy.json and prints a table.
"""

import functools

import benchmark
import diffrax
import jax
import numpy as np
from jax.flatten_util import ravel_pytree

import lgsens as lg
from lgsens.criteria._cost import median_seconds
from lgsens.examples import PROBLEMS

NAMES = (
    "spinning_top_brulls.l_1.0_reproduces_published_number",
    "lagrange_top_analytic.nutating",
    "free_rigid_body.asymmetric",
    "simple_pendulum_A01",
    "slider_crank_sundials",
    "four_bar_spring",
    "quarter_car_linear",
    "five_link_quarter_car",
)
ASKED = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
EQUAL = [(k * 2**i, runs) for k in (64, 96) for i in range(11) for runs in (1, 2, 3) if k * 2 ** (i + 1 - runs) >= 64]
RADAU = [(k * 2**i, 1) for k in (16, 24) for i in range(7)]
LADDERS = {
    "equal": (lg.GeneralizedAlpha(), EQUAL),
    "aligned": (lg.AlignedSteps(), EQUAL),
    "Radau IIA": (lg.AlignedSteps(lg.RadauIIA()), RADAU),
}
WITH_EDGES = ("quarter_car_linear",)  # between its times; elsewhere aligned steps are equal ones, or nearly so


def error(found, true) -> float:
    """The largest relative error of a value and of a gradient."""
    norm = lambda tree: float(np.linalg.norm(np.asarray(ravel_pytree(tree)[0])))
    less = lambda a, b: norm(np.asarray(ravel_pytree(a)[0]) - np.asarray(ravel_pytree(b)[0])) / norm(b)
    return max(less(part[key], of[key]) for part, of in zip(found[:2], true[:2]) for key in of)


def work_of(num_steps: int, runs: int) -> float:
    """In steps: n + n/2 + …."""
    return num_steps * (2.0 - 2.0 ** (1 - runs))


def rows(name: str) -> list[dict]:
    problem = PROBLEMS[name]
    of = functools.partial(lg.differentiate, problem.criteria, problem.build, problem.parameters, t1=problem.t1)
    true = of(num_steps=8 * problem.num_steps, integrator=lg.AlignedSteps(lg.IndexReducedODE(diffrax.Dopri8())))

    @functools.cache
    def run(integrator, n):
        return of(num_steps=n, integrator=integrator, throw=False)

    def extrapolated(each, n: int, runs: int):
        return lg.richardson(each, n // 2 ** (runs - 1), runs).value if runs > 1 else each(n)

    def setting(integrator, n: int, runs: int):
        return extrapolated(lambda k: of(num_steps=k, integrator=integrator)[:2], n, runs)

    @functools.cache
    def error_of(integrator, n: int, runs: int) -> float:
        return error(extrapolated(lambda k: run(integrator, k)[:2], n, runs), true)

    def cheapest(ladder: str, asked: float):
        """In the order of their work."""
        integrator, settings = LADDERS[ladder]
        ordered = sorted(settings, key=lambda each: work_of(*each))
        return next(((integrator, *each) for each in ordered if error_of(integrator, *each) <= asked), None)

    ladders = [ladder for ladder in LADDERS if ladder != "aligned" or name in WITH_EDGES]
    found = []
    for asked in ASKED:
        row = {"problem": name, "asked": asked}
        try:
            reached = of(accuracy=asked)
        except lg.SimulationError:
            found.append(row | {"reached": None})
            continue
        own = reached.reached
        best = {ladder: at for ladder in ladders if (at := cheapest(ladder, asked)) is not None}
        settings = [(own.integrator, own.num_steps, own.runs), *best.values()]
        chosen, *others = median_seconds(*(functools.partial(setting, *each) for each in settings))
        ms = {ladder: 1e3 * seconds for ladder, seconds in zip(best, others)}
        work = sum(n for n, _ in own.tried) / work_of(own.num_steps, own.runs)
        row |= {"reached": error(reached, true), "estimated": own.error, "steps": own.num_steps}
        row |= {"aligned": own.integrator == lg.AlignedSteps(), "runs": own.runs, "work": work}
        row |= {"ms": 1e3 * chosen, "best": {ladder: at[1:] for ladder, at in best.items()}, "best_ms": ms}
        found.append(row)
        print(
            f"{name[:34]:34} {asked:7.0e} {row['reached']:9.1e} {own.error:9.1e} {own.num_steps:7d} "
            f"{own.runs:4d}  {row['ms']:8.2f} {work:5.1f}  "
            + ", ".join(f"{ladder} {ms[ladder]:.2f} ({at[1]}, {at[2]})" for ladder, at in best.items()),
            flush=True,
        )
    jax.clear_caches()  # programs hold memory maps, of which a process has only so many
    return found


def main() -> None:
    parser = benchmark.options(__doc__, repeats=False)
    parser.add_argument("--problems", nargs="+", default=NAMES, choices=NAMES)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'problem':34}   asked   reached estimated   steps runs       ms  work  cheapest of each ladder, ms")
    every = [row for name in given.problems for row in rows(name)]
    timed = [row for row in every if row["reached"] is not None]
    within = sum(row["reached"] <= row["asked"] for row in timed)
    print(f"{within} of {len(timed)} reached, {len(every) - len(timed)} refused")
    for what, names in (("generalized-α", ("equal", "aligned")), ("all ladders", tuple(LADDERS))):
        least = [min(ms for ladder, ms in row["best_ms"].items() if ladder in names) for row in timed]
        ratios = [row["ms"] / ms for row, ms in zip(timed, least)]
        print(f"time beside the best of {what}: median {np.median(ratios):.2f}, largest {max(ratios):.2f}")
    benchmark.write(given.out / "to_accuracy.json", {"rows": every, "environment": benchmark.environment()})


if __name__ == "__main__":
    main()
