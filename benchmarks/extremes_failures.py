"""Beyond the extremes: what cannot be right says so, in words; nothing is NaN in silence."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from extremes_rows import Row

import lgsens as lg
from lgsens.examples import spinning_top


def _said(function, parts) -> float:
    """0 if the message has all of `parts`, else how many are missing; inf without a message."""
    try:
        function()
    except (ValueError, lg.SimulationError) as error:
        return float(sum(part not in str(error) for part in parts))
    return math.inf


def _too_coarse(spin=1e3, *, throw=True):
    """Fifty radians of spin per step about an axis that is none of inertia: Newton has no solution to find."""
    scheme = lg.GeneralizedAlpha(0.999)
    return lg.simulate(spinning_top(0.7, spin=spin), t1=1.0, num_steps=20, integrator=scheme, throw=throw)


def _slope_of_a_failure(spin):
    return jax.grad(lambda spin: _too_coarse(spin, throw=False).body("top").position[-1, 0])(spin)


def failures() -> list[Row]:
    body = {"b": lg.RigidBody(1.0, (1.0, 1.0, 1.0))}
    held = {"b": lg.RigidBody(1.0, (1.0, 1.0, 1.0), free=())}
    origin = (0.0, 0.0, 0.0)
    said = {
        "steps too coarse for Newton": (_too_coarse, ("did not converge", "smaller step", "at step", "t = ")),
        "no body": (lambda: lg.Model({}), ("at least one RigidBody",)),
        "no degree of freedom": (lambda: lg.Model(held).system(), ("no body has a degree of freedom",)),
        "mass zero": (lambda: lg.RigidBody(0.0, (1.0, 1.0, 1.0)), ("`mass` must be positive",)),
        "mass infinite": (lambda: lg.RigidBody(math.inf, (1.0, 1.0, 1.0)), ("`mass` must be positive",)),
        "inertia zero": (lambda: lg.RigidBody(1.0, (1.0, 1.0, 0.0)), ("`inertia`",)),
        "rod of no length": (
            lambda: lg.DistanceJoint(None, "b", at_a=origin, at_b=origin),
            ("coincide", "use a SphericalJoint"),
        ),
        "no time": (lambda: lg.simulate(lg.Model(body), t1=0.0, num_steps=1), ("`t1` must be later than `t0`",)),
        "no step": (lambda: lg.simulate(lg.Model(body), t1=1.0, num_steps=0), ("`num_steps` must be at least 1",)),
    }
    why = "the message names what is wrong and what to do; parts of it that are missing"
    rows = [Row("what has no answer", name, _said(*each), 0.0, why) for name, each in said.items()]
    failed = _too_coarse(throw=False)
    silent = int(failed.result) == lg.RESULTS.successful
    slope = float(_slope_of_a_failure(jnp.asarray(1e3)))
    rows.append(
        Row("what has no answer", "a failed run whose `result` is a success", float(silent), 0.0, "`result` says it")
    )
    number = float(np.isfinite(slope))
    rows.append(
        Row("what has no answer", "a failed run with a gradient that is a number", number, 0.0, "NaN, with `result`")
    )
    return rows
