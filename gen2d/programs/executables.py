"""Traced and compiled programs on disk, found before anything is traced and loaded on any device of their kind.

A trace holds the parameters of a program (records/parameter.py), the hash of its text and the shapes of its results.
Its folder is named by the hash of all that can reach the program: the structure of the config, versions, sources and
flags. An executable is named by the hashes of the program's text and of what its compiler depends on. Both are code, so
they are read only from folders that this user owns and nobody else can write.
"""

import contextlib
import dataclasses
import hashlib
import inspect
import io
import os
import pathlib
import pickle
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import jax
import numpy as np
from jax._src.lib import xla_client  # pyright: ignore[reportPrivateImportUsage]
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from gen2d.programs import environment
from gen2d.programs.devices import Device, default_cache
from gen2d.records.parameter import Tape
from gen2d.storage.atomic import publish
from gen2d.storage.sealed import as_json, read_bytes, sha256

MAX_BYTES = 2**31  # of all files on disk; the least recently used are removed
FILE_BYTES = 2**28
MAGIC = b"gen2d program 1\n"


@dataclasses.dataclass(frozen=True)
class Trace:
    """All that is known of a traced program but its code."""

    tape: Tape
    digest: str  # sha256 of the text and the inputs of the program
    results: Any  # tree of jax.ShapeDtypeStruct


def compiled(lowered: Any, device: Device) -> tuple[Callable[..., list[jax.Array]], bytes | None]:
    """The executable of a program that jax lowered for a device, and its bytes; None where XLA cannot give them."""
    with _without_jax_cache():  # an executable that jax loads from its cache cannot be serialized again
        executable = lowered.compile(environment.compiler_options(device))
    try:
        return executable, serialize_executable.serialize(executable)[0]
    except (ValueError, NotImplementedError, jax.errors.JaxRuntimeError):
        return executable, None


def loaded(executable: bytes, device: Device) -> Callable[..., list[jax.Array]]:
    """An executable on a device, as a function of the leaves of its arguments that lists those of its results."""
    program, arguments, no_kwargs = _Unpickler(executable, device).load()
    tree, results = jax.tree.structure((tuple(arguments), {})), jax.tree.structure([0] * len(program.output_avals))
    return jax.stages.Compiled(program.load(), [], tree.unflatten(arguments), results, no_kwargs=no_kwargs)


class _Unpickler(serialize_executable._JaxPjrtUnpickler):
    """jax's own reader of executables, but for any device of the kind, not only the one that it was compiled for."""

    def __init__(self, content: bytes, device: Device) -> None:
        super().__init__(io.BytesIO(content), device.client, [device])
        self.device = device

    def persistent_load(self, pid: Any) -> Any:
        if pid[0] == "device":
            return self.device
        if pid[0] != "exec":
            return super().persistent_load(pid)
        options = xla_client.CompileOptions()
        options.num_replicas = options.num_partitions = 1
        options.device_assignment = xla_client.DeviceAssignment.create(np.array([[self.device.id]]))
        return self.device.client.deserialize_executable(pid[1], self.execution_devices, options)


_compiling = 0  # number of threads in `_without_jax_cache`
_was_enabled = True  # jax's own cache, before the first of them
_lock = threading.Lock()


@contextlib.contextmanager
def _without_jax_cache() -> Iterator[None]:
    """Context in which jax's own cache of compiled programs is off, for all threads."""
    global _compiling, _was_enabled
    with _lock:
        _compiling += 1
        if _compiling == 1:
            _was_enabled = jax.config.values["jax_enable_compilation_cache"]
            _enable_jax_cache(False)
    try:
        yield
    finally:
        with _lock:
            _compiling -= 1
            if not _compiling:
                _enable_jax_cache(_was_enabled)


def _enable_jax_cache(enabled: bool) -> None:
    jax.config.update("jax_enable_compilation_cache", enabled)
    compilation_cache.reset_cache()


class _Pickler(pickle.Pickler):
    """Pickler that takes a decorated function for the one that it decorates."""

    def reducer_override(self, value: Any) -> Any:
        if inspect.isfunction(value) and (name := value.__qualname__).isidentifier():
            wrapper = getattr(sys.modules.get(value.__module__), name, None)
            if wrapper is not value and getattr(wrapper, "__wrapped__", None) is value:
                return _wrapped, (value.__module__, name)
        return NotImplemented


def _wrapped(module: str, name: str) -> Any:
    return getattr(import_module(module), name).__wrapped__


# ---- On disk


def find_traces(key: str, device: Device, own_code: bool) -> Iterator[Trace]:
    """Traces of programs with this key for this kind of device; damaged and foreign ones are left out.

    `own_code` says whether a user's file can reach the program.
    """
    folder = _trace_folder(key, device, own_code)
    for path in sorted(folder.iterdir()) if folder is not None and _is_private(folder) else []:
        content = _read(path)
        with contextlib.suppress(Exception):  # one of an unknown version may fail in any way
            if content is not None:
                yield Trace(*pickle.loads(content))


def store_trace(key: str, device: Device, own_code: bool, trace: Trace) -> None:
    """Keep a trace on disk, if there is a folder for it and its operations have names."""
    folder, buffer = _trace_folder(key, device, own_code), io.BytesIO()
    if folder is not None:
        try:
            _Pickler(buffer).dump((trace.tape, trace.digest, trace.results))
        except (pickle.PicklingError, AttributeError, TypeError):
            return
        guards = sha256(repr(trace.tape.guards).encode())[:16]  # so that a damaged one is replaced
        _write(folder / guards, buffer.getvalue())


def find_executable(digest: str, device: Device) -> bytes | None:
    """The executable of the program with this hash for this kind of device; None if there is none."""
    path = _executable_path(digest, device)
    return None if path is None else _read(path)


def store_executable(digest: str, device: Device, executable: bytes) -> None:
    """Keep an executable on disk, if there is a folder for it."""
    path = _executable_path(digest, device)
    if path is not None:
        _write(path, executable)


def _trace_folder(key: str, device: Device, own_code: bool) -> pathlib.Path | None:
    root, own_sources = _root(), environment.local_sources() if own_code else {}
    reach = [key, environment.of_compiler(device), environment.of_trace(), own_sources]
    return None if root is None else root / "traces" / sha256(as_json(reach))[:32]


def _executable_path(digest: str, device: Device) -> pathlib.Path | None:
    root, reach = _root(), [digest, environment.of_compiler(device)]
    return None if root is None else root / "executables" / sha256(as_json(reach))[:32]


def _root() -> pathlib.Path | None:
    """Folder of all programs; None if jax keeps its own at a URL."""
    cache = str(jax.config.values["jax_compilation_cache_dir"] or default_cache())
    return None if "://" in cache else pathlib.Path(cache) / "programs"


def _write(path: pathlib.Path, content: bytes) -> None:
    """Write a file with its hash; what cannot be written is left out."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if _is_private(path.parent):
            publish(path, MAGIC + hashlib.sha256(content).digest() + content)
            _evict()
    except OSError:
        pass


def _read(path: pathlib.Path) -> bytes | None:
    """The content of a file that `_write` wrote; None if it is damaged or others can write it."""
    try:
        content = read_bytes(path, FILE_BYTES) if _is_private(path) else b""
    except OSError:
        return None
    start = len(MAGIC) + 32
    if content[:start] != MAGIC + hashlib.sha256(content[start:]).digest():
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # used last
    return content[start:]


def _is_private(path: pathlib.Path) -> bool:
    """Whether this user owns a file or folder and its folder, and nobody else can write them."""
    try:
        states = [os.lstat(part) for part in (path, path.parent)]
    except OSError:
        return False
    user = os.geteuid() if hasattr(os, "geteuid") else states[0].st_uid
    kinds = stat.S_IFREG, stat.S_IFDIR
    return all(s.st_uid == user and not s.st_mode & 0o022 and stat.S_IFMT(s.st_mode) in kinds for s in states)


def _evict() -> None:
    """Remove the least recently used files beyond MAX_BYTES; in a folder of gen2d's own, also those of jax."""
    root = _root()
    folder = root.parent if root and root.parent == default_cache() else root
    states = [(path.stat(), path) for path in folder.rglob("*") if path.is_file()] if folder else []
    total = 0
    for state, path in sorted(states, key=lambda pair: -pair[0].st_mtime):
        total += state.st_size
        if total > MAX_BYTES:
            path.unlink(missing_ok=True)
