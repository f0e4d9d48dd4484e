"""diffrax on the index-reduced equations, in plain JAX: Tsit5 and Dopri8 with error control.

State: positions, rotation matrices, velocities and Ψ. Accelerations come from the Schur complement B M⁻¹ Bᵀ (Cholesky)
on the blocks of M. No step is longer than a limit: chosen by the trajectory alone, steps may leave the stability region
of its derivatives. Steps end where a bump does.
"""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from rival_equations import DIM, constraint_jacobian, forces, skew
from rival_scenes import Numbers, Scene
from rival_timing import Program, compiled

LONGEST = {"top": 2e-2, "quarter_car": 5e-3}  # s
SETTINGS = (("Tsit5", diffrax.Tsit5, 1e-5), ("Dopri8", diffrax.Dopri8, 1e-6))
MAX_STEPS = 1024


def version() -> str:
    return diffrax.__version__


def _rates(scene: Scene, t, y, numbers):
    """ẋ, Ṙ, v̇, Ψ̇."""
    (x, r, v, _), (numbers, inverse) = y, numbers
    n = numbers.mass.shape[0]
    poses = jnp.concatenate([x, jnp.zeros((1, 3))]), jnp.concatenate([r, jnp.eye(3)[None]])
    twist = v.reshape(n, DIM)
    turning = r @ skew(twist[:, 3:])
    still = jnp.concatenate([twist[:, :3], jnp.zeros((1, 3))]), jnp.concatenate([turning, jnp.zeros((1, 3, 3))])
    jacobian_at = partial(constraint_jacobian, numbers, scene.topology)
    jacobian, change = jax.jvp(jacobian_at, poses, still)

    def unweighted(w):
        """M⁻¹ on rows of (…, 6 n)."""
        parts = w.reshape(*w.shape[:-1], n, 2, 3)
        moved = parts[..., 0, :] / numbers.mass[:, None]
        turned = jnp.einsum("nij,...nj->...ni", inverse, parts[..., 1, :])
        return jnp.stack([moved, turned], axis=-2).reshape(w.shape)

    free = -unweighted(forces(numbers, scene.topology, *poses, v, t))
    light = unweighted(jacobian)
    lam = cho_solve(cho_factor(light @ jacobian.T), jacobian @ free + change @ v)
    vdot = free - lam @ light
    body, quantity, axis = scene.observed
    index = scene.bodies.index(body)
    observed = x[index, axis] if quantity == "position" else vdot[index * DIM + axis]
    return twist[:, :3], turning, vdot, observed**2


def controller(scene: Scene, tolerance: float, longest: float):
    """Error control with steps no longer than a limit [s], which end where forces are not smooth."""
    limited = diffrax.PIDController(tolerance, tolerance, dtmax=longest)
    return diffrax.ClipStepSizeController(limited, jump_ts=jnp.asarray(scene.breaks) if scene.breaks else None)


def criterion(scene: Scene, solver, control, adjoint, numbers: Numbers, dt0=None, max_steps: int = MAX_STEPS):
    """Ψ, and the number of steps."""
    n = numbers.mass.shape[0]
    v = jnp.concatenate([numbers.velocity, numbers.spin], axis=1).ravel()
    y = (numbers.position, jnp.broadcast_to(jnp.eye(3), (n, 3, 3)), v, jnp.zeros(()))
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(partial(_rates, scene)),
        solver(),
        *(0.0, scene.t1, dt0, y),
        args=(numbers, jnp.linalg.inv(numbers.inertia)),
        stepsize_controller=control,
        adjoint=adjoint,
        max_steps=max_steps,
    )
    return solution.ys[3][0], solution.stats["num_steps"]


def programs(scene: Scene) -> list[Program]:
    """Ψ by both; by Tsit5 its gradient in reverse mode (recursive checkpoints) and in forward mode."""
    if scene.name not in LONGEST:
        return []
    p = jnp.asarray(scene.start)
    found = []
    for name, solver, tolerance in SETTINGS:
        control = controller(scene, tolerance, LONGEST[scene.name])
        reverse = partial(criterion, scene, solver, control, diffrax.RecursiveCheckpointAdjoint())
        forward = partial(criterion, scene, solver, control, diffrax.ForwardMode())
        title = f"{name}, tolerance {tolerance:.0e}"
        of_p = lambda p, psi=reverse: psi(scene.numbers(p))[0]
        with_steps = lambda p, psi=forward: psi(scene.numbers(p))
        of_p_forward = lambda p, with_steps=with_steps: with_steps(p)[0]
        members = {"rival": "diffrax", "num_steps": 0, "basis": "equal accuracy"}
        own = compiled(with_steps, (p,), kind="forward", program=title, **members)
        own.show = lambda found: (float(found[0]), None)
        own.prepare(own)  # it says how many steps there are
        own.prepare, own.num_steps = None, int(own.call()[1])
        members["num_steps"] = own.num_steps
        found.append(own)
        if name != "Tsit5":
            continue
        found.append(
            compiled(jax.value_and_grad(of_p), (p,), kind="gradient, p", program=f"{title}, reverse", **members)
        )
        for subset, indices in scene.subsets[-1:]:
            index = jnp.asarray(indices)
            part = lambda chosen, index=index, psi=of_p_forward: psi(p.at[index].set(chosen))
            found.append(
                compiled(
                    lambda chosen, part=part: (jnp.nan, jax.jacfwd(part)(chosen)),
                    (p[index],),
                    kind=f"gradient, {subset}",
                    program=f"{title}, forward",
                    **members,
                )
            )
    return found
