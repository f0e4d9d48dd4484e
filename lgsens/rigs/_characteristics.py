"""The characteristics of an axle: what its curves are at the design position, one number each."""

from operator import attrgetter
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.rigs._curves import AxleCurves
from lgsens.rigs._kc import KC

DEGREE = float(np.degrees(1.0))
_PER_100MM, _PER_KN, _MM_PER_KN = (DEGREE / 10, "°/100 mm"), (1e3 * DEGREE, "°/kN"), (1e6, "mm/kN")
_ANGLE, _LENGTH, _PERCENT, _RATIO = (DEGREE, "°"), (1e3, "mm"), (100.0, "%"), (1.0, "–")
# Shares of the left and the right side. Camber is outward: to the left on the left.
_SIDES = {"alike": (0.5, 0.5), "outward": (0.5, -0.5), "rightward": (-0.5, 0.5)}


class Characteristic(NamedTuple):
    """One number of an axle, in SI units.

    Attributes:
        sweep: from whose curves it is.
        member: which of `AxleCurves`: "caster", "rates.toe".
        shown: factor and unit in which it is shown.
        label: what it is, with its sign.
        mean: of both sides: "alike", "outward" of what is to the left, or of camber "rightward", the inclination.
        by: "travel" or "roll": it is divided by the rate of mean wheel travel, or of the roll angle.
        end: at the end of the sweep, and not in its middle.
    """

    sweep: str
    member: str
    shown: tuple[float, str]
    label: str
    mean: str = "alike"
    by: str | None = None
    end: bool = False

    def of(self, curves: AxleCurves) -> Float[Array, ""] | None:
        """Its value; None: the axle does not have it."""
        found = attrgetter(self.member)(curves)
        if found is None:
            return None
        at = -1 if self.end else len(found) // 2
        side = np.array(_SIDES[self.mean])
        number = found[at] if found.ndim == 1 else jnp.sum(found[at] * side)
        if self.by == "travel":
            return number / jnp.mean(curves.rates.travel[at])
        return number / curves.roll_angle_rate[at] if self.by == "roll" else number


_C = Characteristic
CHARACTERISTICS = {
    "static_toe": _C("parallel", "wheels.toe", _ANGLE, "toe, front inward +"),
    "static_camber": _C("parallel", "wheels.camber", _ANGLE, "camber, top outward +"),
    "caster": _C("parallel", "caster", _ANGLE, "caster, top rearward +"),
    "kingpin_inclination": _C("parallel", "kingpin_inclination", _ANGLE, "kingpin inclination, top inward +"),
    "scrub_radius": _C("parallel", "scrub_radius", _LENGTH, "scrub radius, axis inward of the contact +"),
    "trail": _C("parallel", "trail", _LENGTH, "trail, axis in front of the contact +"),
    "bump_steer": _C("parallel", "rates.toe", _PER_100MM, "toe per wheel travel", by="travel"),
    "bump_camber": _C("parallel", "rates.camber", _PER_100MM, "camber per wheel travel", by="travel"),
    "bump_scrub": _C(
        "parallel", "rates.contact_y", (100.0, "mm/100 mm"), "contact outward per wheel travel", "outward", "travel"
    ),
    "bump_recession": _C(
        "parallel", "rates.contact_x", (100.0, "mm/100 mm"), "contact forward per wheel travel", by="travel"
    ),
    "spring_motion_ratio": _C("parallel", "spring_motion_ratio", _RATIO, "motion ratio of the spring"),
    "damper_motion_ratio": _C("parallel", "damper_motion_ratio", _RATIO, "motion ratio of the damper"),
    "wheel_rate": _C("parallel", "wheel_rate", (1e-3, "N/mm"), "wheel rate"),
    "roll_rate": _C("parallel", "roll_rate", (1.0 / DEGREE, "N m/°"), "roll rate"),
    "roll_centre_height": _C("parallel", "roll_centre_height", _LENGTH, "roll centre height, kinematic"),
    "roll_steer": _C("opposite", "rates.steer", (100.0, "%"), "steer to the left per roll to the right", by="roll"),
    "roll_camber": _C(
        "opposite", "rates.camber", (100.0, "%"), "inclination to the right per roll to the right", "rightward", "roll"
    ),
    "steer_per_rack": _C("steering", "steer_per_rack", (DEGREE / 1e3, "°/mm"), "steer angle per way of the rack"),
    "steering_ratio": _C("steering", "steering_ratio", _RATIO, "steering ratio"),
    "ackermann": _C("steering", "ackermann", _PERCENT, "Ackermann at the end of the sweep", end=True),
    "lateral_steer": _C("lateral", "rates.steer", _PER_KN, "steer to the left per lateral force to the left"),
    "lateral_camber": _C(
        "lateral",
        "rates.camber",
        _PER_KN,
        "inclination to the right per lateral force to the left",
        "rightward",
    ),
    "lateral_compliance": _C("lateral", "rates.contact_y", _MM_PER_KN, "contact centre per lateral force"),
    "lateral_centre_compliance": _C("lateral", "rates.centre_y", _MM_PER_KN, "wheel centre per lateral force"),
    "force_roll_centre_height": _C("lateral", "force_roll_centre_height", _LENGTH, "roll centre height, by forces"),
    "lateral_opposed_toe": _C("lateral_opposed", "rates.toe", _PER_KN, "toe per lateral force, outward on both"),
    "lateral_opposed_camber": _C("lateral_opposed", "rates.camber", _PER_KN, "camber per lateral force, outward"),
    "braking_toe": _C("braking", "rates.toe", _PER_KN, "toe per braking force"),
    "braking_compliance": _C("braking", "rates.contact_x", _MM_PER_KN, "contact centre forward per braking force"),
    "braking_centre_compliance": _C("braking", "rates.centre_x", _MM_PER_KN, "wheel centre forward per braking force"),
    "anti_dive": _C("braking", "anti_dive", _PERCENT, "anti-dive"),
    "anti_lift": _C("braking", "anti_lift", _PERCENT, "anti-lift under braking"),
    "traction_toe": _C("traction", "rates.toe", _PER_KN, "toe per traction"),
    "traction_compliance": _C("traction", "rates.centre_x", _MM_PER_KN, "wheel centre forward per traction"),
    "anti_squat": _C("traction", "anti_squat", _PERCENT, "anti-squat"),
    "traction_anti_lift": _C("traction", "anti_lift", _PERCENT, "anti-lift under traction"),
    "aligning_steer": _C("aligning", "rates.steer", (1e3 * DEGREE, "°/(kN m)"), "steer per aligning moment"),
    "aligning_opposed_toe": _C(
        "aligning_opposed", "rates.steer", (1e3 * DEGREE, "°/(kN m)"), "toe-out per opposed aligning moment", "outward"
    ),
}


def characteristics(test: KC) -> dict[str, Float[Array, ""]]:
    """The characteristics of an axle at the design position by name, SI units; those that its sweeps have.

    Arguments:
        test: the curves of its sweeps.

    `CHARACTERISTICS` says from which sweep each is, how it is signed, and in which unit it is shown. Differentiable.
    """
    found = {name: one.of(test.sweeps[one.sweep]) for name, one in CHARACTERISTICS.items() if one.sweep in test.sweeps}
    return {name: value for name, value in found.items() if value is not None}
