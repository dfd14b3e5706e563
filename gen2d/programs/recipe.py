"""Config that a stored dataset was generated from."""

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from gen2d.config.config import Config, load_config, user_plugin_files
from gen2d.config.plugin_options import StoredCopies
from gen2d.config.trust import check_trusted
from gen2d.core.errors import ConfigError
from gen2d.dataset.spec import PLUGIN
from gen2d.loading.dataset import Dataset
from gen2d.storage.paths import Place, reading
from gen2d.storage.sealed import read_bytes, sha256

Trust = str | Sequence[str]  # sha256 of code from a dataset that may run
SOURCE_BYTES = 2**24  # largest file of code


def config_of(ds: Dataset, overrides: Sequence[str] = (), trust: Trust = ()) -> Config:
    """Config that a dataset's split was generated from, with `overrides` such as 'video.height=128' applied.

    Raises ConfigError if the dataset spans several folders or the config is invalid here, and UntrustedError if it
    needs code from the dataset that is not trusted.
    """
    if not isinstance(ds, Dataset):
        hint = {"datasets": ": give one of ds.datasets", "source": ": give ds.source, and ds.indices as indices"}
        given = next((said for name, said in hint.items() if hasattr(ds, name)), "")
        raise ConfigError(f"ds is {type(ds).__name__}, but must be a dataset of one folder{given}")
    return load_config(config_from(ds.root, ds.manifest.identity, trust).of_split(ds.options.split), overrides)


def config_from(root: Place, identity: Mapping[str, Any], trust: Trust = ()) -> Config:
    """Config of the dataset with this identity, which comes from its manifest or mark.

    A family or look from a user's file is loaded from the copy in the dataset, never from another file of that name.
    Raises ConfigError if the config cannot be used here, and UntrustedError if it needs code that is not trusted.
    """
    config, hashes = identity["config"], _config_hashes(identity["config"])
    copies = {path: copy for path, copy in _stored_copies(root, config).items() if sha256(copy[1]) in hashes}
    check_trusted({path: content for path, (_, content) in copies.items()}, trust, root)
    try:
        return load_config(config | {"seed": identity["seed"]}, copies=StoredCopies(copies.values()))
    except ConfigError as error:
        raise ConfigError(f"{root}: its config cannot be used ({error})") from None


def _config_hashes(value: Any) -> set[str]:
    """All sha256 in a config."""
    if not isinstance(value, Mapping):
        return set()
    own = {value["sha256"]} if isinstance(value.get("sha256"), str) else set()
    return own.union(*(_config_hashes(part) for part in value.values()))


def _stored_copies(root: Place, config: Mapping[str, Any]) -> dict[str, tuple[str, bytes]]:
    """Copies of user files in the dataset: the name in the config and the content, by path."""
    copies = {}
    for path, name in user_plugin_files(config).items():
        if PLUGIN.fullmatch(path):
            with reading(root), contextlib.suppress(FileNotFoundError, IsADirectoryError):
                copies[path] = name, read_bytes(root / path, SOURCE_BYTES)
    return copies
