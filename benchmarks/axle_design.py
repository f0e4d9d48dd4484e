"""The multi-link axle designed to bands: hardpoints, bushing, spring and damper rates for the least acceleration.

    python benchmarks/axle_design.py [--out benchmarks/results]

Toe and camber over the travel of the wheels, lateral compliance steer and bump recession stay within bands. The problem
is solved by `lgsens.optimize.minimize`, and by SciPy's SLSQP called directly on the same functions, with its own
scaling of the variables. Writes axle_design.json.
"""

import time

import benchmark
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jax.flatten_util import ravel_pytree

from lgsens.examples import Axle
from lgsens.optimize import minimize
from lgsens.rigs import AxleDesign

DEGREE = np.radians(1.0)
VARY = {
    "links.lateral_link": 0.01,
    "links.tie_rod": 0.01,
    "bushings.*.stiffness": 0.5,
    "spring.stiffness": 0.3,
    "damper.damping": 0.3,
}
KEEP = {"toe": 0.1 * DEGREE, "camber": 0.2 * DEGREE, "lateral_steer": 0.02 * DEGREE / 1e3}


def by_scipy(design):
    """SLSQP in units of half the bounds' distance, about the start."""
    x0, unravel = ravel_pytree(design.start)
    lower, upper = (ravel_pytree(end)[0] for end in (design.numbers.lower, design.numbers.upper))
    half = (upper - lower) / 2
    scale = float(jax.jit(lambda x: design(x)[0])(design.start))

    @jax.jit
    def values(z):
        f, g = design(unravel(x0 + half * z))
        return jnp.concatenate([f[None] / scale, -g])

    jacobian = jax.jit(jax.jacfwd(values))
    bounds = np.stack([(lower - x0) / half, (upper - x0) / half], axis=1)
    below = {"type": "ineq", "fun": lambda z: values(z)[1:], "jac": lambda z: jacobian(z)[1:]}
    found = scipy.optimize.minimize(
        lambda z: float(values(z)[0]),
        np.zeros(len(x0)),
        jac=lambda z: np.asarray(jacobian(z)[0]),
        bounds=bounds,
        method="SLSQP",
        constraints=below,
        options={"ftol": 1e-8, "maxiter": 100},
    )
    return {
        "objective": found.fun * scale,
        "worst_constraint": float(-np.min(values(found.x)[1:])),
        "message": found.message,
        "evaluations": found.nfev,
    }


def main() -> None:
    arguments = benchmark.options(__doc__, repeats=False).parse_args()
    jax.config.update("jax_enable_x64", True)
    design = AxleDesign.of(Axle.load("multi_link"), VARY, KEEP)
    started = time.perf_counter()
    bounds = {"lower": design.numbers.lower, "upper": design.numbers.upper}
    best = minimize(design, design.start, **bounds, num_steps=300, progress=False)
    ours = {
        "objective": best.objective,
        "worst_constraint": float(best.constraints.max()),
        "reason": best.reason,
        "evaluations": len(best.history.objective),
        "seconds": time.perf_counter() - started,
        "compile_seconds": best.compile_seconds,
    }
    print(ours, flush=True)
    other = by_scipy(design)
    print(other, flush=True)
    found = {
        "variables": {kind: len(names) for kind, names in design.numbers.names.items()},
        "bands": {name: float(width) for name, width in KEEP.items()},
        "start": float(best.history.objective[0]),
        "minimize": ours,
        "scipy": other,
        "relative_difference": abs(best.objective / other["objective"] - 1.0),
        "environment": benchmark.environment(),
    }
    benchmark.write(arguments.out / "axle_design.json", found)


if __name__ == "__main__":
    main()
