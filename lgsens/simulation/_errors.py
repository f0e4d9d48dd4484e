"""Failures are data inside a trace; here they become exceptions, with the step, the time and advice."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

from lgsens.dynamics import RESULTS, full_jacobian, initial_state, names_of_all, redundant_names
from lgsens.integrate import singular_steps
from lgsens.model import invalid_numbers, scene_of

# Whether a failure inside `jit` calls back. JAX keys its caches on it: both are traced.
_by_callback = jax.make_user_context(False)

# Which of several runs: `details["run"]`.
_RUNS = ("", " of the coarser of two runs", " of the finer of two runs")


class SimulationError(RuntimeError):
    """A simulation or an equilibrium that failed; the message says at which step, when, and what to try."""


def failures_by_callback(active: bool = True):
    """A context in which what `jit` compiles raises its failures itself, by a callback to Python.

    ```python
    with lg.failures_by_callback():
        step = jax.jit(step).lower(p).compile()   # raises JAX's runtime error with step, time and advice
    ```

    Without it a failure inside `jit` is NaN in the values and in every derivative of them, and `raise_if_failed` raises
    from what comes out. A program with a callback is not kept in JAX's persistent cache, nor can it be exported.
    """
    return _by_callback(active)


def _describe(result: int, details: dict[str, Any], names: tuple[str, ...]) -> str:
    """The message of a failure; `details` are those of `outcome`, or what else the code wants to know."""
    code = RESULTS(result)
    if not details:
        return code.message
    if code is RESULTS.redundant_constraints:
        involved = redundant_names(details["jacobian"], names)
        rods = all(names.count(name) == 1 for name in involved)
        more = " Each is one equation: if no two are the same, the configuration is singular; begin beside it."
        return f"{code.message} Joints involved: {involved}.{more if rods else ''}"
    step, num_steps = int(details.get("step", 0)), int(details.get("num_steps", 0))
    place, time = f"step {step} of {num_steps}", f"t = {details.get('time', 0.0):.6g} s"
    violation, worst = np.abs(details.get("violation", ())), ""
    if code is RESULTS.joints_apart and len(missing := np.abs(details.get("missing", ()))):
        violation, names = missing, names[len(names) - len(missing) :]
    if violation.size and np.all(np.isfinite(violation)):
        i = int(np.argmax(violation))
        worst = f"Left over: |Φ| = {violation[i]:.3g}, largest in joint {names[i]!r}."
    match code:
        case RESULTS.assembly_failed | RESULTS.off_joints:
            more = worst
        case RESULTS.equilibrium_failed if np.any(np.isfinite(details.get("moved", np.nan))):
            far = int(np.nanargmax(details["moved"]))
            more = f"The search went farthest with body {str(details['bodies'][far])!r}, {details['moved'][far]:.3g} m."
        case RESULTS.invalid_numbers if "numbers" in details:
            more = f"Found: {'; '.join(details['numbers'])}."
        case RESULTS.invalid_numbers if "position" in details:
            more = f"It is so at position {int(details['position'])}{_driven(details)}, {time}."
        case RESULTS.newton_failed:
            asked = f" (tolerance {details['tolerance']:.3g})" if "tolerance" in details else ""
            more = (
                f"It failed at {place}{_RUNS[int(details.get('run', 0))]}, {time}, after {int(details['iterations'])} "
                f"iterations: last increment {details['increment']:.3g}{asked}, residual {details['residual']:.3g}. "
                "`throw=False` returns the data up to the step before."
            )
        case RESULTS.singular_configuration if "position" in details:
            more = f"It is in one at position {int(details['position'])}{_driven(details)}, {time}: the driven values "
            more += (
                "do not determine it, rates and forces are infinite. Drive another coordinate, or stay away from it."
            )
        case RESULTS.singular_configuration:
            more = f"It does so about {place}, {time}. `throw=False` returns the data, which follow one branch."
        case RESULTS.turn_not_resolved:
            turn = float(details["turn"])
            more = (
                f"It turns by {turn:.3g} rad in {place}, {time}: try num_steps = "
                f"{np.ceil(num_steps * turn / 0.3):.0f}. `throw=False` returns the data."
            )
        case RESULTS.angle_jumped if "position" in details:
            more = f"It did so before position {int(details['position'])}{_driven(details)}. It is told from the "
            more += "position before: let them be less than half a turn apart. `throw=False` returns the data."
        case RESULTS.angle_jumped:
            more = f"It did so in {place}, {time}. `throw=False` returns the data."
        case RESULTS.joints_apart:
            more = f"It is so at {place}, {time}. {worst} `throw=False` returns the data." if step else worst
        case RESULTS.outputs_not_steady if "outputs" in details:
            more = f"They are {[str(name) for name, moves in zip(details['outputs'], details['changing']) if moves]}."
        case RESULTS.position_failed:
            more = f"It failed at position {int(details['position'])}{_driven(details)}, {time}. {worst}"
            if details.get("left_out"):
                more += " Or equations that redundant='remove' left out are not met where the others are."
        case RESULTS.statics_failed | RESULTS.not_held:
            more = f"It failed at point {int(details['position'])}{_driven(details)}."
            if len(details.get("free", ())):
                more = f"What moves freely: {', '.join(map(str, details['free']))}. {more}"
        case RESULTS.steps_exhausted:
            more = f"It came to {time} of {details['t1']:.6g} s in {num_steps} steps. `throw=False` returns these."
        case RESULTS.integration_failed:
            more = (
                f"It failed in interval {step} of {num_steps}, from t = {details['begin']:.6g} s on, in "
                f"{int(details['iterations'])} steps. `throw=False` returns the data before."
            )
        case _:
            more = ""
    return f"{code.message} {more}".strip()


def _driven(details: dict[str, Any]) -> str:
    """The values of drivers and the factors of loads by name; of many those that are not zero."""
    values, names = np.atleast_1d(details["values"]), details.get("names")
    if names is None:
        return f", driven values {np.array2string(values, precision=6)}"
    moved = [f"{name} = {value:.6g}" for name, value in zip(names, values) if value != 0.0 or len(names) < 5]
    return f", driven values {', '.join(moved) or 'all 0'}" if len(names) else ""


def _exception(result: int, details: dict[str, Any], names: tuple[str, ...], note: str) -> Exception:
    bad_input = (
        RESULTS.assembly_failed,
        RESULTS.off_joints,
        RESULTS.redundant_constraints,
        RESULTS.position_failed,
        RESULTS.invalid_numbers,
        RESULTS.not_steady,
        RESULTS.outputs_not_steady,
        RESULTS.not_held,
    )
    of_values = result == RESULTS.singular_configuration and "position" in details
    kind = ValueError if result in bad_input or of_values else SimulationError
    return kind(f"{note} {_describe(result, details, names)}".strip())


def throw_if_failed(tree: Any, result: Any, details: dict[str, Any], names: tuple[str, ...], note: str = "") -> Any:
    """`tree` unchanged, unless `result` is a failure: then raise or, inside a trace, make it NaN.

    `note` is what else to say where the constraints are redundant.

    Under `failures_by_callback` the exception inside a trace is JAX's runtime error with the same message. The callback
    runs only in the failing branch (under `vmap`, always, and names the first lane that failed).
    """

    noted = lambda code: note if code == RESULTS.redundant_constraints else ""

    def host(result, details) -> np.ndarray:
        codes = np.asarray(result)
        failed = np.argwhere(codes != RESULTS.successful)
        if len(failed):  # not its size: a scalar that has failed has an index of no entries
            lane = tuple(failed[0])
            message_details = jax.tree.map(lambda value: np.asarray(value)[lane], details)
            raise _exception(int(codes[lane]), message_details, names, noted(int(codes[lane])))
        return np.ones(codes.shape, bool)

    if not isinstance(result, Tracer):
        # Details may be traced (by grad) where the result is not; their values are all that is needed.
        if int(result) != RESULTS.successful:
            values = jax.tree.map(lambda value: np.asarray(primal_value(value)), details)
            raise _exception(int(result), values, names, noted(int(result)))
        return tree

    passed = result == RESULTS.successful
    if _by_callback.value:
        result, details = lax.stop_gradient((result, details))
        shape = jax.ShapeDtypeStruct((), bool)
        fail = lambda *operands: jax.pure_callback(host, shape, *operands, vmap_method="broadcast_all")
        passed = lax.cond(result != RESULTS.successful, fail, lambda *_: jnp.ones((), bool), result, details)
    # Leaves depend on the callback, which is therefore not removed. A product and no selection: the derivatives of a
    # failure are NaN too, where those of a selection would be zero.
    poison = lambda leaf: leaf * jnp.where(passed, 1.0, jnp.nan).astype(leaf.dtype)
    return jax.tree.map(lambda leaf: poison(leaf) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf, tree)


def raise_if_failed(found: Any) -> Any:
    """What comes out of `jit` or `vmap` as it is, unless it failed: then raise, as `simulate` does outside of `jit`.

    ```python
    trajectory = lg.raise_if_failed(jax.jit(run)(p))
    ```

    Arguments:
        found: a `Trajectory`, or anything else with a `result`: `Saved`, `Kinematics`, `Sensitivities`; of a batch
            the first one that failed counts.

    Inside `jit` failures are NaN, in values and derivatives, and `result` says why. Raises `ValueError` for a mechanism
    that cannot be assembled or has redundant constraints, and where `found` is traced; else `SimulationError`.
    """
    if not hasattr(found, "result"):
        raise ValueError(
            f"`found` must have a `result`, as a Trajectory or Sensitivities have, got a {type(found).__name__}."
        )
    if isinstance(found.result, Tracer):
        raise ValueError(
            "`raise_if_failed` is for what comes out of `jit` or `vmap`: inside, no number is known yet. Return the "
            "trajectory or its `result` from there, or trace under `failures_by_callback`."
        )
    codes = np.asarray(found.result)
    failed = np.argwhere(codes != RESULTS.successful)
    if not len(failed):
        return found
    lane = tuple(failed[0])
    code = int(codes[lane])
    of_batch = f"{len(failed)} of {codes.size} runs failed, the first at {list(map(int, lane))}." if lane else ""
    one = lambda name: jax.tree.map(lambda leaf: jnp.asarray(leaf)[lane], getattr(found, name, None))
    system, stats = one("system"), one("stats")
    t: Any = jax.tree.map(jnp.atleast_1d, one("t"))
    details: dict[str, Any] = {}
    if system is not None and code in (RESULTS.assembly_failed, RESULTS.redundant_constraints):
        initial = initial_state(system, t[0])
        jacobian = full_jacobian(system, initial.state.q, t[0])
        details = {"violation": np.asarray(initial.violation), "jacobian": np.asarray(jacobian)}
    elif code == RESULTS.invalid_numbers:
        scene = None if system is None else scene_of(system)
        known = [] if scene is None else invalid_numbers(scene)
        details = (
            {"numbers": known or [f"t0 = {float(t[0]) + 0.0:.6g} s, t1 = {float(t[-1]):.6g} s"]}
            if system is not None
            else {}
        )
    elif (
        code in (RESULTS.newton_failed, RESULTS.integration_failed, RESULTS.singular_configuration)
        and stats is not None
    ):
        details = _of_steps(code, t, stats)
    raise _exception(code, details, () if system is None else names_of_all(system), of_batch)


def _of_steps(code: int, t, stats: Any) -> dict[str, Any]:
    """What statistics say of a step that failed."""
    singular, explicit = code == RESULTS.singular_configuration, code == RESULTS.integration_failed
    at = int(np.argmax(singular_steps(stats.margin)) if singular else np.argmin(stats.converged))
    count, i, run, times = len(t) - 1, at, 0, np.asarray(t)
    if len(stats.converged) > count:  # those of two runs
        run, i = (1, at) if at < count else (2, at - count)
        times = np.linspace(times[0], times[-1], run * count + 1)
    of = {"iterations": "steps"} if explicit else {name: name for name in ("iterations", "increment", "residual")}
    known = {name: np.asarray(getattr(stats, field))[at] for name, field in of.items()}
    return known | {"run": run, "step": i + 1, "num_steps": len(times) - 1, "begin": times[i], "time": times[i + 1]}


def primal_value(array: Any) -> Any:
    while isinstance(array, Tracer) and hasattr(array, "primal"):
        array = array.primal
    return array
