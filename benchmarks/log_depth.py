"""The derivative by sweeps, one step after the other, and by an associative scan of all steps at once.

    python benchmarks/log_depth.py [--steps 1000] [--scenes top top_radau quarter_car] [--out benchmarks/results]

At the states of a run, which are found before: the forward solution for as many parameters as the scene has in an
optimization, and the transposed one for one criterion; the simulation itself for comparison. Medians of `--repeats`
rounds after a warm-up, the programs of a scene in turns, compilation apart; on one thread of a CPU, or with `--device`
as JAX finds it. Memory is what the compiled program says of its temporaries. Writes log_depth.json, device by device.
"""

import json
import os
import statistics
import time

from benchmark import SINGLE_THREAD, circumstances, environment, grid, interleaved, options, write

SCENES = ("top", "top_radau", "quarter_car")


def problem(name: str, steps: int):
    """Scheme, parameters, initial state, and how many directions."""
    import jax.numpy as jnp

    import lgsens as lg
    from lgsens.dynamics import initial_state
    from lgsens.examples import QuarterCar, spinning_top
    from lgsens.integrate import EqualGrid
    from lgsens.sensitivity import Parameters

    scheme = (lg.RadauIIA() if name == "top_radau" else lg.GeneralizedAlpha(0.9)).scheme
    model, directions = (QuarterCar.load().model(), 32) if name == "quarter_car" else (spinning_top(0.7), 4)
    system, zero = model.system(), jnp.asarray(0.0)
    grid = EqualGrid(zero, jnp.asarray(1e-3), steps)
    start = scheme.start(system, initial_state(system, zero), zero)
    return scheme, Parameters(system, grid), start.at(system, grid.h), directions


def measure(name: str, steps: int, repeats: int) -> dict:
    import jax
    import jax.numpy as jnp
    import numpy as np

    from lgsens.integrate import Variation, states_of
    from lgsens.sensitivity import direct_sweep
    from lgsens.sensitivity._carried import Carried
    from lgsens.sensitivity._log_depth import adjoint_at_once, direct_at_once
    from lgsens.sensitivity._sweeps import adjoint_sweep

    scheme, parameters, state0, directions = problem(name, steps)
    simulate = jax.jit(lambda parameters, state0: states_of(scheme, *parameters, state0))
    states, stats = simulate(parameters, state0)
    assert bool(jnp.all(stats.converged))
    rng = np.random.default_rng(0)
    relative = lambda shape: lambda leaf: leaf * jnp.asarray(rng.normal(size=(*shape, *leaf.shape)))
    none = Variation.none(states)
    b = jax.tree.map(lambda leaf: jnp.zeros((directions, *leaf.shape)), none)
    d = jax.tree.map(relative((directions,)), parameters)
    c = none._replace(w=jnp.asarray(rng.normal(size=none.w.shape)))
    zero = jax.tree.map(jnp.zeros_like, parameters)

    def forward(solve):
        return jax.vmap(
            lambda b, d, states, parameters: solve(scheme, states, parameters, b, d)[0].w, (0, 0, None, None)
        )

    def reverse(solve):
        return lambda c, zero, states, parameters: solve(scheme, states, parameters, c, zero)[1]

    kinds = {
        ("forward", "sweep"): (forward(direct_sweep), b, d),
        ("forward", "scan"): (forward(direct_at_once), b, d),
        ("reverse", "sweep"): (reverse(adjoint_sweep), c, zero),
        ("reverse", "scan"): (reverse(adjoint_at_once), c, zero),
    }
    calls = {("simulation", ""): lambda: jax.block_until_ready(simulate(parameters, state0))}
    found, compiled, memory = {}, {}, {}
    for kind, (function, *given) in kinds.items():
        begun = time.perf_counter()
        program = jax.jit(function).lower(*given, states, parameters).compile()
        compiled[kind] = time.perf_counter() - begun
        memory[kind] = program.memory_analysis().temp_size_in_bytes / 1e6
        calls[kind] = lambda program=program, given=given: jax.block_until_ready(program(*given, states, parameters))
        found[kind] = calls[kind]()
    medians = {kind: statistics.median(times.wall) for kind, times in interleaved(calls, repeats).items()}
    first = jax.tree.map(lambda leaf: leaf[0], states)
    carried = Carried.of(scheme, parameters.system, first, parameters.grid.t0, reduced=True)
    rows = []
    for mode in ("forward", "reverse"):
        leaves = [jax.tree.leaves(found[mode, kind]) for kind in ("sweep", "scan")]
        size = lambda leaf: np.abs(leaf).max(initial=0.0)
        difference = max(size(one - other) / size(one) for one, other in zip(*leaves) if size(one) > 0.0)
        row = {"mode": mode, "right_hand_sides": directions if mode == "forward" else 1, "difference": difference}
        for kind in ("sweep", "scan"):
            key = mode, kind
            row[kind] = {"ms": medians[key] * 1e3, "compile_s": compiled[key], "temporary_mb": memory[key]}
        rows.append(row)
    size = carried.back(Variation.none(first)).shape[0]
    simulated = medians["simulation", ""] * 1e3
    return {"scene": name, "steps": steps, "matrix_rows": size, "simulation_ms": simulated, "modes": rows}


def table(documents: dict) -> str:
    head = "scene | rows of A | simulation [ms] | mode | right-hand sides | sweep [ms] | scan [ms] | ratio"
    head += " | memory [MB] | difference"
    parts = []
    for document in documents.values():
        rows = []
        for scene in document["scenes"].values():
            for row in scene["modes"]:
                sweep, scan = row["sweep"], row["scan"]
                memory = ", ".join(f"{kind['temporary_mb']:.0f}" for kind in (sweep, scan))
                cells = f"{sweep['ms']:.1f}", f"{scan['ms']:.1f}", f"{scan['ms'] / sweep['ms']:.2g}", memory
                what = (
                    f"{scene['scene']}, {scene['steps']} steps",
                    scene["matrix_rows"],
                    f"{scene['simulation_ms']:.1f}",
                    row["mode"],
                )
                rows.append((*what, row["right_hand_sides"], *cells, f"{row['difference']:.0e}"))
        found = document["environment"]
        on = "" if found["device"] == "cpu" else f"{found['device']}; "
        parts += [on + circumstances(found), grid(head, rows)]
    return "\n\n".join(parts)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--device", action="store_true", help="the device and the threads that JAX finds")
    arguments = parser.parse_args()
    threads = {} if arguments.device else SINGLE_THREAD
    os.environ.update(threads)  # before jax and numpy are imported
    import jax

    jax.config.update("jax_enable_x64", True)
    found = environment(threads) | {"device": jax.devices()[0].device_kind}
    path = arguments.out / "log_depth.json"
    documents = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    documents[found["device"]] = {"environment": found, "scenes": {}}
    for name in arguments.scenes:
        documents[found["device"]]["scenes"][name] = measure(name, arguments.steps, arguments.repeats)
        write(path, documents)
        print(name, flush=True)
    print(table(documents))


if __name__ == "__main__":
    main()
