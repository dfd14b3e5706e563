"""Stored fields of a config's videos, the sizes of their axes, and the fields computed on the host."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gen2d import annotations
from gen2d.captions import caption, facts
from gen2d.config import quality
from gen2d.config.config import Config
from gen2d.config.options import drawn_options
from gen2d.config.sections import ImageOptions
from gen2d.core.enums import JOINT_KINDS
from gen2d.core.palettes import NAME_BYTES, Palette, palette_of
from gen2d.core.schema import Field
from gen2d.physics import lyapunov
from gen2d.physics.simulate import SaveAt
from gen2d.records import axes, scene, trajectory
from gen2d.records.layout import Layout
from gen2d.renderers.paint import NO_MATERIAL
from gen2d.renderers.plan import FramePlan
from gen2d.sampling import rejection, sampler
from gen2d.sampling.matched import sets

FACTS = "objects/", "states/", "camera/", "world/", "contacts/", "joints/"  # what nouns depend on
OCCLUDERS = {
    "occluders/box": Field("float32", "n O 4", "px", "x0 y0 x1 y1 of each occluder, back to front; 0: none"),
    "occluders/color": Field("uint8", "n O 3", "sRGB", "color of each occluder"),
    "occluders/depth": Field("int16", "n O", "1", "objects whose objects/depth is below this are behind the occluder"),
}
FRAMES = Field("uint8", "n T H W 3", "sRGB", "frames of the video")
CAMERA = (
    ("center", "n T 2", "m", "world point at the centre of the frame"),
    ("scale", "n T", "px/m", "pixels per metre"),
    ("angle", "n T", "rad", "angle of the camera, counter-clockwise"),
)


@dataclasses.dataclass(frozen=True, eq=False)
class VideoSchema:
    """Fields, axis sizes and constants of a config's videos."""

    config: Config
    layout: Layout
    plan: FramePlan
    save_at: SaveAt
    sampler: sampler.Sampler

    @functools.cached_property
    def sizes(self) -> dict[str, int]:
        """Sizes of the named axes of all fields (T, K, H, W and so on)."""
        video = self.config.video
        sizes = {"T": video.frames, "K": self.layout.slots, "H": video.height, "W": video.width}
        sizes |= {"C": self.save_at.contacts} if self.save_at.contacts else {}
        sizes |= {"J": len(self.layout.joints)} if self.layout.joints else {}
        sizes |= {"O": self._occluders} if self._occluders else {}
        corners = max(group.vertices for group in self.layout.groups)
        sizes |= {"V": corners} if corners else {}
        return annotations.sizes(self.config.annotations, self.plan, sizes | self.sampler.lengths)

    @functools.cached_property
    def fields(self) -> dict[str, Field]:
        """All stored fields, by name."""
        config = self.config
        records = [scene.State, trajectory.Quality, *([trajectory.Contacts] if self.save_at.contacts else [])]
        records += [trajectory.Energy] if self.save_at.energy else []
        simulated = {name: field for record in records for name, (_, field) in axes.stored_fields(record).items()}
        if config.annotations.simulated.lyapunov:
            simulated |= lyapunov.FIELDS
        fields = {name: self._in_precision(field) for name, field in simulated.items()}
        fields |= axes.fields_of(jax.eval_shape(self._scene, jax.eval_shape(lambda: jax.random.key(0))))
        if not self.save_at.energy:
            del fields["quality/energy_residual"]
        for name in sets.omitted_fields(config.matched):
            del fields[name]
        if self.plan.frames:
            fields["frames"] = FRAMES
        fields |= self.host_fields
        fields["index"] = Field("int64", "n", "1", "number of the video in its split")
        fields["time"] = Field("float64", "T", "s", "time of each frame; frame 0 is the initial state")
        if self.layout.joints:
            fields["joints/kind"] = Field("uint8", "J", "1", f"kind, an index into {', '.join(JOINT_KINDS)}")
            fields |= {f"joints/{side}": Field("int16", "J", "object", f"slot of object {side}") for side in "ab"}
        fields["quality/rejected_draws"] = Field("int32", "n", "1", "number of positions rejected for overlap")
        fields |= {"quality/rejected_videos": rejection.FIELD} if quality.ranges(config.quality) else {}
        for name, axis_names, unit, meaning in CAMERA:
            fields[f"camera/{name}"] = Field("float32", axis_names, unit, meaning)
        fields |= sampler.fields(config) | sets.fields(config.matched)
        return dict(sorted(annotations.fields(config.annotations, fields).items()))

    def _in_precision(self, field: Field) -> Field:
        """A field of the simulation, whose floating-point numbers are stored as they are computed."""
        return dataclasses.replace(field, dtype=self.config.physics.precision) if field.dtype == "float32" else field

    def _scene(self, key: jax.Array) -> scene.Scene:
        return self.sampler.sample(key, given=jnp.zeros(len(self.sampler.gridded)))[1].scene

    @functools.cached_property
    def constants(self) -> dict[str, np.ndarray]:
        """Values of the stored fields that are the same for all videos."""
        joints = self.layout.joints
        if not joints:
            return {"time": self.time}
        slots = {f"joints/{side}": np.array([getattr(joint, side) for joint in joints], np.int16) for side in "ab"}
        kinds = np.array([JOINT_KINDS.index(joint.kind) for joint in joints], np.uint8)
        return {"time": self.time, "joints/kind": kinds, **slots}

    @functools.cached_property
    def time(self) -> np.ndarray:
        """Time of each frame [T] in s, exactly t / fps."""
        return np.arange(self.config.video.frames, dtype=np.float64) / self.config.video.fps

    @functools.cached_property
    def host_fields(self) -> dict[str, Field]:
        """Fields that the host computes from the others: split, names of colours and materials, and captions."""
        longest = max((len(split.name) for split in self.config.splits), default=0)
        fields = {"split": Field(f"S{longest}", "n", "", "split of the video")} if longest else {}
        if any(palette_of(config.look.options) for config in self._split_configs):
            meaning = "name of the color in the look's palette; empty: none"
            fields["objects/color_name"] = Field(f"S{NAME_BYTES}", "n K", "", meaning)
        found = [names for config in self._split_configs if (names := materials_of(config.look.options))]
        if found:
            listed = " or ".join(sorted({", ".join(names) for names in found}))
            meaning = f"material, an index into {listed}; {NO_MATERIAL}: none"
            fields["objects/material"] = Field("uint8", "n K", "1", meaning)
            meaning = "name of the material in the look; empty: none"
            longest = max(len(name) for names in found for name in names)
            fields["objects/material_name"] = Field(f"S{longest}", "n K", "", meaning)
        fields |= {f"image/{name}": self._sensor_field(name) for name in self._sensor_options}
        for config in self._split_configs:
            for name, spec in drawn_options(config.look.options).items():
                fields[f"look/{name}"] = Field("float32", "n", spec.unit, f"{spec.meaning}; NaN: of another look")
        fields |= OCCLUDERS if self._occluders else {}
        if self.config.annotations.simulated.classes:
            longest, meaning = max(map(len, facts.CLASSES)), "noun of the object; empty: none"
            fields["objects/class_name"] = Field(f"S{longest}", "n K", "", meaning)
        captioned = self.config.annotations.simulated.captions
        return fields | (caption.fields(self.layout.slots, self.config.video.frames) if captioned else {})

    @property
    def _sensor_options(self) -> list[str]:
        """Names of the options of `image` that sample a number of the lens or the sensor in some split."""
        return sorted({name for config in self._split_configs for name in config.image.sensor})

    @staticmethod
    def _sensor_field(name: str) -> Field:
        """The field of a sampled number."""
        spec = ImageOptions.__dataclass_fields__[name].metadata["option"]
        return Field("float32", "n", spec.unit, spec.meaning.replace("null: none", "0: none"))

    @property
    def _split_configs(self) -> list[Config]:
        """The configs of all splits; the config itself if there are no splits."""
        return [self.config.of_split(split.name) for split in self.config.splits] or [self.config]

    @property
    def _occluders(self) -> int:
        """Largest number of occluders of a split."""
        return max(config.image.occluders for config in self._split_configs)

    def host_columns(self, columns: dict[str, np.ndarray], split: str) -> dict[str, np.ndarray]:
        """Values of the host's fields for videos of one split, from their other fields [n, ...]."""
        count, config = len(columns["objects/present"]), self.config
        host_columns = {}
        if config.splits:
            host_columns["split"] = np.full(count, split.encode(), self.host_fields["split"].dtype)
        if "objects/color_name" in self.host_fields:
            palette = palette_of(config.of_split(split).look.options)
            host_columns["objects/color_name"] = _color_names(columns, palette)
        if "objects/material" in self.host_fields:
            names = materials_of(config.of_split(split).look.options)
            present = columns["objects/present"]
            material = columns.get("objects/material", np.full(present.shape, NO_MATERIAL, np.uint8))
            table = np.zeros(NO_MATERIAL + 1, self.host_fields["objects/material_name"].dtype)
            table[: len(names)] = [name.encode() for name in names]
            host_columns |= {"objects/material": material, "objects/material_name": table[material]}
        for name in (f"image/{name}" for name in self._sensor_options):
            host_columns[name] = columns.get(name, np.zeros(count, np.float32))
        host_columns |= self._padded_columns(columns)
        if "objects/class_name" in self.host_fields:
            host_columns["objects/class_name"] = self._class_names(columns)
        return host_columns | (
            caption.caption_fields(columns | host_columns, config.video, self.constants)
            if config.annotations.simulated.captions
            else {}
        )

    def _padded_columns(self, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Values of the look and occluders; NaN and 0 for those that the look or the images of a split do not have."""
        count, padded = len(columns["objects/present"]), {}
        for name, field in self.host_fields.items():
            if name.startswith("look/"):
                padded[name] = columns.get(name, np.full(count, np.nan, np.float32))
            elif name.startswith("occluders/"):
                padded[name] = np.zeros((count, *field.shape(self.sizes)), field.dtype)
                if name in columns:
                    padded[name][:, : columns[name].shape[1]] = columns[name]
        return padded

    def _class_names(self, columns: dict[str, np.ndarray]) -> np.ndarray:
        """Nouns [n, K] of the objects; empty where there is none."""
        names = np.zeros(columns["objects/present"].shape, self.host_fields["objects/class_name"].dtype)
        for row in range(len(names)):
            video = {name: values[row] for name, values in columns.items() if name.startswith(FACTS)}
            for slot, noun in facts.VideoFacts(video | self.constants, self.config.video).nouns.items():
                names[row, slot] = noun.encode()
        return names


def materials_of(options: Any) -> tuple[str, ...]:
    """Names of the materials of a look with these options; empty if it has none."""
    return getattr(options, "materials", ())


def _color_names(columns: dict[str, np.ndarray], palette: Palette | None) -> np.ndarray:
    """Names [n, K] of the objects' colours in a palette; empty for other colours, and where there is no object."""
    colors, present = columns["objects/color"], columns["objects/present"]
    names = np.zeros(present.shape, f"S{NAME_BYTES}")
    if palette is not None:
        for name, color in (palette.wall, *palette.objects.items()):
            names[present & (colors == color).all(-1)] = name.encode()
    return names
