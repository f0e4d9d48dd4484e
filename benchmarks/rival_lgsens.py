"""lgsens's own programs, by its public interface alone."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from rival_scenes import Scene
from rival_timing import Program, compiled

import lgsens as lg

FEW_STEPS = 6  # extrapolated, a hundred times as accurate on the chains as generalized-α's own 100


def criterion(scene: Scene, model):
    """Ψ."""
    trajectory = lg.simulate(model, t1=scene.t1, num_steps=scene.num_steps, throw=False)
    body, quantity, axis = scene.observed
    observed = getattr(trajectory.body(body), quantity)[:, axis]
    return lg.time_integral(trajectory.t, observed**2)


def extrapolated(scene: Scene, num_steps: int, model):
    """Ψ, extrapolated from so many steps and twice as many."""
    return lg.richardson(lambda n: criterion(scene._replace(num_steps=n), model), num_steps).value


def common_entries(scene: Scene, gradient: lg.Model):
    """Entries of a gradient with respect to all numbers that every program has: masses and rates."""
    rates = []
    if "spring" in gradient.forces:
        forces = gradient.forces
        rates = [forces["spring"].stiffness, forces["damper"].damping, forces["tyre"].stiffness]
    return jnp.stack([*(gradient.bodies[name].mass for name in scene.bodies), *rates])


def _system(scene: Scene):
    """The equations of motion, made of p outside of any compiled program, and what makes of a gradient with respect to
    all of their numbers that with respect to p."""
    system, pull_back = eqx.filter_vjp(lambda p: scene.model(p).system(), jnp.asarray(scene.start))
    return system, lambda gradient: pull_back(gradient)[0]


def reference(scene: Scene) -> tuple[float, list[float]]:
    """Ψ and dΨ/dp of the motion itself: the index-reduced equations, by diffrax's Dopri8 at a tolerance of 1e-12 or in
    the scene's equal steps; of chains, generalized-α extrapolated from those steps and half of them."""
    body, quantity, axis = scene.observed
    if scene.reference_route == "extrapolation":
        assert scene.reference_steps is not None
        system, pull_back = _system(scene)
        of_steps = lambda n: eqx.filter_value_and_grad(partial(criterion, scene._replace(num_steps=n)))
        found = lg.richardson(lambda n: eqx.filter_jit(of_steps(n))(system), scene.reference_steps).value
        return float(found[0]), pull_back(found[1]).tolist()
    if scene.reference_steps is not None:
        psi = lg.Criterion(integrand=lambda s, _: getattr(s.body(body), quantity)[axis] ** 2)
        route = {"num_steps": scene.reference_steps, "integrator": lg.IndexReducedODE(diffrax.Dopri8())}
        of_p = lambda p: psi(lg.simulate(scene.model(p), t1=scene.t1, **route))
        value, gradient = jax.jit(jax.value_and_grad(of_p))(jnp.asarray(scene.start))
        return float(value), gradient.tolist()
    found = lg.differentiate(
        lg.Criterion(integrand=lambda s, p: getattr(s.body(body), quantity)[axis] ** 2),
        scene.model,
        jnp.asarray(scene.start),
        t1=scene.t1,
        num_steps=scene.num_steps,
        method=lg.IndexReduced(breaks=scene.breaks),
    )
    return float(found.value), [float(g) for g in found.gradient]


def _programs_of_system(scene: Scene, basis: dict) -> list[Program]:
    """Ψ and its gradient for p, by the scene's steps and extrapolated from a few."""
    system, pull_back = _system(scene)
    few = partial(extrapolated, scene, FEW_STEPS)
    shorter = {"rival": "lgsens", "num_steps": 3 * FEW_STEPS, "basis": f"{FEW_STEPS} and {2 * FEW_STEPS} steps"}
    found = []
    for function, title, settings in ((partial(criterion, scene), "simulate", basis), (few, "richardson", shorter)):
        gradient, of_gradient = eqx.filter_value_and_grad(function), f"filter_value_and_grad of {title}"
        found += [
            compiled(function, (system,), kind="forward", program=title, **settings),
            compiled(gradient, (system,), kind="gradient, p", program=of_gradient, select=pull_back, **settings),
        ]
    return found


def programs(scene: Scene) -> list[Program]:
    """Ψ; its gradient by reverse mode for all numbers and for p; by forward mode for parts of p."""
    p = jnp.asarray(scene.start)
    psi = partial(criterion, scene)
    psi_of_p = lambda p: psi(scene.model(p))
    basis = {"rival": "lgsens", "num_steps": scene.num_steps, "basis": "equal step"}
    if scene.of_system:
        return _programs_of_system(scene, basis)

    def part(indices):
        index = jnp.asarray(indices)
        return lambda chosen: psi_of_p(p.at[index].set(chosen))

    of_p = jax.value_and_grad(psi_of_p)
    found = [
        compiled(psi_of_p, (p,), kind="forward", program="simulate", **basis),
        compiled(of_p, (p,), kind="gradient, p", program="jax.value_and_grad", **basis),
    ]
    if scene.all_numbers:
        found.append(
            compiled(
                eqx.filter_value_and_grad(psi),
                (eqx.filter_jit(scene.model)(p),),
                kind="gradient, all numbers",
                program="eqx.filter_value_and_grad",
                select=partial(common_entries, scene),
                **basis,
            )
        )
    for name, indices in scene.subsets:
        function = jax.jacfwd(part(indices))
        found.append(
            compiled(
                lambda chosen, function=function: (jnp.nan, function(chosen)),
                (p[jnp.asarray(indices)],),
                kind=f"gradient, {name}",
                program="jax.jacfwd",
                **basis,
            )
        )
    if scene.reduced is not None:
        smaller = lambda p: psi(scene.model(p, **scene.reduced))
        basis["basis"] = "equal step, " + ", ".join(f"{key}={value}" for key, value in scene.reduced.items())
        found += [
            compiled(smaller, (p,), kind="forward", program="simulate", **basis),
            compiled(jax.value_and_grad(smaller), (p,), kind="gradient, p", program="jax.value_and_grad", **basis),
        ]
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
