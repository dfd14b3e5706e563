"""Versions, sources, processor and flags, on which compiled programs depend."""

import functools
import os
import pathlib
import platform
import sys
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

import gen2d
from gen2d.programs.devices import Device, instruction_set, processor_properties
from gen2d.storage.sealed import sha256

# Prefixes of XLA flags that leave all results unchanged to the bit; any other flag is assumed to change some.
HARMLESS = (
    "--xla_dump_",
    "--xla_force_host_platform_device_count",
    "--xla_hlo_profile",
    "--xla_cpu_parallel_codegen_split_count",
    "--xla_gpu_force_compilation_parallelism",
    "--xla_gpu_kernel_cache_file",
    "--xla_gpu_per_fusion_autotune_cache_dir",
)
# Parts of the names of jax's options that no program depends on.
_HARMLESS_OPTIONS = ("cache", "log", "num_cpu_devices", "platform", "traceback", "profiler", "dump", "distributed")


# Options of XLA on CPUs. Without its newer emitters, programs compile in two thirds of the time, and are as fast at
# LLVM's level 2 as with them at level 1 or 3; at level 1, they are slower by a fifth (measured with jaxlib 0.10).
_CPU_OPTIONS = {"xla_backend_optimization_level": 2, "xla_cpu_use_fusion_emitters": False}
_OTHER_CPU_OPTIONS = {"xla_backend_optimization_level": 1}  # of a version of XLA that has no older emitters


def compiler_options(device: Device) -> dict[str, Any]:
    """XLA's options for all programs on a device."""
    return dict(_cpu_options()) if device.platform == "cpu" else {}


@functools.cache
def _cpu_options() -> dict[str, Any]:
    return _CPU_OPTIONS if _are_known(_CPU_OPTIONS) else _OTHER_CPU_OPTIONS


def _are_known(options: dict[str, Any]) -> bool:
    """Whether this version of XLA has these options."""
    try:
        jax.jit(lambda: 0).lower().compile(options)
    except jax.errors.JaxRuntimeError:
        return False
    return True


def of_compiler(device: Device) -> dict[str, Any]:
    """What the executable of a given program depends on."""
    return {
        "versions": [version("jax"), version("jaxlib")],
        "device": [device.platform, device.device_kind, device.client.platform_version],
        "processor": [instruction_set(), processor()] if device.platform == "cpu" else [],
        "flags": [flags(), compiler_options(device)],
        "options": _options(),
    }


def of_trace() -> dict[str, Any]:
    """What the trace of a given config depends on, besides the compiler."""
    return {"versions": [np.__version__, platform.python_version()], "sources": sources()}


def _options() -> dict[str, str]:
    values = jax.config.values.items()
    return {name: str(value) for name, value in values if not any(part in name for part in _HARMLESS_OPTIONS)}


def flags() -> str:
    """XLA's flags that may change results."""
    return " ".join(sorted(f for f in os.environ.get("XLA_FLAGS", "").split() if not f.startswith(HARMLESS)))


@functools.cache
def processor() -> str:
    """Hash of the processor's model and features, for which programs are compiled."""
    properties = processor_properties()
    if not properties:
        return platform.processor()
    return sha256(
        "\n".join(properties.get(name, "") for name in ("model name", "CPU part", "flags", "Features")).encode()
    )


@functools.cache
def sources() -> dict[str, str]:
    """First 12 digits of the sha256 of each source file of gen2d, by path."""
    package = pathlib.Path(gen2d.__file__).parent
    renderers = package / "renderers"
    files = {f"gen2d/{path.relative_to(package).as_posix()}": path for path in package.rglob("*.py")}
    files |= {f"renderers/{path.relative_to(renderers).as_posix()}": path for path in renderers.rglob("*.py")}
    return {
        name: sha256(path.read_bytes())[:12] for name, path in sorted(files.items()) if "gen2d/renderers/" not in name
    }


def local_sources() -> dict[str, str]:
    """Hashes of the imported modules that belong to neither Python, an installed package nor gen2d."""
    installed = [pathlib.Path(folder).resolve() for folder in {sys.prefix, sys.base_prefix}]
    installed.append(pathlib.Path(gen2d.__file__).parent.resolve())
    hashes = {}
    for module in list(sys.modules.values()):
        name = getattr(module, "__file__", None)
        path = pathlib.Path(name).resolve() if isinstance(name, str) and name.endswith(".py") else None
        if path is not None and path.is_file() and not any(path.is_relative_to(folder) for folder in installed):
            hashes[str(path)] = sha256(path.read_bytes())
    return hashes
