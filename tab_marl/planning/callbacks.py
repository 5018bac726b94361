"""Compiled functions as arguments of a compiled search that is cached on disk.

A search that takes jitted functions as arguments is compiled anew in every process. numba's first-class function types avoid
that: the search knows a signature and receives a pointer. numba's own way of handing over the pointer goes through a C wrapper
(every argument copied twice) and works out the function's type at each call (as long as a hundred simulations take). The type
below holds the address of the function proper and is made once; calls through it are those of any jitted function.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from numba import njit, types
from numba.core import cgutils, ir
from numba.core.errors import NumbaError
from numba.experimental.function_type import FunctionModel
from numba.extending import NativeValue, register_model, unbox


class CallbackType(types.FunctionType):
    """A first-class function type whose values are `Callback` objects."""


register_model(CallbackType)(FunctionModel)


@unbox(CallbackType)
def _unbox_callback(typ: Any, obj: Any, c: Any) -> Any:
    address = c.pyapi.object_getattr_string(obj, "address")
    function = cgutils.create_struct_proxy(typ)(c.context, c.builder)
    function.jit_addr = c.pyapi.long_as_voidptr(address)
    c.pyapi.decref(address)
    function.py_addr = c.builder.ptrtoint(obj, c.context.get_value_type(types.voidptr))
    return NativeValue(function._getvalue())


def _compiled(function: Callable[..., Any], signature: Any) -> Any:
    try:
        return njit(signature, cache=True)(function)
    except RuntimeError as error:  # a function typed at a prompt has no file beside which to keep a cache
        if "locator" not in str(error):
            raise
    return njit(signature)(function)


def _reason(error: NumbaError) -> str:
    """The lines of numba's message that say what and where."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [line.strip() for line in plain.splitlines()]
    telling = [
        line for line in lines if line.startswith(("No implementation", "No conversion", "Cannot", "Can't", ">>>"))
    ]
    places = [line for line in lines if line.startswith("File ")]
    return " ".join([*(telling[:2] or lines[:2]), *places[-1:]]).rstrip(":")


def _truncates(result: Any) -> bool:
    """Whether the function returns, in a tuple, a float where its signature has an integer, which numba cuts to one in silence.

    Known only where the function has just been compiled; one found on disk was looked at when it was put there.
    """
    annotation = result.type_annotation
    declared = getattr(result.signature.return_type, "types", ())
    if not declared or isinstance(annotation, str):
        return False
    for block in annotation.blocks.values():
        for line in block.body:
            if isinstance(line, ir.Assign) and isinstance(line.value, ir.Expr) and line.value.op == "cast":
                given = getattr(annotation.typemap[line.value.value.name], "types", ())
                if any(
                    isinstance(d, types.Integer) and isinstance(g, types.Float)
                    for d, g in zip(declared, given, strict=False)
                ):
                    return True
    return False


class Callback:
    """A function compiled for one signature."""

    def __init__(self, function: Callable[..., Any], signature: Any) -> None:
        try:
            compiled = _compiled(function, signature)
        except NumbaError as error:
            raise TypeError(
                f"{function.__name__} does not compile as {signature}: {_reason(error)}. See tab_marl.planning.model for what "
                "a model's functions take and return; options with compiled=False run them interpreted"
            ) from error
        result = compiled.get_compile_result(signature)
        if _truncates(result):
            compiled._cache.flush()  # or the next process would find it on disk and ask no more
            raise TypeError(
                f"{function.__name__} returns a float as its observation, which would be cut to a whole number: return "
                "np.int64(...) of a number that stands for what is seen; for observations that are measured, see ContinuousModel"
            )
        self._keep = compiled  # the machine code lives as long as this
        self.address = int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))
        self._numba_type_ = CallbackType(signature)


@lru_cache(maxsize=512)
def callback(function: Callable[..., Any], signature: Any) -> Callback:
    """The function compiled for the signature; remembered."""
    return Callback(function, signature)
