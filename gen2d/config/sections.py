"""Options of every section of a config, except those of plug-ins."""

import dataclasses

from gen2d.config import matched
from gen2d.config.distributions import Distribution
from gen2d.config.options import option
from gen2d.storage.codecs import CODECS

MAX_SLOTS = 254  # mask ids (slot + 1) are one byte; 0 is the background, 255 an occluder


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """Length, frame rate and size of videos."""

    frames: int = option(64, int, "frames", "in a video, the initial state included", low=1, high=100_000)
    fps: float = option(30.0, float, "1/s", "frames per second of the world's time", above=0, high=100_000)
    height: int = option(64, int, "px", "of a frame", low=4, high=8192)
    width: int = option(64, int, "px", "of a frame", low=4, high=8192)


@dataclasses.dataclass(frozen=True)
class PhysicsOptions:
    """Time steps, damping and contact parameters of the simulation."""

    substeps: int | None = option(
        None, int, "steps/frame", "null: as many as max_step asks for", low=1, high=10_000, optional=True
    )
    max_step: float = option(1 / 240, float, "s", "longest step where substeps is null", above=0, high=1)
    mixing: str = option(
        "product", str, "", "of two elasticities or frictions", choices=("product", "mean", "max", "geometric")
    )
    damping: float = option(0.0, float, "1/s", "rate at which velocity and spin die away", low=0, high=1000)
    bounce_threshold: float = option(
        0.01, float, "m/s", "slower impacts do not bounce, nor any that gravity makes in two steps", low=0
    )
    contact_hertz: float = option(
        30.0, float, "Hz", "stiffness of an overlapping contact; at most 1/8 of the step rate", above=0
    )
    contact_damping_ratio: float = option(10.0, float, "1", "of an overlapping contact", above=0)
    push_speed: float = option(3.0, float, "m/s", "an overlap is undone no faster", above=0)


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """View of the world and motion of the camera."""

    center: tuple[float, ...] | None = option(
        None, float, "m", "world point in the middle of the frame; null: the scene's", parts=2, optional=True
    )
    scale: float | None = option(
        None, float, "px/m", "pixels per metre; null: all of the scene", above=0, high=1e6, optional=True
    )
    margin: float = option(0.0, float, "m", "shown around the scene where scale is null", low=0)
    angle: Distribution = option(0.0, float, "rad", "of the camera, counter-clockwise", draw=True)
    pan: tuple[Distribution, ...] = option([0, 0], float, "m/s", "speed of the camera", parts=2, draw=True)
    zoom: Distribution = option(0.0, float, "1/s", "rate at which the scale grows", draw=True, low=-100, high=100)
    turn: Distribution = option(0.0, float, "rad/s", "at which the camera turns", draw=True)
    shake: Distribution = option(0.0, float, "m", "of a hand's tremor, rms in each direction", draw=True, low=0)
    shake_hertz: float = option(4.0, float, "Hz", "lowest frequency of the tremor", above=0)
    follow: int | None = option(
        None, int, "slot", "of the object that stays in the middle of the frame; null: none", low=0, optional=True
    )


@dataclasses.dataclass(frozen=True)
class ImageOptions:
    """Image formation: blending of colours, motion blur, occluders and sensor noise."""

    blending: str = option(
        "srgb", str, "", "of a pixel's colours: as most tools do, or in linear light", choices=("srgb", "linear")
    )
    exposure: float = option(
        0.0,
        float,
        "frames",
        "for which the shutter is open, until the frame's instant; 0: no motion blur",
        low=0,
        high=1,
    )
    exposure_samples: int = option(8, int, "samples", "of an exposure, evenly in time", low=2, high=256)
    noise: Distribution = option(
        0.0, float, "sRGB", "standard deviation of a video's sensor noise", draw=True, low=0, high=255
    )
    occluders: int = option(0, int, "rectangles", "that stand before objects and do not take part", low=0, high=16)
    occluder_width: Distribution = option([0.1, 0.3], float, "1", "of an occluder, over the frame's", draw=True, low=0)
    occluder_height: Distribution = option([0.1, 0.6], float, "1", "of an occluder, over the frame's", draw=True, low=0)
    occluder_front: Distribution = option(
        1.0, float, "1", "share of the objects that an occluder stands before, in their drawing order",
        draw=True, low=0, high=1,
    )  # fmt: skip
    occluder_color: tuple[Distribution, ...] = option(
        [[60, 140]] * 3, int, "sRGB", "of an occluder", parts=3, draw=True, low=0, high=255
    )


@dataclasses.dataclass(frozen=True)
class SimulationAnnotations:
    """Annotations computed from the simulation, stored beside frames and states."""

    contacts: int = option(
        0, int, "rows", "of contacts, per object and 16 frames; 4 is a good number, 0: none", low=0, high=1000
    )
    energy: bool = option(False, bool, "", "books of energy and momentum, and what they leave unexplained")
    captions: bool = option(False, bool, "", "a caption and a list of events, as text; they need contacts")
    lyapunov: bool = option(False, bool, "", "how fast a small change of the start grows")


@dataclasses.dataclass(frozen=True)
class QualityOptions:
    """Accepted ranges of quality measures (null: no limit); videos outside are replaced by new samples."""

    min_contacts: int | None = option(None, int, "contacts", "that begin in a video", low=0, optional=True)
    max_contacts: int | None = option(None, int, "contacts", "that begin in a video", low=0, optional=True)
    min_penetration: float | None = option(None, float, "m", "of a video's deepest overlap", low=0, optional=True)
    max_penetration: float | None = option(None, float, "m", "of a video's deepest overlap", low=0, optional=True)
    min_lyapunov: float | None = option(
        None, float, "1/s", "of a small change; needs annotations.lyapunov", optional=True
    )
    max_lyapunov: float | None = option(
        None, float, "1/s", "of a small change; needs annotations.lyapunov", optional=True
    )
    min_energy_residual: float | None = option(
        None, float, "J", "of energy; needs annotations.energy", low=0, optional=True
    )
    max_energy_residual: float | None = option(
        None, float, "J", "of energy; needs annotations.energy", low=0, optional=True
    )
    min_visibility: float | None = option(
        None, float, "1", "of the object least seen; needs annotations.visibility", low=0, high=1, optional=True
    )
    max_visibility: float | None = option(
        None, float, "1", "of the object least seen; needs annotations.visibility", low=0, high=1, optional=True
    )
    attempts: int = option(1000, int, "attempts", "at a video, at most", low=1, high=1_000_000)


@dataclasses.dataclass(frozen=True)
class MatchedOptions:
    """Matched sets: videos that share a scene and differ in one factor or event; off if `change` is null."""

    change: tuple[str, ...] | None = option(
        None,
        str,
        "",
        "what members differ in: a factor of the scene's, or "
        f"{', '.join(matched.INTERVENTIONS)}; one of a list for each set",
        several=True,
        optional=True,
    )
    members: int = option(2, int, "videos", "in a set, the original included", low=2, high=256)
    scale: Distribution | None = option(
        None, float, "1", "that a factor is multiplied by; null: it is drawn anew", above=0, draw=True, optional=True
    )
    objects: str = option(
        "one", str, "", "whose factor is changed where each has its own: one's or all's", choices=("one", "all")
    )
    onset: Distribution = option(
        [0.3, 0.7], float, "1", "share of a video before a violation", low=0, high=1, draw=True
    )
    distance: Distribution = option([2, 4], float, "m", "that teleport moves an object by", above=0, draw=True)
    gain: Distribution = option([1.5, 2.5], float, "1", "of an object's speed in energy_gain", low=0, draw=True)


@dataclasses.dataclass(frozen=True)
class StorageOptions:
    """Storage of videos on disk."""

    frames: str = option(
        "video",
        str,
        "",
        "video: stored; none: left out, to be drawn again with gen2d.render",
        choices=("video", "none"),
    )
    codec: str = option(
        "gzip", str, "", "of the frames: gzip opens everywhere, zstd is smaller, none can be mapped", choices=CODECS
    )
    chunk_frames: int | None = option(
        None,
        int,
        "frames",
        "compressed together; null: a whole video. Fewer make short windows faster to read and files larger",
        low=1,
        optional=True,
    )
    videos_per_shard: int | None = option(
        None,
        int,
        "videos",
        "null: the largest power of two with raw frames of 1 GiB at most, up to 1024",
        low=1,
        high=65536,
        optional=True,
    )
    batch_size: int | None = option(
        None,
        int,
        "videos",
        "simulated at once by a device; null: 512, or fewer with many objects. Changes the last bits of a simulation",
        low=1,
        high=65536,
        optional=True,
    )
