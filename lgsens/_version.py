"""The version that is installed."""

from importlib import metadata


def version(distribution: str = "lgsens") -> str:
    """The version of an installed distribution; "unknown" for a source tree that is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "unknown"
