"""Parameters: numbers of a config that compiled programs take as arguments, not as constants.

A program is traced with a `Parameter` in the place of each number of the config. Arithmetic on parameters happens on
the host and is recorded on a `Tape`; where one meets a jax array, it becomes an argument of the program. Where Python
needs a value, for a branch, a length or `int()`, the value is recorded as a guard. The program thus serves every config
of the same structure whose numbers satisfy the guards, and the tape computes its arguments from these numbers.

NumPy's functions take parameters (`np.sqrt`, `np.hypot`), and so do `maximum` and `minimum`. Those of `math` need
values, and `max` and `min` comparisons, so they leave guards.
"""

import contextlib
import functools
import math
import operator
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.core.errors import ConfigError

R = TypeVar("R")
SIZE = 2**14  # numbers that a program can take


class Tape:
    """Operations on the numbers of one config, the guards among them, and the arguments of its programs."""

    def __init__(self) -> None:
        self._nodes: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []  # operation and operands, in order
        self._parameters: dict[Hashable, Parameter] = {}
        self.guards: dict[int, Any] = {}  # value that each of these nodes must have
        self._arguments: dict[tuple[int, np.dtype], tuple[int, Parameter]] = {}  # first place, by node and type
        self._used = 0
        self._trace = threading.local()  # its `arguments`: those of the program that this thread traces

    def __getstate__(self) -> tuple[Any, ...]:
        return self._nodes, self.guards, self._arguments, self._used

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.__init__()
        self._nodes, self.guards, self._arguments, self._used = state

    def apply(self, operation: Callable[..., Any], *operands: Any) -> "Parameter":
        """Result of an operation on parameters and constants; the same object for the same operands."""
        known = operation, *(x.node if isinstance(x, Parameter) else _identity(x) for x in operands)
        if known not in self._parameters:
            value = operation(*(x.value if isinstance(x, Parameter) else x for x in operands))
            self._nodes.append((operation, operands))
            self._parameters[known] = Parameter(self, len(self._nodes) - 1, value)
        return self._parameters[known]

    def leaf(self, index: int, value: Any) -> "Parameter":
        """Number `index` of the config."""
        self._nodes.append((_leaf, (index,)))
        return Parameter(self, len(self._nodes) - 1, value)

    @property
    def size(self) -> int:
        """Number of arguments that the programs traced so far take."""
        return self._used

    def guard(self, parameter: "Parameter") -> Any:
        """Value of a parameter, on which the programs then depend."""
        self.guards[parameter.node] = parameter.value
        return parameter.value

    @contextlib.contextmanager
    def tracing(self, arguments: jax.Array) -> Iterator[None]:
        """Context of a program's trace, in which parameters are read from `arguments`, uint32 [SIZE]."""
        outer, self._trace.arguments = getattr(self._trace, "arguments", None), arguments
        try:
            yield
        finally:
            self._trace.arguments = outer

    def traced(self, parameter: "Parameter") -> jax.Array:
        """A parameter as an array of the program that is being traced, of the type `Parameter.dtype`.

        Raises ConfigError if the program has too many.
        """
        arguments = getattr(self._trace, "arguments", None)
        if arguments is None:
            raise RuntimeError("a parameter is an array only while its program is traced")
        dtype, key = parameter.dtype, (parameter.node, parameter.dtype)
        words = [2] if dtype.itemsize == 8 else []
        if key not in self._arguments:
            self._arguments[key] = self._used, parameter
            self._used += math.prod([parameter.size, *words])
            if self._used > SIZE:
                raise ConfigError(
                    f"config: one of its programs takes {self._used:,} numbers or more, but at most {SIZE:,} are "
                    "possible: shorten its longest choice, grid or palette"
                )
        start, shape = self._arguments[key][0], (*parameter.shape, *words)
        return jax.lax.bitcast_convert_type(arguments[start : start + math.prod(shape)].reshape(shape), dtype)

    def arguments(self, leaves: Sequence[Any]) -> np.ndarray | None:
        """Arguments of the programs, uint32 [SIZE], for other leaves; None if the programs do not serve these."""
        values: list[Any] = []
        try:
            with np.errstate(all="ignore"):
                for operation, operands in self._nodes:
                    inputs = (values[x.node] if isinstance(x, Parameter) else x for x in operands)
                    values.append(leaves[next(inputs)] if operation is _leaf else operation(*inputs))
        except (ArithmeticError, LookupError, ValueError):
            return None
        if not all(_identity(values[node]) == _identity(value) for node, value in self.guards.items()):
            return None
        words = np.zeros(SIZE, np.uint32)
        for (node, dtype), (start, parameter) in self._arguments.items():
            argument = _as_argument(values[node], wide=dtype.itemsize == 8)
            if (argument.dtype, argument.shape) != (dtype, parameter.shape):
                return None  # `maximum` of a whole number and a fraction may be either
            words[start : start + argument.nbytes // 4] = argument.ravel().view(np.uint32)
        return words


def _leaf(index: int) -> Any:
    """Leaf number `index`, which the tape looks up."""
    raise AssertionError(index)


def _identity(value: Any) -> Hashable:
    """A hashable value that is equal for constants that are the same, NaN included."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    return type(value), repr(value) if value != value else value


def _as_argument(value: Any, wide: bool) -> np.ndarray:
    """A number as int32 or float32; with `wide`, a fraction is float64."""
    array, real = np.asarray(value), np.float64 if wide else np.float32
    return array.astype(real if array.dtype.kind == "f" else np.int32)


class Parameter:
    """A number, or an array of numbers, that a tape computes from the leaves of a config.

    As an array it is int32 or float32; in jax's 64-bit mode, a fraction is float64.
    """

    __slots__ = ("node", "tape", "value")

    def __init__(self, tape: Tape, node: int, value: Any) -> None:
        self.tape, self.node, self.value = tape, node, value

    # ---- As an array

    dtype = property(lambda self: _as_argument(self.value, wide=jax.config.values["jax_enable_x64"]).dtype)
    shape = property(lambda self: np.shape(self.value))
    ndim = property(lambda self: np.ndim(self.value))
    size = property(lambda self: np.size(self.value))

    def __jax_array__(self) -> jax.Array:
        return self.tape.traced(self)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method != "__call__" or options:
            return NotImplemented
        return self.tape.apply(ufunc, *inputs)

    def __getitem__(self, index: Any) -> "Parameter":
        return self.tape.apply(operator.getitem, self, index)

    # ---- Concrete values, each of them a guard

    def _concrete(self, operation: Callable[..., Any]) -> Any:
        return self.tape.guard(self.tape.apply(operation, self))

    def __bool__(self) -> bool:
        return self._concrete(bool)

    def __int__(self) -> int:
        return self._concrete(int)

    def __float__(self) -> float:
        return self._concrete(float)

    def __index__(self) -> int:
        return self._concrete(operator.index)

    def __len__(self) -> int:
        return self._concrete(len)

    def __hash__(self) -> int:
        return id(self.tape)  # not of the value: sets and dicts must compare, which leaves a guard

    def __repr__(self) -> str:
        return f"Parameter({self.value!r})"

    def __format__(self, spec: str) -> str:
        return format(self.value, spec)


def _operator(operation: Callable[..., Any], swapped: bool = False) -> Callable[..., Any]:
    def method(self: Parameter, *others: Any) -> Any:
        if any(isinstance(other, jax.Array) for other in others):
            array = self.__jax_array__()
            return operation(*others, array) if swapped else operation(array, *others)
        return self.tape.apply(operation, *others, self) if swapped else self.tape.apply(operation, self, *others)

    return method


def _comparison(operation: Callable[..., Any]) -> Callable[..., Any]:
    compared = _operator(operation)

    def method(self: Parameter, other: Any) -> Any:
        if isinstance(other, Parameter) and other.tape is not self.tape:
            return NotImplemented
        result = compared(self, other)
        return bool(result) if isinstance(result, Parameter) and not result.shape else result

    return method


for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow"):
    setattr(Parameter, f"__{_name}__", _operator(getattr(operator, _name)))
    setattr(Parameter, f"__r{_name}__", _operator(getattr(operator, _name), swapped=True))
for _name in ("neg", "pos", "abs"):
    setattr(Parameter, f"__{_name}__", _operator(getattr(operator, _name)))
for _operation in (math.ceil, math.floor, math.trunc, round):
    setattr(Parameter, f"__{_operation.__name__}__", _operator(_operation))
for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Parameter, f"__{_name}__", _comparison(getattr(operator, _name)))

# jitted functions such as jnp.where take parameters as trees; inside they are arrays.
jax.tree_util.register_pytree_node(Parameter, lambda x: ((jnp.asarray(x),), None), lambda _, leaves: leaves[0])  # pyright: ignore[reportArgumentType]


def apply(operation: Callable[..., Any], *operands: Any) -> Any:
    """Result of a host function of numbers; recorded if one of them is a parameter."""
    tape = next((x.tape for x in operands if isinstance(x, Parameter)), None)
    return operation(*operands) if tape is None else tape.apply(operation, *operands)


def recorded(operation: Callable[..., R]) -> Callable[..., R]:
    """Decorator of a host function of numbers, which `apply` then calls."""
    return functools.wraps(operation)(functools.partial(apply, operation))


maximum, minimum = recorded(max), recorded(min)
