"""The tests run in 64 bits, under JAX's strictest promotion rules.

Nearly all their time is compilation, so XLA's costly optimizations are off, as in JAX's own tests: a third less.
The command line's tests and the benchmarks run the program that users run.
"""

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_disable_most_optimizations", True)
