"""CasADi's interfaces to SUNDIALS on the quarter-car: CVODES and IDAS, with their adjoint sensitivity analysis.

CVODES integrates the index-reduced equations of `rival_casadi` as an ordinary differential equation: Adams' formulas
with fixed-point iteration, as suits equations that are not stiff, or BDF with Newton and CasADi's sparse LU. IDAS
integrates the same equations with λ as algebraic variables, a differential-algebraic equation of index 1, by BDF. The
road's bump ends where one integrator ends and the next begins. Functions run in CasADi's virtual machine.
"""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rival_casadi import Equations, casadi, initial, parameters, puller
from rival_scenes import Scene
from rival_timing import Program

ADAMS = {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"}
KINDS: dict[str, tuple[str, dict[str, Any]]] = {"Adams": ("cvodes", ADAMS), "BDF": ("cvodes", {}), "IDAS": ("idas", {})}


def programs(scene: Scene, tolerances: Mapping[str, Iterable[float]]) -> list[Program]:
    """Ψ with its gradient by the adjoint, for each of `KINDS` that is named at the tolerances given with it."""
    ca = casadi()
    numbers = scene.arrays()
    y0, theta = (np.asarray(f(numbers)) for f in (initial, parameters))
    pull_back = puller(scene)
    equations = Equations(scene)
    rate = equations.function()
    ode = {"x": equations.state, "p": equations.theta, "ode": rate(equations.state, equations.theta)}
    problems = {"cvodes": ode, "idas": equations.algebraic()}
    times = (0.0, *scene.breaks, scene.t1)
    found = []
    for kind, tolerance in ((kind, tolerance) for kind, several in tolerances.items() for tolerance in several):
        plugin, options = KINDS[kind]
        options = {**options, "reltol": tolerance, "abstol": tolerance, "max_num_steps": 100_000}
        y, t = (ca.MX.sym(name, size) for name, size in (("y", y0.size), ("theta", theta.size)))
        last = y
        for begin, end in itertools.pairwise(times):
            part = ca.integrator("part", plugin, problems[plugin], begin, end, options)
            last = part(x0=last, p=t)["xf"]
        psi = ca.Function("psi", [y, t], [last[-1]])
        value = psi(y, t)
        gradient = ca.Function("gradient", [y, t], [value, *psi.reverse(1)(y, t, value, 1)])

        def call(gradient=gradient):
            value, *bars = gradient(y0, theta)
            return float(value), pull_back(bars)

        title = f"{plugin.upper()}, {'BDF' if kind == 'IDAS' else kind}, tolerance {tolerance:.0e}"
        found.append(Program(f"CasADi, {plugin.upper()}", title, "gradient, p", 1, "", call))
    return found
