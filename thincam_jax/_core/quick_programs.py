"""Programs that run once for a size of image, compiled in half the time."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp

from thincam_jax._core.checks import holds_traced, is_traced

_Function = TypeVar("_Function", bound=Callable[..., Any])


def quickly_compiled(function: _Function, static_argnames: str | tuple[str, ...] = ()) -> _Function:
    """`jax.jit` for a program that runs once for a size: its compiling is what it costs.

    On a processor LLVM optimises it the least: half as long to compile, up to three times as long
    to run (docs/decisions/quick_programs.md). Within another program it is a part of that one.
    """
    thorough = jax.jit(function, static_argnames=static_argnames)
    least = {"xla_backend_optimization_level": 0}
    quick = jax.jit(function, static_argnames=static_argnames, compiler_options=least)

    @functools.wraps(function)
    def call(*arguments, **named):
        is_part = holds_traced(arguments, named) or is_traced(jnp.zeros(()))
        run = quick if jax.default_backend() == "cpu" and not is_part else thorough
        return run(*arguments, **named)

    return cast(_Function, call)
