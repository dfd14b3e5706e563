"""Fingerprint of everything that affects a dataset's bits: compiled programs, compiler, device and host code.

Two runs may add to one dataset if their fingerprints agree. A program is identified by the hash of its text, lowered
for one device, without names and source locations: editing a scene, look or solver changes it, renaming a function
does not.
"""

import ast
import hashlib
import inspect
import textwrap
from importlib.metadata import version
from typing import Any

from gen2d.captions import actions, caption, colors, events, facts, questions, references, sentences
from gen2d.core import permutation
from gen2d.loading import epochs
from gen2d.programs.devices import processor_kind
from gen2d.programs.environment import compiler_options, flags
from gen2d.programs.rollout import Rollout
from gen2d.sampling.sampler import Sampler


def fingerprint(rollout: Rollout) -> dict[str, Any]:
    """Fingerprint of the datasets of a config; it is the same for all its splits and any number of devices."""
    return machine(rollout) | {"programs": _program_hashes(rollout)}


def machine(rollout: Rollout) -> dict[str, Any]:
    """Part of the fingerprint that is known before anything is traced."""
    device = rollout.devices[0]
    kind = device.device_kind if device.platform != "cpu" else f"cpu {processor_kind()}"
    options = " ".join(f"{name}={value}" for name, value in compiler_options(device).items())
    own = {"batch_size": rollout.batch_size, "xla_flags": flags(), "xla_options": options}
    return {"jaxlib": version("jaxlib"), "device": kind, **own}


def _program_hashes(rollout: Rollout) -> dict[str, str]:
    """Hashes of all programs, by name.

    If a split has its own look or physics, the names of its programs are prefixed with the split's name.
    """
    config, names, hashes = rollout.config, {}, {}
    for name in [split.name for split in config.splits] or [""]:
        names.setdefault(config.of_split(name), name)
    for split_config, name in names.items():
        if split_config == config:
            hashes |= _hashes(rollout)
        else:
            programs = _hashes(Rollout(split_config, rollout.devices[:1]))
            hashes |= {f"{name}.{kind}": digest for kind, digest in programs.items()}
    return hashes


def _hashes(rollout: Rollout) -> dict[str, str]:
    programs = rollout.programs | {"draw": rollout.draw_program(rollout.slice)}
    hashes = {name: program.sha256 for name, program in programs.items()}
    if rollout.config.annotations.simulated.captions:
        hashes["captions"] = code_hash(actions, caption, colors, events, facts, questions, references, sentences)
    if rollout.sampler.gridded:
        hashes["grids"] = code_hash(
            Sampler.grid_values, epochs.order, permutation.hashed, permutation.feistel, permutation.splitmix64
        )
    return hashes


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
