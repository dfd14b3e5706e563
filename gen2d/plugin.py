"""Public API for plug-ins: a scene family, look, annotation or export needs to import no other module of gen2d.

Names stay available here when their modules move. Each is imported on first use, so an export does not import jax.
"""

from typing import TYPE_CHECKING

from gen2d.core.lazy import attach

if TYPE_CHECKING:
    from gen2d.captions import caption, facts, questions
    from gen2d.config import common
    from gen2d.config.contracts import Annotation, Bodies, Export, Family, Look
    from gen2d.config.distributions import Distribution
    from gen2d.config.options import option
    from gen2d.core.enums import CIRCLE, DYNAMIC, KINEMATIC, POLYGON, STATIC
    from gen2d.core.errors import ConfigError, UserError
    from gen2d.core.schema import Field
    from gen2d.core.sizes import power_of_two
    from gen2d.exports import arrays, tables
    from gen2d.exports.source import Source
    from gen2d.loading import dataset
    from gen2d.loading.protocols import Batch
    from gen2d.media import films, images
    from gen2d.records.axes import Array
    from gen2d.records.layout import JointSpec, Layout, SlotGroup
    from gen2d.records.parameter import maximum, minimum
    from gen2d.records.scene import Scene
    from gen2d.renderers import extents
    from gen2d.renderers.camera import pixel_at, to_pixels
    from gen2d.renderers.compositing import OCCLUDER
    from gen2d.renderers.look import (
        LINES,
        LineOptions,
        PlainOptions,
        are_lines,
        are_moving,
        backdrop,
        contrasting,
        line_fields,
        line_margin,
        mean_color,
        palette_option,
        plain,
        sampled_options,
    )
    from gen2d.renderers.noise import fraction, hashed
    from gen2d.renderers.paint import Background, Light, Paint, Pattern, Shadow, Surface, Texture
    from gen2d.renderers.plan import FramePlan, RenderScene, tile_windows
    from gen2d.renderers.primitives import Instants, PixelWindow
    from gen2d.renderers.rasterizer import alone, draw
    from gen2d.renderers.relief import SurfacePoints
    from gen2d.renderers.sensor import distorted_points
    from gen2d.renderers.surfaces import visible_surfaces
    from gen2d.sampling import builder
    from gen2d.sampling.builder import SampledScene
    from gen2d.sampling.placement import CLEARANCE, place, start_position
    from gen2d.storage.sealed import as_json
    from gen2d.xla import each_video, on_cpu, reduce_halves

_HOMES = {
    "gen2d.captions": "caption facts questions",
    "gen2d.config": "common",
    "gen2d.config.contracts": "Annotation Bodies Export Family Look",
    "gen2d.config.distributions": "Distribution",
    "gen2d.config.options": "option",
    "gen2d.core.enums": "CIRCLE DYNAMIC KINEMATIC POLYGON STATIC",
    "gen2d.core.errors": "ConfigError UserError",
    "gen2d.core.schema": "Field",
    "gen2d.core.sizes": "power_of_two",
    "gen2d.exports": "arrays tables",
    "gen2d.exports.source": "Source",
    "gen2d.loading": "dataset",
    "gen2d.loading.protocols": "Batch",
    "gen2d.media": "films images",
    "gen2d.records.axes": "Array",
    "gen2d.records.layout": "JointSpec Layout SlotGroup",
    "gen2d.records.parameter": "maximum minimum",
    "gen2d.records.scene": "Scene",
    "gen2d.renderers": "extents",
    "gen2d.renderers.camera": "pixel_at to_pixels",
    "gen2d.renderers.compositing": "OCCLUDER",
    "gen2d.renderers.look": (
        "LINES LineOptions PlainOptions are_lines are_moving backdrop contrasting line_fields line_margin mean_color "
        "palette_option plain sampled_options"
    ),
    "gen2d.renderers.noise": "fraction hashed",
    "gen2d.renderers.paint": "Background Light Paint Pattern Shadow Surface Texture",
    "gen2d.renderers.plan": "FramePlan RenderScene tile_windows",
    "gen2d.renderers.primitives": "Instants PixelWindow",
    "gen2d.renderers.rasterizer": "alone draw",
    "gen2d.renderers.relief": "SurfacePoints",
    "gen2d.renderers.sensor": "distorted_points",
    "gen2d.renderers.surfaces": "visible_surfaces",
    "gen2d.sampling": "builder",
    "gen2d.sampling.builder": "SampledScene",
    "gen2d.sampling.placement": "CLEARANCE place start_position",
    "gen2d.storage.sealed": "as_json",
    "gen2d.xla": "each_video on_cpu reduce_halves",
}

__all__ = [
    "CIRCLE",
    "CLEARANCE",
    "DYNAMIC",
    "KINEMATIC",
    "LINES",
    "OCCLUDER",
    "POLYGON",
    "STATIC",
    "Annotation",
    "Array",
    "Background",
    "Batch",
    "Bodies",
    "ConfigError",
    "Distribution",
    "Export",
    "Family",
    "Field",
    "FramePlan",
    "Instants",
    "JointSpec",
    "Layout",
    "Light",
    "LineOptions",
    "Look",
    "Paint",
    "Pattern",
    "PixelWindow",
    "PlainOptions",
    "RenderScene",
    "SampledScene",
    "Scene",
    "Shadow",
    "SlotGroup",
    "Source",
    "Surface",
    "SurfacePoints",
    "Texture",
    "UserError",
    "alone",
    "are_lines",
    "are_moving",
    "arrays",
    "as_json",
    "backdrop",
    "builder",
    "caption",
    "common",
    "contrasting",
    "dataset",
    "distorted_points",
    "draw",
    "each_video",
    "extents",
    "facts",
    "films",
    "fraction",
    "hashed",
    "images",
    "line_fields",
    "line_margin",
    "maximum",
    "mean_color",
    "minimum",
    "on_cpu",
    "option",
    "palette_option",
    "pixel_at",
    "place",
    "plain",
    "power_of_two",
    "questions",
    "reduce_halves",
    "sampled_options",
    "start_position",
    "tables",
    "tile_windows",
    "to_pixels",
    "visible_surfaces"
]  # fmt: skip

__getattr__, __dir__ = attach(__name__, _HOMES)
