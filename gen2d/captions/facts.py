"""A video as its texts see it: stored fields in float64, the picture of frame 0, contacts by object, and nouns."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np

from gen2d.captions.events import BOX_SIDES, Hit, hits, moving_slots, wall_names
from gen2d.core.enums import CAPSULE, CIRCLE, END, NO_CONTACT, POLYGON, STATIC

CLASSES = (  # nouns of all objects; class names of annotations
    "ball", "block", "triangle", "pentagon", "hexagon", "polygon", "capsule", "rod", "link", "plank",
    "peg", "pin", "wall", "bar", "obstacle", "stand", "screen",
)  # fmt: skip
CORNERS = {3: "triangle", 4: "block", 5: "pentagon", 6: "hexagon"}
CHAIN_LINKS = 3  # joined capsules are the links of a chain if they are this many, and rods otherwise
PLANK = 4.0  # a joined block that is longer than this, relative to its height, is a plank


@dataclasses.dataclass(frozen=True, eq=False)
class VideoFacts:
    """Stored fields of one video, and what follows from them for its objects.

    `video` has fps, and height and width of the frames in px.
    """

    columns: Mapping[str, np.ndarray]
    video: Any

    @functools.cached_property
    def moving(self) -> list[int]:
        """Slots of the objects that are not static."""
        return [int(slot) for slot in moving_slots(self.columns)]

    @functools.cached_property
    def position(self) -> np.ndarray:
        """Positions [T, K, 2], m."""
        return self.columns["states/position"].astype(float)

    @functools.cached_property
    def velocity(self) -> np.ndarray:
        """Velocities [T, K, 2], m/s."""
        return self.columns["states/velocity"].astype(float)

    @functools.cached_property
    def angle(self) -> np.ndarray:
        """Angles [T, K], rad."""
        return self.columns["states/angle"].astype(float)

    @functools.cached_property
    def spin(self) -> np.ndarray:
        """Angular velocities [T, K], rad/s."""
        return self.columns["states/angular_velocity"].astype(float)

    @functools.cached_property
    def gravity(self) -> np.ndarray:
        """Acceleration of free fall [2], m/s^2."""
        return self.columns["world/gravity"].astype(float)

    @functools.cached_property
    def reach(self) -> np.ndarray:
        """Largest distance from each object's centre to its outline [K], m."""
        core = self.columns["objects/half_length"].astype(float)
        if "objects/vertices" in self.columns:
            corners = np.linalg.norm(self.columns["objects/vertices"].astype(float), axis=-1).max(-1)
            core = np.where(self.columns["objects/shape"] == POLYGON, corners, core)
        return core + self.columns["objects/radius"].astype(float)

    @functools.cached_property
    def point_speed(self) -> np.ndarray:
        """Largest speed of any point of each object [T, K], m/s, at most."""
        return np.linalg.norm(self.velocity, axis=-1) + np.abs(self.spin) * self.reach

    def pixels(self, frame: int) -> np.ndarray:
        """Columns and rows of the centres in a frame [K, 2], px."""
        scale, turn = (float(self.columns[f"camera/{name}"][frame]) for name in ("scale", "angle"))
        x, y = (self.position[frame] - self.columns["camera/center"][frame].astype(float)).T
        right, up = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
        return np.stack([self.video.width / 2 + scale * right, self.video.height / 2 - scale * up], -1)

    @functools.cached_property
    def start(self) -> np.ndarray:
        """Columns and rows of the centres in frame 0 [K, 2], px."""
        return self.pixels(0)

    @functools.cached_property
    def seen_at_start(self) -> frozenset[int]:
        """Objects whose centres are in frame 0 and not behind a screen."""
        inside = np.all((self.start >= 0) & (self.start < [self.video.width, self.video.height]), axis=-1)
        slots = (slot for slot in self.nouns if inside[slot])
        return frozenset(s for s in slots if not any(self.depth_inside(s, screen)[0] > 0 for screen in self.screens))

    # ---- Contacts

    @functools.cached_property
    def missed(self) -> bool:
        """Whether there were more contacts than are stored."""
        return int(self.columns["contacts/count"]) > len(self.columns["contacts/kind"])

    @functools.cached_property
    def known_frames(self) -> int:
        """Number of frames whose contacts are all stored."""
        frames = len(self.position)
        return int(self.columns["contacts/frame"].max()) if self.missed else frames

    @functools.cached_property
    def hits(self) -> list[Hit]:
        """Impacts that begin a contact, by time."""
        return hits(self.columns)

    @functools.cached_property
    def touches(self) -> dict[int, dict[int, dict[int, int]]]:
        """Rows of contacts by object, frame and other object, without those that end a contact."""
        rows: dict[int, dict[int, dict[int, int]]] = {}
        if "contacts/kind" not in self.columns:
            return rows
        kinds, frames, a, b = (self.columns[f"contacts/{name}"].tolist() for name in ("kind", "frame", "a", "b"))
        for row, kind in enumerate(kinds):
            if kind in (NO_CONTACT, END):
                continue
            for one, other in ((a[row], b[row]), (b[row], a[row])):
                rows.setdefault(one, {}).setdefault(frames[row], {})[other] = row
        return rows

    # ---- Joints, screens, nouns

    @functools.cached_property
    def joints(self) -> list[tuple[int, int]]:
        """Slots of the two sides of each joint whose objects are present."""
        if "joints/a" not in self.columns:
            return []
        pairs = zip(self.columns["joints/a"].tolist(), self.columns["joints/b"].tolist(), strict=True)
        present = self.columns["objects/present"]
        return [(a, b) for a, b in pairs if present[a] and present[b]]

    @functools.cached_property
    def joined(self) -> dict[int, frozenset[int]]:
        """Objects that joints connect to each joined object, itself included."""
        groups: dict[int, frozenset[int]] = {}
        for a, b in self.joints:
            merged = groups.get(a, frozenset([a])) | groups.get(b, frozenset([b]))
            groups |= dict.fromkeys(merged, merged)
        return groups

    def chain_of(self, slot: int) -> list[int]:
        """Links of the chain that an object is joined to, in the order of their slots; empty if there is none."""
        capsules = [s for s in sorted(self.joined.get(slot, ())) if self.columns["objects/shape"][s] == CAPSULE]
        return capsules if len(capsules) >= CHAIN_LINKS else []

    def pins_of(self, slot: int) -> list[int]:
        """Static objects that an object is joined to, also through others."""
        return [s for s in sorted(self.joined.get(slot, ())) if self.columns["objects/kind"][s] == STATIC]

    @functools.cached_property
    def screens(self) -> list[int]:
        """Static polygons that nothing touches and that are in front of a moving object which overlaps them."""
        static = self.columns["objects/present"] & (self.columns["objects/kind"] == STATIC)
        polygons = np.flatnonzero(static & (self.columns["objects/shape"] == POLYGON)).tolist()
        depth = self.columns.get("objects/depth", np.zeros(len(static)))
        return [
            screen
            for screen in polygons
            if screen not in self.touches and screen not in self.joined
            if any(depth[screen] > depth[slot] and (self.depth_inside(slot, screen) > 0).any() for slot in self.moving)
        ]

    def depth_inside(self, slot: int, polygon: int) -> np.ndarray:
        """Distance of an object's centre from the nearest side of a static polygon [T], m; negative outside."""
        count = int(self.columns["objects/vertex_count"][polygon])
        local = self.columns["objects/vertices"][polygon, :count].astype(float)
        cos, sin = np.cos(self.angle[0, polygon]), np.sin(self.angle[0, polygon])
        corners = local @ np.array([[cos, sin], [-sin, cos]]) + self.position[0, polygon]
        along = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
        return ((self.position[:, slot, None] - corners) * inward).sum(-1).min(-1)

    @functools.cached_property
    def nouns(self) -> dict[int, str]:
        """Noun of each object that is present, by slot."""
        return {int(slot): self._noun(int(slot)) for slot in np.flatnonzero(self.columns["objects/present"])}

    def _noun(self, slot: int) -> str:
        shape, joined = int(self.columns["objects/shape"][slot]), slot in self.joined
        corners = int(self.columns["objects/vertex_count"][slot]) if shape == POLYGON else 0
        if self.columns["objects/kind"][slot] == STATIC:
            if shape == POLYGON:
                return "screen" if slot in self.screens else "stand" if joined else "obstacle"
            return ("pin" if joined else "peg", "wall", "bar")[shape]
        if shape == POLYGON:
            size = np.ptp(self.columns["objects/vertices"][slot, :corners].astype(float), axis=0)
            long = corners == 4 and size.max() > PLANK * size.min()
            return "plank" if joined and long else CORNERS.get(corners, "polygon")
        if shape == CAPSULE and joined:
            return "link" if self.chain_of(slot) else "rod"
        return "ball" if shape == CIRCLE else "capsule" if shape == CAPSULE else "rod"

    @functools.cached_property
    def walls(self) -> dict[int, str]:
        """Names of static segments, by slot."""
        return wall_names(self.columns)

    @functools.cached_property
    def boxed(self) -> bool:
        """Whether there are a floor, a ceiling and walls on both sides."""
        return set(BOX_SIDES) <= set(self.walls.values())
