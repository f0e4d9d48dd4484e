"""A full K&C report of an axle: five sweeps of 41 points, all outputs, and their gradients by 60 numbers.

    python benchmarks/kc.py [--axle multi_link] [--rounds 5]

Writes results/kc.json: seconds after compilation (medians), seconds of compilation apart.
"""

import argparse
import json
import os
import platform
import statistics
import time
from importlib import metadata
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens import rigs
from lgsens.examples import Axle

jax.config.update("jax_enable_x64", True)
COUNT = 60
SWEEPS = ("parallel", "opposite", "lateral", "braking", "aligning")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--axle", default="multi_link")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    axle = Axle.load(arguments.axle)
    known = rigs.standard_sweeps()
    sweeps = {name: known[name] for name in SWEEPS}
    leaves, structure = jax.tree.flatten(axle)
    sizes = np.cumsum([0, *(leaf.size for leaf in leaves)])
    # The first 60 numbers of the axle: hardpoints, masses and rates as they come.
    flat = jnp.concatenate([leaf.ravel() for leaf in leaves])

    def report(numbers):
        every = jnp.concatenate([numbers, flat[COUNT:]])
        parts = [every[a:b].reshape(leaf.shape) for a, b, leaf in zip(sizes, sizes[1:], leaves)]
        own = jax.tree.unflatten(structure, parts)
        test = rigs.kc(own.model(links="rods"), own.wheel_centres, sweeps, throw=False)
        return test.sweeps, rigs.characteristics(test)

    test = eqx.filter_eval_shape(lambda: rigs.kc(axle.model(links="rods"), axle.wheel_centres, sweeps, throw=False))
    found = {"axle": axle.name, "sweeps": SWEEPS, "points": 41, "numbers": COUNT}
    found["unknowns"] = test.statics.states.v.shape[1] + test.statics.states.lam.shape[1]
    for name, function in (("report", report), ("gradients", jax.jacfwd(report))):
        start = time.perf_counter(), time.process_time()
        program = jax.jit(function).lower(flat[:COUNT]).compile()
        compiled = time.perf_counter() - start[0], time.process_time() - start[1]
        jax.block_until_ready(program(flat[:COUNT]))
        rounds = []
        for _ in range(arguments.rounds):
            start = time.perf_counter(), time.process_time()
            jax.block_until_ready(program(flat[:COUNT]))
            rounds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
        wall, processor = (statistics.median(of) for of in zip(*rounds))
        found[name] = {
            "seconds": wall,
            "processor_seconds": processor,
            "compile_seconds": compiled[0],
            "compile_processor_seconds": compiled[1],
        }
        print(name, found[name], flush=True)
    found["cores"], found["python"] = os.cpu_count(), platform.python_version()
    found["load"] = os.getloadavg()[0]
    found["versions"] = {name: metadata.version(name) for name in ("jax", "jaxlib", "numpy")}
    path = Path(__file__).parent / "results" / "kc.json"
    path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
