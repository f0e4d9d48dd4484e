"""What lgsens asks of XLA when it is imported."""

import os
import subprocess
import sys

import pytest

OPTION = "--xla_cpu_experimental_ynn_fusion_type"
# Σ (A x)² over more than 16,384 vectors (jax-ml/jax issue 39103), and Σ (A B) ∘ A with a constant B: both wrong with
# YNN fusions, the first in jaxlib 0.10.2, the second in 0.12.0 too.
SUMS = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)

def squares(x):
    return jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2))(x)

def product(a):
    return jnp.sum((a @ jnp.ones_like(a)) * a, axis=-1)

for function, x in (
    (squares, jnp.arange(3.0 * 16_385).reshape(-1, 3)),
    (product, jax.random.normal(jax.random.key(0), (16, 16, 16))),
):
    compiled = jax.jit(function).lower(x).compile()
    assert "ynn" not in compiled.as_text(), compiled.as_text()
    with jax.disable_jit():
        expected = function(x)
    # sums of at most 16² terms of one size: a hundred round-offs
    assert jnp.allclose(compiled(x), expected, rtol=1e-13, atol=1e-13 * float(jnp.max(jnp.abs(expected))))
"""


def run(code, flags=""):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | {"XLA_FLAGS": flags}
    )


def test_programs_are_without_ynn_fusions():
    found = run("import lgsens\n" + SUMS)
    assert found.returncode == 0, found.stderr[-2000:]


@pytest.mark.parametrize("flags", ["", "--xla_cpu_multi_thread_eigen=false", f"{OPTION}=reduce"])
def test_other_flags_stay_and_so_does_a_choice_of_ones_own(flags):
    found = run("import lgsens, os\nprint(os.environ['XLA_FLAGS'])", flags)
    assert found.stdout.strip() == (flags if OPTION in flags else f"{flags} {OPTION}=".strip()), found.stderr[-2000:]


@pytest.mark.parametrize("flags", ["", f"{OPTION}="])
def test_an_import_after_jax_has_started_warns(flags):
    found = run("import jax.numpy as jnp\njnp.zeros(1)\nimport lgsens", flags)
    assert found.returncode == 0
    assert ("Import lgsens first" in found.stderr) == (not flags)
