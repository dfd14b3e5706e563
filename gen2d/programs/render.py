"""Render scenes of simulated videos: camera, paint and occluders, sampled from each video's key.

Each of them has its own key, so changing the look or the camera changes nothing else.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d import annotations
from gen2d.config.annotations import Annotations
from gen2d.config.config import Config
from gen2d.config.options import drawn_options
from gen2d.config.sections import ImageOptions
from gen2d.core.errors import ConfigError
from gen2d.media.backgrounds import crops
from gen2d.records.axes import Array, assert_shape, check_shapes
from gen2d.records.keys import key_for
from gen2d.records.layout import Layout
from gen2d.records.scene import Scene, State
from gen2d.renderers import camera
from gen2d.renderers.camera import CameraView
from gen2d.renderers.compositing import OCCLUDER
from gen2d.renderers.paint import NO_MATERIAL, Paint
from gen2d.renderers.plan import FramePlan, Occluders, RenderScene
from gen2d.renderers.primitives import BodyGeometry, Instants
from gen2d.renderers.rasterizer import draw
from gen2d.renderers.sensor import Sensor


def plan_of(config: Config, layout: Layout) -> FramePlan:
    """Frame plan of a config: everything static that rendering needs.

    Raises ConfigError if an annotation tells apart more objects than a byte can number.
    """
    video, image, look = config.video, config.image, config.look
    owners = annotations.need_owners(config.annotations)
    if owners and layout.slots >= OCCLUDER:
        name = next(plugin.name for plugin in config.annotations.wanted if plugin.contract.owners)
        raise ConfigError(
            f"annotations.{name} is on for {layout.slots} objects of scene {config.scene.name}, "
            f"but must be off for more than {OCCLUDER - 1}"
        )
    if getattr(look.options, "background_kind", "") == "images" and camera.may_move(config.camera):
        raise ConfigError("look.background_kind is images, which are fixed to the frame, but the camera moves")
    seconds = video.frames / video.fps
    scale = camera.largest_scale(config.camera, layout, video.height, video.width, seconds)
    return FramePlan(
        layout=layout,
        height=video.height,
        width=video.width,
        scale=scale,
        grow=look.contract.margin(look.options),
        grown=look.contract.grown,
        blur=look.contract.blur(look.options, layout) * scale,
        still=not camera.may_move(config.camera),
        linear=image.blending == "linear",
        frames=config.storage.frames != "none",
        owners=owners,
        exposed=image.exposure_samples if image.exposure else 0,
    )


def paint_of(key: Array, config: Config, scene: Scene, layout: Layout) -> Paint:
    """Paint of one video with this key. Raises ConfigError if it lacks a part that the look declares."""
    contract = config.look.contract
    paint = contract.paint(scene, layout, config.look.options, key_for(key, "look"))
    for part in contract.parts:
        if getattr(paint, part, None) is None:
            raise ConfigError(f"look {config.look.name} has {part!r} in Look.parts, but its paint has no {part}")
    return paint


def view_of(key: Array, config: Config, layout: Layout, states: State) -> CameraView:
    """Camera view of one video with this key."""
    video = config.video
    return camera.sample_view(
        key_for(key, "camera"), config.camera, layout, states, video.fps, video.height, video.width
    )


def render_scene(
    key: Array,
    config: Config,
    plan: FramePlan,
    scene: Scene,
    states: State,
    view: CameraView | None = None,
    between: State | None = None,
) -> RenderScene:
    """Render scene of one video.

    `states` [T, K, ...] are those at the frames, `between` [T - 1, steps, K, ...] those after each step, which motion
    blur needs. By default, the view comes from the key. Raises AssertionError for states of another layout, and for
    a look's colours of another number of slots.
    """
    slots = plan.layout.slots
    check_shapes(states, absent="n", K=slots)
    paint = paint_of(key, config, scene, plan.layout)
    assert_shape(paint.color, (slots, 3), "the look's colours")
    view = view_of(key, config, plan.layout, states) if view is None else view
    objects, image = scene.objects, config.image
    bodies = BodyGeometry(objects.radius, objects.half_length, objects.vertices)
    exposed = None
    if image.exposure:
        assert between is not None, "motion blur needs the states between frames"
        exposed = _exposure_instants(image, config.video.fps, states, between, view)
    seed = jax.random.bits(key_for(key, "pixels"), (), jnp.uint32)
    sampled = {name: source.sample(key_for(key, name), ()) for name, source in image.sensor.items()}
    sensor = Sensor(**sampled) if sampled else None
    occluders = _sample_occluders(key_for(key, "occluders"), config, plan) if image.occluders else None
    return RenderScene(bodies, Instants(states.position, states.angle, view), exposed, paint, occluders, sensor, seed)


def _exposure_instants(image: ImageOptions, fps: float, states: State, between: State, view: CameraView) -> Instants:
    """Positions, angles and views at the samples of each exposure [T, samples, ...].

    An exposure ends at the frame's instant, or has it in its middle; its samples are the midpoints of equal parts.
    Motion is linear between steps, and is extrapolated before the first frame and after the last.
    """
    steps, samples, centred = between.angle.shape[1], image.exposure_samples, image.shutter == "centre"
    before = image.exposure * ((0.5 if centred else 1) - (jnp.arange(samples) + 0.5) / samples)  # frames

    def interpolate(values: Array, rates: Array, step_values: Array) -> Array:
        """Values [T, samples, ...], interpolated between those of frames [T, ...] and of steps [T - 1, steps, ...]."""
        previous = values[0] - rates[0] / fps  # one frame before the first
        weight = (jnp.arange(steps + 1) / steps).reshape(-1, *[1] * (values.ndim - 1))
        path = jnp.concatenate([values[:-1, None], step_values], axis=1)
        path = jnp.concatenate([(previous + weight * (values[0] - previous))[None], path])
        if centred:  # the paths to the next frames, too
            beyond = (values[-1] + weight * rates[-1] / fps)[None]
            path = jnp.concatenate([path, jnp.concatenate([path[1:], beyond])[:, 1:]], axis=1)
        time = (1 - before) * steps
        low = jnp.clip(jnp.floor(time).astype(jnp.int32), 0, path.shape[1] - 2)
        weight = (time - low).reshape(-1, *[1] * (values.ndim - 1))
        return path[:, low] * (1 - weight) + path[:, low + 1] * weight

    def interpolate_camera(values: Array) -> Array:
        """A camera parameter [T, samples, ...], interpolated linearly between frames."""
        last = jnp.concatenate([2 * values[:1] - values[1:2] if len(values) > 1 else values[:1], values[:-1]])
        weight = before.reshape(-1, *[1] * (values.ndim - 1))
        if not centred:
            return values[:, None] * (1 - weight) + last[:, None] * weight
        following = jnp.concatenate([values[1:], 2 * values[-1:] - last[-1:]])
        steps = jnp.where(weight > 0, last[:, None] - values[:, None], values[:, None] - following[:, None])
        return values[:, None] + weight * steps

    position = interpolate(states.position, states.velocity, between.position)
    angle = interpolate(states.angle, states.angular_velocity, between.angle)
    return Instants(position, angle, CameraView(*map(interpolate_camera, view)))


def _sample_occluders(key: Array, config: Config, plan: FramePlan) -> Occluders:
    image, video = config.image, config.video
    count = image.occluders
    keys = dict(zip(("place", "width", "height", "front", "color"), jax.random.split(key, 5), strict=True))
    size = jnp.stack(
        [
            image.occluder_width.sample(keys["width"], (count,)) * video.width,
            image.occluder_height.sample(keys["height"], (count,)) * video.height,
        ],
        -1,
    )
    center = jax.random.uniform(keys["place"], (count, 2)) * jnp.asarray([video.width, video.height])
    front = image.occluder_front.sample(keys["front"], (count,))
    rank = jnp.sort(jnp.round(front * plan.moving).astype(jnp.int32))
    channels = [
        part.sample(k, (count,)).astype(jnp.float32)
        for part, k in zip(image.occluder_color, jax.random.split(keys["color"], 3), strict=True)
    ]
    return Occluders(jnp.concatenate([center - size / 2, center + size / 2], -1), jnp.stack(channels, -1), rank)


def render_frames(render_scenes: RenderScene, plan: FramePlan, options: Annotations) -> dict[str, Array]:
    """Frames and annotations [n, ...] of these videos, by stored name."""
    frames, owners = draw(render_scenes, plan)
    rendered = {} if frames is None else {"frames": frames}
    return rendered | annotations.annotate(render_scenes, owners, plan, options)


def painted_colors(paint: Paint, scene: Scene) -> Array:
    """Rendered colours [K, 3] uint8 of the slots; zero for empty slots."""
    present = scene.objects.present[:, None]
    return jnp.where(present, jnp.clip(jnp.round(paint.color), 0, 255), 0).astype(jnp.uint8)


def material_columns(paint: Paint, scene: Scene) -> dict[str, Array]:
    """The materials of the slots, by stored name, if the look has any; NO_MATERIAL for empty slots."""
    if paint.material is None:
        return {}
    return {"objects/material": jnp.where(scene.objects.present, paint.material, NO_MATERIAL).astype(jnp.uint8)}


def sensor_columns(sensor: Sensor | None) -> dict[str, Array]:
    """The numbers of the lens and the sensor that are sampled, by stored name."""
    numbers = {} if sensor is None else sensor._asdict()
    return {f"image/{name}": value.astype(jnp.float32) for name, value in numbers.items() if value is not None}


def with_pictures(render_scenes: RenderScene, config: Config) -> RenderScene:
    """Render scenes [n], or their shapes and types, with the pixels of their backgrounds' pictures, if they have any.

    Raises ConfigError for an image that is not there, or that cannot be read.
    """
    background, digests = render_scenes.paint.background, getattr(config.look.options, "background_images", None)
    if background.picture is None or digests is None:
        return render_scenes
    picture, size = background.picture, (config.video.height, config.video.width)
    chosen = picture.number, picture.corner, picture.extent
    if isinstance(picture.number, jax.ShapeDtypeStruct):
        pixels: Any = jax.ShapeDtypeStruct((*picture.number.shape, *size, 3), np.uint8)
    else:
        number, corner, extent = map(np.asarray, chosen)
        pixels = jax.device_put(crops(digests, number, corner, extent, *size), picture.number.device)
    background = background._replace(picture=picture._replace(pixels=pixels))
    return render_scenes._replace(paint=render_scenes.paint._replace(background=background))


def look_columns(paint: Paint, config: Config) -> dict[str, Array]:
    """Values of the look's sampled options, by stored name.

    Raises ConfigError if the look's paint has other values than its options declare.
    """
    declared, sampled = drawn_options(config.look.options), paint.sampled or {}
    for name in sorted(declared.keys() ^ sampled.keys()):
        verb = "samples" if name in declared else "does not declare"
        raise ConfigError(
            f"look {config.look.name} {verb} the option {name}, but Paint.sampled must hold just the options that it "
            "samples: the result of sampled_options"
        )
    return {f"look/{name}": value for name, value in sampled.items()}


def occluder_columns(occluders: Occluders | None, plan: FramePlan) -> dict[str, Array]:
    """The occluders of a video, by stored name, if it has any."""
    if occluders is None:
        return {}
    return {
        "occluders/box": occluders.box,
        "occluders/color": jnp.round(occluders.color).astype(jnp.uint8),
        "occluders/depth": (occluders.rank + plan.layout.slots - plan.moving).astype(jnp.int16),
    }


def camera_columns(view: CameraView) -> dict[str, Array]:
    """The parameters of a view, by stored name."""
    return {f"camera/{name}": values for name, values in view._asdict().items()}
