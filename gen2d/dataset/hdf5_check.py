"""A check of a shard by the HDF5 library, in a process of its own.

A stranger's file may crash libhdf5 or keep it busy. Loading never uses the library. This check runs it in a process
with limits on memory and time, which reads no value before it has checked its type and size.

    python -m gen2d.dataset.hdf5_check      reads a JSON request per line, answers each with a JSON list of faults
"""

import atexit
import contextlib
import json
import os
import select
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gen2d.dataset.manifest import Manifest
from gen2d.dataset.spec import EARLIER_SCHEMA, Shard, stored_axes

SECONDS = 60.0  # time limit for one file
MEMORY = 2**32  # limit of the address space, bytes


def faults(path: Path, shard: Shard, manifest: Manifest) -> list[str]:
    """The differences between the file as HDF5 reads it and the manifest, a sentence each."""
    repeated = manifest.schema != EARLIER_SCHEMA
    fields = {
        name: {
            "dtype": field.dtype,
            "shape": [*([shard.count] if field.per_video or repeated else []), *field.shape(manifest.sizes)],
            "axes": stored_axes(field, manifest.schema),
            "unit": field.unit,
            "meaning": field.meaning,
            "compressed": manifest.codec_of(name) != "none",
            "constant": manifest.constants[name].tolist() if name in manifest.constants else None,
        }
        for name, field in manifest.fields.items()
    }
    request = {"path": str(path.absolute()), "split": shard.split, "first": shard.first, "fields": fields}
    with _lock:
        return _query(json.dumps(request).encode() + b"\n")


# ---- The calling process

_lock = threading.Lock()
_process: subprocess.Popen[bytes] | None = None
_owner = 0  # the id of the process that started it; a fork starts its own


def _query(request: bytes) -> list[str]:
    process = _checker_process()
    assert process.stdin
    assert process.stdout
    answer = b""
    with contextlib.suppress(OSError):
        process.stdin.write(request)
        process.stdin.flush()
        while not answer.endswith(b"\n"):
            if not select.select([process.stdout], [], [], SECONDS)[0]:
                _stop()
                return [f"HDF5 has not finished reading it after {SECONDS:.0f} s"]
            part = os.read(process.stdout.fileno(), 2**16)
            if not part:
                break
            answer += part
    if not answer.endswith(b"\n"):
        _stop()
        return ["HDF5 crashed while reading it"]
    return json.loads(answer)


def _checker_process() -> subprocess.Popen[bytes]:
    global _process, _owner
    if _process is None or _process.poll() is not None or _owner != os.getpid():
        _stop()
        command = [sys.executable, "-W", "ignore", "-m", "gen2d.dataset.hdf5_check"]
        home = str(Path(__file__).parent.parent.parent)
        paths = os.pathsep.join([home, *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = os.environ | {"PYTHONPATH": paths}
        pipe = subprocess.PIPE
        _process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=environment)
        _owner = os.getpid()
    return _process


@atexit.register
def _stop() -> None:
    global _process
    process, _process = _process, None
    if process is not None and _owner == os.getpid():
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()


# ---- The checking process


def _serve() -> None:
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin.buffer:
        request = json.loads(line)
        try:
            answer = _faults(request)
        except MemoryError:
            answer = ["HDF5 needs more memory for it than it may have"]
        except Exception as error:  # h5py raises errors of many types
            answer = [f"HDF5 cannot read it ({' '.join(str(error).split())[:200]})"]
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


def _faults(request: Mapping[str, Any]) -> list[str]:
    import h5py

    problems = []
    with h5py.File(request["path"], "r", locking=False) as file:
        start = file.attrs.get("split"), file.attrs.get("first")
        if not all(isinstance(part, str | int) or getattr(part, "shape", None) == () for part in start) or start != (
            request["split"],
            request["first"],
        ):
            problems.append(f"its attributes say that it begins with {start[0]!s:.60} video {start[1]!s:.60}")
        for name, expected in request["fields"].items():
            dataset = file.get(name)
            if not isinstance(dataset, h5py.Dataset):
                problems.append(f"{name} is missing")
            else:
                problems += [f"{name} {problem}" for problem in _dataset_faults(dataset, expected)]
    return problems


def _dataset_faults(dataset: Any, expected: Mapping[str, Any]) -> list[str]:
    import numpy as np

    if list(dataset.shape or ()) != expected["shape"] or dataset.dtype != np.dtype(expected["dtype"]):
        return [f"is {dataset.dtype} {list(dataset.shape or ())}, but must be {expected['dtype']} {expected['shape']}"]
    if bool(dataset.compression or dataset._filters) and not expected["compressed"]:
        return ["is compressed, but must not be"]
    if dataset.external or dataset.is_virtual:
        return ["lies in another file"]
    problems = []
    for key in ("axes", "unit", "meaning"):
        value = dataset.attrs.get(key)
        if not isinstance(value, str) or value != expected[key]:
            problems.append(f"has {key} {value!r:.80}, but must have {expected[key]!r}")
    if expected["constant"] is not None and not (dataset[()] == np.array(expected["constant"])).all():
        problems.append("differs from the manifest")
    return problems


if __name__ == "__main__":
    _serve()
