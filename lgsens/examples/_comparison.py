"""The scenes on which all methods are compared: four scenes, five kinds of criteria on each."""

import equinox as eqx
import jax.numpy as jnp

from lgsens.criteria import Criterion
from lgsens.examples._mechanisms import four_bar, spatial_chain
from lgsens.examples._problems import FREE, Problem
from lgsens.examples._quarter_car import QuarterCar
from lgsens.examples._tops import spinning_top
from lgsens.model import Model


def _quarter_car(p) -> Model:
    """The five-link quarter-car; one chassis hardpoint is moved, spring and tyre keep their free lengths."""
    car = QuarterCar.load().with_values(stiffness=p["k"], damping=p["c"])
    member = lambda car: car.links["trailing_arm"].chassis
    moved = member(car) + p["trailing_arm_y"] * jnp.asarray([0.0, 1.0, 0.0], car.bearing.dtype)
    return eqx.tree_at(member, car, moved).model(**FREE)


def _five(terminal, q, v, vdot, lam) -> dict[str, Criterion]:
    """A terminal criterion, and integrals of positions, velocities, accelerations and multipliers."""
    rates = {"q": q, "v": v, "vdot": vdot, "lam": lam}
    return {"terminal": Criterion(terminal=terminal)} | {k: Criterion(integrand=f) for k, f in rates.items()}


COMPARISON: dict[str, Problem] = {
    "top": Problem(
        name="spinning_top",
        build=lambda p: spinning_top(p["alpha0"], p["mass"], length=p["length"], spin=p["spin"]),
        parameters={"alpha0": 0.7853981633974483, "mass": 15.0, "length": 1.0, "spin": 10.0},
        t1=1.0,
        criteria=_five(
            terminal=lambda s, p: s.body("top").position[2] + 0.01 * s.body("top").angular_velocity[2] ** 2,
            q=lambda s, p: s.body("top").position[0] ** 2,
            v=lambda s, p: s.body("top").velocity[1] ** 2,
            vdot=lambda s, p: s.body("top").acceleration[1] ** 2,
            lam=lambda s, p: (s.multiplier("pivot")[2] / p["mass"]) ** 2,
        ),
        num_steps=500,
    ),
    "four_bar": Problem(
        name="four_bar",
        build=lambda p: four_bar(**p),
        parameters={"a": 0.3, "b": 0.8, "m3": 2.0, "k": 200.0, "w0": 5.0},
        t1=0.5,
        criteria=_five(
            terminal=lambda s, p: s.body("coupler").position[1] + 0.1 * s.body("rocker").angular_velocity[2],
            q=lambda s, p: jnp.sum(s.body("coupler").position[:2] ** 2),
            v=lambda s, p: s.body("rocker").angular_velocity[2] ** 2,
            vdot=lambda s, p: jnp.sum(s.body("coupler").acceleration ** 2),
            lam=lambda s, p: jnp.sum(s.multiplier("B") ** 2),
        ),
        num_steps=250,
    ),
    "chain": Problem(
        name="spatial_chain",
        build=lambda p: spatial_chain(3, **p),
        parameters={"length": 0.3, "mass": 0.5, "tilt": 1.0, "spin": 3.0},
        t1=0.5,
        criteria=_five(
            terminal=lambda s, p: s.body("link2").position[2] + 0.1 * s.body("link1").velocity[0],
            q=lambda s, p: s.body("link2").position[1] ** 2,
            v=lambda s, p: jnp.sum(s.body("link2").angular_velocity ** 2),
            vdot=lambda s, p: jnp.sum(s.body("link2").acceleration ** 2),
            lam=lambda s, p: jnp.sum(s.multiplier("hinge0")[:3] ** 2),
        ),
        num_steps=250,
    ),
    "quarter_car": Problem(
        name="five_link_quarter_car",
        build=_quarter_car,
        parameters={"k": 109000.0, "c": 4900.0, "trailing_arm_y": 0.0},
        t1=0.3,
        criteria=_five(
            terminal=lambda s, p: s.force("spring").length,  # Ψ₃ of eq. (50) at one time
            q=lambda s, p: s.body("wheel").position[2] ** 2,
            v=lambda s, p: s.body("knuckle").velocity[2] ** 2,
            vdot=lambda s, p: s.body("chassis").acceleration[2] ** 2,  # Ψ₀ of eq. (47)
            lam=lambda s, p: jnp.sum(s.multiplier("trailing_arm_knuckle") ** 2),
        ),
        num_steps=300,
    ),
}
