"""What XLA has to be told for results to be right and for programs to be ready soon, where they are kept; and what JAX
has to be told inside of `shard_map`.

From jaxlib 0.10.2 on XLA hands sums on a CPU to YNNPACK ("YNN fusions"), alone or with the product before them, and
what comes back can be wrong without a word. Measured, the largest error relative to the largest result:

    jaxlib                                    0.10.0, 0.10.1    0.10.2        0.11.0        0.12.0
    Σ (A x)², 40,000 vectors x                round-off         6e-3          round-off     round-off
    Σ (A B) ∘ A, constant B                   round-off         1e180         0.9           0.9
    Σ a b along one of seven or eight axes    round-off         the process ends            round-off

(jax-ml/jax issues 39103, 40412, 39257). Without sums ("-reduce") all of them are right, and thirty directional
derivatives of a quarter-car take 0.5 to 0.7 of the time. Products may stay there: they are right, and take as long.

What has the least reach? `jax.jit(…, compiler_options=…)` is for one function, but JAX accepts it on the outermost jit
alone and raises elsewhere; that one is the user's, `jax.grad` or `jax.vmap` around lgsens. What remains is XLA_FLAGS,
which XLA reads once, when a process computes first. So this one option is added there, for the versions that are wrong
and no other, unless the user's flags name it or JAX has started. It holds for the process, other users of JAX in it and
those that it starts.

A second one, for jaxlib 0.10, is for speed. Its "fusion emitters" set up an MLIR compiler of its own for every kernel,
of which a scene's gradient has hundreds: more than half of what compilation takes, and two thirds of the memory. The
emitters before them are still there. And loops that read little can be one function each, which later versions make of
them unasked. Of the quarter-car, relative to jaxlib 0.10.2 as it comes, one core, alternated in one run:

    emitters    loops       compile    memory     simulation    gradient
    new         as always   30.3 s     1.63 GB    1             1
    before      as always   18.3 s     0.59 GB    1.04          1.03
    new         functions                         0.70          0.82
    before      functions   19.9 s     0.59 GB    0.68          0.81

(the top's simulation and gradient 0.58 and 0.55, those of a chain of 64 links 0.92; batches of 32 designs on two cores
no slower). Both are keys of `--xla_backend_extra_options`, of which XLA ignores those that it does not know.

Third, on two cores jaxlib before 0.12 can wait for ever. A LAPACK call with a batch of matrices hands them to XLA's
threads and waits for them on one of these. Where the two threads of two cores are both at such a call, nobody is left:
`vmap` of 26 quarter-cars stood still at the second call in two factorizations that do not depend on each other, the
batched gradient of `random_road` in a QR and an LU. (With 0.12 both came to their end, 16 batches and 400 gradients;
with 0.10 and three or four threads too, 8 and 200 each.) With one thread (`PJRT_NPROC=1`, which XLA reads when it
starts) a batch is done where it is asked for. So that is set on machines of one or two cores unless the user has set
it; with more cores as many such calls would have to meet. One quarter-car or top is faster with it, a batch of 256 tops
takes 83 instead of 66 ms. (`lgsens.sweep` takes its factorizations apart by itself, `sweeps._one_by_one`.)
"""

import contextlib
import gc
import os
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.compilation_cache import compilation_cache as jax_cache
from jaxlib.version import __version_info__ as _VERSION

_SUMS = "--xla_cpu_experimental_ynn_fusion_type"
_EXTRA = "--xla_backend_extra_options"
_SMALL_PROGRAMS = "xla_cpu_disable_new_fusion_emitters=true,xla_cpu_small_while_loop_byte_threshold=10000000"
# What each option is set to, from which version on and before which. Those after them are not known yet, and XLA ends
# the process at an option unknown to it.
_OPTIONS = (
    (_SUMS, "-reduce", (0, 10, 2), (0, 13)),
    (_EXTRA, _SMALL_PROGRAMS, (0, 10), (0, 11)),
)
_WAITS, _FEW_CORES = _VERSION < (0, 12), 2
Carry = TypeVar("Carry")
Y = TypeVar("Y")
# One program where a function is called outside of `jit`: there each of its operations would be one, and those of its
# derivatives too, 10 to 20 ms of compilation each. Inside of `jit` it leaves no call behind, and is traced once for all
# calls with such arguments: a gradient evaluates a scene's equations five times, and that saves a third of its tracing.
one_program = partial(jax.jit, inline=True)
_COLLECTED = 100_000  # how many objects are made before Python looks for those that are no longer used


def set_options() -> None:
    """Adds to XLA_FLAGS the options that this version needs, of which the user's flags say nothing; one thread for few
    cores.

    Warns where JAX has read XLA_FLAGS already, and sums may be wrong.
    """
    # of a process that is held to some cores XLA counts those, where the system says which
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if _WAITS and cores <= _FEW_CORES:
        os.environ.setdefault("PJRT_NPROC", "1")
    flags = os.environ.get("XLA_FLAGS", "")
    missing = {
        option: value for option, value, first, after in _OPTIONS if first <= _VERSION < after and option not in flags
    }
    if not missing:
        return
    # there is no public way to ask
    from jax._src.xla_bridge import backends_are_initialized

    if not backends_are_initialized():
        os.environ["XLA_FLAGS"] = " ".join([flags, *map("=".join, missing.items())]).strip()
    elif _SUMS in missing:
        warnings.warn(
            "JAX computed something before lgsens was imported, and so uses XLA's YNN fusions of sums, whose results "
            "are wrong in rare cases (jax-ml/jax issue 39103). Import lgsens first, or start Python with "
            f"XLA_FLAGS={_SUMS}={missing[_SUMS]}",
            RuntimeWarning,
            stacklevel=3,
        )


class _SeldomCollected:
    """A threshold of Python's collector, one for all threads: the first to enter raises it, the last restores it."""

    def __init__(self):
        self._lock, self._entered, self._before = threading.Lock(), 0, (0, 0, 0)

    def __enter__(self):
        with self._lock:
            if self._entered == 0:
                self._before = gc.get_threshold()
                if 0 < self._before[0] < _COLLECTED:
                    gc.set_threshold(_COLLECTED, *self._before[1:])
            self._entered += 1

    def __exit__(self, *_):
        with self._lock:
            self._entered -= 1
            if self._entered == 0:
                gc.set_threshold(*self._before)


_seldom_collected = _SeldomCollected()


@contextlib.contextmanager
def tracing() -> Iterator[None]:
    """While a simulation and its derivatives are traced, of which it takes a half: 3.5 s instead of 6.3 s for the
    quarter-car's gradient.

    JAX keeps what it has traced by the mesh of its context, None outside of `jit` and an empty one where it evaluates a
    custom rule: named as it is, it is the same in both, and nothing is traced for each of them. And a trace is millions
    of small objects that live until it ends: Python looks through them a hundred times as seldom.
    """
    with _seldom_collected, jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
        yield


# Inside of `shard_map` numbers of a design differ from device to device ("vary"), constants do not, and JAX refuses
# loops and derivatives in which one becomes the other. So what a simulation is made of varies as a whole (`alike`), and
# the carries of its loops do. Elsewhere the functions below are JAX's.


def alike(tree: Any, *others: Any) -> Any:
    """A tree whose arrays vary over the same axes of a mesh: those over which one of them or of `others` does."""
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return tree
    is_array = lambda leaf: isinstance(leaf, jax.Array | np.ndarray | jax.ShapeDtypeStruct)
    of = lambda leaf: jax.typeof(leaf).manual_axis_type.varying
    axes = frozenset().union(*(of(leaf) for leaf in jax.tree.leaves((tree, others)) if is_array(leaf)))

    def varying(leaf):
        missing = tuple(axes - of(leaf)) if is_array(leaf) else ()
        return lax.pcast(leaf, missing, to="varying") if missing else leaf

    return jax.tree.map(varying, tree)


def while_loop(unfinished: Callable[[Carry], Any], body: Callable[[Carry], Carry], init: Carry) -> Carry:
    if jax.sharding.get_abstract_mesh().manual_axes:
        init = alike(init, jax.eval_shape(body, init))
        return lax.while_loop(unfinished, lambda carry: alike(body(carry), carry), init)
    return lax.while_loop(unfinished, body, init)


def changed_where(which, change: Callable[[Carry], Carry], same: Carry) -> Carry:
    """`change(same)` where it is so, by `cond`."""
    if jax.sharding.get_abstract_mesh().manual_axes:
        shapes = jax.eval_shape(change, same)
        return lax.cond(which, lambda same: alike(change(same), shapes), lambda same: alike(same, shapes), same)
    return lax.cond(which, change, lambda same: same, same)


def renewed_where(due, new: Callable[[], Carry], earlier: Carry) -> Carry:
    """`new()` where it is due. A loop of no or one turn, because `cond` would copy what is large."""
    renewed = lambda carry: (jnp.zeros((), bool), new())
    return while_loop(lambda carry: carry[0], renewed, (due, earlier))[1]


def fori_loop(first: int, after: Any, body: Callable[[Any, Carry], Carry], init: Carry, **options: Any) -> Carry:
    if jax.sharding.get_abstract_mesh().manual_axes:
        init = alike(init, jax.eval_shape(body, first, init))
        return lax.fori_loop(first, after, lambda i, carry: alike(body(i, carry), carry), init, **options)
    return lax.fori_loop(first, after, body, init, **options)


def scan(body: Callable[[Carry, Any], tuple[Carry, Y]], init: Carry, xs: Any, **options: Any) -> tuple[Carry, Y]:
    def same(carry, x):
        after, y = body(carry, x)
        return alike(after, carry), y

    if jax.sharding.get_abstract_mesh().manual_axes:
        init = alike(init, jax.eval_shape(body, init, jax.tree.map(lambda leaf: leaf[0], xs))[0])
        return lax.scan(same, init, xs, **options)
    return lax.scan(body, init, xs, **options)


# JAX batches a `while_loop` whose predicate differs between lanes by a selection between old and new of all that the
# loop carries, in every turn: of the inverse of a matrix too, which costs as much as an iteration with it. And of a
# `cond` it computes both. So predicates are the same in all lanes, where bodies leave lanes alone that are done.


@jax.custom_batching.custom_vmap
def in_any_lane(flag):
    """A flag that is the same in all lanes of a batch: whether it is raised in any. The predicate of a loop whose body
    leaves lanes alone that are done."""
    return flag


@in_any_lane.def_vmap
def _of_all_lanes(axis_size, in_batched, flag):
    return in_any_lane(jnp.any(flag)), False  # a batch of batches comes here again


@jax.custom_batching.custom_vmap
def most_of_lanes(count):
    """The largest of all lanes of a batch: the turns of a loop whose body leaves lanes alone that are done."""
    return count


@most_of_lanes.def_vmap
def _most_of_all(axis_size, in_batched, count):
    return most_of_lanes(jnp.max(count)), False


def compilation_cache(folder: str | os.PathLike | None = None) -> Path:
    """Keep compiled programs in a folder, in which the next process finds them: there a gradient is only traced.

    ```python
    import lgsens as lg

    lg.compilation_cache()
    ```

    Arguments:
        folder: where; None: where JAX keeps them already (`JAX_COMPILATION_CACHE_DIR`), or else `lgsens` in the user's
            folder of caches, `$XDG_CACHE_HOME` or `~/.cache`.

    Returns the folder. JAX's persistent cache is a setting of the process (`jax_compilation_cache_dir`), which nothing
    but this function and the command line touches; `JAX_ENABLE_COMPILATION_CACHE=false` switches it off. Programs that
    take less than half a second are not kept, nor those with a callback to Python (`failures_by_callback`,
    `jax.debug.print`). Raises `ValueError` for a folder that cannot be written.
    """
    config: Any = jax.config  # its settings are declared at run time
    given = folder if folder is not None else config.jax_compilation_cache_dir
    found = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "lgsens" if given is None else Path(given)
    try:
        found = found.expanduser()
        found.mkdir(parents=True, exist_ok=True)
        (found / ".writable").touch()
    except (OSError, RuntimeError) as error:  # the latter of a user without a home
        raise ValueError(f"`folder` {str(found)!r} cannot be written ({error}); name another one.") from error
    if str(found) != config.jax_compilation_cache_dir:
        config.update("jax_compilation_cache_dir", str(found))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
        jax_cache.reset_cache()  # else a process that has compiled before keeps to the folder it had
    return found
