"""Beams: what elements cost, how fast they converge, and which links of a suspension have to bend.

    python benchmarks/beams.py [--elements 8 32 128 256] [--repeats 5] [--exudyn] [--compile] [--picture]
        [--out benchmarks/results]

Cost: a beam on a hinge falls, h = 1 ms; the gradient is that of the height of its tip by the stiffnesses of its
section, in reverse mode. Time per step as in chain.py, the difference of two runs. Convergence: the Princeton beam,
loaded at 45° by 8.896 N, its tip against that of 16 and 32 elements extrapolated. Links: the five-link quarter-car with
its strut, which carries spring and damper, and its trailing arm as steel tubes of 30 × 3 mm in four elements each; what
bending changes of its comfort and the gradient, predicted by one program of the rich scene and run. Writes beams.json
and prints tables, and draws beams.png: an anti-roll bar before and under a load, in the colours of its stress.

With `--picture` that picture alone. With `--compile` the time to compile the first and the last number of elements
alone: processor time to trace, lower and compile, in processes of their own without a cache, taken in turns, to be run
on one core (`taskset -c 0`). With `--exudyn` this alone: the simulation beside the fastest program of Exudyn's
geometrically exact beam (`rival_beams.py`), timed in the same rounds on the same beam without damping. Both join what
beams.json has already.
"""

import itertools
import json
import math
import os
import statistics
import subprocess
import sys
import time

import rival_beams
from benchmark import SINGLE_THREAD, circumstances, environment, interleaved, options, write
from rival_beams import GRAVITY, INERTIA, LENGTH, MASS, STIFFNESS

STEPS, H = (20, 100), 1e-3
NAMES = ("simulate", "gradient")
STEEL = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}


def height(stiffness, elements: int, steps: int, damping: float):
    """Of the tip [m], after so many steps."""
    import lgsens as lg

    section = lg.BeamSection(stiffness, MASS, INERTIA, damping=damping)
    beam = lg.Beam("b", section, [[0, 0, 0], [LENGTH, 0, 0]], elements=elements)
    hinge = {"hinge": lg.RevoluteJoint(None, "b.0", at=[0, 0, 0], axis=[0, 0, 1.0])}
    model = lg.Model(beam.bodies, hinge, beam.forces | {"gravity": lg.Gravity([0, -GRAVITY, 0])})
    return lg.simulate(model, t1=steps * H, num_steps=steps).body(beam.nodes[-1]).position[-1, 1]


def lowered(name: str, elements: int, steps: int):
    """The program of the height, or of its gradient."""
    import jax
    import jax.numpy as jnp

    function = {"simulate": height, "gradient": jax.grad(height)}[name]
    return jax.jit(function, static_argnums=(1, 2, 3)).lower(jnp.array(STIFFNESS), elements, steps, 1e-4)


def compilation(sizes: list[int], repeats: int) -> dict:
    """Processor times of processes of their own, in turns: a machine is not as fast in one minute as in the next."""
    times = {(elements, name): [] for elements in sizes for name in NAMES}
    for _ in range(repeats):
        for (elements, name), taken in times.items():
            command = [sys.executable, __file__, "--elements", str(elements), "--one", name]
            own = os.environ | SINGLE_THREAD | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
            taken.append(float(subprocess.check_output(command, env=own, text=True)))
            print(f"{elements} elements, {name}: {taken[-1]:.1f} s", flush=True)
    rows = [{"elements": elements, "program": name, "cpu_s": taken} for (elements, name), taken in times.items()]
    return {"environment": environment(SINGLE_THREAD), "rows": rows}


def compile_table(found: dict) -> list[str]:
    lines = ["", "| elements | program | trace, lower and compile [s of processor]: median | least | largest |"]
    lines += ["|---|---|---|---|---|"]
    lines += [
        f"| {row['elements']} | {row['program']} | {statistics.median(row['cpu_s']):.1f} | {min(row['cpu_s']):.1f} "
        f"| {max(row['cpu_s']):.1f} |"
        for row in found["rows"]
    ]
    few, *_, many = sorted({row["elements"] for row in found["rows"]})
    taken = {(row["elements"], row["program"]): row["cpu_s"] for row in found["rows"]}
    ratio = lambda by, name: by(taken[many, name]) / by(taken[few, name])
    said = [f"{name} {ratio(statistics.median, name):.2f} and {ratio(min, name):.2f}" for name in NAMES]
    count = len(taken[few, NAMES[0]])
    lines += ["", f"{many} elements over {few}, medians and least of {count} processes: {', '.join(said)}."]
    lines += ["", circumstances(found["environment"])]
    return lines


def cost(elements: int, repeats: int) -> dict:
    import jax
    import jax.numpy as jnp

    stiffness, found, calls = jnp.array(STIFFNESS), {"elements": elements}, {}
    for steps, name in itertools.product(STEPS, NAMES):
        compiled = lowered(name, elements, steps).compile()
        calls[name, steps] = lambda compiled=compiled: jax.block_until_ready(compiled(stiffness))
        calls[name, steps]()
    times = interleaved(calls, repeats, seconds=3.0)
    for name in NAMES:
        few, many = (times[name, steps].wall for steps in STEPS)
        taken = statistics.median(long - short for short, long in zip(few, many))
        found[f"{name}_us_per_step"] = taken / (STEPS[1] - STEPS[0]) * 1e6
    jax.clear_caches()  # programs hold memory maps, of which a process has only so many
    return found


def beside_exudyn(elements: int, repeats: int) -> dict:
    import jax
    import jax.numpy as jnp

    stiffness, calls = jnp.array(STIFFNESS), {}
    beam, choice, found = rival_beams.fastest(elements, STEPS[1], H)
    for steps in STEPS:
        started = time.process_time()
        compiled = jax.jit(height, static_argnums=(1, 2, 3)).lower(stiffness, elements, steps, 0.0).compile()
        found["compile_cpu_s"] = time.process_time() - started
        settings = beam.settings(steps, H, *choice)
        calls["lgsens", steps] = lambda compiled=compiled: compiled(stiffness).block_until_ready()
        calls["exudyn", steps] = lambda settings=settings: beam.solve(settings)
        found["tip_lgsens"] = float(calls["lgsens", steps]())
        calls["exudyn", steps]()
    times = interleaved(calls, repeats, seconds=5.0)
    for name in ("lgsens", "exudyn"):
        few, many = (times[name, steps] for steps in STEPS)
        for suffix, short, long in (("", few.wall, many.wall), ("_cpu", few.cpu, many.cpu)):
            taken = statistics.median(b - a for a, b in zip(short, long))
            found[f"{name}_us_per_step{suffix}"] = taken / (STEPS[1] - STEPS[0]) * 1e6
    print(found, flush=True)
    return {"elements": elements, **found}


def convergence() -> list[dict]:
    import numpy as np

    import lgsens as lg

    section = lg.BeamSection.rectangle(3.2024e-3, 12.3777e-3, young=71.7e9, poisson=0.31, density=2800.0)
    force, ends = 8.896 * np.array([0.0, np.sin(np.radians(45.0)), np.cos(np.radians(45.0))]), {}
    for elements in (2, 4, 8, 16, 32):
        beam = lg.Beam("b", section, [[0, 0, 0], [0.508, 0, 0]], elements=elements)
        load = {"P": lg.AppliedForce(beam.nodes[-1], at=beam.points[-1], force=force)}
        clamp = {"clamp": lg.FixedJoint(None, "b.0", at=beam.points[0])}
        model = lg.Model(beam.bodies, clamp, beam.forces | load, merge_fixed=True)
        run = lg.statics(model, loads={"P": np.linspace(0.0, 1.0, 4)})
        ends[elements] = np.asarray(run.body(beam.nodes[-1]).position[-1])
    limit = (4 * ends[32] - ends[16]) / 3
    return [{"elements": n, "error": float(np.abs(end - limit).max() / np.abs(limit[1]))} for n, end in ends.items()]


def links() -> list[dict]:
    import lgsens as lg
    from lgsens.accuracy import fidelity
    from lgsens.examples import QuarterCar
    from lgsens.model import Rigid

    car, tube = QuarterCar.load(), lg.BeamSection.tube(0.03, 0.003, **STEEL)
    bars = {"rollover_strut": tube, "trailing_arm": tube}
    p = {"stiffness": car.spring.rate, "damping": car.damper.rate, "hardpoints": car.hardpoints}

    def build(p):
        model = car.with_values(**p).model(wheel="locked").flexible(bars, nodes={"spring": 2, "damper": 2})
        elements = [name for name in model.forces if name.rpartition(".")[0] in bars]
        return lg.static_preload(model, ["spring", "tyre", *elements])[0]

    comfort = lg.Criterion(integrand=lambda s, p: s.body("chassis").acceleration[2] ** 2)
    found = fidelity(comfort, build, p, [Rigid(name) for name in bars], t1=1.0, num_steps=200)
    print(found)
    rows = []
    for row in found.rows:
        verified = found.verified(row)
        numbers = {"value": row.value, "gradient": row.gradient, "value_run": verified.value}
        rows.append({"link": row.options[0][0].beam, **numbers, "gradient_run": verified.gradient})
    return rows


def picture(path) -> None:
    """An anti-roll bar of 22 mm in two bearings, one end on a drop link, 1500 N on the other."""
    import numpy as np

    import lgsens as lg

    corners = [[0.3, 0.6, 0.0], [0.0, 0.5, 0.0], [0.0, -0.5, 0.0], [0.3, -0.6, 0.0]]
    bar = lg.BentBeam("bar", lg.BeamSection.round(0.022, **STEEL), corners, elements=6)
    end, left, right, other = bar.corners
    joints = {
        "left bearing": lg.RevoluteJoint(None, left, at=corners[1], axis=[0, 1.0, 0]),
        "right bearing": lg.CylindricalJoint(None, right, at=corners[2], axis=[0, 1.0, 0]),
        "drop link": lg.DistanceJoint(None, other, at_a=[0.3, -0.6, -0.3], at_b=corners[3]),
    }
    load = {"load": lg.AppliedForce(end, at=corners[0], force=[0, 0, 1.0])}
    model = lg.Model(bar.bodies, joints, bar.forces | load)
    loaded = lg.statics(model, loads={"load": np.linspace(0.0, 1500.0, 7)})
    largest = {name: 1e-6 * float(loaded.force(name).stress[-1]) for name in bar.forces}
    worst = max(largest, key=lambda name: largest[name])
    print(f"\nThe largest stress in the anti-roll bar: {largest[worst]:.0f} MPa, in {worst}.")
    lg.plotting.save(lg.plotting.mechanism({"before": model, "under load": loaded}), path, dpi=110)


def table(document: dict) -> str:
    lines = [circumstances(document["environment"]), ""]
    lines += ["| elements | simulate [µs/step] | with gradient [µs/step] |"]
    lines += ["|---|---|---|"]
    lines += [
        f"| {row['elements']} | {row['simulate_us_per_step']:.0f} | {row['gradient_us_per_step']:.0f} |"
        for row in document["cost"]
    ]
    for short, long in itertools.pairwise(document["cost"]):
        ratio = math.log(long["elements"] / short["elements"])
        slopes = [
            math.log(long[f"{name}_us_per_step"] / short[f"{name}_us_per_step"]) / ratio
            for name in ("simulate", "gradient")
        ]
        lines.append(
            f"\nSlope from {short['elements']} to {long['elements']} elements: simulate {slopes[0]:.2f}, with gradient "
            f"{slopes[1]:.2f}."
        )
    if "compile" in document:
        lines += compile_table(document["compile"])
    lines += ["", "| elements | error of the tip, over its deflection |", "|---|---|"]
    lines += [f"| {row['elements']} | {row['error']:.1e} |" for row in document["convergence"]]
    lines += ["", "| rigid | of Ψ, predicted | run | of dΨ/dp, predicted | run |", "|---|---|---|---|---|"]
    lines += [
        f"| {row['link']} | {row['value']:+.2e} | {row['value_run']:+.2e} | {row['gradient']:.2e} "
        f"| {row['gradient_run']:.2e} |"
        for row in document["links"]
    ]
    return "\n".join(lines + (rival_table(document["exudyn"]) if "exudyn" in document else []))


def rival_table(found: dict) -> list[str]:
    """Processor time, which other load changes least; the tip of lgsens beside those of both beams of Exudyn's."""
    lines = ["", circumstances(found["environment"]), ""]
    lines += ["| elements | lgsens [µs/step] | Exudyn [µs/step] | ratio | Exudyn's program | tips differ [m] by "]
    lines[-1] += "| with masses on nodes by |"
    lines += ["|---" * 7 + "|"]
    for row in found["rows"]:
        ours, theirs = (row[f"{name}_us_per_step_cpu"] for name in ("lgsens", "exudyn"))
        tips = (row[key] for key in ("tip", "tip_lumped"))
        tips = " | ".join("–" if tip is None else f"{abs(tip - row['tip_lgsens']):.0e}" for tip in tips)
        cells = f"{row['elements']} | {ours:.0f} | {theirs:.0f} | {ours / theirs:.2f} | {row['program']} | {tips}"
        lines.append(f"| {cells} |")
    return lines


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--elements", nargs="+", type=int, default=[8, 32, 128, 256])
    parser.add_argument("--exudyn", action="store_true", help="beside Exudyn, nothing else; skipped without it")
    parser.add_argument("--compile", action="store_true", help="time to compile, nothing else")
    parser.add_argument("--one", choices=NAMES, help="compiles one program in this process, and prints the time")
    parser.add_argument("--picture", action="store_true", help="draws beams.png, nothing else")
    arguments = parser.parse_args()
    path = arguments.out / "beams.json"
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    import jax

    jax.config.update("jax_enable_x64", True)
    if arguments.one:
        import lgsens  # noqa: F401  imports are no part of it

        started = time.process_time()
        lowered(arguments.one, arguments.elements[0], STEPS[1]).compile()
        print(time.process_time() - started)
        return
    if arguments.picture:
        picture(path.with_suffix(".png"))
        return
    document: dict = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if arguments.compile:
        if len({*arguments.elements}) < 2:
            parser.error("--compile compares two numbers of --elements.")
        document["compile"] = compilation([arguments.elements[0], arguments.elements[-1]], arguments.repeats)
        write(path, document)
        print("\n".join(compile_table(document["compile"])))
        return
    if arguments.exudyn:
        if not rival_beams.available():
            print("Exudyn is not installed (benchmarks/requirements.txt); skipped.")
            return
        document["exudyn"] = {"environment": environment(SINGLE_THREAD), "rows": []}
        for elements in arguments.elements:
            document["exudyn"]["rows"].append(beside_exudyn(elements, arguments.repeats))
            write(path, document)
        print("\n".join(rival_table(document["exudyn"])))
        return
    document["environment"] = environment(SINGLE_THREAD)
    document["cost"] = [cost(elements, arguments.repeats) for elements in arguments.elements]
    document |= {"convergence": convergence(), "links": links()}
    write(path, document)
    print(table(json.loads(path.read_text(encoding="utf-8"))))
    picture(path.with_suffix(".png"))


if __name__ == "__main__":
    main()
