"""XLA's settings that results depend on.

From jaxlib 0.10.2 on, XLA hands small products and sums on a CPU to YNNPACK ("YNN fusions"), and what comes back can be
wrong without a word: `Σ (A x)²` over more than 16,384 vectors x in jaxlib 0.10.2 (jax-ml/jax issue 39103), the sum of
(A B) ∘ A with a constant matrix B up to 0.12.0, the newest that was looked at. They are slow besides: thirty
directional derivatives of a quarter-car take 3 times as long with them. So they are off, for every program of a process
that imports lgsens before JAX computes anything.
"""

import os
import warnings

from jaxlib.version import __version_info__ as _VERSION

_FUSIONS = "--xla_cpu_experimental_ynn_fusion_type"
# XLA ends the process at an option that it does not know: these versions know it
_FIRST, _UNKNOWN = (0, 10), (0, 13)


def without_ynn_fusions() -> None:
    """Turns YNN fusions off in XLA_FLAGS, unless those say what to do with them.

    Warns where JAX has read XLA_FLAGS already.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if not _FIRST <= _VERSION[:2] < _UNKNOWN or _FUSIONS in flags:
        return
    # there is no public way to ask
    from jax._src.xla_bridge import backends_are_initialized

    if backends_are_initialized():
        warnings.warn(
            "JAX computed something before lgsens was imported, and so uses XLA's YNN fusions, whose results are wrong "
            f"in rare cases (jax-ml/jax issue 39103). Import lgsens first, or start Python with XLA_FLAGS={_FUSIONS}=",
            RuntimeWarning,
            stacklevel=3,
        )
        return
    os.environ["XLA_FLAGS"] = f"{flags} {_FUSIONS}=".strip()
