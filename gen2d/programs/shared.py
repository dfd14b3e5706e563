"""Programs that are traced and compiled once for all configs of one structure and all devices of one kind.

The numbers of a config are arguments of its programs (records/parameter.py), so another gravity, radius or colour needs
no other program. Compiled programs are kept in memory and on disk (programs/executables.py).
"""

import re
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.interpreters import partial_eval
from jax.sharding import SingleDeviceSharding

from gen2d.config.config import Config
from gen2d.config.parameters import parametrized, split_numbers
from gen2d.programs import devices, executables
from gen2d.programs.devices import Device
from gen2d.programs.executables import Trace
from gen2d.records.layout import Layout
from gen2d.records.parameter import SIZE, Tape
from gen2d.storage.sealed import as_json, sha256

MAX_PROGRAMS = 24  # loaded at once; each takes up to thousands of the 65,530 memory maps that a process may have

Build = Callable[[Config, Layout], Callable[..., Any]]


class Program:
    """A traced program, which is compiled when it first runs and loaded on each device where it runs.

    Attributes
    ----------
    trace : Trace
        Its parameters, the hash of its text without names and source locations, and the shapes of its results.
    x64 : bool
        Whether it is traced, compiled and called in jax's 64-bit mode.
    executable : bytes or None
        Its executable, for all devices of its kind; None until it is compiled, and where XLA cannot give the bytes.
    """

    def __init__(
        self, trace: Trace, device: Device, x64: bool, lowered: Any = None, executable: bytes | None = None
    ) -> None:
        self.trace, self.x64, self.executable = trace, x64, executable
        self._device, self._lowered = device, lowered  # lowered for this device, where there is no executable yet
        self._loaded: dict[Device, Callable[..., Any]] = {}
        self._lock = threading.Lock()

    def load(self, device: Device) -> Callable[..., Any]:
        """The program on a device, as a function of leaves; compiled on the first call for any device."""
        with self._lock, jax.enable_x64(self.x64):
            if device not in self._loaded:
                if self.executable is None:
                    self._loaded[self._device], self.executable = executables.compiled(self._lowered, self._device)
                    if self.executable is not None:
                        executables.store_executable(self.trace.digest, device, self.executable)
                        self._lowered = None
                if device not in self._loaded:
                    assert self.executable is not None, f"XLA has no executable for {device}"
                    self._loaded[device] = executables.loaded(self.executable, device)
            return self._loaded[device]

    def unload(self) -> None:
        """Free the memory of the program on all devices; the next call loads it again."""
        with self._lock:
            self._loaded.clear()


class BoundProgram(NamedTuple):
    """A program with the numbers of one config."""

    program: Program
    numbers: np.ndarray  # uint32 [SIZE]

    def __call__(self, device: Device, *args: Any) -> Any:
        """Result of the program on a device; without the 64-bit mode it takes float64 as float32."""
        program, x64 = self.program.load(device), self.program.x64
        with jax.enable_x64(x64):
            leaves = program(self.numbers, *(_taken(leaf, x64) for leaf in jax.tree.leaves(args)))
        return jax.tree.unflatten(jax.tree.structure(self.program.trace.results), leaves)

    @property
    def results(self) -> Any:
        """Tree of jax.ShapeDtypeStruct: shapes and types of its results."""
        return self.program.trace.results

    @property
    def sha256(self) -> str:
        """Hash of the program's text and of the words of its arguments that come from the config."""
        return sha256(as_json([self.program.trace.digest, self.numbers[: self.program.trace.tape.size].tolist()]))


_programs: list[tuple[str, Program]] = []  # with their keys, the last used at the end
_lock = threading.Lock()


def program_for(
    config: Config, layout: Layout, key: Hashable, build: Build, args: tuple, device: Device, x64: bool = False
) -> BoundProgram:
    """The program of a config: one that is already there if it serves the config, else a new one, traced for `args`.

    Parameters
    ----------
    config : Config
        The config; sections that the program does not depend on should have their defaults.
    layout : Layout
        Layout of the videos.
    key : hashable
        Everything else that determines the program, such as its sizes.
    build : callable
        `build(config, layout)` returns the function to be traced, for a config and layout whose numbers are parameters.
    args : tuple
        Arguments of the function, or their shapes.
    device : jax.Device
        Any device of the kind that the program shall run on.
    x64 : bool
        Whether the program runs in jax's 64-bit mode.
    """
    structure, leaves = split_numbers(config, layout)

    def function(tape: Tape) -> Callable[..., Any]:
        return build(*parametrized(config, tape, layout))

    own_code = bool(config.copies)
    return _bound(_Request(build.__qualname__, (key, structure), leaves, function, args, device, own_code, x64))


def cached_jit(
    function: Callable[..., Any], key: Hashable | None, own_code: bool = False, x64: bool = False
) -> Callable[..., Any]:
    """A function whose compiled programs are kept in memory and on disk, as those of configs are.

    Parameters
    ----------
    function : callable
        A function of trees of arrays. Where it is differentiated or traced, it is only jitted.
    key : hashable or None
        Everything that determines its programs, besides gen2d's sources and the shapes and types of its arguments.
        Equal keys have the same `repr`. None where nobody can say; the function is then only jitted.
    own_code : bool
        Whether a user's file can reach the function.
    x64 : bool
        Whether the function runs in jax's 64-bit mode; otherwise it takes float64 as float32.
    """
    device, name = devices.default(), f"{function.__module__}.{function.__qualname__}"
    jitted = jax.jit(function)

    def call(*args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return jitted(*args)
        with jax.enable_x64(x64):
            if key is None:
                return jitted(*args)
            args = tree.unflatten(jax.device_put(leaves, device))
        return _bound(_Request(name, key, [], lambda tape: function, args, device, own_code, x64))(device, *args)

    return call


class _Request(NamedTuple):
    """What a program is wanted for."""

    name: str
    key: Hashable
    leaves: Sequence[Any]  # numbers of the config
    function: Callable[[Tape], Callable[..., Any]]  # to be traced
    args: tuple
    device: Device
    own_code: bool
    x64: bool

    @property
    def types(self) -> list[jax.ShapeDtypeStruct]:
        """Shapes and types of the leaves of the arguments."""
        return [jax.ShapeDtypeStruct(np.shape(x), _type(x, self.x64)) for x in jax.tree.leaves(self.args)]


def _type(leaf: Any, x64: bool) -> np.dtype:
    """Type as which a program takes a leaf of its arguments."""
    return np.dtype(np.float32) if leaf.dtype == np.float64 and not x64 else leaf.dtype


def _taken(leaf: Any, x64: bool) -> Any:
    """A leaf as a program takes it."""
    dtype = _type(leaf, x64)
    return leaf if leaf.dtype == dtype else leaf.astype(dtype)


def _bound(request: _Request) -> BoundProgram:
    """The program that serves a request: one that is in memory or on disk, else a new one."""
    name, key, leaves, _, args, device, own_code, x64 = request
    types = [(x.shape, str(x.dtype)) for x in request.types]
    parts = name, key, str(jax.tree.structure(args)), types, device.device_kind, x64
    # Addresses of functions differ between processes; their sources are part of the key on disk.
    text = re.sub(r" at 0x[0-9a-f]+", "", repr(parts))
    with _lock, jax.enable_x64(x64):
        for entry in _programs:
            numbers = entry[1].trace.tape.arguments(leaves) if entry[0] == text else None
            if numbers is not None:
                _programs.remove(entry)
                break
        else:
            disk = text, device, own_code
            program = _stored(disk, x64, leaves)
            if program is None:
                program = _traced(request)
                executables.store_trace(*disk, program.trace)
            entry = text, program
            numbers = program.trace.tape.arguments(leaves)
            assert numbers is not None, "a program serves the config that it is traced for"
        _programs.append(entry)
        while len(_programs) > MAX_PROGRAMS:
            _programs.pop(0)[1].unload()
        return BoundProgram(entry[1], numbers)


def clear() -> None:
    """Forget all programs in memory."""
    with _lock:
        while _programs:
            _programs.pop()[1].unload()


def _stored(disk: tuple[str, Device, bool], x64: bool, leaves: Sequence[Any]) -> Program | None:
    """The program on disk that serves these numbers; None if there is none."""
    device = disk[1]
    for trace in executables.find_traces(*disk):
        if trace.tape.arguments(leaves) is not None:
            return _loadable(trace, device, x64)
    return None


def _loadable(trace: Trace, device: Device, x64: bool) -> Program | None:
    """The program with this trace, if its executable is on disk and can be loaded."""
    executable = executables.find_executable(trace.digest, device)
    try:
        program = None if executable is None else Program(trace, device, x64, executable=executable)
        if program is not None:
            program.load(device)
        return program
    except Exception:  # XLA may fail in any way for a foreign executable, which is compiled again
        return None


def _traced(request: _Request) -> Program:
    device, tape, one = request.device, Tape(), SingleDeviceSharding(request.device)
    function, tree = request.function(tape), jax.tree.structure(request.args)
    results: Any = None

    def run(numbers: jax.Array, *leaves: Any) -> list[jax.Array]:
        nonlocal results
        with tape.tracing(numbers):
            results = function(*tree.unflatten(leaves))
        return jax.tree.leaves(results)

    run.__name__ = request.name.rpartition(".")[2]
    numbers = jax.ShapeDtypeStruct((SIZE,), np.uint32)
    shapes = [jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=one) for x in (numbers, *request.types)]
    traced = jax.jit(run).trace(*shapes)
    lowered = traced.lower()
    results = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), results)
    # jax leaves inputs that are not used out of the text, so programs that read another input of a type have one text.
    jaxpr = traced.jaxpr.jaxpr
    _, used = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    inputs = [f"{x.dtype}{x.shape}{'' if read else ' unused'}" for x, read in zip(shapes, used, strict=True)]
    trace = Trace(tape, sha256(as_json([canonical(lowered.as_text()), inputs])), results)
    return _loadable(trace, device, request.x64) or Program(trace, device, request.x64, lowered)


def canonical(text: str) -> str:
    """Text of a lowered program with functions renamed to numbers and names of arguments and results removed."""
    names = re.findall(r"func\.func (?:public |private )?@([\w.$-]+)\(", text)
    numbers = {name: f"@f{number}" for number, name in enumerate(dict.fromkeys(names))}
    text = re.sub(r"@([\w.$-]+)", lambda match: numbers.get(match[1], match[0]), text)
    text = re.sub(r'jax\.(?:result_info|arg_info) = "[^"]*"', "", text)
    return re.sub(r"^module @\S+", "module", text, count=1, flags=re.M)
