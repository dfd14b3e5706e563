"""Engines that run the shards of a job: in this process (`Local`), or on the machines of a Ray cluster (`Ray`).

`gen2d.generate(..., engine=gen2d.engines.Ray("auto"))` generates on a cluster. The driver, which opens the folder,
plans the shards and completes the dataset, is the same for all engines (generation/run.py).
"""

from typing import TYPE_CHECKING

from gen2d.core.lazy import attach

if TYPE_CHECKING:
    from gen2d.engines.local import Local as Local
    from gen2d.engines.ray import Ray as Ray

__getattr__, __dir__ = attach(__name__, {"gen2d.engines.local": "Local", "gen2d.engines.ray": "Ray"})
