"""What lgsens asks of XLA when it is imported."""

import contextlib
import gc
import os
import subprocess
import sys

import pytest
from helpers import some_quick
from jaxlib.version import __version_info__ as VERSION

from lgsens._xla import _seldom_collected, tracing

OPTION = "--xla_cpu_experimental_ynn_fusion_type"
EXTRA = "--xla_backend_extra_options"
SMALL_PROGRAMS = (
    f"{EXTRA}=xla_cpu_disable_new_fusion_emitters=true,xla_cpu_small_while_loop_byte_threshold=10000000"
    if VERSION < (0, 11)
    else ""
)
# Σ (A x)² over more than 16,384 vectors (jax-ml/jax issue 39103), and Σ (A B) ∘ A with a constant B: both wrong with
# YNN fusions of sums, the first in jaxlib 0.10.2, the second in 0.12.0 too. Of seven axes they end jaxlib 0.10.2.
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
    with jax.disable_jit():
        expected = function(x)
    # sums of at most 16² terms of one size: a hundred round-offs
    assert jnp.allclose(jax.jit(function)(x), expected, rtol=1e-13, atol=1e-13 * float(jnp.max(jnp.abs(expected))))

axes = jax.random.normal(jax.random.key(0), (3, 1, 2, 2, 8, 8, 8), jnp.float32)
assert jnp.all(jnp.isfinite(jax.jit(lambda a: jnp.sum(a * a, axis=3))(axes)))
"""
FLAGS = "print(os.environ['XLA_FLAGS'])"


def run(code, flags=""):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | {"XLA_FLAGS": flags}
    )


def test_sums_are_right():
    found = run("import lgsens\n" + SUMS)
    assert found.returncode == 0, found.stderr[-2000:]


@pytest.mark.parametrize(
    "flags",
    some_quick(["--xla_cpu_multi_thread_eigen=false", "", f"{OPTION}=reduce", f"{EXTRA}=xla_lgsens=off"]),
)
def test_other_flags_stay_and_so_does_a_choice_of_ones_own(flags):
    found = run("import lgsens, os\n" + FLAGS, flags)
    added = {OPTION: f"{OPTION}=-reduce", EXTRA: SMALL_PROGRAMS}
    expected = [flags, *(value for option, value in added.items() if option not in flags)]
    assert found.stdout.split() == " ".join(expected).split(), found.stderr


@pytest.mark.parametrize("flags", some_quick([f"{EXTRA}=xla_lgsens=off", ""]))  # without others: `test_sums_are_right`
def test_xla_takes_the_options(flags):
    """It ends the process at one that it cannot read."""
    found = run("import lgsens, jax\nassert jax.jit(lambda x: x + 1)(1) == 2", flags)
    assert found.returncode == 0, found.stderr


@pytest.mark.parametrize("version", some_quick([((0, 13, 0),), ((0, 10, 0),), ((0, 10, 1),), ((0, 12, 0),)]))
def test_versions_that_need_nothing_and_those_not_known_are_left_alone(version):
    found = run(f"import jax, jaxlib.version as v, os\nv.__version_info__ = {version}\nimport lgsens\n" + FLAGS)
    assert (OPTION in found.stdout) == (version == (0, 12, 0)), found.stderr
    assert (EXTRA in found.stdout) == (version < (0, 11))


@pytest.mark.parametrize("flags", some_quick(["", f"{OPTION}=-reduce"]))
def test_an_import_after_jax_has_started_warns(flags):
    found = run("import jax.numpy as jnp\njnp.zeros(1)\nimport lgsens", flags)
    assert found.returncode == 0
    assert ("Import lgsens first" in found.stderr) == (not flags)


def test_what_is_traced_sets_the_collector_back():
    before = gc.get_threshold()
    with pytest.raises(ValueError, match="of the user's"), tracing():
        assert gc.get_threshold()[0] > before[0] or before[0] >= 100_000
        raise ValueError("of the user's")
    assert gc.get_threshold() == before


@pytest.mark.parametrize("cores, own, threads", some_quick([(2, None, "1"), (2, "2", "2"), (16, None, "None")]))
def test_few_cores_get_one_thread_unless_the_user_says_otherwise(cores, own, threads):
    """On two, batched factorizations at once wait for each other for ever, before 0.12."""
    if own is None and VERSION >= (0, 12):
        threads = "None"
    given = {name: value for name, value in os.environ.items() if name != "PJRT_NPROC"}
    given |= {} if own is None else {"PJRT_NPROC": own}
    code = f"import os; os.sched_getaffinity = lambda _: range({cores}); import lgsens; print(os.getenv('PJRT_NPROC'))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=given, check=True)
    assert found.stdout.split() == [threads]


def test_threads_leave_the_collector_as_it_was():
    """One enters before the other leaves, and leaves before that."""
    before = gc.get_threshold()
    with contextlib.ExitStack() as first, contextlib.ExitStack() as second:
        first.enter_context(tracing())
        second.enter_context(_seldom_collected)
        first.close()
        assert gc.get_threshold()[0] > before[0] or before[0] >= 100_000
    assert gc.get_threshold() == before
