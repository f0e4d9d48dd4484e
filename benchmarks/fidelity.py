"""What reductions of two quarter-cars change, predicted from one program of the rich scene, and run.

    python benchmarks/fidelity.py [--out benchmarks/results]

Options of the five-link car and of a multi-link one: Ψ₀ and its gradient by k, c and all hardpoints of the chassis.
Each option is compiled as a lean scene of its own and compared with its prediction; of the five-link car also what is
recommended for 1e-2 and 1e-3, what `Fidelity.fastest` chooses, and the reductions around it. Value and gradient of all
are timed in turns, and which is the fastest of those within a tolerance. Writes fidelity.json and prints a table; some
twenty minutes of compilation.
"""

import time

import benchmark
import jax
import numpy as np

import lgsens as lg
from lgsens.accuracy import fidelity
from lgsens.examples import QuarterCar
from lgsens.model import Frozen, Merged, Rod, Without

CRITERION = lg.Criterion(integrand=lambda s, p: s.body("chassis").acceleration[2] ** 2)
HEAVE, HUB = Frozen("chassis", "x y rx ry rz", guide="heave"), Merged("knuckle", "wheel")
TOLERANCES = (1e-2, 1e-3)


def five_link():
    rods = [Rod(name) for name in ("guide_link", "wishbone", "track_strut", "trailing_arm")]
    options = [*rods, HUB, HEAVE, Without("damper")]
    return "five_link", QuarterCar.load(), options


def multi_link():
    options = [Rod("lateral_link"), Rod("tie_rod"), HUB, HEAVE, Without("damper")]
    return "multi_link", QuarterCar.load("multi_link"), options


def rank_correlation(a, b) -> float:
    """Spearman's, of distinct numbers."""
    rank = lambda x: np.argsort(np.argsort(x)).astype(float)
    return float(np.corrcoef(rank(a), rank(b))[0, 1])


def study(name, car, options, repeats: int):
    p = {"stiffness": car.spring.rate, "damping": car.damper.rate, "hardpoints": car.hardpoints}

    def build(p):
        return car.with_values(**p).model()

    started = time.perf_counter()
    found = fidelity(CRITERION, build, p, options, t1=1.0, num_steps=200)
    predicting = time.perf_counter() - started
    print(name, found, sep="\n", flush=True)
    sets = [(), *(row.options for row in found.rows)]
    best, chosen = {}, {}
    if name == "five_link":
        best = {tolerance: found.recommended(tolerance) for tolerance in TOLERANCES}
        chosen = {tolerance: found.fastest(tolerance) for tolerance in TOLERANCES}
        rows = sorted((row for row in found.rows if row.unknowns < found.unknowns), key=lambda row: row.error)
        sets += [found.combined(rows[:n]).options for n in range(2, len(rows) + 1)]
        for row in [*best.values(), *chosen.values()]:
            if set(row.options) not in map(set, sets):
                sets.append(row.options)
    programs = [found.runs.program(options) for options in sets]
    evaluated = [program.evaluate()[0] for program in programs]
    calls = {place: lambda program=program: program() for place, program in enumerate(programs)}  # which block
    times = benchmark.interleaved(calls, repeats)
    predicted = {row.options: row for row in found.rows}
    rows = []
    for place, (options, each) in enumerate(zip(sets, evaluated)):
        value, gradient = each.relative(evaluated[0])
        row = predicted.get(options) or found.combined([predicted[(option,)] for option in options])
        rows.append(
            {
                "options": [repr(reduction) for option in options for reduction in option],
                "unknowns": row.unknowns,
                "predicted": {"value": abs(row.value), "gradient": row.gradient, "one_run": abs(row.first)},
                "run": {"value": value, "gradient": gradient},
                "processor_seconds": float(np.median(times[place].cpu)),
            }
        )
        print(rows[-1], flush=True)
    single = rows[1 : 1 + len(found.rows)]
    larger = lambda of: [max(row[of]["value"], row[of]["gradient"]) for row in single]
    correlation = rank_correlation(larger("predicted"), larger("run"))
    summary = {"rank_correlation": correlation, "predicting_seconds": predicting}
    for tolerance, row in best.items():
        at = lambda row: rows[next(i for i, options in enumerate(sets) if set(options) == set(row.options))]
        within = [one for one in rows if max(one["run"].values()) <= tolerance]
        fastest = min(within, key=lambda one: one["processor_seconds"])
        summary[f"{tolerance:g}"] = {
            "recommended": at(row),
            "chosen": at(chosen[tolerance]) | {"time": chosen[tolerance].time},
            "fastest": fastest,
        }
    print(summary, flush=True)
    return {"car": name, "rows": rows, **summary}


def main() -> None:
    arguments = benchmark.options(__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    studies = [study(*car(), arguments.repeats) for car in (five_link, multi_link)]
    benchmark.write(arguments.out / "fidelity.json", {"studies": studies, "environment": benchmark.environment()})


if __name__ == "__main__":
    main()
