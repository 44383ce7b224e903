"""Gymnasium environments of shadow-repose, its policies, and its program.

    import shadow_repose

    envs = shadow_repose.VectorEnv(1024, policy="builtin")   # the task that the built-in policy was trained for
    policy = shadow_repose.Policy.load("builtin")
    observations, _ = envs.reset(seed=0)                     # [1024, O]
    observations, rewards, terminated, truncated, info = envs.step(policy(observations))

NumPy and Gymnasium are only imported where they are used.
"""
from __future__ import annotations

import importlib
import os
import sys

from ._registration import register

TYPE_CHECKING = False  # as in `typing`, which takes longer to import than all of this
if TYPE_CHECKING:
    from typing import Any

    from . import _native
    from ._policy import Normalizer, Policy, evaluate
    from ._program import program
    from ._show import show
    from .envs import Env, VectorEnv

__all__ = ["Env", "Normalizer", "Policy", "VectorEnv", "evaluate", "program", "show"]


def _expect_avx(facts: str = "/proc/cpuinfo") -> None:
    """Reports a processor that MuJoCo cannot run on. MuJoCo's library would end Python by SIGILL."""
    if os.uname().machine != "x86_64":
        return
    try:
        with open(facts, encoding="ascii", errors="replace") as lines:
            flags = next((line.split() for line in lines if line.startswith("flags")), None)
    except OSError:
        return
    if flags is not None and "avx" not in flags:
        raise ImportError("this processor has no AVX, which MuJoCo needs (Intel and AMD have it since 2011)")


def _binding() -> int:
    """Returns the flags with which the extension module uses the symbols of its own MuJoCo, whatever libraries are loaded already.

    All its symbols are bound at once, so a later library changes nothing. Only where another MuJoCo offers its symbols to all libraries,
    ours come first. The module would then also take `free` from the C library, which must not free what another allocator has allocated.
    On macOS, a library names the library of each symbol that it uses.
    """
    if sys.platform != "linux":
        return os.RTLD_NOW
    import ctypes

    everything = ctypes.CDLL(None)
    if not hasattr(everything, "mj_step"):
        return os.RTLD_NOW
    [used, own] = (ctypes.cast(library.malloc, ctypes.c_void_p).value for library in (everything, ctypes.CDLL("libc.so.6")))
    if used != own:
        raise ImportError(
            "the symbols of another MuJoCo are global and memory has another allocator than the C library's: "
            "import shadow_repose first, or leave out one of the two"
        )
    return os.RTLD_NOW | os.RTLD_DEEPBIND


def _load() -> Any:
    """Loads the extension module."""
    flags = sys.getdlopenflags()
    sys.setdlopenflags(_binding())
    try:
        from . import _native
    finally:
        sys.setdlopenflags(flags)
    return _native


_expect_avx()
if not TYPE_CHECKING:
    _native = _load()

if "gymnasium" in sys.modules:
    register()


_PLACES = {
    "Env": "envs", "Normalizer": "_policy", "Policy": "_policy", "VectorEnv": "envs", "evaluate": "_policy", "program": "_program",
    "show": "_show",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(importlib.import_module("." + _PLACES[name], __name__), name)
    raise AttributeError(f"module 'shadow_repose' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
