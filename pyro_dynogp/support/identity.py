"""What tells one value from another, in every process: a digest of all that it is made of."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import sysconfig
from collections.abc import Iterator, Mapping
from importlib import metadata
from types import CodeType, FunctionType, MethodType, ModuleType

import numpy as np
from torch import Tensor

from pyro_dynogp.support.errors import invalid

# Where code lies that its version tells from another; other code is the user's.
INSTALLED = tuple(sysconfig.get_paths()[name] for name in ("purelib", "platlib", "stdlib"))
# Packages on whose version the last bit of a result may depend.
PACKAGES = ("pyro-dynogp", "torch", "pyro-ppl", "gpytorch", "numpy", "scipy", "numba")


def versions() -> list[str]:
    """The packages that results depend on, with their versions."""
    return [f"{name} {metadata.version(name)}" for name in PACKAGES]


def digest(value: object) -> str:
    """Hex SHA-256 of a value by its content: numbers, arrays, modules, functions with their code.

    Functions of the user's count with their code, defaults, closures and the globals that they
    name; those of installed packages by their names.

    Raises:
        ValueError: where a part of it has no content that could be compared.
    """
    return hashlib.sha256("\n".join(_parts(value, ())).encode()).hexdigest()


def _parts(value: object, above: tuple[int, ...]) -> Iterator[str]:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, None.__class__ | bool | int | float | complex | str | bytes):
        yield repr(value)
        return
    if id(value) in above:  # a cycle
        yield f"{len(above) - above.index(id(value))} levels up"
        return
    above = (*above, id(value))
    yield f"{type(value).__module__}.{type(value).__qualname__}("
    for part in _content(value):
        yield from _parts(part, above)
    yield ")"


def _content(value: object) -> Iterator[object]:
    """What a value is made of."""
    if isinstance(value, Tensor):
        value = value.detach().resolve_conj().cpu().numpy()
    if isinstance(value, np.ndarray) and value.dtype != object:
        plain = np.ascontiguousarray(value)
        yield from (str(plain.dtype), value.shape, hashlib.sha256(plain.data).hexdigest())
    elif isinstance(value, Mapping):
        yield from sorted(value.items(), key=lambda item: digest(item[0]))
    elif isinstance(value, set | frozenset):
        yield from sorted(map(digest, value))
    elif isinstance(value, list | tuple | np.ndarray):
        yield from value
    elif isinstance(value, CodeType):
        yield from (value.co_code, value.co_names, value.co_varnames, value.co_consts)
    elif isinstance(value, FunctionType):
        yield from _function(value)
    elif isinstance(value, MethodType):
        yield from (value.__func__, value.__self__)
    elif isinstance(value, functools.partial):
        yield from (value.func, value.args, value.keywords)
    elif isinstance(value, ModuleType):
        yield value.__name__
    elif hasattr(value, "__qualname__"):  # a class, or a function that is compiled
        yield f"{value.__module__}.{value.__qualname__}"
        own = [x for x in vars(value).values() if isinstance(x, FunctionType)] if isinstance(
            value, type) else []  # fmt: skip
        yield from (f for f in own if _is_users(f))
    elif dataclasses.is_dataclass(value):
        yield from ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
        yield type(value)
    elif hasattr(value, "__dict__"):
        # Torch numbers the hooks of all modules of a process: the numbers differ from run to run.
        yield from (type(value), {k: v for k, v in vars(value).items() if "_hook" not in k})
    else:
        try:
            yield from (part for part in value.__reduce_ex__(2)[:3] if part is not None)
        except TypeError as error:
            raise invalid(
                "checkpoint",
                expected="a model and a method that their content identifies",
                got=f"a {type(value).__name__} in them",
            ) from error


def _function(function: FunctionType) -> Iterator[object]:
    yield (function.__module__, function.__qualname__)
    if not _is_users(function):
        return
    code = function.__code__
    yield from (code, function.__defaults__, function.__kwdefaults__)
    cells = zip(code.co_freevars, function.__closure__ or (), strict=True)
    yield [(name, _held(cell)) for name, cell in cells]
    known = function.__globals__
    yield [(name, known[name]) for name in sorted(set(_names(code))) if name in known]


def _held(cell: object) -> object:
    try:
        return cell.cell_contents  # type: ignore[attr-defined]
    except ValueError:  # not yet assigned
        return "empty"


def _names(code: CodeType) -> Iterator[str]:
    inner = (_names(one) for one in code.co_consts if isinstance(one, CodeType))
    return itertools.chain(code.co_names, *inner)


def _is_users(function: FunctionType) -> bool:
    """Whether code is neither this package's nor that of another one installed."""
    own = function.__module__.split(".")[0] == "pyro_dynogp"
    return not own and not function.__code__.co_filename.startswith(INSTALLED)
