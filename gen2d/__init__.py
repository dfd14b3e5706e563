"""Rendered-video datasets of 2D rigid bodies with complete ground truth.

    import gen2d
    gen2d.generate("bouncing.yaml", n=1000, out="datasets/bouncing")
    ds = gen2d.open("datasets/bouncing")
    for batch in gen2d.DataLoader(ds, batch_size=32): ...

Each name is imported on first use, so a training process that only reads data does not import jax.

The logger "gen2d" says at level INFO what a wait of more than two seconds is; `logging.basicConfig(level="INFO")` shows
it.
"""

import os
from typing import TYPE_CHECKING

from gen2d import engines as engines
from gen2d._version import __version__ as __version__
from gen2d.core.lazy import attach

if TYPE_CHECKING:
    from gen2d.cli.report import info
    from gen2d.config.config import Config, load_config
    from gen2d.core.errors import (
        ConfigError,
        DamagedError,
        Error,
        FolderError,
        IncompleteError,
        UnreachableError,
        UntrustedError,
        UserError,
    )
    from gen2d.exports.export import export
    from gen2d.exports.upload import push
    from gen2d.generation.run import generate
    from gen2d.loading.dataloader import DataLoader
    from gen2d.loading.dataset import Dataset, open
    from gen2d.loading.mixture import mix
    from gen2d.programs.redraw import render, render_soft, simulate_again
    from gen2d.programs.stream import stream
    from gen2d.space.space import Space
    from gen2d.storage.image_folder import use_images
    from gen2d.tools.plot import plot
    from gen2d.tools.preview import preview
    from gen2d.tools.verify import verify

_HOMES = {
    "gen2d.cli.report": "info",
    "gen2d.config.config": "Config load_config",
    "gen2d.core.errors": (
        "ConfigError DamagedError Error FolderError IncompleteError UnreachableError UntrustedError UserError"
    ),
    "gen2d.exports.export": "export",
    "gen2d.exports.upload": "push",
    "gen2d.generation.run": "generate",
    "gen2d.loading.dataloader": "DataLoader",
    "gen2d.loading.dataset": "Dataset open",
    "gen2d.loading.mixture": "mix",
    "gen2d.programs.redraw": "render render_soft simulate_again",
    "gen2d.programs.stream": "stream",
    "gen2d.space.space": "Space",
    "gen2d.storage.image_folder": "use_images",
    "gen2d.tools.plot": "plot",
    "gen2d.tools.preview": "preview",
    "gen2d.tools.verify": "verify",
}

__all__ = [
    "Config", "ConfigError", "DamagedError", "DataLoader", "Dataset", "Error", "FolderError", "IncompleteError",
    "Space", "UnreachableError", "UntrustedError", "UserError", "export", "generate", "info", "load_config",
    "mix", "open", "plot", "preview", "push", "render", "render_soft", "simulate_again", "stream", "use_images",
    "verify",
]  # fmt: skip

__getattr__, __dir__ = attach(__name__, _HOMES, ("grain", "torch"))
if TYPE_CHECKING:
    from gen2d import grain as grain
    from gen2d import torch as torch

# XLA reads it when jax is imported. Its log says that it is slow, and nothing that is not raised as an error too.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
