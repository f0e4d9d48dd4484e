"""One scene on R³ × SO(3) and on SE(3): errors of motion, multipliers and gradient, and the time of a step.

    python benchmarks/formulations.py [--repeats 7] [--out benchmarks/results]

heavy_top: that of the literature, 150 rad/s, over 0.2 s, against Euler's equations by SciPy (as in heavy_top.py);
errors are the largest over all steps, relative to the largest value. quarter_car: the five-link car over the bump in
1 s, comfort Ψ and its gradient by 32 numbers, relative to its largest component, against the limit of 2,000 and 4,000
steps; both formulations with dense matrices, and that on R³ × SO(3) with the solver that it chooses. Times are those of
compiled programs on one thread, in rounds in which each is called once: medians. Writes formulations.json.
"""

import dataclasses
import json
import os
import statistics
from typing import Any

from benchmark import SINGLE_THREAD, circumstances, environment, grid, interleaved, options, write

TOP, CAR, REFERENCE, REPEATED = (200, 400, 800), (250, 500, 1000), (2000, 4000), 1000
TITLES = {"R3xSO3": "R³ × SO(3)", "SE3": "SE(3)", "": "R³ × SO(3), solver chosen"}


def formulated(model, formulation: str):
    """The model in a formulation with dense matrices; "": as it is."""
    import lgsens as lg

    if not formulation:
        return model
    return dataclasses.replace(model, formulation=formulation, linear_solver=lg.DenseLU())


def top() -> list[dict[str, Any]]:
    import heavy_top
    import numpy as np

    import lgsens as lg
    from lgsens.examples import heavy_top as scene

    exact = heavy_top.exact_motion(np.arange(TOP[-1] + 1) * (heavy_top.T1 / TOP[-1]))
    largest = {name: np.linalg.norm(getattr(exact, name), axis=1).max() for name in ("velocity", "multiplier")}
    rows = []
    for formulation in ("R3xSO3", "SE3"):
        for n in TOP:
            run = lg.simulate(formulated(scene(), formulation), t1=heavy_top.T1, num_steps=n)
            of_steps = heavy_top.Motion(*(array[:: TOP[-1] // n] for array in exact))
            errors = heavy_top.errors(heavy_top.motion_of(run), of_steps)
            relative = {
                "rotation": float(errors["rotation"].max()),
                "velocity": float(errors["velocity"].max() / largest["velocity"]),
                "multiplier": float(errors["multiplier"].max() / largest["multiplier"]),
            }
            rows.append({"formulation": formulation, "steps": n, "errors": relative})
    return rows


def car() -> list[dict[str, Any]]:
    import jax
    import numpy as np

    import lgsens as lg
    from lgsens.examples import QuarterCar

    design, comfort = QuarterCar.load(), lg.Criterion(lambda s, p: s.body("chassis").acceleration[2] ** 2)
    p = {"stiffness": design.spring.rate, "damping": design.damper.rate, "hardpoints": design.hardpoints}

    def found(formulation: str, n: int):
        build = lambda p: formulated(design.with_values(**p).model(), formulation)
        result = lg.differentiate(comfort, build, p, t1=1.0, num_steps=n)
        size = {"stiffness": p["stiffness"], "damping": p["damping"], "hardpoints": 0.01}
        gradient = jax.tree.map(lambda g, s: np.ravel(g * s), result.gradient, size)
        return float(result.value), np.concatenate(jax.tree.leaves(gradient))

    coarse, fine = (found("", n) for n in REFERENCE)
    value, gradient = ((4 * b - a) / 3 for a, b in zip(coarse, fine))
    rows = []
    for formulation in ("R3xSO3", "SE3"):
        for n in CAR:
            psi, slope = found(formulation, n)
            errors = {"Ψ": abs(psi / value - 1), "dΨ/dp": np.abs(slope - gradient).max() / np.abs(gradient).max()}
            rows.append({"formulation": formulation, "steps": n, "errors": {k: float(e) for k, e in errors.items()}})
    return rows


def times(repeats: int) -> list[dict[str, Any]]:
    """µs per step of both scenes: simulated, and with the gradient in reverse mode."""
    import jax
    import jax.numpy as jnp

    import lgsens as lg
    from lgsens.examples import QuarterCar, heavy_top

    design = QuarterCar.load()
    scenes = {
        "heavy_top": (lambda p: heavy_top(l=p), jnp.asarray(1.0), "top", 0.2),
        "quarter_car": (lambda p: design.with_values(stiffness=p).model(), design.spring.rate, "chassis", 1.0),
    }
    calls = {}
    for scene, (build, p, body, t1) in scenes.items():
        for formulation in TITLES:

            def height(p, build=build, body=body, t1=t1, formulation=formulation):
                run = lg.simulate(formulated(build(p), formulation), t1=t1, num_steps=REPEATED)
                return jnp.mean(run.body(body).position[:, 2] ** 2)

            for kind, function in (("simulate", height), ("gradient", jax.value_and_grad(height))):
                compiled = jax.jit(function).lower(p).compile()
                call = lambda compiled=compiled, p=p: jax.block_until_ready(compiled(p))
                call()
                calls[scene, formulation, kind] = call
    medians = {key: statistics.median(of.cpu) / REPEATED * 1e6 for key, of in interleaved(calls, repeats).items()}
    return [
        {
            "scene": scene,
            "formulation": formulation,
            **{f"{kind}_us_per_step": medians[scene, formulation, kind] for kind in ("simulate", "gradient")},
        }
        for scene in scenes
        for formulation in TITLES
    ]


def table(found: dict) -> str:
    lines = [circumstances(found["environment"])]
    for scene in ("heavy_top", "quarter_car"):
        names = list(found[scene][0]["errors"])
        cells = [
            (scene, TITLES[row["formulation"]], row["steps"], *(f"{row['errors'][name]:.1e}" for name in names))
            for row in found[scene]
        ]
        lines += ["", grid(f"scene | formulation | steps | {' | '.join(f'error of {name}' for name in names)}", cells)]
    cells = [
        (
            row["scene"],
            TITLES[row["formulation"]],
            f"{row['simulate_us_per_step']:.1f}",
            f"{row['gradient_us_per_step']:.1f}",
        )
        for row in found["times"]
    ]
    return "\n".join([*lines, "", grid("scene | formulation | simulate [µs/step] | with gradient [µs/step]", cells)])


def main() -> None:
    arguments = options(__doc__).parse_args()
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    import jax

    jax.config.update("jax_enable_x64", True)
    found = {"environment": environment(SINGLE_THREAD), "heavy_top": top(), "quarter_car": car()}
    found["times"] = times(arguments.repeats)
    write(arguments.out / "formulations.json", found)
    print(table(json.loads((arguments.out / "formulations.json").read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
