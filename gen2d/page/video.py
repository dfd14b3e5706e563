"""One video of a dataset as plain values, as in JSON, from which a page draws it."""

import base64
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from gen2d.core.enums import BEGIN, DYNAMIC, IMPACT, SHAPES
from gen2d.core.schema import Field
from gen2d.dataset.manifest import Manifest
from gen2d.loading.dataset import Dataset, ViewOptions
from gen2d.media.drawing import rgb_of
from gen2d.media.overlays import colors, directions, grey_levels, normals_overlay
from gen2d.media.sprites import reduced, sprite_rows, sprite_sheet
from gen2d.page.arrays import packed
from gen2d.storage.paths import Place

# Fields that a page draws; a field of another shape, from some plug-in, is not drawn.
DRAWN = {
    "frames": "n T H W 3",
    "masks/instance": "n T H W",
    "flow/forward": "n T H W 2",
    "surface/height": "n T H W",
    "surface/normal": "n T H W 3",
    "surface/shadow": "n T H W",
    "boxes/visible": "n T K 4",
    "states/position": "n T K 2",
    "states/angle": "n T K",
    "states/velocity": "n T K 2",
    "states/angular_velocity": "n T K",
    "camera/center": "n T 2",
    "camera/scale": "n T",
    "camera/angle": "n T",
    "momentum/linear": "n T 2",
    "objects/present": "n K",
    "objects/color": "n K 3",
    "objects/vertices": "n K V 2",
    "occluders/box": "n O 4",
    "occluders/color": "n O 3",
    "occluders/depth": "n O",
    "world/gravity": "n 2",
}
CONTACT_CODES = ("frame", "a", "b", "kind")
DRAWN |= {f"contacts/{name}": "n C" for name in (*CONTACT_CODES, "normal_impulse")} | {"contacts/point": "n C 2"}
ENERGIES = ("kinetic", "rotational", "potential", "lost_in_contact", "lost_to_damping", "work_in")
DRAWN |= {f"energy/{name}": "n T" for name in ENERGIES}
MAX_VALUES = 100  # of one field, in the tables of values
MAX_TEXT = 2000  # characters


@dataclasses.dataclass(frozen=True)
class Detail:
    """How much of a video a page holds."""

    frames: int  # maximum number, evenly spaced from the first
    side: int  # px, of a square of as many pixels as a frame has at most
    mask_side: int
    quality: int | None  # of WebP, 0 to 100; None: lossless
    objects: int  # maximum numbers
    contacts: int


class Videos:
    """Videos of one split of a dataset."""

    def __init__(self, root: Place, manifest: Manifest, split: str) -> None:
        self.manifest, self.split, self.frames = manifest, split, manifest.frames[split]
        self.drawn = [name for name, axes in DRAWN.items() if _is_drawn(name, manifest.fields.get(name), axes)]
        self.objects = [name for name, field in manifest.fields.items() if field.axes == "n K" and name not in DRAWN]
        self.values = [name for name, field in manifest.fields.items() if is_value(name, field, manifest)]
        fields = *self.drawn, *self.objects, *self.values
        options = ViewOptions(split, fields, None, 1, "first", "THWC", "uint8", "checksum")
        self.dataset = Dataset(root, manifest, options.within(self.frames, manifest.sizes.get("T", 0)))

    def __len__(self) -> int:
        return len(self.dataset)

    def video(self, number: int, detail: Detail) -> dict[str, Any]:
        """The video with this number; raises the errors of `Dataset.batch`."""
        values = self.dataset[number]
        stride = max(1, -(-self.frames // detail.frames))
        sizes = self.manifest.sizes
        video: dict[str, Any] = {
            "split": self.split,
            "number": number,
            "frames": self.frames,
            "stride": stride,
            "height": sizes.get("H", 1),
            "width": sizes.get("W", 1),
            "values": {name: self._value(name, values) for name in self.values},
        }
        if "frames" in values:
            frames = reduced(values["frames"][::stride], detail.side)
            video["sprite"] = _sprite(sprite_sheet(frames, detail.quality), frames)
        for name, (field, paint) in LAYERS.items():
            if field in values:
                height, width = values[field].shape[1:3]
                step = math.ceil(math.sqrt(height * width) / detail.mask_side)
                layer = paint(values[field][::stride, ::step, ::step])
                quality = None if layer.shape[-1] == 4 else detail.quality  # ids and hues are exact
                video[name] = _sprite(sprite_sheet(layer, quality), layer)
        if "frames" not in values:
            video["occluders"] = _occluders(values)
        if "sprite" in video and np.any(values.get("image/distortion", 0)):
            # Outlines would not lie on what the frames show.
            values = {name: value for name, value in values.items() if not name.startswith("camera/")}
        present = values.get("objects/present", np.zeros(sizes.get("K", 0), bool))
        slots = np.flatnonzero(present)[: detail.objects]
        if len(slots):
            video["objects"] = self._objects(values, slots)
        if "contacts/point" in values and "contacts/normal_impulse" in values:
            video["contacts"] = _contacts(values, slots, self.frames, detail.contacts)
        cameras = [name for name in self.drawn if name.startswith("camera/") and name in values]
        arrays = {name: values[name][::stride].astype(np.float64) for name in cameras}
        for name in self.drawn:
            if DRAWN[name].startswith("n T K") and name != "states/angular_velocity":
                arrays[name] = values[name][::stride][:, slots].astype(np.float64)
        arrays |= {name: series[::stride] for name, series in energies(values).items()}
        return video | {"arrays": packed(arrays)}

    def _value(self, name: str, values: Mapping[str, np.ndarray]) -> Any:
        """A field's value; a factor of single objects, in the order of the scene, without those that it lacks."""
        field = self.manifest.fields[name]
        counted = f"factors/{field.axes.split()[1]}" if len(field.axes.split()) > 1 else ""
        if counted in self.values and values[counted].ndim == 0 and 0 <= values[counted] <= len(values[name]):
            return _plain(values[name][: int(values[counted])], field)
        return _plain(values[name], field)

    def _objects(self, values: Mapping[str, np.ndarray], slots: np.ndarray) -> dict[str, Any]:
        """The objects in these slots: their fields, colours and vertices by slot."""
        found: dict[str, Any] = {"slot": slots.tolist()}
        for name in self.objects:
            found[name] = _plain(values[name][slots], self.manifest.fields[name], len(slots))
        if "objects/color" in values:
            found["color"] = values["objects/color"][slots].tolist()
        if "objects/vertices" in values and "objects/vertex_count" in values:
            counts, vertices = _codes(values["objects/vertex_count"][slots]), values["objects/vertices"][slots]
            found["vertices"] = [
                np.round(np.nan_to_num(own[:count].astype(np.float64)), 4).tolist()
                for own, count in zip(vertices, counts, strict=True)
            ]
        if "objects/shape" in values:
            codes = _codes(values["objects/shape"][slots])
            found["shape"] = [SHAPES[code] if code < len(SHAPES) else "" for code in codes]
        return found


def energies(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Energies and momenta [T, ...] of a video by field: the stored ones or, without, those of its states.

    Those of its states are the kinetic, rotational and potential energy, without springs, and the momentum.
    """
    names = [name for name in values if name.startswith(("energy/", "momentum/"))]
    stored = {name: values[name].astype(np.float64) for name in names if name in DRAWN}
    needed = "objects/present", "objects/kind", "objects/mass", "states/position", "states/velocity", "world/gravity"
    if stored or any(name not in values for name in needed):
        return stored
    moves = values["objects/present"] & (values["objects/kind"] == DYNAMIC) & np.isfinite(values["objects/mass"])
    mass = values["objects/mass"][moves].astype(np.float64)
    position, velocity = (values[f"states/{name}"][:, moves].astype(np.float64) for name in ("position", "velocity"))
    gravity = values["world/gravity"].astype(np.float64)
    with np.errstate(all="ignore"):
        found = {
            "energy/kinetic": (mass * (velocity**2).sum(-1)).sum(-1) / 2,
            "energy/potential": -(mass * (position * gravity).sum(-1)).sum(-1),
            "momentum/linear": (mass[:, None] * velocity).sum(1),
        }
        if "objects/moment" in values and "states/angular_velocity" in values:
            moment = values["objects/moment"][moves].astype(np.float64)
            spin = values["states/angular_velocity"][:, moves].astype(np.float64)
            turns = np.isfinite(moment)
            found["energy/rotational"] = (moment[turns] * spin[:, turns] ** 2).sum(-1) / 2
    return found


def _occluders(values: Mapping[str, np.ndarray]) -> list[list[float]]:
    """Occluders, back to front: x0 y0 x1 y1 in px, red, green, blue, and the depth behind which objects are hidden."""
    if any(f"occluders/{name}" not in values for name in ("box", "color", "depth")):
        return []
    boxes = np.nan_to_num(values["occluders/box"].astype(np.float64))
    depths = values["occluders/depth"].astype(np.float64)
    rows = np.concatenate([boxes, values["occluders/color"], depths[:, None]], axis=1)
    return rows[(boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])].tolist()


def _is_drawn(name: str, field: Field | None, axes: str) -> bool:
    """Whether a dataset has this field, as gen2d stores it."""
    if field is None or field.axes != axes or field.is_text:
        return False
    if name in ("frames", "masks/instance", "surface/shadow", "objects/color", "occluders/color"):
        return field.dtype == "uint8"
    if name == "surface/normal":
        return field.dtype == "int8"
    if name in ("flow/forward", "surface/height"):
        return field.dtype in ("float16", "float32")
    if name.removeprefix("contacts/") in CONTACT_CODES or name == "occluders/depth":
        return np.issubdtype(field.dtype, np.integer)
    return field.dtype != "bool" or name == "objects/present"


def is_value(name: str, field: Field, manifest: Manifest) -> bool:
    """Whether the value of a field is shown in tables: it has neither frames nor slots, and few numbers."""
    if name in DRAWN and name != "world/gravity":
        return False
    if not field.per_video or field.unit == "JSON" or {*field.axes.split()} & {*"TKHWCJVO"}:
        return False
    return int(np.prod(field.shape(manifest.sizes), dtype=np.float64)) <= MAX_VALUES


def _plain(values: np.ndarray, field: Field, most: int = MAX_VALUES) -> Any:
    """A field's value as in JSON: numbers with five digits, text, or a list of these; not finite ones as text."""
    if values.ndim:
        return [_plain(value, field) for value in values[:most]]
    value = values.item()
    if field.is_text:
        return value.rstrip(b"\0").decode("utf-8", "replace")[:MAX_TEXT]
    if isinstance(value, float):
        return float(f"{value:.5g}") if np.isfinite(value) else str(value)
    return value


def _false_colors() -> np.ndarray:
    """Colours of ids [256, 4], uint8: no object is transparent."""
    opaque = np.where(np.arange(256) > 0, 255, 0)
    return np.concatenate([colors(256), opaque[:, None].astype(np.uint8)], axis=1)


def flow_colors(flow: np.ndarray) -> np.ndarray:
    """Colours [T, H, W, 4], uint8, of flow [T, H, W, 2] in px: the direction as hue in steps of 10 degrees, the speed
    as opacity in eighths of the largest one."""
    finite = np.nan_to_num(flow.astype(np.float32), posinf=0, neginf=0)
    speed = np.hypot(finite[..., 0], finite[..., 1])
    level = np.rint(8 * speed / max(float(speed.max()), 1e-6)).astype(np.uint8)
    rgba = np.concatenate([rgb_of(directions(finite), 1.0), (31 * level)[..., None]], -1)
    return np.where(level[..., None] > 0, rgba, 0).astype(np.uint8)


def relative_grey(values: np.ndarray) -> np.ndarray:
    """Values [T, H, W] from 0 on, such as heights, as grey levels [T, H, W, 3], uint8: the largest one is white."""
    finite = np.nan_to_num(values.astype(np.float32), posinf=0, neginf=0)
    return grey_levels(255 * (finite / max(float(finite.max(initial=0)), 1e-6)))


def _sprite(content: bytes, frames: np.ndarray) -> dict[str, Any]:
    """A sprite sheet with the size of a frame in it."""
    height, width = frames.shape[1:3]
    rows = sprite_rows(len(frames), height)
    return {"content": base64.b64encode(content).decode(), "height": height, "width": width, "rows": rows}


# Pictures over the frames: their field, and their colours [T, H, W, 3 or 4].
LAYERS: Mapping[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "masks": ("masks/instance", lambda values: _false_colors()[values]),
    "flow": ("flow/forward", flow_colors),
    "depth": ("surface/height", relative_grey),
    "normals": ("surface/normal", lambda values: normals_overlay({"surface/normal": values})),
    "shadow": ("surface/shadow", relative_grey),
}


def _codes(values: np.ndarray) -> list[int]:
    """Whole numbers from 0 to 255, whatever a stranger's dataset stores as codes."""
    return np.clip(np.nan_to_num(values), 0, 255).astype(int).tolist()


def _contacts(values: Mapping[str, np.ndarray], slots: np.ndarray, frames: int, most: int) -> list[list[float]]:
    """The strongest beginnings of contacts, by time: frame, slots a and b, x and y in m, impulse in N s."""
    if any(f"contacts/{name}" not in values for name in CONTACT_CODES):
        return []
    begins = np.isin(values["contacts/kind"], (IMPACT, BEGIN)) & (values["contacts/frame"] < frames)
    begins &= np.isin(values["contacts/a"], slots) | np.isin(values["contacts/b"], slots)
    rows = np.flatnonzero(begins)
    impulse = np.abs(np.nan_to_num(values["contacts/normal_impulse"][rows].astype(np.float64)))
    strongest = np.argsort(-impulse, kind="stable")[:most]
    return [
        [int(values[f"contacts/{name}"][rows[place]]) for name in ("frame", "a", "b")]
        + [float(f"{x:.4g}") for x in (*np.nan_to_num(values["contacts/point"][rows[place]]), impulse[place])]
        for place in np.sort(strongest)
    ]
