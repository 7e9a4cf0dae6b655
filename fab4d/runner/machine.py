"""What the report says about the machine and the programs that made a design."""

import importlib.metadata
import platform
import sys

PACKAGES = ("fab4d", "numpy", "scipy", "numba", "rslab", "meshio", "manifold3d", "trimesh", "reportlab", "matplotlib")


def versions() -> dict[str, str | None]:
    """Python and the packages that a design depends on; None for one that is not installed."""
    return {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def peak_rss_mb() -> float | None:
    """Largest resident memory of this process so far, MB; None on Windows, which does not tell it in Python."""
    if sys.platform == "win32":
        return None
    import resource  # not on Windows

    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit_bytes / 1e6
