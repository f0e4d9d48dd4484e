"""The tests run in 64 bits, under JAX's strictest promotion rules.

Nearly all their time is compilation, so XLA's costly optimizations are off, as in JAX's own tests: a third less.
`pytest --optimized` leaves them on.
"""

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


def pytest_addoption(parser):
    parser.addoption("--optimized", action="store_true", help="compile as users do, with all of XLA's optimizations")


def pytest_configure(config):
    jax.config.update("jax_disable_most_optimizations", not config.getoption("--optimized"))


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
