"""Dr.Jit and Mitsuba as `dr` and `mi`, and the choice of variant and threads, at run time and never by an import.

Every module of the renderer and the solver takes `dr` and `mi` from here. They are imported at their first use, so that
importing such a module is quick and needs no LLVM.
"""

import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any, no_type_check

from mistyle.core.errors import EnvironmentMissing, InputRefused
from mistyle.process import stopping
from mistyle.setup.environment import known_llvm, use_llvm

# The first that works is used; a GPU needs no LLVM.
VARIANTS = {"cuda_ad_rgb": "CUDA", "metal_ad_rgb": "Metal", "llvm_ad_rgb": "LLVM"}

# Dr.Jit 1.5 rejects LLVM 14 itself; 15 and 16 abort the process when the first kernel is compiled.
OLDEST_LLVM = 17

LLVM_HELP = (
    "Run `python3 -m mistyle doctor`: it downloads a working LLVM or prints the command for this system "
    "(on Debian 12: apt-get install libllvm19 libatomic1; then DRJIT_LIBLLVM_PATH may name the libLLVM file)."
)


class _AtFirstUse(ModuleType):
    """A module that is imported when something of it is used. Dr.Jit looks for LLVM when it is imported."""

    @no_type_check  # called for every operation that is traced: pytest's check of annotations would take most of it
    def __getattr__(self, name: str) -> Any:
        if name != "module":
            return getattr(self.module, name)
        if "drjit" not in sys.modules:
            use_llvm()
        self.module = import_module(self.__name__)
        return self.module


dr: Any = _AtFirstUse("drjit")
mi: Any = _AtFirstUse("mitsuba")  # of any variant: Mitsuba's own type stubs describe one


def use(variant: str | None = None, threads: int | None = None) -> str:
    """Make a differentiable RGB variant of Mitsuba current and return its name.

    `variant` None keeps the current variant, or else selects the first of VARIANTS that works. `threads` sets Dr.Jit's
    thread count (CPU only; None keeps it): results are bit-identical only at the same count. Repeated calls are cheap;
    every function of `render/` calls it. Raises EnvironmentMissing if no variant works.
    """
    current: str = mi.variant() or ""
    if variant is None:
        variant = current if current in VARIANTS else _first_working(mi.variants())
    elif variant not in VARIANTS:
        raise EnvironmentMissing(f"Mitsuba variant '{variant}' cannot be used; expected one of {', '.join(VARIANTS)}.")
    if variant != current:
        if not _works(variant, mi.variants()):
            raise EnvironmentMissing(_missing(variant))
        mi.set_variant(variant)
    if threads is not None and threads != dr.thread_count():
        if threads < 1:
            raise ValueError(f"threads is {threads}; expected 1 or more")
        dr.set_thread_count(threads)
    return variant


@contextmanager
def file_threads() -> Iterator[None]:
    """At least two threads: with one, Mitsuba 3.9 deadlocks when it reads or writes an OpenEXR file."""
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
    """Errors of Mitsuba and Dr.Jit while `doing`, as one sentence (InputRefused); a request to stop is passed on.

    Dr.Jit wraps exceptions inside a loop, signals included, into a RuntimeError.
    """
    try:
        yield
    except RuntimeError as error:
        stopping.check()
        cause: BaseException = error
        while (inner := cause.__cause__ or cause.__context__) is not None:
            cause = inner
        text = " ".join(str(cause).split())
        if "not attached to the AD graph" in text:
            text = "no gradient reaches the chosen parameters: no camera sees them, or their plugin propagates none"
        raise InputRefused(
            f"Mitsuba failed while {doing}: {text[:400].rstrip('.')}. Check that the mitsuba command renders the scene."
        ) from error


def give_back() -> None:
    """Release Dr.Jit's cached memory to the system."""
    dr.flush_malloc_cache()


class Frozen:
    """`dr.freeze` of a function, with Python's garbage collector disabled while it runs.

    If an array on NumPy's memory is freed while Dr.Jit 1.5 records, the process aborts. The collector may free
    unrelated arrays at any time. With $MISTYLE_PLAIN set nothing is recorded and each call is traced anew: slow, but a
    workaround if a recording still aborts the process.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
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
        """Number of recordings of the function."""
        return getattr(self._run, "n_recordings", 0)


def _first_working(built: list[str]) -> str:
    for variant in VARIANTS:
        if _works(variant, built):
            return variant
    raise EnvironmentMissing(_missing("llvm_ad_rgb"))


def _works(variant: str, built: list[str]) -> bool:
    backend = getattr(dr.JitBackend, VARIANTS[variant], None)
    if variant not in built or backend is None or not dr.has_backend(backend):
        return False
    return VARIANTS[variant] != "LLVM" or dr.detail.llvm_version()[0] >= OLDEST_LLVM


def _missing(variant: str) -> str:
    if VARIANTS[variant] != "LLVM":
        return f"Mitsuba's {variant} does not work on this machine (no device or no driver). Use llvm_ad_rgb instead."
    if (ours := known_llvm()) and not os.environ.get("DRJIT_LIBLLVM_PATH"):
        return (
            f"Dr.Jit was imported before it could load the working LLVM ({ours}). Call"
            " `mistyle.setup.environment.use_llvm()` before the first import of mitsuba or drjit."
        )
    if not dr.has_backend(dr.JitBackend.LLVM):
        return f"Found neither an LLVM library that Dr.Jit can load nor a working GPU. {LLVM_HELP}"
    version = ".".join(str(n) for n in dr.detail.llvm_version())
    return f"Found LLVM {version}; expected {OLDEST_LLVM} or newer (older ones abort while compiling). {LLVM_HELP}"
