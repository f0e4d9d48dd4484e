"""The tests run in 64 bits, under JAX's strictest promotion rules.

Nearly all their time is compilation, so XLA's costly optimizations are off, as in JAX's own tests: a third less. So are
its fusion emitters where they can be (jaxlib 0.10), as with lgsens, but loops are left as they are: a tenth less. Nor
does XLA look for what a loop may leave outside or inside, again and again in loops in loops: a quarter less. LLVM gets
a program as one module and not as 32, which may be compiled side by side and cost more together: a tenth less.
`pytest --optimized` compiles as users do. Programs that two tests have in common, mostly single operations, are
compiled once in a run: JAX keeps them in a folder that ends with it.
"""

import gc
import json
import logging
import os
import re
import tempfile

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# A trace is millions of small objects that live until it ends; to look through them seldom saves a tenth of the time.
gc.set_threshold(200_000, 20, 100)


def pytest_addoption(parser):
    parser.addoption("--optimized", action="store_true", help="compile as users do, with all of XLA's optimizations")


def pytest_configure(config):
    if not hasattr(config, "workerinput"):  # the first process of a run; the others have its environment
        folder = tempfile.TemporaryDirectory(prefix="programs-", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    if config.getoption("--optimized"):
        return
    jax.config.update("jax_disable_most_optimizations", True)
    option = "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters=true"
    passes = "--xla_disable_hlo_passes=while-loop-invariant-code-motion,while-loop-constant-sinking"
    whole = "--xla_cpu_parallel_codegen_split_count=1"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {option} {passes} {whole}"


def _forget_programs():
    """Compiled programs hold memory maps, of which a process has only so many; hardly any serves two modules."""
    jax.clear_caches()


@pytest.fixture(autouse=True, scope="module")
def forget_programs_of_a_module():
    yield
    _forget_programs()


@pytest.fixture(autouse=True)
def forget_large_programs(request):
    """A dozen optimized programs of the quarter-car are too many for one module."""
    yield
    if request.node.get_closest_marker("slow"):
        _forget_programs()


@pytest.fixture
def compiled(caplog):
    """The names of the programs that a call compiles, as JAX logs them, and what it returns."""

    def of(function, *arguments, **settings):
        caplog.clear()
        with jax.log_compiles(), caplog.at_level(logging.WARNING):
            found = jax.block_until_ready(function(*arguments, **settings))
        return re.findall(r"Compiling jit\((\w+)\)", caplog.text), found

    return of


@pytest.fixture
def load(tmp_path):
    """A suspension from the file of a document, an `Axle` or of another kind."""
    from lgsens.examples import Axle

    def load(document, kind=Axle):
        path = tmp_path / "suspension.json"
        path.write_text(json.dumps(document), encoding="utf-8")
        return kind.load(path)

    return load
