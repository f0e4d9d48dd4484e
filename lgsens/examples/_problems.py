"""Problems with published or independently computed numbers: scene, parameters, time and criteria of each."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.criteria import Criterion
from lgsens.examples._four_bar import four_bar
from lgsens.examples._free_rigid_body import free_rigid_body
from lgsens.examples._heavy_top import heavy_top
from lgsens.examples._lagrange_top import lagrange_top
from lgsens.examples._linear_quarter_car import linear_quarter_car
from lgsens.examples._quarter_car import QuarterCar
from lgsens.examples._simple_pendulum import simple_pendulum
from lgsens.examples._slider_crank import slider_crank
from lgsens.examples._top import spinning_top
from lgsens.integrate import GeneralizedAlpha
from lgsens.model import Model
from lgsens.simulation import Trajectory, simulate


class Reference(NamedTuple):
    """The reference numbers of one criterion: its value and its derivative with respect to each parameter."""

    value: float
    gradient: dict[str, float]


class Evaluation(NamedTuple):
    """Values and gradients of criteria by name, the gradient a dict of the parameters, and the motion."""

    values: dict[str, Float[Array, ""]]
    gradients: dict[str, dict[str, Float[Array, ""]]]
    trajectory: Trajectory


class Problem(NamedTuple):
    """A scene, its parameters and the criteria whose values and gradients are known.

    Attributes:
        name: stem of the JSON file with the reference numbers; after a point the case, where it has several.
        build: the scene of a dict of parameters.
        parameters: their values, named as in the file.
        t1: the criteria are those of the motion from 0 to t1 [s].
        criteria: criteria by their name in the file ("Psi" where it has one without a name).
        num_steps: from here on every error falls by four when the step is halved (order 2 ± 0.1 of each value and each
            derivative).
        rho_inf: numerical damping of the integrator.
    """

    name: str
    build: Callable[[Mapping[str, Any]], Model]
    parameters: dict[str, float]
    t1: float
    criteria: dict[str, Criterion]
    num_steps: int
    rho_inf: float = 0.9

    @property
    def file(self) -> str:
        """Name of the JSON file with the reference numbers."""
        return f"{self.name.partition('.')[0]}.json"

    def simulate(self, parameters: Mapping[str, Any], **settings: Any) -> Trajectory:
        """The motion for some values of the parameters; `settings`: those of `lgsens.simulate` that shall be others."""
        own = {"t1": self.t1, "num_steps": self.num_steps, "integrator": GeneralizedAlpha(self.rho_inf)}
        return simulate(self.build(parameters), **(own | settings))

    def evaluate(self, trajectory: Trajectory, parameters: Mapping[str, Any]) -> dict[str, Float[Array, ""]]:
        """Every criterion of a motion."""
        return {name: criterion(trajectory, parameters) for name, criterion in self.criteria.items()}

    @property
    def family(self) -> list["Problem"]:
        """The problems with this file and this scene: they differ in their numbers, times and criteria only."""
        return [other for other in PROBLEMS.values() if (other.file, other.build) == (self.file, self.build)]

    def differentiate(self, parameters: Mapping[str, Any], **settings: Any) -> Evaluation:
        """Every criterion of the family and its gradient, from one simulation and one reverse sweep.

        `settings` are those of `simulate`. A jitted function of `parameters` and `t1` serves the whole family.
        """

        def evaluate(parameters):
            trajectory = self.simulate(parameters, **settings)
            values = {}
            for problem in self.family:
                values |= problem.evaluate(trajectory, parameters)
            return values, (values, trajectory)

        gradients, (values, trajectory) = jax.jacrev(evaluate, has_aux=True)(parameters)
        return Evaluation(values, gradients, trajectory)

    def reference(self, document: Mapping[str, Any]) -> dict[str, Reference]:
        """The reference numbers of every criterion, from the contents of the problem's JSON file.

        A file has one criterion, or several by name, or one for each of several cases by name; the linear
        quarter-car's terminal criteria are among its details.
        """
        case = self.name.partition(".")[2]
        found = {}
        for name in self.criteria:
            terminal = document.get("details_full_digits", {}).get("pointwise_constraints", {})
            value, gradient = document["value"], document["gradient"]
            if name in terminal:
                value, gradient = terminal[name]["value"], terminal[name]["gradient"]
            elif isinstance(value, dict):
                key = name if name in value else case
                value, gradient = value[key], gradient[key]
            found[name] = Reference(float(value), {parameter: float(slope) for parameter, slope in gradient.items()})
        return found


@functools.cache  # the cases of a problem have one `build`, and so one compiled program
def _of_dict(builder: Callable[..., Model]) -> Callable[[Mapping[str, Any]], Model]:
    return lambda p: builder(**p)


def _with_defaults(builder: Callable[..., Model], **changes: float) -> dict[str, Any]:
    """`build` and `parameters` of a builder whose arguments are the parameters."""
    defaults = {name: argument.default for name, argument in inspect.signature(builder).parameters.items()}
    return {"build": _of_dict(builder), "parameters": defaults | changes}


def _spinning_top(p) -> Model:
    return spinning_top(p["alpha0"], p["m"], (p["J11"], p["J22"], p["J33"]), p["l"], p["omega0"], p["g"])


# Those at which the quarter-car's design position is in equilibrium for the k below, printed with the reference [m].
FREE = {"free_length": 0.3350681866287862, "free_radius": 0.336861050861}


def _five_link(wheel: str) -> Callable[[Mapping[str, Any]], Model]:
    """The five-link quarter-car with given rates and bump; spring and tyre keep their free lengths."""

    def build(p):
        with jax.ensure_compile_time_eval():  # the file is read and checked even where k, c, hb are traced
            car = QuarterCar.load()
        members = lambda car: (car.spring.rate, car.damper.rate, car.bump_height)
        car = eqx.tree_at(members, car, tuple(jnp.asarray(p[name], car.bearing.dtype) for name in ("k", "c", "hb")))
        return car.model(wheel=wheel, **FREE)

    return build


def _integral(integrand: Callable[[Any, Any], Float[Array, ""]]) -> Criterion:
    return Criterion(integrand=integrand)


def _terminal(terminal: Callable[[Any, Any], Float[Array, ""]]) -> Criterion:
    return Criterion(terminal=terminal)


def _kinetic_energy_of_crank(s, p):
    crank, conrod = (s.body(name).angular_velocity[2] for name in ("crank", "conrod"))
    return (p["J1"] * crank**2 + p["m2"] * s.body("slider").velocity[0] ** 2 + p["J2"] * conrod**2) / 2


def _distance_of_coupler(s, p):
    x, y, _ = s.body("coupler").position
    return (x - 0.5) ** 2 + (y - 0.45) ** 2


_X1_SQUARED = _integral(lambda s, p: s.body("top").position[0] ** 2)
_HEIGHT = _integral(lambda s, p: s.body("top").position[2])
_COMFORT = _integral(lambda s, p: s.body("chassis").acceleration[2] ** 2)
_LINEAR = {
    "stroke": _terminal(lambda s, p: s.body("sprung").position[2] - s.body("unsprung").position[2]),
    "tire_dyn_force": _terminal(lambda s, p: s.force("tyre")),
    "zs_acc": _terminal(lambda s, p: s.body("sprung").acceleration[2]),
}

_TOP = {
    "alpha0": 0.7853981633974483,
    "m": 15.0,
    "J11": 0.2,
    "J22": 0.4,
    "J33": 0.2,
    "l": 1.0,
    "omega0": 10.0,
    "g": 9.81,
}
_CAR = {"k": 109000.0, "c": 4900.0, "hb": 0.05}


def _tops() -> list[Problem]:
    spinning = {"build": _spinning_top, "t1": 1.0, "criteria": {"Psi": _X1_SQUARED}, "num_steps": 200}
    # x_cm = l R e₃; the scene's body has its centre of mass elsewhere
    centre = _integral(lambda s, p: (p["l"] * s.body("top").orientation[0, 2]) ** 2)
    lagrange = {"t1": 1.0, "criteria": {"Psi": centre}}
    simo_wong = {"m": 20.0, "l": 1.0, "J1": -15.0, "J3": 1.0, "w3": 50.0, "theta0": 0.05, "g": 1.0}
    return [
        Problem("spinning_top_brulls.as_printed_l_0.5", parameters=_TOP | {"l": 0.5}, **spinning),
        Problem("spinning_top_brulls.l_1.0_reproduces_published_number", parameters=_TOP, **spinning),
        Problem("spinning_top_brulls.l_1.0_alpha0_0.785398", parameters=_TOP | {"alpha0": 0.785398}, **spinning),
        *(
            Problem(
                f"heavy_top_bruls2012.to_{seconds}s",
                **_with_defaults(heavy_top),
                t1=float(seconds),
                criteria={f"int_x1^2_0_{seconds}": _X1_SQUARED, f"int_x3_0_{seconds}": _HEIGHT},
                num_steps=num_steps,
            )
            for seconds, num_steps in ((1, 1000), (2, 4000))
        ),
        Problem("lagrange_top_analytic.nutating", **_with_defaults(lagrange_top), **lagrange, num_steps=4000),
        Problem(
            "lagrange_top_analytic.simo_wong", **_with_defaults(lagrange_top, **simo_wong), **lagrange, num_steps=500
        ),
    ]


def _free_bodies() -> list[Problem]:
    criteria = {"Psi": _integral(lambda s, p: s.body("body").orientation[1, 0] ** 2)}
    cases = {
        "asymmetric": ({}, 10.0, 500),
        "dzhanibekov": ({"J1": 1.0, "J2": 2.0, "J3": 3.0, "w1": 0.001, "w2": 3.0, "w3": 0.002}, 20.0, 1000),
        "symmetric_kynema": ({"J1": 1.0, "J2": 1.0, "J3": 0.5, "w1": 0.5, "w2": 0.5, "w3": 1.0}, 5.0, 250),
    }
    return [
        Problem(
            f"free_rigid_body.{case}",
            **_with_defaults(free_rigid_body, **changes),
            t1=t1,
            criteria=criteria,
            num_steps=num_steps,
        )
        for case, (changes, t1, num_steps) in cases.items()
    ]


def _planar() -> list[Problem]:
    return [
        Problem(
            "simple_pendulum_A01",
            **_with_defaults(simple_pendulum),
            t1=10.0,
            criteria={"Psi": _integral(lambda s, p: s.body("mass").position[0] ** 2)},
            num_steps=1000,
        ),
        Problem(
            "slider_crank_sundials",
            **_with_defaults(slider_crank),
            t1=10.0,
            criteria={
                "G": _integral(_kinetic_energy_of_crank),
                "Psi2": _integral(lambda s, p: s.body("slider").acceleration[0] ** 2),
            },
            num_steps=500,
        ),
        Problem(
            "four_bar_spring",
            **_with_defaults(four_bar),
            t1=2.0,
            criteria={
                "Psi1": _integral(_distance_of_coupler),
                "Psi2": _integral(lambda s, p: jnp.sum(s.body("coupler").acceleration ** 2)),
            },
            num_steps=500,
        ),
    ]


def _cars() -> list[Problem]:
    linear = _with_defaults(linear_quarter_car)
    comfort = _integral(lambda s, p: s.body("sprung").acceleration[2] ** 2)
    hinged = {"build": _five_link("hinged"), "parameters": _CAR}
    return [
        Problem("quarter_car_linear", **linear, t1=3.0, criteria={"Psi0": comfort}, num_steps=750),
        *(
            Problem(
                f"quarter_car_linear.at_{t}s",
                **linear,
                t1=t,
                criteria={f"{name}({t})": criterion for name, criterion in _LINEAR.items()},
                num_steps=150,
            )
            for t in (0.1, 0.3)
        ),
        Problem("five_link_quarter_car", **hinged, t1=2.0, criteria={"Psi0": _COMFORT}, num_steps=480),
        Problem(
            "five_link_quarter_car.at_0.3s",
            **hinged,
            t1=0.3,
            criteria={
                "F_tire(0.3)": _terminal(lambda s, p: s.force("tyre")),
                "spring_length(0.3)": _terminal(lambda s, p: s.force("spring").length),
            },
            num_steps=300,
        ),
        Problem(
            "five_link_quarter_car.locked_wheel",
            build=_five_link("locked"),
            parameters=_CAR,
            t1=2.0,
            criteria={"Psi0_locked_wheel": _COMFORT},
            num_steps=480,
        ),
    ]


PROBLEMS: dict[str, Problem] = {problem.name: problem for problem in (*_tops(), *_free_bodies(), *_planar(), *_cars())}
