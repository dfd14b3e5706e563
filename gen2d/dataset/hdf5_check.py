"""What HDF5 itself says of a shard, asked in a process of its own.

The files of strangers may be made to crash libhdf5, or to keep it busy. Loading never uses it; checking does, so the
library runs where it can do no more than end: with a limit on memory and on time, and nothing is read there before its
type and size are known to be right.

    python -m gen2d.dataset.hdf5_check      a JSON question per line on standard input, a JSON list of faults per answer
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
from gen2d.dataset.spec import Shard

SECONDS = 60.0  # for one file
MEMORY = 2**32  # bytes, of address space


def faults(path: Path, shard: Shard, manifest: Manifest) -> list[str]:
    """What differs between the file as HDF5 sees it and the manifest, a sentence each."""
    fields = {
        name: {
            "dtype": field.dtype,
            "shape": [*([shard.count] if field.per_video else []), *field.shape(manifest.sizes)],
            "axes": field.axes,
            "unit": field.unit,
            "meaning": field.meaning,
            "compressed": manifest.codec_of(name) != "none",
            "constant": manifest.constants[name].tolist() if name in manifest.constants else None,
        }
        for name, field in manifest.fields.items()
    }
    question = {"path": str(path.absolute()), "split": shard.split, "first": shard.first, "fields": fields}
    with _lock:
        return _ask(json.dumps(question).encode() + b"\n")


# ---- This side

_lock = threading.Lock()
_process: subprocess.Popen[bytes] | None = None


def _ask(question: bytes) -> list[str]:
    process = _started()
    assert process.stdin
    assert process.stdout
    answer = b""
    with contextlib.suppress(OSError):
        process.stdin.write(question)
        process.stdin.flush()
        while not answer.endswith(b"\n"):
            if not select.select([process.stdout], [], [], SECONDS)[0]:
                _stop()
                return [f"HDF5 was not done with it after {SECONDS:.0f} s"]
            part = os.read(process.stdout.fileno(), 2**16)
            if not part:
                break
            answer += part
    if not answer.endswith(b"\n"):
        _stop()
        return ["HDF5 crashed while it read it"]
    return json.loads(answer)


def _started() -> subprocess.Popen[bytes]:
    global _process
    if _process is None or _process.poll() is not None or _owner != os.getpid():
        _stop()
        _start()
    assert _process is not None
    return _process


_owner = 0


def _start() -> None:
    global _process, _owner
    words = [sys.executable, "-W", "ignore", "-m", "gen2d.dataset.hdf5_check"]
    home = str(Path(__file__).parent.parent.parent)
    paths = os.pathsep.join([home, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"PYTHONPATH": paths}
    pipe = subprocess.PIPE
    _process = subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, env=environment)
    _owner = os.getpid()


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


# ---- The other side


def _serve() -> None:
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for line in sys.stdin.buffer:
        question = json.loads(line)
        try:
            found = _faults(question)
        except MemoryError:
            found = ["HDF5 needs more memory for it than it may have"]
        except Exception as error:  # h5py raises whatever comes to it
            found = [f"HDF5 cannot read it ({' '.join(str(error).split())[:200]})"]
        sys.stdout.write(json.dumps(found) + "\n")
        sys.stdout.flush()


def _faults(question: Mapping[str, Any]) -> list[str]:
    import h5py

    found = []
    with h5py.File(question["path"], "r", locking=False) as file:
        said = file.attrs.get("split"), file.attrs.get("first")
        if not all(isinstance(part, str | int) or getattr(part, "shape", None) == () for part in said) or said != (
            question["split"],
            question["first"],
        ):
            found.append(f"it says that it begins with {said[0]!s:.60} video {said[1]!s:.60}")
        for name, about in question["fields"].items():
            dataset = file.get(name)
            if not isinstance(dataset, h5py.Dataset):
                found.append(f"{name} is missing")
            else:
                found += [f"{name} {wrong}" for wrong in _misdescribed(dataset, about)]
    return found


def _misdescribed(dataset: Any, about: Mapping[str, Any]) -> list[str]:
    import numpy as np

    if list(dataset.shape or ()) != about["shape"] or dataset.dtype != np.dtype(about["dtype"]):
        return [f"is {dataset.dtype} {list(dataset.shape or ())}, but must be {about['dtype']} {about['shape']}"]
    if bool(dataset.compression or dataset._filters) and not about["compressed"]:
        return ["is compressed, but must not be"]
    if dataset.external or dataset.is_virtual:
        return ["lies in another file"]
    found = []
    for key in ("axes", "unit", "meaning"):
        said = dataset.attrs.get(key)
        if not isinstance(said, str) or said != about[key]:
            found.append(f"has {key} {said!r:.80}, but must have {about[key]!r}")
    if about["constant"] is not None and not np.array_equal(dataset[()], np.array(about["constant"])):
        found.append("is not what the manifest says")
    return found


if __name__ == "__main__":
    _serve()
