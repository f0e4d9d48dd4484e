"""`lgsens paper`: figures 2 and 4 of the paper, errors of sensitivities against the step size by all its methods."""

import argparse
import contextlib
import itertools
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from lgsens import plotting
from lgsens._progress import progress_bar
from lgsens.cli._report import ANEW, interrupted, output_folder, versions, write_json
from lgsens.cli._top import REFERENCE
from lgsens.criteria import Criterion, IndexReduced, Method, differentiate
from lgsens.examples import PROBLEMS, Problem
from lgsens.integrate import GeneralizedAlpha
from lgsens.model import Model
from lgsens.sensitivity import AdjointVariable, ContinuousAdjoint, ContinuousDirect, DirectDifferentiation

METHODS: dict[str, Method] = {
    "DDM of the scheme": DirectDifferentiation(),
    "AVM of the scheme": AdjointVariable(),
    "DDM of the equations of motion": ContinuousDirect(),
    "AVM of the equations of motion": ContinuousAdjoint(),
}
# What else §7.2 does with accelerations in a criterion; the paper's Fig. 4b is made with the first of them.
TREATMENTS: dict[str, Method] = {
    "AVM, differentiated accelerations": ContinuousAdjoint("derivatives"),
    "AVM, first-order equations": ContinuousAdjoint("first_order"),
}
RHO_INF = 0.9
RTOL = 1e-12  # of the reference
CALLS = 3  # of which the median time is taken, after the one that compiles
SLOPE_STEPS = 3  # the finest ones, through which the slope is fitted


class Curves(NamedTuple):
    """One panel: the derivative of a criterion with respect to a parameter; `published`: its value from `source`."""

    label: str
    title: str
    unit: str
    criterion: str
    parameter: str
    t1: float
    published: float
    source: str
    methods: Mapping[str, Method] = METHODS


class PaperStudy(NamedTuple):
    """One figure: panels whose numbers come from the same calls of `differentiate`.

    `problem` is the scene, `free` names the parameters by which is differentiated; the others keep their values.
    """

    scene: str
    problem: Problem
    free: tuple[str, ...]
    criteria: dict[str, Criterion]
    panels: dict[str, Curves]
    num_steps: tuple[int, ...]
    coarse: tuple[int, ...]
    breaks: tuple[float, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """The free ones."""
        return {name: self.problem.parameters[name] for name in self.free}

    def build(self, p: Mapping[str, Any]) -> Model:
        """The scene for some values of the free ones."""
        return self.problem.build({**self.problem.parameters, **p})


def _top() -> PaperStudy:
    problem = PROBLEMS["spinning_top_brulls.l_1.0_reproduces_published_number"]
    panel = Curves(
        label="dPsi/dalpha_0",
        title=r"spinning top, $d\Psi/d\alpha_0$",
        unit="m^2 s/rad",
        criterion="Psi",
        parameter="alpha0",
        t1=problem.t1,
        published=REFERENCE,
        source="lgsens.examples.spinning_top: Runge-Kutta and generalized-alpha, both converged",
    )
    scene, num_steps = "spinning top, l = 1 m, alpha_0 = pi/4", (100, 200, 500, 1000, 2000)
    return PaperStudy(scene, problem, ("alpha0",), problem.criteria, {"fig2": panel}, num_steps, coarse=(100, 200))


def _quarter_car() -> PaperStudy:
    problem = PROBLEMS["five_link_quarter_car"]
    at_instant = PROBLEMS["five_link_quarter_car.at_0.3s"]
    source = "tests/data/five_link_quarter_car.json: Bulirsch-Stoer of order 14 on quaternions in 80 bits"
    # In eq. (50) l_max is subtracted, a number that no derivative sees.
    spring = Curves(
        label="dPsi_3/dc, Psi_3 = l_spring(0.3 s) - l_max",
        title=r"(a) $d\Psi_3/dc$, spring length at 0.3 s",
        unit="m/(N s/m)",
        criterion="Psi_3",
        parameter="c",
        t1=at_instant.t1,
        published=-5.145103818505668e-07,
        source=source,
    )
    comfort = Curves(
        label="dPsi_0/dk, Psi_0 = integral of the squared acceleration of the chassis",
        title=r"(b) $d\Psi_0/dk$, $\int \dot v_z^2\,dt$ of the chassis over 2 s",
        unit="m^2/s^3/(N/m)",
        criterion="Psi_0",
        parameter="k",
        t1=problem.t1,
        published=0.00010220048752247168,
        source=source,
        methods=METHODS | TREATMENTS,
    )
    return PaperStudy(
        scene="five-link quarter-car",
        problem=problem,
        free=("k", "c"),
        criteria={"Psi_0": problem.criteria["Psi0"], "Psi_3": at_instant.criteria["spring_length(0.3)"]},
        panels={"fig4a": spring, "fig4b": comfort},
        # Multiples of 24: the end of the bump, 0.25 s, is a node of both horizons, and they share their programs.
        num_steps=(240, 480, 960, 1920),
        coarse=(120, 240),
        breaks=(0.25,),
    )


STUDIES: dict[str, Callable[[], PaperStudy]] = {"fig2": _top, "fig4": _quarter_car}


def run(arguments: argparse.Namespace) -> int:
    """Compute the chosen figures, write `paper.json` and the PNGs, print the tables."""
    plotting.figure()  # asks for matplotlib now, not after minutes
    names = [arguments.only] if arguments.only else list(STUDIES)
    with output_folder(arguments.out, arguments.overwrite) as out:
        panels: dict[str, Any] = {}
        whole, drawn_files = True, []
        for name in names:
            study = STUDIES[name]()
            found, whole = measure(study, arguments.coarse, progress=not arguments.quiet)
            if not (found or panels):
                raise KeyboardInterrupt
            if not found:
                break
            if not arguments.quiet:
                print("\n\n".join(table(panel) for panel in found.values()), end="\n\n")
            drawn = []
            for key, panel in found.items():
                series = {method: (curve["h"], curve["relative_error"]) for method, curve in panel["methods"].items()}
                drawn.append(plotting.ErrorPanel(study.panels[key].title, "relative error [–]", series))
            plotting.save(plotting.errors(drawn), out / f"{name}.png")
            drawn_files.append(f"{name}.png")
            panels |= found
            if not whole:
                break
        document = {
            "source": "Sonneville & Bruls (2014), Fig. 2 and Fig. 4",
            "settings": {"only": arguments.only, "coarse": arguments.coarse},
            "panels": panels,
            "timing": f"median of {CALLS} calls after the first, which compiles; a program of fig4a serves fig4b, too",
            "slope": f"least squares through the {SLOPE_STEPS} smallest steps",
            "cores": os.cpu_count(),
            "device": jax.devices()[0].platform,
            "versions": versions("diffrax", "equinox"),
        }
        write_json(document, out / "paper.json", indent=2)
    if not arguments.quiet:
        print(f"written to {out}: paper.json, {', '.join(drawn_files)}")
    if not whole:
        return interrupted("paper", f"{sum(len(panel['methods']) for panel in panels.values())} curves written", ANEW)
    return 0


def measure(study: PaperStudy, coarse: bool, progress: bool) -> tuple[dict[str, dict[str, Any]], bool]:
    """Everything about the panels of a study by their names, as for JSON; and whether that is all.

    After an interrupt it is the curves with all their steps.
    """
    methods = {name: method for panel in study.panels.values() for name, method in panel.methods.items()}
    num_steps = study.coarse if coarse else study.num_steps
    runs = list(itertools.product(methods, num_steps))
    found: dict[str, dict[str, Any]] = {}
    whole = False
    with (
        progress_bar(len(study.panels) + len(runs), "run", progress) as bar,
        contextlib.suppress(KeyboardInterrupt),
    ):
        for key, panel in study.panels.items():
            bar.set_postfix({"": f"reference of {key}"})
            found[key] = _referred(study, panel)
            bar.update()
        for name, count in runs:
            bar.set_postfix({"": f"{name}, {count} steps"})
            for key, panel in study.panels.items():
                if name in panel.methods:
                    row = _timed(study, panel, methods[name], count, found[key]["reference"]["value"])
                    for column, number in row.items():
                        found[key]["methods"][name].setdefault(column, []).append(number)
            if count == num_steps[-1]:
                jax.clear_caches()  # a program of the quarter-car takes 6,000 of the 65,530 memory maps of Linux
            bar.update()
        whole = True
    for panel in found.values():
        complete = lambda curve: curve and all(len(column) == len(num_steps) for column in curve.values())
        panel["methods"] = {name: curve for name, curve in panel["methods"].items() if complete(curve)}
        for curve in panel["methods"].values():
            h, error = np.log(curve["h"]), np.log(curve["relative_error"])
            curve["slopes_between"] = (np.diff(error) / np.diff(h)).tolist()
            curve["slope"] = float(np.polyfit(h[-SLOPE_STEPS:], error[-SLOPE_STEPS:], 1)[0])
    return {key: panel for key, panel in found.items() if panel["methods"]}, whole


def _referred(study: PaperStudy, panel: Curves) -> dict[str, Any]:
    """A panel without its curves: what it is, and its reference."""
    method = IndexReduced(rtol=RTOL, breaks=study.breaks)
    value = _gradient(study, panel, method, 1)  # the tolerances decide, not the number of steps
    return {
        "scene": study.scene,
        "derivative": panel.label,
        "unit": panel.unit,
        "parameters": study.parameters,
        "t1": panel.t1,
        "rho_inf": RHO_INF,
        "reference": {
            "value": value,
            "route": f"IndexReduced(rtol={RTOL:g}): diffrax on the index-reduced equations",
            "published": panel.published,
            "source": panel.source,
            "relative_difference": abs(value / panel.published - 1),
        },
        "methods": {name: {} for name in panel.methods},
    }


def _gradient(study: PaperStudy, panel: Curves, method: Method, num_steps: int) -> float:
    settings = {"t1": panel.t1, "num_steps": num_steps, "integrator": GeneralizedAlpha(RHO_INF), "method": method}
    found = differentiate(study.criteria, study.build, study.parameters, **settings)
    return float(found.gradient[panel.criterion][panel.parameter])


def _timed(study: PaperStudy, panel: Curves, method: Method, num_steps: int, reference: float) -> dict[str, float]:
    """The entries of a curve at one step size."""
    seconds, value = [], 0.0
    for _ in range(1 + CALLS):
        started = time.perf_counter()
        value = _gradient(study, panel, method, num_steps)
        seconds.append(time.perf_counter() - started)
    return {
        "h": panel.t1 / num_steps,
        "gradient": value,
        "relative_error": abs(value / reference - 1),
        "seconds": statistics.median(seconds[1:]),
        "seconds_of_first_call": seconds[0],
    }


def table(panel: Mapping[str, Any]) -> str:
    """Reference, errors, slopes and times of one panel."""
    reference, methods = panel["reference"], panel["methods"]
    steps = next(iter(methods.values()))["h"]
    lines = [
        f"{panel['derivative']} [{panel['unit']}]",
        f"{panel['scene']}, t = 0..{panel['t1']:g} s, rho_inf = {panel['rho_inf']}",
        f"{'reference':<34}{reference['value']:>22.14e}   {reference['route']}",
        f"{'published':<34}{reference['published']:>22.14e}   {reference['source']}",
        f"{'relative difference':<34}{reference['relative_difference']:>22.1e}",
    ]

    def block(head: str, columns: Sequence[str], row: Callable[[Any], Sequence[str]]):
        rows = [(head, columns), *((name, row(curve)) for name, curve in methods.items())]
        lines.extend(["", *(f"{name:<34}" + "".join(f"{cell:>11}" for cell in cells) for name, cells in rows)])

    sizes = [f"{h:.4g}" for h in steps]
    errors = lambda c: [*(f"{error:.3e}" for error in c["relative_error"]), f"{c['slope']:.3f}"]
    block("relative error, h [s] =", [*sizes, "slope"], errors)
    slopes = lambda c: ["", *(f"{slope:.3f}" for slope in c["slopes_between"])]
    block("slope between this h and the last", ["", *sizes[1:]], slopes)
    block("time of one gradient [ms]", sizes, lambda c: [f"{1e3 * seconds:.1f}" for seconds in c["seconds"]])
    return "\n".join(lines)
