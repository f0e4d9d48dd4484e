"""What the compilation of a gradient is made of, beside that of a pendulum in diffrax.

    taskset -c 0 python benchmarks/compile_profile.py [--repeats 5] [--scenes top arm …] [--out benchmarks/results]

The gradient of a criterion of 500 steps by a few numbers of a scene: processor time to trace (Python), to lower
(Python too) and to compile (XLA), in a process of its own, without a cache; medians of at least 5 processes. The ratio
is that to the gradient of a pendulum with diffrax's Tsit5, compiled before it in the same process. Kernels are the
operations of the compiled program: outside of loops (the scene with its pull-back, the start and its derivative), and
in each outermost loop with those inside of it (the steps; the sweep back; small ones). Writes compile_profile.json.
"""

import json
import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

from benchmark import SINGLE_THREAD, circumstances, environment, grid, options, write

FREE = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "call", "conditional"}
RUN = {"t1": 1.0, "num_steps": 500}


def pendulum(p):
    import diffrax
    import jax.numpy as jnp

    term = diffrax.ODETerm(lambda t, y, a: jnp.array([y[1], -a * jnp.sin(y[0])]))
    save = diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 50))
    found = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, 1.0, 0.01, jnp.array([1.0, 0.0]), args=p[0], saveat=save)
    return jnp.sum(found.ys**2)


def top(p):
    import lgsens as lg
    from lgsens.examples import spinning_top

    run = lg.simulate(spinning_top(p[0], mass=p[1]), **RUN)
    return lg.time_integral(run.t, run.body("top").position[:, 0] ** 2)


def arm(p):
    """Two links on hinges, a spring-damper to the second one."""
    import lgsens as lg

    link = lambda mass, x: lg.RigidBody(mass, (0.01, 0.1, 0.1), position=(x, 0, 0))
    joints = {
        "shoulder": lg.RevoluteJoint(None, "upper", at=(0, 0, 0), axis=(0, 1, 0)),
        "elbow": lg.RevoluteJoint("upper", "lower", at=(1, 0, 0), axis=(0, 1, 0)),
    }
    spring = lg.SpringDamper(None, "lower", at_a=(1, 0, 1), at_b=(1.5, 0, 0), stiffness=p[2], damping=p[3])
    forces = {"gravity": lg.Gravity((0, 0, -9.81)), "spring": spring}
    run = lg.simulate(lg.Model({"upper": link(p[0], 0.5), "lower": link(p[1], 1.5)}, joints, forces), **RUN)
    return lg.time_integral(run.t, run.body("lower").position[:, 2] ** 2)


def double_wishbone(p):
    """A chassis that heaves, two wishbones, upright, tie rod, spring-damper, tyre; p: three hardpoints, flat."""
    import jax.numpy as jnp

    import lgsens as lg

    (outer_l, outer_u, tie), v = p.reshape(3, 3), jnp.array
    inner_l, inner_u, contact = v([0.0, -0.35, 0.20]), v([0.0, -0.42, 0.48]), v([0.0, -0.76, 0.31])
    bodies = {
        "chassis": lg.RigidBody(350.0, (30.0, 30.0, 30.0), position=(0, -0.2, 0.5), free="z"),
        "lower": lg.RigidBody(5.0, (0.08, 0.08, 0.12), position=(inner_l + outer_l) / 2),
        "upper": lg.RigidBody(3.0, (0.04, 0.04, 0.06), position=(inner_u + outer_u) / 2),
        "upright": lg.RigidBody(35.0, (0.8, 1.1, 0.8), position=contact),
    }
    joints = {
        "lower_in": lg.RevoluteJoint("chassis", "lower", at=inner_l, axis=(1, 0, 0)),
        "upper_in": lg.RevoluteJoint("chassis", "upper", at=inner_u, axis=(1, 0, 0)),
        "lower_out": lg.SphericalJoint("lower", "upright", at=outer_l),
        "upper_out": lg.SphericalJoint("upper", "upright", at=outer_u),
        "tie": lg.DistanceJoint("chassis", "upright", at_a=(-0.14, -0.38, 0.26), at_b=tie),
    }
    top, bottom = (0, -0.46, 0.60), (0, -0.58, 0.20)
    road = lg.BumpRoad(height=0.04, duration=0.15, start=0.05)
    forces = {
        "gravity": lg.Gravity((0, 0, -9.81)),
        "spring": lg.SpringDamper("chassis", "lower", at_a=top, at_b=bottom, stiffness=30e3, damping=2500.0),
        "tyre": lg.TyreSpring("upright", at=contact, stiffness=220e3, road=road),
    }
    model, _ = lg.static_preload(lg.Model(bodies, joints, forces), ["spring", "tyre"])
    run = lg.simulate(model, **RUN)
    return lg.time_integral(run.t, run.body("chassis").acceleration[:, 2] ** 2)


def quarter_car(p):
    import equinox as eqx

    import lgsens as lg

    car = eqx.tree_at(lambda c: (c.spring.rate, c.damper.rate), lg.examples.QuarterCar.load(), tuple(p))
    run = lg.simulate(car.model(wheel="locked"), **RUN)
    return lg.time_integral(run.t, run.body("chassis").acceleration[:, 2] ** 2)


HARDPOINTS = (0.0, -0.72, 0.18, -0.02, -0.68, 0.50, -0.13, -0.70, 0.25)
SCENES: dict[str, tuple[Callable, tuple[float, ...]]] = {
    "top": (top, (0.7, 15.0)),
    "arm": (arm, (1.0, 1.0, 10.0, 1.0)),
    "double_wishbone": (double_wishbone, HARDPOINTS),
    "quarter_car": (quarter_car, (109000.0, 4900.0)),
}


def kernels(program: str) -> tuple[int, list[int]]:
    """Operations of a compiled program, as HLO: outside of loops, and in each outermost loop, the largest first."""
    operation = re.compile(r"^\s+(?:ROOT )?%?[\w.\-]+ = .*? ([a-z][a-z\-]*)\(")
    called = re.compile(r"(?:body|condition|to_apply|true_computation|false_computation)=%?([\w.\-]+)")
    branches = re.compile(r"branch_computations=\{([^}]*)\}")
    found, entry, own = {}, "", []
    for line in program.splitlines():
        if line.endswith("{") and (head := re.match(r"(ENTRY )?%?([\w.\-]+) ", line)):
            own = found[head[2]] = []
            entry = head[2] if head[1] else entry
        elif match := operation.match(line):
            names = called.findall(line) + [n.strip(" %") for one in branches.findall(line) for n in one.split(",")]
            own.append((match[1], names if match[1] in ("while", "call", "conditional") else []))

    def count(name: str, loops: list[int] | None) -> int:
        total = 0
        for kind, names in found[name]:
            total += kind not in FREE
            if kind == "while" and loops is not None:
                loops.append(sum(count(inner, None) for inner in names))
            else:
                total += sum(count(inner, loops) for inner in names)
        return total

    loops: list[int] = []
    outside = count(entry, loops)
    return outside, sorted(loops, reverse=True)


def profile(scene: str) -> dict:
    """Of a scene, in this process."""
    import diffrax  # noqa: F401  imports are no part of it
    import jax
    import jax.numpy as jnp

    import lgsens.examples  # noqa: F401

    jax.config.update("jax_enable_x64", True)

    def times(function, p):
        clock = [time.process_time()]
        traced = jax.jit(jax.value_and_grad(function)).trace(jnp.array(p))
        clock.append(time.process_time())
        lowered = traced.lower()
        clock.append(time.process_time())
        compiled = lowered.compile()
        clock.append(time.process_time())
        parts = ("trace", "lower", "compile")
        return {name: b - a for name, a, b in zip(parts, clock, clock[1:])}, compiled.as_text()

    times(lambda p: p[0] ** 2, (1.0,))
    unit, _ = times(pendulum, (1.0,))
    found, program = times(*SCENES[scene])
    outside, loops = kernels(program)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return found | {
        "pendulum": sum(unit.values()),
        "ratio": sum(found.values()) / sum(unit.values()),
        "outside": outside,
        "loops": loops,
        "peak_bytes": peak,
    }


def measure(scene: str) -> dict:
    own = os.environ | SINGLE_THREAD
    return json.loads(subprocess.check_output([sys.executable, __file__, "--one", scene], env=own, text=True))


def markdown(document: dict) -> str:
    rows = [
        (
            scene,
            f"{row['ratio']:.1f}",
            *(f"{row[part]:.1f}" for part in ("pendulum", "trace", "lower", "compile")),
            row["outside"],
            ", ".join(map(str, row["loops"][:2])),
            sum(row["loops"][2:]),
            f"{row['peak_bytes'] / 1e9:.2f}",
        )
        for scene, row in document["scenes"].items()
    ]
    head = (
        "scene | ratio | pendulum [s] | trace [s] | lower [s] | compile [s] | kernels outside of loops | in the two "
        "largest loops | in the others | peak memory [GB]"
    )
    return f"{circumstances(document['environment'])}\n\n{grid(head, rows)}"


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--one", choices=SCENES, help="one scene in this process, as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(profile(arguments.one)))
        return
    path = arguments.out / "compile_profile.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"scenes": {}}
    taken = {scene: [] for scene in arguments.scenes}
    for _ in range(arguments.repeats):
        for scene, rows in taken.items():
            rows.append(measure(scene))
            print(scene, {key: round(value, 2) for key, value in rows[-1].items() if key != "loops"}, flush=True)
    for scene, rows in taken.items():
        document["scenes"][scene] = {
            key: value if isinstance(value, list) else statistics.median(row[key] for row in rows)
            for key, value in rows[0].items()
        }
    document["environment"] = environment(SINGLE_THREAD)
    write(path, document)
    print(markdown(document))


if __name__ == "__main__":
    main()
