"""Eight numbers that the compiled kernels treat as one: the same quantity of eight points.

numba knows numbers and arrays; whether it finds that neighbouring numbers of an array can be
computed together depends on how a loop is written. Here `Lanes` is a type of its own, a vector of
LLVM, with +, -, *, / and what the kernels need besides. Every operation acts on each lane by
itself and rounds as IEEE 754 says, so that a point's result is the same in any lane and beside any
other points. Processors with shorter vectors take two or four instructions for one.

An array of lanes is a contiguous float64 array whose last axis has `WIDTH` entries; `get` and `put`
take the number of the vector, counted through all other axes.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir
from numba import njit
from numba.core.cgutils import get_or_insert_function
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model, types

from pyro_dynogp.support.compiled import BORROWING

WIDTH = 8


class LanesType(types.Type):
    """numba's type of eight float64 numbers."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{WIDTH}")


LANES = LanesType()
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
WHOLE = ir.VectorType(ir.IntType(64), WIDTH)


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def _constant(x: float) -> ir.Constant:
    return ir.Constant(VECTOR, [x] * WIDTH)


def _operator(symbol: Any, instruction: str) -> None:
    """Let a binary operator of Python act on lanes."""

    @infer_global(symbol)
    class _Template(ConcreteTemplate):
        cases = [signature(LANES, LANES, LANES)]  # noqa: RUF012 (numba's own attribute)

    @lower_builtin(symbol, LANES, LANES)
    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


for _symbol, _instruction in (
    ("add", "fadd"),
    ("sub", "fsub"),
    ("mul", "fmul"),
    ("truediv", "fdiv"),
):
    _operator(getattr(operator, _symbol), _instruction)


def _address(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    array = context.make_array(sig.args[0])(context, builder, args[0])
    place = builder.mul(args[1], context.get_constant(types.intp, WIDTH))
    return builder.bitcast(builder.gep(array.data, [place]), VECTOR.as_pointer())


@intrinsic
def get(typing: Any, array: Any, k: Any) -> Any:
    """Vector k of an array of lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, sig, args), align=8)

    return LANES(array, types.intp), lower


@intrinsic
def put(typing: Any, array: Any, k: Any, x: Any) -> Any:
    """Write x to vector k of an array of lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, sig, args), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, LANES), lower


@intrinsic
def gather(typing: Any, array: Any, index: Any) -> Any:
    """Numbers of a contiguous float64 array, counted through all axes; index: whole numbers."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        places = builder.fptosi(args[1], WHOLE)
        found = ir.Constant(VECTOR, ir.Undefined)
        for k in range(WIDTH):
            place = builder.gep(data, [builder.extract_element(places, _index(k))])
            found = builder.insert_element(found, builder.load(place), _index(k))
        return found

    return LANES(array, LANES), lower


@intrinsic
def splat(typing: Any, x: Any) -> Any:
    """The same number in every lane."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        one = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), args[0], _index(0))
        order = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return builder.shuffle_vector(one, ir.Constant(VECTOR, ir.Undefined), order)

    return LANES(types.float64), lower


def _index(k: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), k)


@intrinsic
def choose(typing: Any, where: Any, x: Any, y: Any) -> Any:
    """Take x in lanes where `where` is positive, y elsewhere."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        condition = builder.fcmp_ordered(">", args[0], _constant(0.0))
        return builder.select(condition, args[1], args[2])

    return LANES(LANES, LANES, LANES), lower


def _unary(name: str) -> Any:
    @intrinsic
    def function(typing: Any, x: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.FunctionType(VECTOR, [VECTOR])
            found = get_or_insert_function(builder.module, kind, f"{name}.v{WIDTH}f64")
            return builder.call(found, args)

        return LANES(LANES), lower

    return function


root = _unary("llvm.sqrt")
magnitude = _unary("llvm.fabs")
nearest = _unary("llvm.rint")
below = _unary("llvm.floor")


@intrinsic
def total(typing: Any, x: Any) -> Any:
    """Sum of all lanes: of neighbours, of those sums, and so on."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        parts = [builder.extract_element(args[0], _index(k)) for k in range(WIDTH)]
        while len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [builder.fadd(a, b) for a, b in pairs]
        return parts[0]

    return types.float64(LANES), lower


@intrinsic
def power_of_two(typing: Any, k: Any) -> Any:
    """2^k of whole numbers k from -1022 to 1023: k + 1023 are the bits of the exponent."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        low = builder.bitcast(builder.fadd(args[0], _constant(2.0**52 + 1023.0)), WHOLE)
        shift = ir.Constant(WHOLE, [52] * WIDTH)
        return builder.bitcast(builder.shl(low, shift), VECTOR)

    return LANES(LANES), lower


@njit(**BORROWING)
def larger(x, y):
    """The larger of two numbers in each lane."""
    return choose(x - y, x, y)


# Half of pi in parts whose products with whole numbers below 2^20 are exact (fdlibm, e_rem_pio2.c),
# and log 2 likewise (e_exp.c).
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
_LOG_TWO = (6.93147180369123816490e-01, 1.90821492927058770002e-10)
_EXP = tuple(1.0 / math.factorial(k) for k in range(13, 1, -1))
_SIN = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(8, 0, -1))
_COS = tuple((-1.0) ** k / math.factorial(2 * k) for k in range(8, 1, -1))


@njit(**BORROWING)
def _series(coefficients, x):
    total = splat(coefficients[0])
    for k in range(1, len(coefficients)):
        total = total * x + splat(coefficients[k])
    return total


@njit(**BORROWING)
def exponential(a):
    """exp(a) for a <= 0 within 2 units in the last place; zero where it is below 1e-307."""
    n = nearest(larger(a, splat(-708.0)) * splat(1.4426950408889634))
    r = (larger(a, splat(-708.0)) - n * splat(_LOG_TWO[0])) - n * splat(_LOG_TWO[1])
    size = (_series(_EXP, r) * (r * r) + r + splat(1.0)) * power_of_two(n)
    return choose(a + splat(708.0), size, splat(0.0))


@njit(**BORROWING)
def complex_exponential(a, b):
    """exp(a + i b), real and imaginary part, for a <= 0; zero where it is below 1e-307.

    Within 2 units in the last place of its absolute value for |b| < 1e6; beyond, b itself is known
    no better than the result.
    """
    zero = splat(0.0)
    one = splat(1.0)
    size = exponential(a)
    q = nearest(b * splat(0.6366197723675814))
    t = ((b - q * splat(_HALF_PI[0])) - q * splat(_HALF_PI[1])) - q * splat(_HALF_PI[2])
    t = zero - larger(zero - larger(t, splat(-1.0)), splat(-1.0))
    t2 = t * t
    sine = t + t * t2 * _series(_SIN, t2)
    cosine = one - (splat(0.5) * t2 - t2 * t2 * _series(_COS, t2))
    q = q - splat(4.0) * nearest(q * splat(0.25))  # the quarter: -2, -1, 0, 1 or 2
    odd = splat(0.5) - magnitude(magnitude(q) - one)
    real = choose(odd, sine, cosine)
    imag = choose(odd, cosine, sine)
    # cos(t + q pi/2) changes sign for q = 1, 2, -2; sin for q = -1, 2, -2.
    real = choose(q - splat(0.5), zero - real, choose(splat(-1.5) - q, zero - real, real))
    imag = choose(splat(-0.5) - q, zero - imag, choose(q - splat(1.5), zero - imag, imag))
    return size * real, size * imag
