"""`linearize`: small motions about an equilibrium or a steady motion, their modes and frequency responses."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Complex, Float, Int

from lgsens._brief import brief, listed, roster, shown
from lgsens._validate import as_count, as_float
from lgsens.analysis._eigen import eigen, near, scaled
from lgsens.analysis._inputs import check_inputs, with_inputs
from lgsens.analysis._second_order import Bases, StateSpace, state_space
from lgsens.analysis._steady import accelerates_steadily, later, turning_axes
from lgsens.dynamics import (
    RESULTS,
    AbstractSystem,
    State,
    accelerations,
    constraint_jacobian,
    equilibrium,
    finite,
    full_jacobian,
    is_redundant,
    names_of_all,
    require_independent,
    require_linear,
)
from lgsens.liegroups import unskew
from lgsens.model import Model
from lgsens.simulation import Instant, Trajectory, as_system, check_state0, on_joints, throw_if_failed

Output = Callable[[Instant], Float[Array, ""]]


class ModeShape(NamedTuple):
    """The displacement of a body in each mode, a column of complex amplitudes per mode, n of them.

    Attributes:
        translation: of the centre of mass [m], inertial frame, shape (n, 3).
        rotation: rotation vector [rad], inertial frame, shape (n, 3).
    """

    translation: Complex[Array, "n 3"]
    rotation: Complex[Array, "n 3"]

    __repr__ = brief


class Linearization(eqx.Module):
    """Small motions δy = [x; ν] about a state, of inputs u and outputs δf, from `linearize`.

        ẏ = A y + B u,     δf = C y + D u + D_1 u̇ + D_2 ü

    x are coordinates of the displacement, w = `basis` x with kinetic energy |ẋ|²/2, ν = ẋ, each but for a multiple of
    u, the states of elements last. Where wheels roll (`Rolling`), ν are fewer: coordinates of the velocities that these
    allow. What nothing depends on, where a bicycle is, where it heads and how its wheels are turned, is λ = 0.

    Attributes:
        A, B, C, D: the matrices, shapes (n, n), (n, p), (o, n), (o, p).
        D1, D2: what outputs see of rate and acceleration of the inputs, shape (o, p) each: zero but where a driver
            moves, or a controller differentiates its reference.
        basis: Z, shape (k, f): Lie-algebra coordinates of the displacement for each entry of x.
        eigenvalues: λ of A [1/s], shape (n,), by size, of conjugates that with Im λ > 0 first.
        vectors: eigenvectors of A by columns, shape (n, n), the part x of each with |x| = 1 and its largest entry real.
        repeated: whether an eigenvalue coincides with another one, to 2e-7 of the largest, shape (n,). Its derivative
            is that of their mean, and those of `vectors` leave out what turns them into each other. Beside a pair that
            shares one vector (a wheel that turns freely) derivatives of the others are good to some √ε = 1e-8 … 1e-7.
        state: where the motion is linearized.
        t: the time there [s], shape ().
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        system: the equations of motion.
        inputs, outputs: their names.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n p"]
    C: Float[Array, "o n"]
    D: Float[Array, "o p"]
    D1: Float[Array, "o p"]
    D2: Float[Array, "o p"]
    basis: Float[Array, "k f"]
    eigenvalues: Complex[Array, " n"]
    vectors: Complex[Array, "n n"]
    repeated: Bool[Array, " n"]
    state: State
    t: Float[Array, ""]
    result: Int[Array, ""]
    system: AbstractSystem
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        sizes = {name: shown(getattr(self, name)) for name in ("A", "B", "C", "D", "eigenvalues")}
        names = {"inputs": roster(self.inputs), "outputs": roster(self.outputs)}
        return listed("Linearization", {"t": f"{shown(self.t)} s", "result": shown(self.result)} | sizes | names)

    @property
    def frequencies(self) -> Float[Array, " n"]:
        """Damped frequencies |Im λ|/2π [Hz], shape (n,)."""
        return jnp.abs(jnp.imag(self.eigenvalues)) / (2.0 * jnp.pi)

    @property
    def damping_ratios(self) -> Float[Array, " n"]:
        """ζ = −Re λ/|λ| [–], shape (n,); 0 where λ = 0."""
        still = self.eigenvalues == 0.0
        return jnp.where(still, 0.0, -jnp.real(self.eigenvalues) / jnp.abs(jnp.where(still, 1.0, self.eigenvalues)))

    def mode_shape(self, body: str) -> ModeShape:
        """How the body `name` moves in each mode; the column of the eigenvalue of the same place.

        For w = Re(`basis` x e^{λt}); kinetic energy as `vectors` say. Raises `ValueError` for an unknown name.
        """
        state = self.state
        zero = jnp.zeros_like(state.v)

        def pose(w):
            moved = eqx.tree_at(lambda state: state.q, state, self.system.group.retract(state.q, w))
            motion = Instant(t=self.t, state=moved, system=self.system).body(body)
            return motion.position, motion.orientation

        _, orientation = pose(zero)
        moves, turns = jax.vmap(lambda w: jax.jvp(pose, (zero,), (w,))[1], in_axes=1)(self.basis)
        turned = jax.vmap(lambda change: unskew(change @ orientation.T))(turns)
        x = self.vectors[: self.basis.shape[1]].T
        return ModeShape(x @ moves.astype(x.dtype), x @ turned.astype(x.dtype))

    def mode_motion(self, index: int, *, amplitude=0.1, num_steps: int = 48) -> Trajectory:
        """One period of a mode as a motion, to be animated (`plotting.animate`) or looked at.

            q exp(w̃),   w = Re(`basis` x e^{iωt}) s,   ω = |Im λ|, or |λ| of a mode that does not oscillate

        Arguments:
            index: the place of the eigenvalue, a Python int.
            amplitude: the largest displacement, in rad or lengths of the scene, shape (); it sets s.
            num_steps: of the period, a Python int.

        Returns a `Trajectory` about `state`, undamped, from t = 0 to 2π/ω [s] (1 s where λ = 0), velocities and
        accelerations those of w, multipliers those of `state`. To first order: joints give way by the square of the
        amplitude. Raises `ValueError` for another index.
        """
        count = self.eigenvalues.shape[0]
        if isinstance(index, bool) or not isinstance(index, int) or not -count <= index < count:
            raise ValueError(f"`index` must be a Python int, the place of one of {count} eigenvalues, got {index!r}.")
        num_steps = as_count(num_steps, "num_steps")
        system, state, lam = self.system, self.state, self.eigenvalues[index]
        oscillates = jnp.abs(jnp.imag(lam)) > 1e-6 * jnp.abs(lam)
        size = jnp.where(oscillates, jnp.abs(jnp.imag(lam)), jnp.abs(lam))
        omega = jnp.where(size > 0.0, size, 2.0 * jnp.pi)
        shape = self.basis.astype(lam.dtype) @ self.vectors[: self.basis.shape[1], index]
        largest = jnp.max(jnp.abs(shape) / system.coordinate_scale())
        factor = as_float(amplitude, (), "`amplitude`") / jnp.where(largest > 0.0, largest, 1.0)
        along, across = factor * jnp.real(shape), factor * jnp.imag(shape)

        def at(phase):
            w = jnp.cos(phase) * along - jnp.sin(phase) * across
            rate = -omega * (jnp.sin(phase) * along + jnp.cos(phase) * across)
            vdot = -(omega**2) * w
            return State(system.group.retract(state.q, w), rate, vdot, state.lam, vdot)

        phases = jnp.linspace(0.0, 2.0 * jnp.pi, num_steps + 1, dtype=omega.dtype)
        states = jax.vmap(at)(phases)
        return Trajectory(t=phases / omega, states=states, result=self.result, stats=None, system=system)

    def frequency_response(self, frequency) -> Complex[Array, "*n o p"]:
        """H(iω) = C (iω − A)⁻¹ B + D + iω D_1 − ω² D_2 at ω = 2π `frequency` [Hz], shape (…) → (…, o, p)."""
        frequency = as_float(frequency, None, "`frequency`")

        def response(f):
            s = 2j * jnp.pi * f.astype(self.eigenvalues.dtype)
            a, b, c, *d = (of.astype(s.dtype) for of in (self.A, self.B, self.C, self.D, self.D1, self.D2))
            y = jnp.linalg.solve(s * jnp.eye(a.shape[0], dtype=s.dtype) - a, b)
            return c @ y + d[0] + s * (d[1] + s * d[2])

        found = jax.vmap(response)(frequency.reshape(-1))
        return found.reshape(*frequency.shape, *found.shape[1:])


def linearize(
    model: Model | AbstractSystem,
    state: State | None = None,
    *,
    inputs: Sequence[str] = (),
    outputs: Mapping[str, Output] | None = None,
    rotation=None,
    t0=0.0,
    throw: bool = True,
) -> Linearization:
    """The linear equations of small motions about an equilibrium or a steady motion, on independent coordinates.

        M_r ẍ + C_r ẋ + K_r x + F_0 u + F_1 u̇ = 0,     w = Z x + S u,  J Z = 0,  Zᵀ M Z = I

    Arguments:
        model: the scene, or an `AbstractSystem`. Without redundant equations (`Model(redundant="remove")`).
        state: q and v of a steady motion, `initial_state(model)` say; v̇ and λ are those of the motion through it. None:
            the `equilibrium` near the reference configuration.
        inputs: names of joints and forces with a signal or a prescribed number: the displacement or angle of a driver,
            the road of a tyre, the factor of an `AppliedForce`, the command of an `Actuator`, the reference of a
            controller. u is what they have beside their own value, in the unit of that.
        outputs: functions of an `Instant` by name, `{"heave": lambda s: s.body("chassis").position[2]}`, each a scalar.
        rotation: for a `state` that moves, the angular velocity of axes in which it is steady [rad/s], inertial frame,
            shape (3,); bodies may turn about axes of their own besides. None: 0, a rotor of revolution on its bearings;
            that of the precession for a top, of the shaft for one that is not round.
        t0: the time at which time-dependent forces are taken and drivers are held [s], shape ().
        throw: raise if there is no equilibrium, or the motion is not steady.

    Returns a `Linearization`, differentiable by every number of the model: matrices, eigenvalues, mode shapes,
    frequency responses. The matrices depend on Z, which is a smooth function of the numbers. Eigenvalues are computed
    on a CPU only. Raises `ValueError` for names of inputs or outputs that do not fit, redundant constraints, a
    mechanism without freedom, a state off its joints, a motion that is not steady, and outputs that are not;
    `SimulationError` where no equilibrium is found; inside `jit` the numbers are NaN. Sources: `_second_order`,
    `_steady`.
    """
    system, t0 = as_system(model), as_float(t0, (), "`t0`")
    check_inputs(model, inputs)
    inputs, outputs = tuple(inputs), dict(outputs or {})
    for name, function in outputs.items():
        if not callable(function):
            raise ValueError(f"`outputs[{name!r}]` must be a function of an instant, got {function!r}.")
    require_independent(system, "`linearize`")
    rows = len(system.constraint_names) - system.num_velocity_rows
    if system.group.dim - system.num_states <= rows:
        raise ValueError(
            f"`model`: its joints have {rows} equations for "
            f"{system.group.dim - system.num_states} coordinates and leave no freedom, unless some of them repeat "
            "others: `constraint_rank` tells, and Model(…, redundant='remove') leaves these out."
        )
    if state is not None:
        require_linear(system, "`linearize` of a motion")
        check_state0(system, state, t0, "state", exactly=True)
    if rotation is not None and state is None:
        raise ValueError("`rotation` is that of a motion; give its `state` as well, `initial_state(model)` say.")
    rotation = as_float(jnp.zeros(3) if rotation is None else rotation, (3,), "`rotation`")
    found, details = _linearize_jit(model, state, t0, rotation, inputs, tuple(outputs.items()))
    if not throw:
        return found
    details |= {} if isinstance(found.result, Tracer) else {"outputs": list(outputs)}
    return throw_if_failed(found, found.result, details, names_of_all(system))


@eqx.filter_jit
def _linearize_jit(model, given: State | None, t0, rotation, names: tuple[str, ...], outputs: Any):
    system = as_system(model)

    def built(inputs) -> AbstractSystem:
        return as_system(with_inputs(model, names, inputs, t0)) if names else system

    def measured(system: AbstractSystem, state: State) -> Float[Array, " o"]:
        instant = Instant(t=t0, state=state, system=system)
        return jnp.stack([*(_scalar(name, f(instant), t0) for name, f in outputs), t0])[:-1]

    at = lambda state, turning, bases: state_space(built, measured, len(names), state, t0, turning, bases)
    details: dict[str, Any] = {}
    if given is None:
        initial = equilibrium(system, t0)
        state, result, details = initial.state, initial.result, {"violation": initial.violation}
        jacobian = full_jacobian(system, state.q, t0)
        bases = Bases.of(system, jacobian)
        space = at(state, None, bases)
        steady, changing = accelerates_steadily(system, state, None, space.A), jnp.zeros(len(outputs), bool)
    else:
        turning = turning_axes(system, given, rotation)
        q, v, turn = later(system, given, rotation, turning)
        twice = lambda now, then: jax.tree.map(lambda *leaves: jnp.stack(leaves), now, then)
        jacobian = full_jacobian(system, given.q, t0)
        (q, v), bases = twice((given.q, given.v), (q, v)), Bases.of(system, jacobian)
        vdot, lam = jax.vmap(lambda q, v: accelerations(system, q, v, t0))(q, v)
        states = State(q=q, v=v, vdot=vdot, lam=lam, a=vdot)
        turned = jax.tree.map(lambda basis: turn @ basis, bases)
        spaces = jax.vmap(lambda state, bases: at(state, turning, bases))(states, twice(bases, turned))
        (state, space), (_, again) = (jax.tree.map(lambda leaf, i=i: leaf[i], (states, spaces)) for i in (0, 1))
        result = jnp.where(on_joints(system, given, t0), RESULTS.successful, RESULTS.off_joints)
        result = jnp.where(system.is_valid() & finite(state), result, RESULTS.invalid_numbers)
        alike = _alike(space, again)
        steady = accelerates_steadily(system, state, turning, space.A) & alike.A & alike.B
        changing = ~(alike.C & alike.D & alike.D1 & alike.D2)
    redundant = is_redundant(system, constraint_jacobian(system, state.q, t0))
    unsteady = jnp.where(steady, RESULTS.outputs_not_steady, RESULTS.not_steady)
    result = jnp.where((result == RESULTS.successful) & ~(steady & ~jnp.any(changing)), unsteady, result)
    result = jnp.where(redundant, RESULTS.redundant_constraints, result).astype(jnp.int32)
    usable = result == RESULTS.successful
    # LAPACK does not like NaN, and a failure is said all the same.
    values, vectors = eigen(jnp.where(usable, space.A, jnp.eye(space.A.shape[0], dtype=space.A.dtype)))
    found = Linearization(
        *space,
        basis=bases.position,
        eigenvalues=values,
        vectors=scaled(vectors, vectors[: bases.position.shape[1]]),
        repeated=jnp.sum(near(values), axis=1) > 1,
        state=state,
        t=t0,
        result=result,
        system=system,
        inputs=names,
        outputs=tuple(name for name, _ in outputs),
    )
    return found, jax.lax.stop_gradient(details | {"jacobian": jacobian, "changing": changing})


def _scalar(name: str, value: Any, t0) -> Float[Array, ""]:
    if jnp.shape(value) != ():
        raise ValueError(
            f"`outputs[{name!r}]` must return a scalar, got shape {jnp.shape(value)}; make one of each entry."
        )
    return jnp.asarray(value, t0.dtype)


def _alike(space: StateSpace, again: StateSpace) -> StateSpace:
    """Whether two sets of matrices are the same, each to 1e-6 of its largest number: A and B, and rows of outputs."""
    enough = jnp.finfo(space.A.dtype).eps ** 0.375
    off = lambda a, b: jnp.max(jnp.abs(a - b), axis=1, initial=0.0) > enough * (1.0 + jnp.max(jnp.abs(a), initial=0.0))
    rows = StateSpace(*(~off(a, b) for a, b in zip(space, again)))
    return rows._replace(A=jnp.all(rows.A), B=jnp.all(rows.B))
