"""Options of every section of a config, except those of plug-ins."""

import dataclasses

from gen2d.config import matched
from gen2d.config.distributions import Distribution
from gen2d.config.options import option
from gen2d.storage.codecs import CODECS


@dataclasses.dataclass(frozen=True)
class VideoOptions:
    """Length, frame rate and size of videos."""

    frames: int = option(64, int, "frames", "length of a video, including the initial state", low=1, high=100_000)
    fps: float = option(30.0, float, "1/s", "frame rate, in simulated time", above=0, high=100_000)
    height: int = option(64, int, "px", "height of a frame", low=4, high=8192)
    width: int = option(64, int, "px", "width of a frame", low=4, high=8192)


@dataclasses.dataclass(frozen=True)
class PhysicsOptions:
    """Time steps, damping and contact parameters of the simulation."""

    substeps: int | None = option(
        None, int, "steps/frame", "solver steps per frame; null: set by max_step", low=1, high=10_000, optional=True
    )
    max_step: float = option(1 / 240, float, "s", "largest time step if substeps is null", above=0, high=1)
    mixing: str = option(
        "product", str, "", "rule for two elasticities or frictions", choices=("product", "mean", "max", "geometric")
    )
    damping: float = option(0.0, float, "1/s", "decay rate of velocity and spin", low=0, high=1000)
    bounce_threshold: float = option(
        0.01, float, "m/s", "smallest impact speed that bounces; at least the gain by gravity in two steps", low=0
    )
    contact_hertz: float = option(
        30.0, float, "Hz", "frequency of the spring that corrects overlaps, at most 1/8 of the step rate", above=0
    )
    contact_damping_ratio: float = option(2.0, float, "1", "damping ratio of that spring", above=0)
    push_speed: float = option(3.0, float, "m/s", "largest speed at which an overlap is resolved", above=0)
    precision: str = option(
        "float32",
        str,
        "",
        "type of the simulation's numbers, in which states, contacts and energy are stored",
        choices=("float32", "float64"),
        later=True,
    )
    impact_order: str = option(
        "pairs",
        str,
        "",
        "order of impacts in a step: pairs (the solver's, faster) or time (exact where a disc is hit twice)",
        choices=("pairs", "time"),
        later=True,
    )
    extreme_mass_ratios: bool = option(
        False, bool, "", "far heavier bodies do not go through light ones that others stop (slower)", later=True
    )
    relax_iterations: int | None = option(
        None, int, "passes", "passes over all contacts at the end of a step; null: 1, or 4 to 16 where needed",
        low=1, high=64, optional=True, later=True,
    )  # fmt: skip

    @property
    def x64(self) -> bool:
        """Whether the simulation runs in jax's 64-bit mode."""
        return self.precision == "float64"


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """View of the world and motion of the camera."""

    center: tuple[float, ...] | None = option(
        None, float, "m", "world point at the centre of the frame; null: centre of the scene", parts=2, optional=True
    )
    scale: float | None = option(
        None, float, "px/m", "pixels per metre; null: the scene fits", above=0, high=1e6, optional=True
    )
    margin: float = option(0.0, float, "m", "width of the border around the scene if scale is null", low=0)
    angle: Distribution = option(0.0, float, "rad", "angle of the camera, counter-clockwise", draw=True)
    pan: tuple[Distribution, ...] = option([0, 0], float, "m/s", "velocity of the camera", parts=2, draw=True)
    zoom: Distribution = option(0.0, float, "1/s", "growth rate of the scale", draw=True, low=-100, high=100)
    turn: Distribution = option(0.0, float, "rad/s", "angular velocity of the camera, counter-clockwise", draw=True)
    shake: Distribution = option(0.0, float, "m", "RMS displacement of hand shake per axis", draw=True, low=0)
    shake_hertz: float = option(4.0, float, "Hz", "lowest frequency of hand shake", above=0)
    follow: int | None = option(
        None, int, "slot", "slot of the object that stays at the centre of the frame; null: none", low=0, optional=True
    )


SENSOR = "distortion", "vignette", "exposure_gain", "shot_noise", "white_balance", "noise", "jpeg_quality"


@dataclasses.dataclass(frozen=True)
class ImageOptions:
    """Image formation: blending of colours, motion blur, occluders, lens and sensor."""

    blending: str = option("srgb", str, "", "color space for blending; most tools use srgb", choices=("srgb", "linear"))
    exposure: float = option(0.0, float, "frames", "length of an exposure; 0: no motion blur", low=0, high=1)
    exposure_samples: int = option(8, int, "samples", "instants averaged per exposure", low=2, high=256)
    shutter: str = option(
        "end", str, "", "part of an exposure at the instant of its frame", choices=("end", "centre"), later=True
    )
    distortion: Distribution = option(
        0.0, float, "1", "radial distortion of the lens; above 0: as a barrel, below 0: as a pincushion",
        draw=True, low=-0.3, high=0.5, later=True,
    )  # fmt: skip
    vignette: Distribution = option(
        0.0, float, "1", "part of the light that is missing in the corners", draw=True, low=0, high=1, later=True
    )
    exposure_gain: Distribution = option(
        0.0, float, "stops", "exposure, over that at which frames are as rendered; each stop doubles the light",
        draw=True, low=-10, high=10, later=True,
    )  # fmt: skip
    shot_noise: Distribution = option(
        0.0, float, "1", "standard deviation of the shot noise of white, over its light",
        draw=True, low=0, high=1, later=True,
    )  # fmt: skip
    white_balance: Distribution = option(
        0.0, float, "stops", "gain of red over that of blue; above 0: warmer",
        draw=True, low=-4, high=4, later=True,
    )  # fmt: skip
    noise: Distribution = option(
        0.0, float, "sRGB", "standard deviation of the sensor noise", draw=True, low=0, high=255
    )
    jpeg_quality: Distribution | None = option(
        None, int, "1", "quality of a JPEG round trip of each frame, 1 to 100; null: none",
        draw=True, low=1, high=100, optional=True, later=True,
    )  # fmt: skip
    occluders: int = option(0, int, "rectangles", "number of occluders, fixed in the image", low=0, high=16)
    occluder_width: Distribution = option([0.1, 0.3], float, "1", "occluder width over frame width", draw=True, low=0)
    occluder_height: Distribution = option(
        [0.1, 0.6], float, "1", "occluder height over frame height", draw=True, low=0
    )
    occluder_front: Distribution = option(
        1.0, float, "1", "fraction of the objects, in drawing order, behind an occluder",
        draw=True, low=0, high=1,
    )  # fmt: skip
    occluder_color: tuple[Distribution, ...] = option(
        [[60, 140]] * 3, int, "sRGB", "color of an occluder", parts=3, draw=True, low=0, high=255
    )

    @property
    def sensor(self) -> dict[str, Distribution]:
        """Options of the lens and the sensor that change frames, by name, in the order of their stages."""
        options = {name: getattr(self, name) for name in SENSOR}
        return {name: value for name, value in options.items() if value is not None and value.support != (0.0, 0.0)}


@dataclasses.dataclass(frozen=True)
class SimulationAnnotations:
    """Annotations computed from the simulation, stored beside frames and states."""

    contacts: int = option(
        0, int, "rows", "stored contacts per object and 16 frames, such as 4; 0: none", low=0, high=1000
    )
    energy: bool = option(False, bool, "", "energy balance and momentum in each frame")
    captions: bool = option(False, bool, "", "caption and list of events, as text; needs contacts")
    lyapunov: bool = option(False, bool, "", "growth rate of a small perturbation of the initial state")
    classes: bool = option(False, bool, "", "class name of each object, such as ball or plank", later=True)


@dataclasses.dataclass(frozen=True)
class QualityOptions:
    """Accepted ranges of quality measures (null: no limit); videos outside are replaced by new samples."""

    min_contacts: int | None = option(
        None, int, "contacts", "lower limit of the number of contacts", low=0, optional=True
    )
    max_contacts: int | None = option(
        None, int, "contacts", "upper limit of the number of contacts", low=0, optional=True
    )
    min_penetration: float | None = option(None, float, "m", "lower limit of the deepest overlap", low=0, optional=True)
    max_penetration: float | None = option(None, float, "m", "upper limit of the deepest overlap", low=0, optional=True)
    min_lyapunov: float | None = option(
        None, float, "1/s", "lower limit of the growth rate; needs annotations.lyapunov", optional=True
    )
    max_lyapunov: float | None = option(
        None, float, "1/s", "upper limit of the growth rate; needs annotations.lyapunov", optional=True
    )
    min_energy_residual: float | None = option(
        None, float, "J", "lower limit of the energy residual; needs annotations.energy", low=0, optional=True
    )
    max_energy_residual: float | None = option(
        None, float, "J", "upper limit of the energy residual; needs annotations.energy", low=0, optional=True
    )
    min_visibility: float | None = option(
        None, float, "1", "lower limit of visible fractions; needs annotations.visibility", low=0, high=1, optional=True
    )
    max_visibility: float | None = option(
        None, float, "1", "upper limit of visible fractions; needs annotations.visibility", low=0, high=1, optional=True
    )
    attempts: int = option(1000, int, "attempts", "largest number of attempts at a video", low=1, high=1_000_000)


@dataclasses.dataclass(frozen=True)
class MatchedOptions:
    """Matched sets: videos that share a scene and differ in one factor or event; off if `change` is null."""

    change: tuple[str, ...] | None = option(
        None,
        str,
        "",
        "difference between members: a factor of the scene, or "
        f"{', '.join(matched.INTERVENTIONS)}; from a list, one per set; null: no sets",
        several=True,
        optional=True,
    )
    members: int = option(2, int, "videos", "number of videos in a set, including the original", low=2, high=256)
    scale: Distribution | None = option(
        None, float, "1", "multiplier of the factor; null: new sample", above=0, draw=True, optional=True
    )
    objects: str = option("one", str, "", "objects that change, for a factor per object", choices=("one", "all"))
    onset: Distribution = option(
        [0.3, 0.7], float, "1", "fraction of the video before a violation", low=0, high=1, draw=True
    )
    distance: Distribution = option([2, 4], float, "m", "distance of a teleport", above=0, draw=True)
    gain: Distribution = option([1.5, 2.5], float, "1", "speed ratio of energy_gain", low=0, draw=True)


@dataclasses.dataclass(frozen=True)
class StorageOptions:
    """Storage of videos on disk."""

    frames: str = option(
        "video", str, "", "stored frames; none: rendered when they are read", choices=("video", "none")
    )
    codec: str = option(
        "gzip", str, "", "codec of frames: gzip opens everywhere, zstd is smaller, none can be mapped", choices=CODECS
    )
    chunk_frames: int | None = option(
        None,
        int,
        "frames",
        "frames per compressed chunk; null: a whole video. Small chunks suit short windows but enlarge files",
        low=1,
        optional=True,
    )
    videos_per_shard: int | None = option(
        None,
        int,
        "videos",
        "videos per shard; null: the power of two up to 1024 that holds at most 1 GiB of raw frames",
        low=1,
        high=65536,
        optional=True,
    )
    batch_size: int | None = option(
        None,
        int,
        "videos",
        "number of videos that a device simulates at once; null: 512, or fewer with many objects. "
        "Affects the last bits of a simulation",
        low=1,
        high=65536,
        optional=True,
    )
