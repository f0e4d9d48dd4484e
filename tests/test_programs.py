"""What is compiled can be kept for the next process, and exported: it calls nothing of this one."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from jax import export

import lgsens as lg
from lgsens.examples import spinning_top

P = jnp.array([0.7, 1.0])  # angle, length


def psi(p):
    run = lg.simulate(spinning_top(p[0], length=p[1]), t1=0.1, num_steps=5)
    return lg.time_integral(run.t, run.body("top").position[:, 0] ** 2)


def test_a_gradient_is_exported():
    program = jax.jit(jax.value_and_grad(psi))
    assert "callback" not in program.lower(P).as_text()
    exported = export.export(program)(P)
    for found, expected in zip(exported.call(P), program(P)):
        np.testing.assert_allclose(found, expected, rtol=1e-12)  # compiled anew


SECOND = """
import sys, jax, jax.numpy as jnp
hits = []
jax.monitoring.register_event_listener(lambda event, **_: hits.append(event) if event.endswith("cache_hits") else None)
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, "tests")
import lgsens as lg
jnp.ones(2) + 1.0  # something is compiled before
print(lg.compilation_cache(sys.argv[1]))
from test_programs import P, psi
print(jax.jit(jax.grad(psi))(P), len(hits))
"""


@pytest.mark.slow  # a gradient is compiled in another process
def test_the_next_process_finds_what_was_compiled(tmp_path):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", SECOND, str(tmp_path / "programs")]
    first, second = (
        subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.split("\n")
        for _ in range(2)
    )
    assert first[0] == second[0] == str(tmp_path / "programs")
    (before, hits), (after, more) = (run[1].rsplit(" ", 1) for run in (first, second))
    assert before == after and int(hits) == 0 and int(more) > 0


def test_a_folder_that_cannot_be_written(tmp_path):
    taken = tmp_path / "file"
    taken.write_text("")
    with pytest.raises(ValueError, match=says("`folder`", "cannot be written", "name another one")):
        lg.compilation_cache(taken)
