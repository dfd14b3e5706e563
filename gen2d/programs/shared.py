"""Programs that are traced and compiled once for all configs of one structure.

The numbers of a config are arguments of its programs (records/parameter.py), so another gravity, radius or colour needs
no other program.
"""

import collections
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


_programs: collections.OrderedDict[Hashable, list[Program]] = collections.OrderedDict()
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
    with _lock:
        key = build.__name__, key, structure
        programs = _programs.setdefault(key, [])
        _programs.move_to_end(key)
        for program in programs:
            numbers = program.tape.arguments(leaves)
            if numbers is not None:
                return BoundProgram(program, numbers)
        program = _traced(config, build, args, wrap)
        programs.append(program)
        numbers = program.tape.arguments(leaves)
        assert numbers is not None, "a program serves the config that it is traced for"
        while sum(map(len, _programs.values())) > MAX_PROGRAMS:
            for old in _programs.popitem(last=False)[1]:
                old.jitted.clear_cache()
        return BoundProgram(program, numbers)


def clear() -> None:
    """Free all programs."""
    with _lock:
        for programs in _programs.values():
            for program in programs:
                program.jitted.clear_cache()
        _programs.clear()


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
