"""`accuracy=`: is what is asked for reached, and does the setting found cost more than the best one?

    python benchmarks/to_accuracy.py [--problems NAME …] [--out benchmarks/results]

Eight reference problems × 1e-2 … 1e-8: value and gradient of their criteria by `differentiate(…, accuracy=…)`. True
errors (of values, and of gradients by their norm) are those against an explicit scheme of order 8 on the index-reduced
equations. Beside it the cheapest setting of a ladder of equal steps and of two extrapolated runs, 64, 96, 128, 192, …,
that meets the accuracy by its true errors. Times are medians of 5 calls after a warm-up, of the settings alone; `work`
is what the search takes in steps, in those of the setting found. Writes to_accuracy.json and prints a table.
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
LADDER = sorted(k * 2**i for k in (64, 96) for i in range(11))


def error(found, true) -> float:
    """The largest relative error of a value and of a gradient."""
    norm = lambda tree: float(np.linalg.norm(np.asarray(ravel_pytree(tree)[0])))
    less = lambda a, b: norm(np.asarray(ravel_pytree(a)[0]) - np.asarray(ravel_pytree(b)[0])) / norm(b)
    return max(less(part[key], of[key]) for part, of in zip(found[:2], true[:2]) for key in of)


def rows(name: str) -> list[dict]:
    problem = PROBLEMS[name]
    of = functools.partial(lg.differentiate, problem.criteria, problem.build, problem.parameters, t1=problem.t1)
    true = of(num_steps=8 * problem.num_steps, integrator=lg.IndexReducedODE(diffrax.Dopri8()))

    @functools.cache
    def run(n):
        return of(num_steps=n, throw=False)

    def setting(n: int, extrapolated: bool):
        return lg.richardson(lambda k: of(num_steps=k)[:2], n // 2).value if extrapolated else of(num_steps=n)[:2]

    @functools.cache
    def error_of(n: int, extrapolated: bool) -> float:
        if not extrapolated:
            return error(run(n)[:2], true)
        return error(lg.richardson(lambda k: run(k)[:2], n // 2).value, true)

    found = []
    for asked in ASKED:
        row = {"problem": name, "asked": asked}
        try:
            reached = of(accuracy=asked)
        except lg.SimulationError:
            found.append(row | {"reached": None})
            continue
        own = reached.reached
        # In the order of their work; an extrapolated run of n steps takes another one of n/2.
        ladder = sorted((n * (1.5 if two else 1.0), n, two) for n in LADDER for two in (False, True) if n > 64)
        best = next(((n, two) for _, n, two in ladder if error_of(n, two) <= asked), None)
        settings = [(own.num_steps, own.extrapolated), best or (own.num_steps, own.extrapolated)]
        chosen, least = median_seconds(*(functools.partial(setting, *each) for each in settings))
        work = sum(n for n, _ in own.tried) / (own.num_steps * (1.5 if own.extrapolated else 1.0))
        row |= {"reached": error(reached, true), "estimated": own.error, "steps": own.num_steps}
        row |= {
            "extrapolated": own.extrapolated,
            "work": work,
            "ms": 1e3 * chosen,
            "best": best,
            "best_ms": 1e3 * least,
        }
        found.append(row)
        print(
            f"{name[:34]:34} {asked:7.0e} {row['reached']:9.1e} {own.error:9.1e} {own.num_steps:7d} "
            f"{'two' if own.extrapolated else 'one'}  {row['ms']:8.2f} {row['best_ms']:8.2f} {work:5.1f}",
            flush=True,
        )
    return found


def main() -> None:
    parser = benchmark.options(__doc__, repeats=False)
    parser.add_argument("--problems", nargs="+", default=NAMES, choices=NAMES)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'problem':34}   asked   reached estimated   steps runs       ms     best  work")
    every = [row for name in given.problems for row in rows(name)]
    timed = [row for row in every if row["reached"] is not None]
    ratios = [row["ms"] / row["best_ms"] for row in timed]
    within = sum(row["reached"] <= row["asked"] for row in timed)
    print(
        f"{within} of {len(timed)} reached, {len(every) - len(timed)} refused; time beside the best of the ladder: "
        f"median {np.median(ratios):.2f}, largest {max(ratios):.2f}"
    )
    benchmark.write(given.out / "to_accuracy.json", {"rows": every, "environment": benchmark.environment()})


if __name__ == "__main__":
    main()
