"""Signs of life: what is compiled and how long it took, and a progress bar where tqdm is installed."""

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def compiling(what: str, progress: bool = True) -> Iterator[None]:
    """Say on stderr that something is compiled, and at the end how long it took."""
    started = time.perf_counter()
    if progress:
        print(f"compiling {what} …", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if progress:
            print(f" {time.perf_counter() - started:.1f} s", file=sys.stderr, flush=True)


class _Silent:
    """Stands in for the bar."""

    n = total = 0

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def set_postfix(self, *_, **__):
        return None

    def update(self, *_):
        return None


def progress_bar(total: int, unit: str, progress: bool, *, initial: int = 0) -> Any:
    """tqdm's bar of `total` units of which `initial` are done; without `progress` or tqdm, one that shows nothing."""
    if not progress:
        return _Silent()
    try:
        from tqdm import tqdm
    except ImportError:
        return _Silent()
    return tqdm(total=total, initial=initial, unit=unit, dynamic_ncols=True)
