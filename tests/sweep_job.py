"""A sweep as a program of its own, run by test_sweep.py: killed half-way, on eight devices, in two processes."""

import argparse
import os
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lgsens as lg
from lgsens.sweeps._folder import Store

COUNT = 4096
BATCH = 128


def psi(design):
    """∫ x² dt of a mass across a spring that is under tension, over five steps."""
    ends = {"at_a": (0.0, 0.0, 0.0), "at_b": (0.0, 0.0, -1.0)}
    spring = lg.SpringDamper(None, "mass", stiffness=design["stiffness"], preload=100.0, **ends)
    mass = lg.RigidBody(design["mass"], None, position=(0.0, 0.0, -1.0), velocity=(1.0, 0.0, 0.0), free="x")
    trajectory = lg.simulate(lg.Model({"mass": mass}, {}, {"spring": spring}), t1=0.05, num_steps=5)
    return lg.time_integral(trajectory.t, trajectory.body("mass").position[:, 0] ** 2)


def designs(count=COUNT):
    rng = np.random.default_rng(0)
    return {"stiffness": rng.uniform(500.0, 1000.0, count), "mass": rng.uniform(10.0, 20.0, count)}


def die_in_batch(number: int) -> None:
    """Let the process be killed in that batch, after a part of its results are written."""
    write = Store.write

    def deadly(self, rows, values, ok):
        nonlocal number
        number -= 1
        if number == 0:
            self.values[0][rows] = values[0]
            os.kill(os.getpid(), signal.SIGKILL)
        write(self, rows, values, ok)

    Store.write = deadly


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--die-in-batch", type=int)
    parser.add_argument("--process", type=int)
    parser.add_argument("--port", type=int)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.process is not None:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{options.port}", 2, options.process)
    if options.die_in_batch is not None:
        die_in_batch(options.die_in_batch)
    size = BATCH if options.process is None else None  # two processes agree on one by themselves
    found = lg.sweep(psi, designs(options.count), batch_size=size, folder=options.folder, progress=False)
    np.savez(options.out, values=found.values, ok=found.ok, devices=jnp.asarray(jax.device_count()))


if __name__ == "__main__":
    main()
