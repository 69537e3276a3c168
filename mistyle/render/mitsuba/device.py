"""Which Mitsuba variant draws, and on how many threads. Chosen at run time, never by an import."""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.process import stopping
from mistyle.setup.environment import known_llvm, use_llvm

# The first that answers is taken; a GPU needs no LLVM.
VARIANTS = {"cuda_ad_rgb": "CUDA", "metal_ad_rgb": "Metal", "llvm_ad_rgb": "LLVM"}

# Dr.Jit 1.5 refuses LLVM 14 itself; 15 and 16 end the whole process when the first kernel is compiled.
OLDEST_LLVM = 17

LLVM_HELP = (
    "Run `python3 -m mistyle doctor`: it fetches an LLVM that works or prints the command for this system "
    "(on Debian 12: apt-get install libllvm19 libatomic1; then DRJIT_LIBLLVM_PATH may name the libLLVM file)."
)


def use(variant: str | None = None, threads: int | None = None) -> str:
    """Make a differentiable RGB variant of Mitsuba current and return its name.

    `variant` None keeps the variant that is current already, or else takes the first of VARIANTS that answers.
    `threads` sets Dr.Jit's thread count (CPU only; None leaves it): results are bit-identical only at the same count.
    Cheap to call again; every function of `render/` calls it. Raises EnvironmentMissing when nothing answers.
    """
    if "drjit" not in sys.modules:
        use_llvm()
    import drjit as dr
    import mitsuba as mi

    current = mi.variant()
    if variant is None:
        variant = current if current in VARIANTS else _first_that_answers(mi.variants())
    elif variant not in VARIANTS:
        raise EnvironmentMissing(f"Mitsuba variant '{variant}' cannot be used; expected one of {', '.join(VARIANTS)}.")
    if variant != current:
        if not _answers(variant, mi.variants()):
            raise EnvironmentMissing(_missing(variant))
        mi.set_variant(variant)
    if threads is not None and threads != dr.thread_count():
        if threads < 1:
            raise ValueError(f"threads is {threads}; expected 1 or more")
        dr.set_thread_count(threads)
    return variant


@contextmanager
def file_threads() -> Iterator[None]:
    """Two threads at least: with one, Mitsuba 3.9 waits for ever when it reads or writes an OpenEXR file."""
    import drjit as dr

    before = dr.thread_count()
    if before < 2:
        dr.set_thread_count(2)
    try:
        yield
    finally:
        if before < 2:
            dr.set_thread_count(before)


@contextmanager
def plain_errors(doing: str) -> Iterator[None]:
    """What Mitsuba and Dr.Jit raise while `doing`, as one sentence (InputRefused); a request to stop stays one.

    Dr.Jit wraps what is raised inside a loop, signals included, into a RuntimeError.
    """
    try:
        yield
    except RuntimeError as error:
        stopping.check()
        cause: BaseException = error
        while (inner := cause.__cause__ or cause.__context__) is not None:
            cause = inner
        said = " ".join(str(cause).split())
        if "not attached to the AD graph" in said:
            said = "no gradient reaches the chosen parameters: no camera sees them, or their plugin passes none on"
        raise InputRefused(
            f"Mitsuba failed while {doing}: {said[:400].rstrip('.')}. Check that the mitsuba command renders the scene."
        ) from error


def give_back() -> None:
    """Memory that Dr.Jit keeps for arrays to come goes back to the system."""
    import drjit as dr

    dr.flush_malloc_cache()


class Frozen:
    """`dr.freeze` of a function, with Python's garbage collector at rest while it runs.

    An array on NumPy's memory that is let go while Dr.Jit 1.5 records ends the whole process; the collector may do
    that at any time, to arrays that have nothing to do with the function. With $MISTYLE_PLAIN set nothing is recorded,
    each call is traced anew: slow, and the way to go on where a recording ends the process all the same.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        import drjit as dr

        self._run: Any = function if os.environ.get("MISTYLE_PLAIN") else dr.freeze(function)

    def __call__(self, *arguments: Any) -> Any:
        collecting = gc.isenabled()
        gc.disable()
        try:
            return self._run(*arguments)
        finally:
            if collecting:
                gc.enable()

    @property
    def n_recordings(self) -> int:
        """How often the function has been recorded so far."""
        return getattr(self._run, "n_recordings", 0)


def _first_that_answers(built: list[str]) -> str:
    for variant in VARIANTS:
        if _answers(variant, built):
            return variant
    raise EnvironmentMissing(_missing("llvm_ad_rgb"))


def _answers(variant: str, built: list[str]) -> bool:
    import drjit as dr

    backend = getattr(dr.JitBackend, VARIANTS[variant], None)
    if variant not in built or backend is None or not dr.has_backend(backend):
        return False
    return VARIANTS[variant] != "LLVM" or dr.detail.llvm_version()[0] >= OLDEST_LLVM


def _missing(variant: str) -> str:
    import drjit as dr

    if VARIANTS[variant] != "LLVM":
        return f"Mitsuba's {variant} does not answer on this machine (no device or no driver). Use llvm_ad_rgb instead."
    if (ours := known_llvm()) and not os.environ.get("DRJIT_LIBLLVM_PATH"):
        return (
            f"Dr.Jit was imported before it could load the working LLVM ({ours}). Call"
            " `mistyle.setup.environment.use_llvm()` before the first import of mitsuba or drjit."
        )
    if not dr.has_backend(dr.JitBackend.LLVM):
        return f"No LLVM library that Dr.Jit can load was found, and no GPU answers. {LLVM_HELP}"
    found = ".".join(str(n) for n in dr.detail.llvm_version())
    return f"LLVM {found} was found; {OLDEST_LLVM} or newer is needed (older ones abort while compiling). {LLVM_HELP}"
