"""The same scheme in plain JAX, by autodiff: three unrolled Newton iterations with a dense solve, in one `lax.scan`.

What lgsens would be without its hand-derived rules. The start and all formulas of the scheme are those of lgsens
(`GeneralizedAlpha`), so Ψ agrees to round-off; no code is shared.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from rival_equations import DIM, constraint, constraint_jacobian, forces, mass_matrix, skew, tangents
from rival_scenes import Numbers, Scene, Topology
from rival_timing import Program, compiled

RHO = 0.9
ALPHA_M, ALPHA_F = (2 * RHO - 1) / (RHO + 1), RHO / (RHO + 1)
GAMMA = 0.5 + ALPHA_F - ALPHA_M
BETA = (GAMMA + 0.5) ** 2 / 4
INERTIA = (1 - ALPHA_M) / (1 - ALPHA_F)
NEWTON = 3
LARGEST = 32  # bodies; the dense matrices of 128 fill a second for each step


class _Motion(NamedTuple):
    x: Any  # (n + 1, 3), the ground last
    r: Any  # (n + 1, 3, 3)
    v: Any  # (6 n,)
    vdot: Any
    a: Any
    lam: Any


def _series(s):
    """(sin θ)/θ, (1 − cos θ)/θ², (θ − sin θ)/θ³ of s = θ², for the fraction of a radian that a step turns."""
    first = 1 + s * (-1 / 6 + s * (1 / 120 + s * (-1 / 5040 + s / 362880)))
    second = 1 / 2 + s * (-1 / 24 + s * (1 / 720 + s * (-1 / 40320 + s / 3628800)))
    third = 1 / 6 + s * (-1 / 120 + s * (1 / 5040 + s * (-1 / 362880 + s / 39916800)))
    return tuple(c[:, None, None] for c in (first, second, third))


def _retract(x, r, step):
    """The poses after the increment `step` (6 n,), and T of each rotation, (n, 3, 3)."""
    moves = step.reshape(-1, DIM)
    wedge = skew(moves[:, 3:])
    square = wedge @ wedge
    first, second, third = _series(jnp.sum(moves[:, 3:] ** 2, axis=1))
    eye = jnp.eye(3)
    turned = r[:-1] @ (eye + first * wedge + second * square)
    x, r = jnp.concatenate([x[:-1] + moves[:, :3], x[-1:]]), jnp.concatenate([turned, r[-1:]])
    return x, r, eye - second * wedge + third * square


def _kkt(mass, jacobian, force, rate):
    m = jacobian.shape[0]
    scale = lax.stop_gradient(jnp.trace(mass) / mass.shape[0])
    matrix = jnp.block([[mass, scale * jacobian.T], [scale * jacobian, jnp.zeros((m, m))]])
    found = jnp.linalg.solve(matrix, jnp.concatenate([force, scale * rate]))
    return found[: mass.shape[0]], scale * found[mass.shape[0] :]


def _rates(x, r, v):
    """ẋ and Ṙ, zero for the ground."""
    twist = jnp.concatenate([v.reshape(-1, DIM), jnp.zeros((1, DIM))])
    return twist[:, :3], r @ skew(twist[:, 3:])


def _accelerations(numbers, topology, x, r, v, t):
    jacobian = lambda x, r: constraint_jacobian(numbers, topology, x, r)
    _, rate = jax.jvp(lambda x, r: jacobian(x, r) @ v, (x, r), _rates(x, r, v))
    return _kkt(mass_matrix(numbers), jacobian(x, r), -forces(numbers, topology, x, r, v, t), -rate)


def _start(numbers: Numbers, topology: Topology, h) -> _Motion:
    """Consistent accelerations and multipliers, and the second-order start of the scheme."""
    n = numbers.mass.shape[0]
    x = jnp.concatenate([numbers.position, jnp.zeros((1, 3))])
    r = jnp.broadcast_to(jnp.eye(3), (n + 1, 3, 3))
    v = jnp.concatenate([numbers.velocity, numbers.spin], axis=1).ravel()
    mass, jacobian = mass_matrix(numbers), constraint_jacobian(numbers, topology, x, r)
    zero = jnp.zeros(jacobian.shape[0])
    v, _ = _kkt(mass, jacobian, mass @ v, zero)
    at = partial(_accelerations, numbers, topology)
    vdot, lam = at(x, r, v, 0.0)
    along = (*_rates(x, r, v), vdot, 1.0)
    _, (jerk, _) = jax.jvp(at, (x, r, v, 0.0), along)
    delta = ALPHA_M - ALPHA_F
    turn = jnp.cross(v.reshape(n, DIM)[:, 3:], vdot.reshape(n, DIM)[:, 3:])
    bracket = jnp.concatenate([jnp.zeros((n, 3)), turn], axis=1).ravel()
    missed = (1 / 6 - BETA - delta / 2) * jerk + bracket / 12
    allowed, _ = _kkt(mass, jacobian, mass @ missed, zero)
    return _Motion(x, r, v + h**2 * (missed - allowed), vdot, vdot + delta * h * jerk, lam)


def _step(numbers: Numbers, topology: Topology, mass, h, old: _Motion, t) -> _Motion:
    k, m = old.v.size, old.lam.size
    scale = lax.stop_gradient(jnp.trace(mass) / k)
    u, lam = old.a, old.lam

    def motion(u, lam):
        step = h * old.v + h**2 * ((0.5 - BETA) * old.a + BETA * u)
        x, r, turning = _retract(old.x, old.r, step)
        v = old.v + h * ((1 - GAMMA) * old.a + GAMMA * u)
        vdot = ((1 - ALPHA_M) * u + ALPHA_M * old.a - ALPHA_F * old.vdot) / (1 - ALPHA_F)
        return _Motion(x, r, v, vdot, u, lam), turning

    for _ in range(NEWTON):
        new, turning = motion(u, lam)
        jacobian = constraint_jacobian(numbers, topology, new.x, new.r)
        residual = mass @ new.vdot + forces(numbers, topology, new.x, new.r, new.v, t) + lam @ jacobian
        violation = constraint(numbers, topology, new.x, new.r) / (BETA * h**2)
        stiffness, damping = tangents(numbers, topology, new.x, new.r, new.v, lam)
        rows = jnp.concatenate([stiffness, jacobian]).reshape(k + m, -1, 2, 3)
        turned = jnp.einsum("rni,nij->rnj", rows[:, :, 1], turning)
        rows = jnp.stack([rows[:, :, 0], turned], axis=2).reshape(k + m, k)
        dynamic = INERTIA * mass + GAMMA * h * damping + BETA * h**2 * rows[:k]
        matrix = jnp.block([[dynamic, scale * jacobian.T], [scale * rows[k:], jnp.zeros((m, m))]])
        change = jnp.linalg.solve(matrix, jnp.concatenate([residual, scale * violation]))
        u, lam = u - change[:k], lam - scale * change[k:]
    return motion(u, lam)[0]


def criterion(scene: Scene, numbers: Numbers):
    """Ψ by the trapezoidal rule."""
    h = scene.t1 / scene.num_steps
    body, quantity, axis = scene.observed
    index = scene.bodies.index(body)
    observe = lambda s: (s.x[index, axis] if quantity == "position" else s.vdot[index * DIM + axis]) ** 2
    mass = mass_matrix(numbers)

    def step(state, n):
        new = _step(numbers, scene.topology, mass, h, state, n * h)
        return new, observe(new)

    first = _start(numbers, scene.topology, h)
    _, values = lax.scan(step, first, jnp.arange(1, scene.num_steps + 1, dtype=first.v.dtype))
    values = jnp.concatenate([observe(first)[None], values])
    return h * (jnp.sum(values) - (values[0] + values[-1]) / 2)


def common_entries(numbers: Numbers) -> Any:
    """Entries of a gradient with respect to all numbers that every program has: masses and rates."""
    rates = numbers.springs[2][:1], numbers.springs[3][1:2], *map(jnp.ravel, numbers.tyre[:1])
    return jnp.concatenate([numbers.mass, *rates])


def programs(scene: Scene) -> list[Program]:
    """Ψ; its gradient by reverse mode for all numbers and for p; by forward mode for two entries."""
    if len(scene.bodies) > LARGEST:
        return []
    p = jnp.asarray(scene.start)
    numbers = jax.jit(scene.numbers)(p)
    psi = partial(criterion, scene)
    psi_of_p = lambda p: psi(scene.numbers(p))
    basis = {"rival": "plain JAX", "num_steps": scene.num_steps, "basis": "equal step"}

    def part(indices):
        index = jnp.asarray(indices)
        return lambda chosen: psi_of_p(p.at[index].set(chosen))

    of_p = jax.value_and_grad(psi_of_p)
    found = [
        compiled(psi_of_p, (p,), kind="forward", program="generalized-alpha, Newton unrolled to 3", **basis),
        compiled(of_p, (p,), kind="gradient, p", program="jax.grad through the loops", **basis),
    ]
    if scene.all_numbers:
        found.append(
            compiled(
                jax.value_and_grad(psi),
                (numbers,),
                kind="gradient, all numbers",
                program="jax.grad through the loops",
                select=common_entries,
                **basis,
            )
        )
    for name, indices in scene.subsets[:1]:
        function = jax.jacfwd(part(indices))
        found.append(
            compiled(
                lambda chosen, function=function: (jnp.nan, function(chosen)),
                (p[jnp.asarray(indices)],),
                kind=f"gradient, {name}",
                program="jax.jacfwd through the loops",
                **basis,
            )
        )
    if scene.batch:
        designs = p * jnp.linspace(1.0, 1.001, scene.batch)[:, None]
        found.append(
            compiled(
                jax.vmap(of_p),
                (designs,),
                kind=f"gradient, p, batch of {scene.batch}",
                program="jax.vmap(jax.value_and_grad)",
                first=True,
                **basis,
            )
        )
    return found
