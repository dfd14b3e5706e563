"""Programs that are traced and compiled once for all configs of one structure.

The numbers of a config are arguments of its programs (records/parameter.py), so another gravity, radius or colour needs
no other program.
"""

import threading
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import jax
import numpy as np

from gen2d.config.config import Config
from gen2d.config.parameters import parametrized, split_numbers
from gen2d.records.parameter import SIZE, Tape

MAX_PROGRAMS = 12  # kept in memory; each takes up to thousands of the 65,530 memory maps that a process may have

Build = Callable[[Config], Callable[..., Any]]
Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]


class Program(NamedTuple):
    """A traced program and the tape of its parameters."""

    jitted: Any  # called with the arguments of the tape, uint32 [SIZE], and others
    tape: Tape


class BoundProgram(NamedTuple):
    """A program with the numbers of one config."""

    program: Program
    numbers: np.ndarray  # uint32 [SIZE]

    def __call__(self, *args: Any, **named: Any) -> Any:
        """Result of the program, which is compiled on its first call for a device."""
        return self.program.jitted(self.numbers, *args, **named)

    @property
    def values(self) -> list[int]:
        """Words of the arguments that the program uses."""
        return self.numbers[: self.program.tape.size].tolist()

    def lower(self, *args: Any) -> Any:
        """The program, lowered for these arguments."""
        return self.program.jitted.lower(self.numbers, *args)


_programs: list[tuple[Hashable, Program]] = []  # with their keys, the last used at the end
_lock = threading.Lock()


def program_for(config: Config, key: Hashable, build: Build, args: tuple, wrap: Wrap | None = None) -> BoundProgram:
    """The program of a config: one that is already there if it serves the config, else a new one, traced for `args`.

    Parameters
    ----------
    config : Config
        The config; sections that the program does not depend on should have their defaults.
    key : hashable
        Everything else that determines the program, such as its devices and sizes.
    build : callable
        `build(config)` returns the function to be traced, for a config whose numbers are parameters.
    args : tuple
        Arguments of the function, or their shapes.
    wrap : callable
        Transformation of the function `run(numbers, *args)` before it is jitted.
    """
    structure, leaves = split_numbers(config)
    key = build.__name__, key, structure
    with _lock:
        for entry in _programs:
            numbers = entry[1].tape.arguments(leaves) if entry[0] == key else None
            if numbers is not None:
                _programs.remove(entry)
                break
        else:
            entry = key, _traced(config, build, args, wrap)
            numbers = entry[1].tape.arguments(leaves)
            assert numbers is not None, "a program serves the config that it is traced for"
        _programs.append(entry)
        while len(_programs) > MAX_PROGRAMS:
            _programs.pop(0)[1].jitted.clear_cache()
        return BoundProgram(entry[1], numbers)


def clear() -> None:
    """Free all programs."""
    with _lock:
        while _programs:
            _programs.pop()[1].jitted.clear_cache()


def _traced(config: Config, build: Build, args: tuple, wrap: Wrap | None) -> Program:
    tape = Tape()
    function = build(parametrized(config, tape))

    def run(numbers: jax.Array, *args: Any, **named: Any) -> Any:
        with tape.tracing(numbers):
            return function(*args, **named)

    run.__name__ = build.__name__
    jitted = jax.jit(run if wrap is None else wrap(run))
    jitted.trace(jax.ShapeDtypeStruct((SIZE,), np.uint32), *args)
    return Program(jitted, tape)
