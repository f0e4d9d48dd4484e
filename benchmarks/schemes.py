"""Work against precision of every scheme: Ψ and its gradient on a smooth scene, a stiff and a flexible one.

    python benchmarks/schemes.py [--scenes heavy_top …] [--repeats 7] [--cache FOLDER] [--out benchmarks/results]
    python benchmarks/schemes.py --table     # table and plots again, from schemes.json; measures nothing

heavy_top: that of the literature, 150 rad/s, over 0.5 s; Ψ is the integral of a squared coordinate of its centre, the
gradient by mass, length and spin. stiff_pair: a pendulum on a hinge and a body that a bushing of 1e7 N/m holds at its
end, 3e3 rad/s beside 3 rad/s, over 0.5 s; Ψ alike, the gradient by the masses and the bushing's stiffness, all
relative. flexible_arm: a steel tube of 1 m as a beam of 8 elements, 1e5 rad/s, with 1 kg at its tip, that a motor turns
by 1 rad in 0.25 s, over 0.5 s; Ψ is the integral of the squared height of the tip, the gradient by diameter, Young's
modulus and density, relative. Each scheme runs in several numbers of steps or with several tolerances, under error
control with room for the steps that it takes; its errors are relative, that of the gradient to its largest component,
against an explicit scheme of order 8 in small steps; of flexible_arm against Radau IIA in 1600 steps, whose own are
told by Richardson's pair of 3200 and 6400 (`reference_error`). All programs of a scene take turns on one thread,
`--repeats` rounds; medians count, compilation apart. Writes schemes.json and work_precision_*.png, and prints the
fastest setting for each error.
"""

import json
import os
import statistics
import time
from collections.abc import Iterator
from typing import Any

from benchmark import SINGLE_THREAD, environment, interleaved, options, write

SCENES = ("heavy_top", "stiff_pair", "flexible_arm")
LEVELS = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
T1 = 0.5
# equal steps, by scene
ALPHA = {"heavy_top": (100, 300, 1000, 3000), "stiff_pair": (50, 200, 1000), "flexible_arm": (400, 1600, 6400)}
RICHARDSON = {"heavy_top": (100, 300, 1000), "stiff_pair": (50, 200), "flexible_arm": (400, 1600)}
RADAU = {"heavy_top": (30, 50, 80, 150, 300), "stiff_pair": (10, 25, 60, 150), "flexible_arm": (25, 50, 100, 200)}
EXPLICIT = {"heavy_top": (40, 80, 160), "stiff_pair": (1500, 3000), "flexible_arm": ()}
# under error control
ALPHA_TOLERANCES = (1e-4, 1e-5, 1e-6)
RADAU_TOLERANCES = {
    "heavy_top": (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9),
    "stiff_pair": (1e-3, 1e-5, 1e-7, 1e-9),
    "flexible_arm": (1e-4, 1e-5, 1e-6, 1e-7),
}
REFERENCE = {"heavy_top": 2000, "stiff_pair": 5000, "flexible_arm": 1600}
CHECK = {"flexible_arm": 3200}


def pair(p):
    """Two bodies; p scales the mass of each, and the bushing's stiffness."""
    import lgsens as lg

    arm = lg.RigidBody(mass=p[0], inertia=(0.01, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    end = lg.RigidBody(mass=p[1], inertia=(0.01, 0.01, 0.01), position=(1.0, 0.0, 0.1))
    bushing = lg.Bushing(
        "arm",
        "end",
        at=(1.0, 0.0, 0.0),
        stiffness=p[2] * 1e7 * _ones(p),
        damping=(5e3, 5e3, 5e3),
        rotational_stiffness=(1e5, 1e5, 1e5),
        rotational_damping=(50.0, 50.0, 50.0),
    )
    hinge = lg.RevoluteJoint(None, "arm", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return lg.Model(
        {"arm": arm, "end": end}, {"hinge": hinge}, {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "bushing": bushing}
    )


def flexible_arm(p):
    """A beam on a hinge, and a driver that turns it; p scales diameter, Young's modulus and density."""
    import lgsens as lg

    steel = {"young": 2.1e11 * p[1], "poisson": 0.3, "density": 7850.0 * p[2], "damping": 1e-4}
    section = lg.BeamSection.tube(0.03 * p[0], 0.003, **steel)
    beam = lg.Beam("arm", section, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], elements=8)
    turn = {"axis": (0.0, 1.0, 0.0)}
    joints = {
        "hinge": lg.RevoluteJoint(None, "arm.0", at=(0.0, 0.0, 0.0), **turn),
        "motor": lg.RotationDriver(None, "arm.0", value=lg.Ramp(end=-1.0, duration=0.25), **turn),
        "grip": lg.SphericalJoint("arm.8", "load", at=(1.0, 0.0, 0.0)),
    }
    load = {"load": lg.RigidBody(1.0, None, position=(1.0, 0.0, 0.0))}
    return lg.Model(beam.bodies | load, joints, beam.forces | {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


def _ones(p):
    import jax.numpy as jnp

    return jnp.ones(3, p.dtype)


def scene(name: str):
    """The model by relative parameters, and Ψ."""
    import lgsens as lg
    from lgsens.examples import heavy_top

    body, axis = {"heavy_top": ("top", 0), "stiff_pair": ("end", 2), "flexible_arm": ("load", 2)}[name]
    top = lambda p: heavy_top(m=15.0 * p[0], l=p[1], Om2=150.0 * p[2])
    build = {"heavy_top": top, "stiff_pair": pair, "flexible_arm": flexible_arm}[name]
    return build, lg.Criterion(integrand=lambda s, p: s.body(body).position[axis] ** 2)


def settings(name: str) -> Iterator[tuple[str, str, Any, int]]:
    """Family, title, integrator and number of steps; of those under error control, the largest number."""
    import diffrax

    import lgsens as lg

    alpha, stabilized, radau = lg.GeneralizedAlpha(0.9), lg.GeneralizedAlpha(0.9, stabilized=True), lg.RadauIIA()
    equal = {
        "generalized-α": (alpha, ALPHA),
        "generalized-α, ρ∞ = 0.6": (lg.GeneralizedAlpha(0.6), ALPHA),
        "generalized-α, stabilized": (stabilized, ALPHA),
        "Richardson": (lg.Richardson(alpha), RICHARDSON),
        "Radau IIA": (radau, RADAU),
        "index-reduced, Dopri8": (lg.IndexReducedODE(diffrax.Dopri8()), EXPLICIT),
    }
    for family, (integrator, counts) in equal.items():
        for n in counts[name]:
            yield family, "equal steps", integrator, n
    for tolerance in ALPHA_TOLERANCES:
        integrator = lg.AdaptiveSteps(alpha, tolerance=tolerance)
        yield "generalized-α, adaptive", f"tolerance {tolerance:.0e}", integrator, 3000
    for tolerance in RADAU_TOLERANCES[name]:
        integrator = lg.AdaptiveSteps(radau, tolerance=tolerance, longest=1.0)
        yield "Radau IIA, adaptive", f"tolerance {tolerance:.0e}", integrator, 500


def program(name: str, integrator: Any, num_steps: int):
    """Value and gradient, whether the run succeeded, and the sizes of its steps; and the seconds that it compiles."""
    import jax
    import jax.numpy as jnp

    import lgsens as lg

    build, criterion = scene(name)

    def evaluate(p):
        run = lg.simulate(build(p), t1=T1, num_steps=num_steps, integrator=integrator, throw=False)
        return criterion(run), (run.result == lg.RESULTS.successful, jnp.diff(run.t))

    started, p = time.perf_counter(), jnp.ones(3)
    made = jax.jit(jax.value_and_grad(evaluate, has_aux=True)).lower(p).compile()
    return (lambda: jax.block_until_ready(made(p))), time.perf_counter() - started


def with_room(name: str, integrator: Any, num_steps: int) -> int:
    """The steps that error control takes, and a few."""
    import jax.numpy as jnp
    import numpy as np

    import lgsens as lg

    if integrator.equal_steps:
        return num_steps
    run = lg.simulate(scene(name)[0](jnp.ones(3)), t1=T1, num_steps=num_steps, integrator=integrator, throw=False)
    return int(np.sum(np.diff(run.t) > 0.0)) + 4


def measure(name: str, repeats: int) -> dict[str, Any]:
    import diffrax
    import jax
    import numpy as np

    import lgsens as lg

    def slopes_by(integrator, num_steps):
        (value, _), gradient = program(name, integrator, num_steps)[0]()
        return float(value), np.asarray(gradient)

    def off(value, gradient):
        return abs(value / exact - 1.0), float(np.abs(gradient - slopes).max() / np.abs(slopes).max())

    reference = lg.IndexReducedODE(diffrax.Dopri8()) if EXPLICIT[name] else lg.RadauIIA()
    exact, slopes = slopes_by(reference, REFERENCE[name])
    checked = off(*slopes_by(lg.Richardson(lg.GeneralizedAlpha(0.9)), CHECK[name])) if name in CHECK else None
    records, calls = [], {}
    for family, title, integrator, most in settings(name):
        call, compiled = program(name, integrator, with_room(name, integrator, most))
        (value, (successful, sizes)), gradient = call()
        record = {
            "rival": f"lgsens, {family}",
            "program": title,
            "num_steps": int(np.sum(sizes > 0.0)),
            "build_seconds": compiled,
        }
        record["value_error"], record["gradient_error"] = off(float(value), np.asarray(gradient))
        print(f"{family}, {title}: {record['num_steps']} steps, {record['gradient_error']:.1e}", flush=True)
        if successful and np.isfinite(record["gradient_error"]):
            calls[len(records)] = call
            records.append(record)
        jax.clear_caches()  # a process has only so many memory maps
    for record, times in zip(records, interleaved(calls, repeats).values()):
        record |= {"seconds": statistics.median(times.wall), "cpu_seconds": statistics.median(times.cpu)}
    found = {
        "levels": LEVELS,
        "parameters": len(slopes),
        "repeats": repeats,
        "value": exact,
        "gradient": slopes.tolist(),
        "reference_error": checked,
    }
    return found | {"programs": records, "environment": environment(SINGLE_THREAD)}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--cache", help="folder for compiled programs (default: none)")
    parser.add_argument("--table", action="store_true", help="print the table, draw the plots, measure nothing")
    given = parser.parse_args()
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    import jax
    import precision_tables

    jax.config.update("jax_enable_x64", True)
    if given.cache:
        jax.config.update("jax_compilation_cache_dir", given.cache)
    path = given.out / "schemes.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"scenes": {}}
    for name in () if given.table else given.scenes:
        document["scenes"][name] = measure(name, given.repeats)
        write(path, document)
    print(precision_tables.markdown(document))
    for name, found in document["scenes"].items():
        precision_tables.plot(found, given.out / f"work_precision_{name}.png")


if __name__ == "__main__":
    main()
