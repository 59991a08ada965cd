"""Whether the loops of compounding are compiled yet: the first run on a machine takes longer."""

from pathlib import Path

from sonosweep.reconstruct import bricks, forward_kernels, gather_kernels, planes

_NEEDED = {
    "gather": (
        planes._matrices,
        bricks._look_up,
        gather_kernels.list_bricks,
        gather_kernels.gather_bytes,
        gather_kernels.finish_bytes,
    ),
    "forward": (forward_kernels.nearest_mean, forward_kernels.finish_packed),
}


def must_compile(method: str = "gather") -> bool:
    """Say whether the first volume of this kind will wait for its loops to be compiled.

    That takes some ten seconds, once: the result is kept beside the package, or in the
    user's cache folder where that cannot be written to.

    Args:
        method: ``"gather"`` or ``"forward"``.
    """
    return not all(kernel.signatures or _is_stored(kernel) for kernel in _NEEDED[method])


def _is_stored(kernel) -> bool:
    """Whether a compiled form is stored that is not older than the source."""
    source = Path(kernel.py_func.__code__.co_filename)
    name = f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi"
    newest = max(
        (path.stat().st_mtime for path in Path(kernel.stats.cache_path).glob(name)), default=0.0
    )
    return newest >= source.stat().st_mtime
