"""An axle of double wishbones written by hand, for the tests of the rig: ten bodies, its numbers in one dictionary."""

import jax.numpy as jnp
import numpy as np

import lgsens as lg

MIRROR = np.array([1.0, -1.0, 1.0])
SIDES = {"left": np.ones(3), "right": MIRROR}
# Of the left side [m]: where the arms hold on to the chassis and to the wheel, tie rod, spring, and the wheel centre.
POINTS = {
    "lower_front": (0.15, 0.36, 0.22),
    "lower_rear": (-0.17, 0.35, 0.23),
    "lower_ball": (0.01, 0.70, 0.20),
    "upper_front": (0.12, 0.42, 0.47),
    "upper_rear": (-0.14, 0.43, 0.46),
    "upper_ball": (-0.02, 0.67, 0.49),
    "tie_rack": (0.14, 0.33, 0.28),
    "tie_wheel": (0.15, 0.68, 0.27),
    "spring_arm": (0.0, 0.58, 0.21),
    "spring_top": (0.01, 0.46, 0.62),
    "centre": (0.0, 0.76, 0.31),
}
RATES = {"spring": 60e3, "preload": -5200.0, "bushing": 4e6, "twist": 300.0, "bar": 900.0, "arm": 2.5, "wheel": 32.0}
ARMS = {"lower": ("lower_front", "lower_rear", "lower_ball"), "upper": ("upper_front", "upper_rear", "upper_ball")}


def numbers():
    """All that can be differentiated by, as arrays."""
    return {name: jnp.asarray(value, float) for name, value in (POINTS | RATES).items()}


def arm_centre(p, arm):
    front, rear, ball = (p[name] for name in ARMS[arm])
    return (front + rear) / 4 + ball / 2


def small_axle(p=None, *, compliant=True, two_sided=False):
    """The model and its wheel centres; `p` as of `numbers()`, of both sides, or with `two_sided` a pair of them."""
    p = numbers() if p is None else p
    bodies, joints, forces, centres = {}, {}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))}, {}
    for i, (side, sign) in enumerate(SIDES.items()):
        own = p[i] if two_sided else p
        at = {name: own[name] * jnp.asarray(sign) for name in POINTS}
        wheel, centres[side] = f"{side}_wheel", at["centre"]
        bodies[wheel] = lg.RigidBody(mass=own["wheel"], inertia=(1.0, 1.5, 1.0), position=at["centre"])
        for arm, (front, rear, ball) in ARMS.items():
            name = f"{side}_{arm}"
            centre = arm_centre(at, arm)
            bodies[name] = lg.RigidBody(mass=own["arm"], inertia=(0.03, 0.02, 0.04), position=centre)
            joints[f"{name}_ball"] = lg.SphericalJoint(name, wheel, at=at[ball])
            if compliant:
                stiffness, twist = (jnp.broadcast_to(own[of], (3,)) for of in ("bushing", "twist"))
                for end in (front, rear):
                    rates = {"stiffness": stiffness, "rotational_stiffness": twist}
                    forces[f"{side}_{end}"] = lg.Bushing(None, name, at=at[end], **rates)
            else:
                middle = (at[front] + at[rear]) / 2
                joints[name] = lg.RevoluteJoint(None, name, at=middle, axis=at[front] - at[rear])
        joints[f"{side}_tie"] = lg.DistanceJoint("rack", wheel, at_a=at["tie_rack"], at_b=at["tie_wheel"])
        ends = {"at_a": at["spring_arm"], "at_b": at["spring_top"]}
        lower = f"{side}_lower"
        forces[f"{side}_spring"] = lg.SpringDamper(lower, None, **ends, stiffness=own["spring"], preload=own["preload"])
        forces[f"{side}_damper"] = lg.SpringDamper(lower, None, **ends, stiffness=0.0, damping=3000.0)
    bar = p[0]["bar"] if two_sided else p["bar"]
    forces["anti_roll_bar"] = lg.TorsionSpringDamper("left_lower", "right_lower", axis=(0.0, 1.0, 0.0), stiffness=bar)
    bodies["rack"] = lg.RigidBody(mass=3.0, inertia=(0.1, 0.01, 0.1), position=(0.14, 0.0, 0.28), free="y")
    joints["steering"] = lg.TranslationDriver(None, "rack", at=(0.14, 0.0, 0.28), axis=(0.0, 1.0, 0.0))
    return lg.Model(bodies, joints, forces), centres
