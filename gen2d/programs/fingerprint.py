"""Fingerprint of everything that affects a dataset's bits: compiled programs, compiler, device and host code.

Two runs may add to one dataset if their fingerprints agree. A program is identified by the hash of its text, lowered
for one device, without names and source locations: editing a scene, look or solver changes it, renaming a function
does not.
"""

import ast
import functools
import hashlib
import inspect
import os
import pathlib
import re
import textwrap
from importlib.metadata import version
from typing import Any

import jax

import gen2d
from gen2d.captions import caption
from gen2d.core import permutation
from gen2d.loading import epochs
from gen2d.programs.devices import instruction_set
from gen2d.programs.rollout import Rollout
from gen2d.sampling.sampler import Sampler
from gen2d.storage.atomic import publish
from gen2d.storage.sealed import as_json, parse_json, read_bytes, sha256

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


def fingerprint(rollout: Rollout) -> dict[str, Any]:
    """Fingerprint of the datasets of a config; it is the same for all its splits and any number of devices."""
    return machine(rollout) | {"programs": _program_hashes(rollout)}


def machine(rollout: Rollout) -> dict[str, Any]:
    """Part of the fingerprint that is known before anything is traced."""
    device = rollout.devices[0]
    kind = device.device_kind if device.platform != "cpu" else f"cpu {instruction_set()}"
    flags = sorted(flag for flag in os.environ.get("XLA_FLAGS", "").split() if not flag.startswith(HARMLESS))
    return {"jaxlib": version("jaxlib"), "device": kind, "batch_size": rollout.batch_size, "xla_flags": " ".join(flags)}


def _program_hashes(rollout: Rollout) -> dict[str, str]:
    """Hashes of all programs, by name.

    If a split has its own look or physics, the names of its programs are prefixed with the split's name.
    """
    config, names, hashes = rollout.config, {}, {}
    for name in [split.name for split in config.splits] or [""]:
        names.setdefault(config.of_split(name), name)
    for split_config, name in names.items():
        if split_config == config:
            hashes |= _cached_hashes(rollout)
        else:
            programs = _cached_hashes(Rollout(split_config, rollout.devices[:1]))
            hashes |= {f"{name}.{kind}": digest for kind, digest in programs.items()}
    return hashes


def _cached_hashes(rollout: Rollout) -> dict[str, str]:
    """Hashes of a config's programs, cached per version of the sources because tracing is slow."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    platform, versions = rollout.devices[0].platform, [version("jax"), version("jaxlib")]
    key = [rollout.config.recipe(), sources(), *versions, platform, rollout.batch_size, rollout.slice]
    path = pathlib.Path(folder or "") / "fingerprints" / sha256(as_json(key))
    try:
        cached = parse_json(read_bytes(path, 10**5)) if folder else None
    except OSError:
        cached = None
    if cached is not None and all(isinstance(digest, str) for digest in cached.values()):
        return cached
    hashes = _compute_hashes(rollout)
    if folder:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            publish(path, as_json(hashes))
        except OSError:
            pass
    return hashes


def _compute_hashes(rollout: Rollout) -> dict[str, str]:
    hashes = {name: sha256(canonical(text).encode()) for name, text in rollout.lowered().items()}
    if rollout.config.annotations.simulated.captions:
        hashes["captions"] = code_hash(caption)
    if rollout.sampler.gridded:
        hashes["grids"] = code_hash(
            Sampler.grid_values, epochs.order, permutation.hashed, permutation.feistel, permutation.splitmix64
        )
    return hashes


def canonical(text: str) -> str:
    """Text of a lowered program with functions renamed to numbers and names of arguments and results removed."""
    names = re.findall(r"func\.func (?:public |private )?@([\w.$-]+)\(", text)
    numbers = {name: f"@f{number}" for number, name in enumerate(dict.fromkeys(names))}
    text = re.sub(r"@([\w.$-]+)", lambda match: numbers.get(match[1], match[0]), text)
    text = re.sub(r'jax\.(?:result_info|arg_info) = "[^"]*"', "", text)
    return re.sub(r"^module @\S+", "module", text, count=1, flags=re.M)


def code_hash(*parts: Any) -> str:
    """Hash of modules or functions that ignores comments, docstrings and formatting."""
    digest = hashlib.sha256()
    for part in parts:
        tree = ast.parse(textwrap.dedent(inspect.getsource(part)))
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list) and body and isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                first = body[0]
                if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                    node.body = body[1:]
        digest.update(ast.dump(tree).encode())
    return digest.hexdigest()


@functools.cache
def sources() -> dict[str, str]:
    """First 12 digits of the sha256 of each source file of gen2d, by path.

    They only serve to name the edited files when a program differs.
    """
    package = pathlib.Path(gen2d.__file__).parent
    renderers = package / "renderers"
    files = {f"gen2d/{path.relative_to(package).as_posix()}": path for path in package.rglob("*.py")}
    files |= {f"renderers/{path.relative_to(renderers).as_posix()}": path for path in renderers.rglob("*.py")}
    return {
        name: sha256(path.read_bytes())[:12] for name, path in sorted(files.items()) if "gen2d/renderers/" not in name
    }
