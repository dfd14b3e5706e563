"""The config that a stored dataset was made from."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from gen2d.config.config import Config, load_config, own_files
from gen2d.config.plugin_options import StoredCopies
from gen2d.config.trust import check_trusted
from gen2d.core.errors import ConfigError
from gen2d.dataset.spec import PLUGIN
from gen2d.loading.dataset import Dataset
from gen2d.storage.paths import Place, reading
from gen2d.storage.sealed import read_bytes, sha256

Trust = str | Sequence[str]  # sha256 of code that came with a dataset and may run
SOURCE_BYTES = 2**24  # of a file of code, at most


def config_of(ds: Dataset, overrides: Sequence[str] = (), trust: Trust = ()) -> Config:
    """The config that a dataset's split was made from, with `overrides` changed ('video.height=128').

    Raises UntrustedError where that would run code that came with the dataset and is not trusted.
    """
    if not isinstance(ds, Dataset):
        raise ConfigError(f"ds is of {len(ds.datasets)} folders, but must be of one: give one of ds.datasets")
    return load_config(config_from(ds.root, ds.manifest.identity, trust).of_split(ds.options.split), overrides)


def config_from(root: Place, identity: Mapping[str, Any], trust: Trust = ()) -> Config:
    """The config that the folder's manifest, or its mark, tells of.

    A family or look that came with the dataset is the copy in the folder, and no other file of that name.
    """
    config = identity["config"]
    copies = {where: copy for where, copy in _copies(root, config).items() if sha256(copy[1]) in _hashes(config)}
    check_trusted({where: content for where, (_, content) in copies.items()}, trust, root)
    try:
        return load_config(config | {"seed": identity["seed"]}, copies=StoredCopies(copies.values()))
    except ConfigError as error:
        raise ConfigError(f"{root}: its config cannot be used ({error})") from None


def _hashes(value: Any) -> set[str]:
    """Every sha256 that a config names."""
    if not isinstance(value, Mapping):
        return set()
    own = {value["sha256"]} if isinstance(value.get("sha256"), str) else set()
    return own.union(*(_hashes(part) for part in value.values()))


def _copies(root: Place, config: Mapping[str, Any]) -> dict[str, tuple[str, bytes]]:
    """What the folder holds of files of its maker's own: the name in the config and the content, by place."""
    found = {}
    for where, name in own_files(config).items():
        if PLUGIN.fullmatch(where):
            with reading(root), contextlib.suppress(FileNotFoundError, IsADirectoryError):
                found[where] = name, read_bytes(root / where, SOURCE_BYTES)
    return found
