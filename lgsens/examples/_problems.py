"""Problems with published or independently computed numbers: scene, parameters, time and criteria of each."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.criteria import Criterion
from lgsens.examples._mechanisms import four_bar, linear_quarter_car, simple_pendulum, slider_crank
from lgsens.examples._quarter_car import QuarterCar
from lgsens.examples._tops import free_rigid_body, heavy_top, lagrange_top, spinning_top
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

    __repr__ = brief


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
def _of_dict(scene: Callable[..., Model]) -> Callable[[Mapping[str, Any]], Model]:
    return lambda p: scene(**p)


def _problem(
    name: str, scene: Callable[..., Model], t1: float, num_steps: int, criteria: dict[str, Criterion], **changes: float
) -> Problem:
    """The problem of a scene whose arguments are its parameters; `changes`: those that differ from their defaults."""
    defaults = {name: argument.default for name, argument in inspect.signature(scene).parameters.items()}
    return Problem(name, _of_dict(scene), defaults | changes, t1, criteria, num_steps)


def _spinning_top(alpha0=0.7853981633974483, m=15.0, J11=0.2, J22=0.4, J33=0.2, l=1.0, omega0=10.0, g=9.81) -> Model:
    return spinning_top(alpha0, m, (J11, J22, J33), l, omega0, g)


# Those at which the quarter-car's design position is in equilibrium for the k below, printed with the reference [m].
FREE: dict[str, Any] = {"free_length": 0.3350681866287862, "free_radius": 0.336861050861}


def _five_link(wheel: str, k=109000.0, c=4900.0, hb=0.05) -> Model:
    """The five-link quarter-car with given rates and bump; spring and tyre keep their free lengths."""
    return QuarterCar.load().with_values(stiffness=k, damping=c, bump_height=hb).model(wheel=wheel, **FREE)


def _kinetic_energy_of_crank(s, p):
    crank, conrod = (s.body(name).angular_velocity[2] for name in ("crank", "conrod"))
    return (p["J1"] * crank**2 + p["m2"] * s.body("slider").velocity[0] ** 2 + p["J2"] * conrod**2) / 2


def _distance_of_coupler(s, p):
    x, y, _ = s.body("coupler").position
    return (x - 0.5) ** 2 + (y - 0.45) ** 2


_X1_SQUARED = Criterion(lambda s, p: s.body("top").position[0] ** 2)
_HEIGHT = Criterion(lambda s, p: s.body("top").position[2])
# x_cm = l R e₃; the scene's body has its centre of mass elsewhere
_LAGRANGE = {"Psi": Criterion(lambda s, p: (p["l"] * s.body("top").orientation[0, 2]) ** 2)}
_TURNED = {"Psi": Criterion(lambda s, p: s.body("body").orientation[1, 0] ** 2)}
_PENDULUM = {"Psi": Criterion(lambda s, p: s.body("mass").position[0] ** 2)}
_SLIDER_CRANK = {
    "G": Criterion(_kinetic_energy_of_crank),
    "Psi2": Criterion(lambda s, p: s.body("slider").acceleration[0] ** 2),
}
_FOUR_BAR = {
    "Psi1": Criterion(_distance_of_coupler),
    "Psi2": Criterion(lambda s, p: jnp.sum(s.body("coupler").acceleration ** 2)),
}
_SPRUNG = {"Psi0": Criterion(lambda s, p: s.body("sprung").acceleration[2] ** 2)}
_COMFORT = Criterion(lambda s, p: s.body("chassis").acceleration[2] ** 2)
_LINEAR = {
    "stroke": Criterion(terminal=lambda s, p: s.body("sprung").position[2] - s.body("unsprung").position[2]),
    "tire_dyn_force": Criterion(terminal=lambda s, p: s.force("tyre")),
    "zs_acc": Criterion(terminal=lambda s, p: s.body("sprung").acceleration[2]),
}
_FIVE_LINK = {
    "F_tire(0.3)": Criterion(terminal=lambda s, p: s.force("tyre")),
    "spring_length(0.3)": Criterion(terminal=lambda s, p: s.force("spring").length),
}


def _heavy_top(seconds: int, num_steps: int) -> Problem:
    criteria = {f"int_x1^2_0_{seconds}": _X1_SQUARED, f"int_x3_0_{seconds}": _HEIGHT}
    return _problem(f"heavy_top_bruls2012.to_{seconds}s", heavy_top, float(seconds), num_steps, criteria)


def _linear_at(t: float) -> Problem:
    criteria = {f"{name}({t})": criterion for name, criterion in _LINEAR.items()}
    return _problem(f"quarter_car_linear.at_{t}s", linear_quarter_car, t, 150, criteria)


_DZHANIBEKOV = {"J1": 1.0, "J2": 2.0, "J3": 3.0, "w1": 0.001, "w2": 3.0, "w3": 0.002}
_SYMMETRIC = {"J1": 1.0, "J2": 1.0, "J3": 0.5, "w1": 0.5, "w2": 0.5, "w3": 1.0}
_SIMO_WONG = {"m": 20.0, "l": 1.0, "J1": -15.0, "J3": 1.0, "w3": 50.0, "theta0": 0.05, "g": 1.0}
_BRULS = "spinning_top_brulls"
_HINGED, _LOCKED = (functools.partial(_five_link, wheel) for wheel in ("hinged", "locked"))
_TOP = (_spinning_top, 1.0, 200, {"Psi": _X1_SQUARED})

PROBLEMS: dict[str, Problem] = {
    problem.name: problem
    for problem in (
        _problem(f"{_BRULS}.as_printed_l_0.5", *_TOP, l=0.5),
        _problem(f"{_BRULS}.l_1.0_reproduces_published_number", *_TOP),
        _problem(f"{_BRULS}.l_1.0_alpha0_0.785398", *_TOP, alpha0=0.785398),
        _heavy_top(1, 1000),
        _heavy_top(2, 4000),
        _problem("lagrange_top_analytic.nutating", lagrange_top, 1.0, 4000, _LAGRANGE),
        _problem("lagrange_top_analytic.simo_wong", lagrange_top, 1.0, 500, _LAGRANGE, **_SIMO_WONG),
        _problem("free_rigid_body.asymmetric", free_rigid_body, 10.0, 500, _TURNED),
        _problem("free_rigid_body.dzhanibekov", free_rigid_body, 20.0, 1000, _TURNED, **_DZHANIBEKOV),
        _problem("free_rigid_body.symmetric_kynema", free_rigid_body, 5.0, 250, _TURNED, **_SYMMETRIC),
        _problem("simple_pendulum_A01", simple_pendulum, 10.0, 1000, _PENDULUM),
        _problem("slider_crank_sundials", slider_crank, 10.0, 500, _SLIDER_CRANK),
        _problem("four_bar_spring", four_bar, 2.0, 500, _FOUR_BAR),
        _problem("quarter_car_linear", linear_quarter_car, 3.0, 750, _SPRUNG),
        _linear_at(0.1),
        _linear_at(0.3),
        _problem("five_link_quarter_car", _HINGED, 2.0, 480, {"Psi0": _COMFORT}),
        _problem("five_link_quarter_car.at_0.3s", _HINGED, 0.3, 300, _FIVE_LINK),
        _problem("five_link_quarter_car.locked_wheel", _LOCKED, 2.0, 480, {"Psi0_locked_wheel": _COMFORT}),
    )
}
