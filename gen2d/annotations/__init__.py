"""What is true of a video's pixels: one file for each annotation, named like the option that asks for it.

A file has `FIELDS`, what it stores, by name; `OWNERS`, whether it needs to know which object each pixel shows; and
`annotate(stages, owners, plan, options)`, which gives an array for each field of some videos. Axes that others do not
have are in `sizes(plan, options)`.
"""

import importlib
import pkgutil
from types import ModuleType
from typing import Any

from gen2d.core.schema import Field
from gen2d.records.axes import Array
from gen2d.renderers.plan import FramePlan, RenderScene


def modules() -> dict[str, ModuleType]:
    """All annotations, by the option that asks for each."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    return {name: importlib.import_module(f"{__name__}.{name}") for name in names}


def wanted(options: Any) -> list[ModuleType]:
    """The annotations that the options ask for."""
    return [module for name, module in modules().items() if getattr(options, name)]


def need_owners(options: Any) -> bool:
    """Whether it must be known which object each pixel shows."""
    return any(module.OWNERS for module in wanted(options))


def fields(options: Any) -> dict[str, Field]:
    """Everything that is stored for these options."""
    return {name: field for module in wanted(options) for name, field in module.FIELDS.items()}


def sizes(options: Any, plan: FramePlan) -> dict[str, int]:
    """The sizes of the axes that annotations bring with them."""
    found: dict[str, int] = {}
    for module in wanted(options):
        if hasattr(module, "sizes"):
            found |= module.sizes(plan, options)
    return found


def annotated(stages: RenderScene, owners: Array | None, plan: FramePlan, options: Any) -> dict[str, Array]:
    """The annotations of some videos, by their stored names; owners [n, T, H, W] uint8 as raster.draw gives them."""
    found: dict[str, Array] = {}
    for module in wanted(options):
        found |= module.annotate(stages, owners, plan, options)
    return found
