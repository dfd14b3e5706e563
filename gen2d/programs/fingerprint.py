"""What decides the bits of a dataset: the programs themselves, what compiles and runs them, and what the host makes.

Two runs may add to one dataset if their fingerprints agree. A program is known by its text, lowered for one device and
freed of names and places in the source: an edited scene, look or solver is another program, a renamed function is not.
"""

import ast
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
from gen2d.storage.sealed import as_json, parsed, read_bytes, sha256

# Flags of XLA that change no bit of a result, by how they begin; any other is taken to change some.
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
    """What decides the bits of the config's datasets, whichever split is made and on how many of these devices."""
    return machine(rollout) | {"programs": _of_splits(rollout)}


def machine(rollout: Rollout) -> dict[str, Any]:
    """The part of the fingerprint that is known before anything is traced."""
    device = rollout.devices[0]
    kind = device.device_kind if device.platform != "cpu" else f"cpu {instruction_set()}"
    flags = sorted(flag for flag in os.environ.get("XLA_FLAGS", "").split() if not flag.startswith(HARMLESS))
    return {"jaxlib": version("jaxlib"), "device": kind, "batch_size": rollout.batch_size, "xla_flags": " ".join(flags)}


def _of_splits(rollout: Rollout) -> dict[str, str]:
    """The hashes of all programs; those of a split with a look or physics of its own have its name before theirs."""
    config, found, seen = rollout.config, {}, set()
    for name in [split.name for split in config.splits] or [""]:
        own = config.of_split(name)
        if own not in seen:
            seen.add(own)
            programs = _remembered(rollout if own == config else Rollout(own, rollout.devices[:1]))
            found |= {f"{name}.{kind}" if own != config else kind: digest for kind, digest in programs.items()}
    return found


def _remembered(rollout: Rollout) -> dict[str, str]:
    """The hashes of a config's programs, of an earlier run of the same sources if there was one: tracing takes long."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    platform = rollout.devices[0].platform
    key = [
        rollout.config.recipe(),
        sources(),
        version("jax"),
        version("jaxlib"),
        platform,
        rollout.batch_size,
        rollout.slice,
    ]
    path = pathlib.Path(folder or "") / "fingerprints" / sha256(as_json(key))
    try:
        known = parsed(read_bytes(path, 10**5)) if folder else None
    except OSError:
        known = None
    if known is not None and all(isinstance(digest, str) for digest in known.values()):
        return known
    found = _hashes(rollout)
    if folder:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            publish(path, as_json(found))
        except OSError:
            pass
    return found


def _hashes(rollout: Rollout) -> dict[str, str]:
    found = {name: sha256(canonical(text).encode()) for name, text in rollout.lowered().items()}
    if rollout.config.annotations.simulated.captions:
        found["captions"] = code_hash(caption)
    if rollout.sampler.gridded:
        found["grids"] = code_hash(
            Sampler.combination, epochs.order, permutation.hashed, permutation.feistel, permutation.splitmix64
        )
    return found


def canonical(text: str) -> str:
    """The text of a lowered program without names: those of functions are numbers, those of results are gone."""
    names = re.findall(r"func\.func (?:public |private )?@([\w.$-]+)\(", text)
    numbers = {name: f"@f{number}" for number, name in enumerate(dict.fromkeys(names))}
    text = re.sub(r"@([\w.$-]+)", lambda found: numbers.get(found[1], found[0]), text)
    text = re.sub(r'jax\.(?:result_info|arg_info) = "[^"]*"', "", text)
    return re.sub(r"^module @\S+", "module", text, count=1, flags=re.M)


def code_hash(*parts: Any) -> str:
    """A hash of modules or functions that comments, docstrings and layout do not change."""
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


def sources() -> dict[str, str]:
    """The beginning of the sha256 of every source file of gen2d; they tell which was edited where a program differs."""
    package = pathlib.Path(gen2d.__file__).parent
    looks = package / "renderers" if (package / "renderers").is_dir() else package.parent / "renderers"
    found = {f"gen2d/{path.relative_to(package).as_posix()}": path for path in package.rglob("*.py")}
    found |= {f"renderers/{path.relative_to(looks).as_posix()}": path for path in looks.rglob("*.py")}
    return {
        name: sha256(path.read_bytes())[:12] for name, path in sorted(found.items()) if "gen2d/renderers/" not in name
    }
