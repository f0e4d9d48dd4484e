"""Certificates against converged references: do estimated errors of values and gradients tell the true ones?

    python benchmarks/certificate.py [--problems NAME …] [--designs 12] [--out benchmarks/results]

Reference problems of `lgsens.examples.PROBLEMS` in their own number of steps and in a half of it, for random parameters
within 10 % of theirs. True errors are those against a run in 16 times as many steps, extrapolated with one in 8 times.
A case counts where two digits are right. Costs: a certificate beside a value and gradient by `differentiate`, medians
after a warm-up. Writes certificate.json and prints a table.
"""

import benchmark
import jax
import jax.numpy as jnp
import numpy as np

import lgsens as lg
from lgsens.examples import PROBLEMS

NAMES = (
    "spinning_top_brulls.l_1.0_reproduces_published_number",
    "lagrange_top_analytic.simo_wong",
    "free_rigid_body.asymmetric",
    "simple_pendulum_A01",
    "slider_crank_sundials",
    "four_bar_spring",
    "quarter_car_linear.at_0.3s",
    "five_link_quarter_car.locked_wheel",
)
WITHIN = 3.0


def flat(tree) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(tree)])


def relative(error: np.ndarray, of: np.ndarray) -> float:
    return float(np.linalg.norm(error) / np.linalg.norm(of))


def cases(name: str, designs: int) -> list[dict]:
    problem = PROBLEMS[name]
    criterion, scheme = next(iter(problem.criteria.values())), lg.GeneralizedAlpha(problem.rho_inf)
    random, found = np.random.default_rng(0), []
    parameters = {key: jnp.asarray(value, float) for key, value in problem.parameters.items()}
    settings = {"t1": problem.t1, "integrator": scheme}
    for num_steps in (problem.num_steps, problem.num_steps // 2):
        for _ in range(designs):
            p = {key: value * (1.0 + 0.1 * random.uniform(-1, 1)) for key, value in parameters.items()}
            one = lg.certify(criterion, problem.build, p, num_steps=num_steps, throw=False, **settings)
            if int(one.result) != lg.RESULTS.successful:  # an inertia that no body has
                continue
            coarse, fine = (
                lg.differentiate(
                    criterion, problem.build, p, num_steps=n * num_steps, method=lg.AdjointVariable(), **settings
                )
                for n in (8, 16)
            )
            for kind in ("value", "gradient"):
                first, second = flat(getattr(coarse, kind)), flat(getattr(fine, kind))
                computed, true = flat(getattr(one, kind)), second + (second - first) / 3
                error, estimate = true - computed, flat(getattr(one, f"{kind}_error"))
                found.append(
                    {
                        "problem": name,
                        "num_steps": num_steps,
                        "of": kind,
                        "true": relative(error, true),
                        "estimated": relative(estimate, computed),
                        "difference": relative(estimate - error, error),
                        "warnings": list(one.warnings),
                        "good_at_a_tenth": bool(one._replace(tolerance=relative(error, true) / 10.0).good),
                    }
                )
    return found


def costs(name: str, repeats: int) -> dict:
    problem = PROBLEMS[name]
    criterion, scheme = next(iter(problem.criteria.values())), lg.GeneralizedAlpha(problem.rho_inf)
    p = {key: jnp.asarray(value, float) for key, value in problem.parameters.items()}
    settings = {"t1": problem.t1, "num_steps": problem.num_steps, "integrator": scheme}
    calls = {
        "gradient": lambda: lg.differentiate(criterion, problem.build, p, method=lg.AdjointVariable(), **settings),
        "certificate": lambda: lg.certify(criterion, problem.build, p, **settings),
    }
    calls = {key: lambda call=call: jax.block_until_ready(jax.tree.leaves(call())) for key, call in calls.items()}
    for call in calls.values():
        call()
    times = benchmark.interleaved(calls, repeats)
    return {"problem": name} | {key: float(np.median(found.wall)) for key, found in times.items()}


def main() -> None:
    parser = benchmark.options(__doc__)
    parser.add_argument("--problems", nargs="+", default=NAMES, choices=NAMES)
    parser.add_argument("--designs", type=int, default=12, help="random parameters for each problem and step")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, times = [], []
    print(f"{'problem':56} {'of':9} cases  within {WITHIN:g}  median estimated/true  warned")
    for name in given.problems:
        found = cases(name, given.designs)
        rows += found
        times.append(costs(name, given.repeats))
        for kind in ("value", "gradient"):
            counted = [row for row in found if row["of"] == kind and row["true"] < 1e-2]
            ratios = np.array([row["estimated"] / row["true"] for row in counted])
            within = np.mean((ratios < WITHIN) & (ratios > 1 / WITHIN)) if counted else np.nan
            warned = sum(bool(row["warnings"]) for row in counted)
            middle = np.median(ratios) if counted else np.nan
            print(f"{name:56} {kind:9} {len(counted):5} {within:9.2f} {middle:22.3f} {warned:7}", flush=True)
        print(f"    gradient {times[-1]['gradient'] * 1e3:.1f} ms, certificate {times[-1]['certificate'] * 1e3:.1f} ms")
    counted = [row for row in rows if row["true"] < 1e-2]
    ratios = np.array([row["estimated"] / row["true"] for row in counted])
    total = float(np.mean((ratios < WITHIN) & (ratios > 1 / WITHIN)))
    wrong = sum(row["good_at_a_tenth"] for row in rows)
    print(f"{len(counted)} cases with two digits: {total:.3f} within a factor {WITHIN:g}")
    print(f"called good at a tenth of the true error: {wrong}")
    record = {"rows": rows, "times": times, "within": total, "wrongly_good": wrong}
    benchmark.write(given.out / "certificate.json", record | {"environment": benchmark.environment()})


if __name__ == "__main__":
    main()
