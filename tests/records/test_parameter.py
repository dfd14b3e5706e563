"""Parameters: what is recorded for some numbers holds for others, or a guard says that it does not."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gen2d.core.errors import ConfigError
from gen2d.records.parameter import SIZE, Parameter, Tape, apply, maximum, minimum

LEAVES = (2.5, -1.25, 7.0, 3)
OTHERS = ((0.5, 9.0, 1e-3, 8), (-2.0, -3.5, 1e6, 1), LEAVES)


def program(function: Callable[..., Any]) -> tuple[Tape, Any, list[int]]:
    """Tape and jitted program of a function of the leaves, and a list that grows with each trace."""
    tape, traces = Tape(), []
    parameters = [tape.leaf(i, leaf) for i, leaf in enumerate(LEAVES)]

    @jax.jit
    def run(arguments: jax.Array) -> Any:
        traces.append(1)
        with tape.tracing(arguments):
            return jax.tree.map(jnp.asarray, function(*parameters))

    run.trace(jax.ShapeDtypeStruct((SIZE,), np.uint32))
    return tape, run, traces


FUNCTIONS: dict[str, Callable[..., Any]] = {
    "arithmetic": lambda a, b, c, n: (a + 2 * b) / (c**2 + 1) - (3 - a) * -b + n // 2 + n % 2,
    "numpy": lambda a, b, c, n: np.hypot(a, b) + np.sqrt(np.abs(c)) * np.cos(a),
    "arrays": lambda a, b, c, n: (np.arange(6.0).reshape(2, 3) * a + b)[1],
    "maximum": lambda a, b, c, n: maximum(a, b, c) - minimum(a, b),
    "recorded": lambda a, b, c, n: apply(math.exp, minimum(a, 1.0)),
    "rounded": lambda a, b, c, n: math.floor(a) + math.ceil(b) * n,
    "jax": lambda a, b, c, n: jnp.where(jnp.arange(3) < n, jnp.full(3, a), b) * c + jnp.stack([a, b, c]),
    "scan": lambda a, b, c, n: jax.lax.scan(lambda x, _: (x * 0.5 + a, b * x), jnp.zeros(()), length=4),
    "vmap": lambda a, b, c, n: jax.vmap(lambda x: jnp.clip(x, minimum(a, b), maximum(a, b)))(jnp.arange(5.0)),
    "cond": lambda a, b, c, n: jax.lax.cond(a > jnp.ones(()), lambda: jnp.asarray(b), lambda: 2.0 * c + jnp.zeros(())),
    "draw": lambda a, b, c, n: jax.random.randint(jax.random.key(0), (4,), 0, n + 1),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_one_trace_serves_other_numbers(name: str) -> None:
    function = FUNCTIONS[name]
    tape, run, traces = program(function)
    for leaves in OTHERS:
        arguments = tape.arguments(leaves)
        assert arguments is not None
        expected = jax.jit(lambda leaves=leaves: jax.tree.map(jnp.asarray, function(*leaves)))()
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-6), run(arguments), expected)
    assert len(traces) == 1


def test_in_the_64_bit_mode_fractions_are_float64_and_may_be_float32_too() -> None:
    def both(a: Any, b: Any, c: Any, n: Any) -> Any:
        with jax.enable_x64(False):
            narrow = [jnp.asarray(x) for x in (a / 3, n)]
        return narrow, [jnp.asarray(x) for x in (a / 3, np.array([1.0, 3.0]) / b, n)]

    with jax.enable_x64(True):
        tape, run, _ = program(both)
        for a, b, c, n in OTHERS:
            narrow, wide = run(tape.arguments((a, b, c, n)))
            assert [x.dtype for x in (*narrow, *wide)] == ["float32", "int32", "float64", "float64", "int32"]
            expected = np.float32(a / 3), n, a / 3, np.array([1, 3]) / b, n
            for x, number in zip((*narrow, *wide), expected, strict=True):
                np.testing.assert_array_equal(x, number)


@pytest.mark.parametrize(
    ("use", "served", "refused"),
    [
        (lambda a, n: 1.0 if a > 2 else 0.0, (9.0, 3), (1.0, 3)),
        (lambda a, n: jnp.zeros(n), (1.0, 3), (2.5, 4)),
        (lambda a, n: math.sqrt(a), (2.5, 9), (2.25, 3)),
        (lambda a, n: float(int(a)), (2.75, 3), (3.0, 3)),
        (lambda a, n: jnp.arange(5)[int(n)], (0.0, 3), (0.0, 2)),
        (lambda a, n: float(a == 2.5), (2.5, 4), (2.0, 3)),
        (lambda a, n: 1 / a, (5.0, 3), (0.0, 3)),
        (lambda a, n: maximum(a, n), (0.5, 9), (9.5, 1)),  # whole, or a fraction
    ],
)
def test_numbers_that_python_branches_on_are_guarded(use: Callable, served: tuple, refused: tuple) -> None:
    tape, _, _ = program(lambda a, b, c, n: use(a, n))
    assert tape.arguments((served[0], 0.0, 0.0, served[1])) is not None
    assert tape.arguments((refused[0], 0.0, 0.0, refused[1])) is None


def test_too_many_numbers_are_an_error_of_the_config() -> None:
    tape = Tape()
    number: Any = tape.leaf(0, np.zeros(SIZE + 1))
    with pytest.raises(ConfigError, match=r"takes 16,385 numbers or more, but at most 16,384 are possible"):
        jax.make_jaxpr(lambda words: _within(tape, words, number))(np.zeros(SIZE, np.uint32))


def _within(tape: Tape, words: Any, number: Any) -> Any:
    with tape.tracing(words):
        return jnp.asarray(number)


def test_a_parameter_is_an_array_within_its_trace_only() -> None:
    number = Tape().leaf(0, 1.0)
    with pytest.raises(RuntimeError, match="only while its program is traced"):
        jnp.asarray(number)


def test_equal_operations_are_one_parameter_and_other_tapes_differ() -> None:
    a: Any = Tape().leaf(0, 1.0)
    b: Any = Tape().leaf(0, 1.0)
    assert a + 1 is a + 1
    assert isinstance(a + 1, Parameter)
    assert a != b
    assert len({a, b}) == 2
