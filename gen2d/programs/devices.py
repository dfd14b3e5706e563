"""Choice of the devices that compute, and the software and hardware that determine their results to the bit."""

import contextlib
import ctypes
import functools
import os
import pathlib
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import h5py
import isal
import jax
import numpy as np
import PIL

from gen2d._version import __version__
from gen2d.core.errors import UserError, argument

DEVICES = ("auto", "cpu", "gpu")
Device = Any  # jax.Device, which jax declares in a way that type checkers do not take


class DeviceError(UserError):
    """A requested device is missing, or jax is in a mode that gen2d does not support."""


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def keep_freed_memory() -> None:
    """Make glibc keep freed memory instead of returning the pages of every batch of frames to the kernel.

    Page faults otherwise cost 5 % of a run (measured). Without glibc this has no effect.
    """
    trim_threshold, mmap_threshold = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD in malloc.h
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(trim_threshold, 2**30)
        libc.mallopt(mmap_threshold, 2**25)  # glibc's maximum


def prepare(device: str = "auto") -> list[Device]:
    """Devices to compute on: "cpu", "gpu", or "auto" for jax's default.

    There is one for each CPU core. If jax already runs in this process with fewer, the first of them is listed again,
    as several programs may run on it at once. Compiled programs are cached between runs in $JAX_COMPILATION_CACHE_DIR
    or the user's cache folder.

    Raises DeviceError if there is no such device, or if jax is in 64-bit mode.
    """
    if device not in DEVICES:
        raise DeviceError(f"{argument('device')} is {device!r}, but must be one of {', '.join(DEVICES)}")
    keep_freed_memory()
    jax.config.update("jax_threefry_partitionable", True)  # sampled values depend on it
    if jax.config.values["jax_enable_x64"]:
        raise DeviceError(
            "jax is in 64-bit mode (JAX_ENABLE_X64), but gen2d samples and renders in 32 bits: switch it off, and say "
            "physics.precision=float64 for a simulation in 64 bits"
        )
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(default_cache()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    try:
        jax.config.update("jax_num_cpu_devices", cores())
        if device == "cpu":
            jax.config.update("jax_platforms", "cpu")
    except RuntimeError:
        pass  # jax already runs; the videos are the same on any number of devices
    if device == "auto":
        return _for_all_cores(jax.devices())
    if device == "cpu" and jax.default_backend() != "cpu":
        raise DeviceError(
            f"{argument('device')} is 'cpu', but this process already runs jax on {jax.default_backend()}: start "
            "another"
        )
    try:
        return _for_all_cores(jax.devices(device))
    except RuntimeError as error:
        hint = f"; pip install 'gen2d[cuda]', or use {argument('device', 'cpu')}" if device == "gpu" else ""
        raise DeviceError(f"{argument('device')} is {device!r}, but jax finds none{hint} ({error})") from None


def _for_all_cores(found: list[Device]) -> list[Device]:
    """These devices; on a CPU at least one for each core."""
    if found[0].platform != "cpu" or len(found) >= cores():
        return found
    return found[:1] * cores()


def start_transfer(arrays: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Start to copy arrays of one device to the host, where NumPy reads them in place; the same arrays on a CPU.

    The device writes into pinned memory, which jax reuses: 52 GB/s (measured on an H200), and 1.9 GB/s into other
    memory.
    """
    return {name: array if _on_cpu(array) else pinned(array) for name, array in arrays.items()}


def _on_cpu(array: jax.Array) -> bool:
    return all(device.platform == "cpu" for device in array.devices())


def pinned(array: jax.Array) -> jax.Array:
    """A copy of an array in pinned memory of the host."""
    with jax.enable_x64(True):  # keeps float64
        return jax.device_put(array, array.sharding.with_memory_kind("pinned_host"))


def default() -> Device:
    """Device on which jax computes where no other is named."""
    device = jax.config.values["jax_default_device"]
    return jax.devices(device)[0] if device is None or isinstance(device, str) else device


def default_cache() -> pathlib.Path:
    """Folder of compiled programs, where the user names none."""
    return (
        pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "gen2d" / instruction_set()
    )


@functools.cache
def processor_properties() -> dict[str, str]:
    """Names and values that the system gives for this CPU's first core; empty if it gives none."""
    try:
        first_core, *_ = pathlib.Path("/proc/cpuinfo").read_text().split("\n\n")
    except OSError:
        return {}
    lines = (line.partition(":") for line in first_core.splitlines())
    return {name.strip(): value.strip() for name, _, value in lines}


def instruction_set() -> str:
    """Widest vector instruction set of this CPU, which affects how sums are rounded."""
    flags = processor_properties().get("flags", "").split()
    return next((isa for isa in ("avx512f", "avx2", "avx") if isa in flags), platform.machine())


def processor_kind() -> str:
    """Widest vector instruction set and vendor of this CPU.

    XLA computes reciprocal square roots from an instruction of which the last bits differ between vendors.
    """
    return f"{instruction_set()} {processor_properties().get('vendor_id', '')}".strip()


def versions() -> dict[str, str]:
    """Versions of gen2d, Python and the libraries that generate a dataset; zstandard only where it is installed."""
    zstandard = {}
    with contextlib.suppress(PackageNotFoundError):
        zstandard["zstandard"] = version("zstandard")
    return {
        "gen2d": __version__,
        "python": ".".join(map(str, sys.version_info[:3])),
        "jax": jax.__version__,
        "jaxlib": version("jaxlib"),
        "numpy": np.__version__,
        "h5py": h5py.__version__,
        "hdf5": h5py.version.hdf5_version,
        "isal": isal.__version__,
        **zstandard,
        "pillow": PIL.__version__,
    }
