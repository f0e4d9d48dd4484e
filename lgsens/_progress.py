"""A progress bar, where tqdm is installed."""

from typing import Any


class _Silent:
    """Stands in for the bar."""

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
