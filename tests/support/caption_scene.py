"""What is there in a video and what phrases mean, from its stored fields: the first half of `caption_reader`."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

EPSILON = 1e-6
COUNTS = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
ORDINALS = ["", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth"]
EXTREMES = {"leftmost": "left", "rightmost": "right", "highest": "top", "lowest": "bottom"}
PLACES = {"on the left": "left", "on the right": "right", "at the top": "top", "at the bottom": "bottom"}
TURNS = ["right", "up right", "up", "up left", "left", "down left", "down", "down right"]
MATERIALS = {"rubber": "rubber", "wood": "wooden", "metal": "metal", "paper": "paper"}  # adjective of each
VIEW_SIDES = ["left", "right", "top", "bottom"]


def lab(rgb: Any) -> np.ndarray:
    """CIELAB of an sRGB colour, D65."""
    u = np.asarray(rgb, np.float64) / 255
    u = np.where(u > 0.04045, ((u + 0.055) / 1.055) ** 2.4, u / 12.92)
    m = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]
    )
    xyz = (u @ m.T) / m.sum(1)  # white is 1
    f = np.where(xyz > 216 / 24389, np.cbrt(xyz), (24389 / 27 * xyz + 16) / 116)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1)


def count_of(word: str) -> int:
    """Number of a word such as 'a', 'seven' or '15'."""
    return 1 if word in ("a", "an") else COUNTS.index(word) if word in COUNTS else int(word)


def singular(word: str) -> str:
    return "shelf" if word == "shelves" else word.removesuffix("s")


class SceneReader:
    """What the stored fields of one video say; `video` has fps, height, width; `colors` are the words of the list."""

    def __init__(self, fields: Mapping[str, np.ndarray], video: Any, colors: Mapping[str, Any]) -> None:
        self.f = {name: np.asarray(v, np.float64) if v.dtype.kind == "f" else v for name, v in fields.items()}
        self.video, self.words = video, colors
        self.lab_of_words = lab(np.array(list(colors.values())))
        self.position, self.velocity = self.f["states/position"], self.f["states/velocity"]
        self.angle, self.spin = self.f["states/angle"], self.f["states/angular_velocity"]
        self.gravity, self.frames = self.f["world/gravity"], len(self.position)
        self.present = [int(s) for s in np.flatnonzero(self.f["objects/present"])]
        self.kind, self.shape = self.f["objects/kind"], self.f["objects/shape"]
        self.moving = [s for s in self.present if self.kind[s] != 1]
        self.fixed = [s for s in self.present if self.kind[s] == 1]
        names = ("kind", "frame", "time", "a", "b", "approach_speed", "separation_speed")
        columns = [self.f[f"contacts/{name}"].tolist() for name in names]
        self.rows = [row for row in zip(*columns, range(len(columns[0])), strict=True) if row[0]]
        self.missed = int(self.f["contacts/count"]) > len(self.f["contacts/kind"])
        self.group: dict[int, set[int]] = {}
        for a, b in zip(self.f.get("joints/a", ()), self.f.get("joints/b", ()), strict=True):
            if a in self.present and b in self.present:
                union = self.group.get(int(a), {int(a)}) | self.group.get(int(b), {int(b)})
                self.group.update(dict.fromkeys(union, union))
        self.outline = {s: self._outline(s) for s in self.present}
        self.reach = {s: self._reach(s) for s in self.present}
        self.screens = [s for s in self.fixed if self._is_screen(s)]
        self.noun = {s: self._noun(s) for s in self.present}
        self.name = {**self.noun, **self._wall_names()}
        self.color = {s: self._color(s) for s in self.moving}
        self.near_words = {s: self._near_words(s) for s in self.moving}
        self.material = {s: self._material(s) for s in self.moving}
        self.size = {s: self._size(s) for s in self.moving}
        self.pixels = self._pixels(0)
        self.hits = self._hits()
        self.ambiguous: list[str] = []  # phrases that say themselves that they fit several objects

    # ---- What is there

    def _outline(self, s: int) -> np.ndarray:
        if self.shape[s] == 3:
            return self.f["objects/vertices"][s, : int(self.f["objects/vertex_count"][s])]
        half = self.f["objects/half_length"][s]
        return np.array([[-half, 0.0], [half, 0.0]])

    def _reach(self, s: int) -> float:
        return float(np.hypot(*self.outline[s].T).max() + self.f["objects/radius"][s])

    def _corners(self, s: int, frame: int) -> np.ndarray:
        c, n = np.cos(self.angle[frame, s]), np.sin(self.angle[frame, s])
        x, y = self.outline[s].T
        return np.stack([c * x - n * y, n * x + c * y], -1) + self.position[frame, s]

    def inside(self, s: int, polygon: int) -> np.ndarray:
        """Depth of a centre in a convex polygon at each frame, m."""
        p = self._corners(polygon, 0)
        q = np.roll(p, -1, axis=0)
        cross = (q[:, 0] - p[:, 0]) * (self.position[:, s, None, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (
            self.position[:, s, None, 0] - p[:, 0]
        )
        return (cross / np.hypot(*(q - p).T)).min(-1)

    def _is_screen(self, s: int) -> bool:
        if self.shape[s] != 3 or s in self.group or any(s in row[3:5] and row[0] != 4 for row in self.rows):
            return False
        depth = self.f["objects/depth"]
        return any(depth[s] > depth[m] and (self.inside(m, s) > 0).any() for m in self.moving)

    def links(self, s: int) -> list[int]:
        capsules = [o for o in sorted(self.group.get(s, ())) if self.shape[o] == 2]
        return capsules if len(capsules) > 2 else []

    def pins(self, s: int) -> list[int]:
        return [o for o in sorted(self.group.get(s, ())) if self.kind[o] == 1]

    def _noun(self, s: int) -> str:
        corners, jointed = len(self.outline[s]), s in self.group
        if self.kind[s] == 1:
            if self.shape[s] == 3:
                return "screen" if s in self.screens else "stand" if jointed else "obstacle"
            return ("pin" if jointed else "peg", "wall", "bar")[self.shape[s]]
        if self.shape[s] == 3:
            w, h = self.outline[s].max(0) - self.outline[s].min(0)
            if jointed and corners == 4 and max(w, h) > 4 * min(w, h):
                return "plank"
            return {3: "triangle", 4: "block", 5: "pentagon", 6: "hexagon"}.get(corners, "polygon")
        if self.shape[s] == 2:
            return "capsule" if not jointed else "link" if self.links(s) else "rod"
        return "ball" if self.shape[s] == 0 else "rod"

    def _wall_names(self) -> dict[int, str]:
        walls = [s for s in self.fixed if self.shape[s] == 1]
        if not walls:
            return {}
        ends = np.array([self._corners(s, 0) for s in walls])
        (left, low), (right, high) = ends.reshape(-1, 2).min(0), ends.reshape(-1, 2).max(0)
        names = {}
        for s, (p, q) in zip(walls, ends, strict=True):
            w, h = abs(q - p)
            x, y = (p + q) / 2
            if h <= w / 10:
                near = (y - low <= (high - low) / 10, high - y <= (high - low) / 10)
                names[s] = "floor" if near[0] else "ceiling" if near[1] else "shelf"
            elif w <= h / 10:
                near = (x - left <= (right - left) / 10, right - x <= (right - left) / 10)
                names[s] = "left wall" if near[0] else "right wall" if near[1] else "divider"
            else:
                names[s] = "slope"
        return names

    def _color(self, s: int) -> str:
        if "objects/color_name" in self.f and (name := bytes(self.f["objects/color_name"][s]).decode()):
            return name
        away = np.linalg.norm(self.lab_of_words - lab(self.f["objects/color"][s]), axis=-1)
        best = int(away.argmin())
        chroma = np.hypot(*self.lab_of_words[best, 1:])
        return list(self.words)[best] if away[best] <= 10 + 0.11 * chroma else ""

    def _near_words(self, s: int) -> set[str]:
        """Colour words as near as the nearest, but for rounding; the stored name alone where there is one."""
        if "objects/color_name" in self.f and bytes(self.f["objects/color_name"][s]):
            return {self.color[s]}
        away = np.linalg.norm(self.lab_of_words - lab(self.f["objects/color"][s]), axis=-1)
        chroma = np.hypot(*self.lab_of_words[:, 1:].T)
        near = (away <= away.min() + EPSILON) & (away <= 10 + EPSILON + 0.11 * chroma)
        return {word for word, is_near in zip(self.words, near, strict=True) if is_near} | {self.color[s]}

    def _material(self, s: int) -> str:
        name = bytes(self.f["objects/material_name"][s]).decode() if "objects/material_name" in self.f else ""
        return MATERIALS.get(name, "")

    def _size(self, s: int) -> str:
        sizes = [self.reach[o] for o in self.moving if self.noun[o] == self.noun[s]]
        if max(sizes) < 1.5 * min(sizes):
            return ""
        small, large = self.reach[s] <= 1.2 * min(sizes), self.reach[s] >= max(sizes) / 1.2
        return "small" if small else "large" if large else ""

    def _pixels(self, frame: int) -> np.ndarray:
        scale, turn = self.f["camera/scale"][frame], self.f["camera/angle"][frame]
        d = self.position[frame] - self.f["camera/center"][frame]
        z = (d[:, 0] + 1j * d[:, 1]) * np.exp(-1j * turn) * scale
        return np.stack([self.video.width / 2 + z.real, self.video.height / 2 - z.imag], -1)

    def _hits(self) -> list[tuple[float, int, int, float, float]]:
        last: dict[tuple[int, int], tuple] = {}
        hits = []
        for kind, frame, time, a, b, approach, separation, _ in self.rows:
            before = last.get((a, b))
            held = (
                before
                and before[1] >= frame - 1
                and (before[0] in (2, 3) or (before[0] == 1 and time - before[2] < 0.1))
            )
            if kind == 1 and not held:
                hits.append((time, a, b, approach, separation))
            last[a, b] = (kind, frame, time)
        return hits

    # ---- Phrases

    def resolve(self, text: str) -> list[int]:
        """Slots of the objects that a phrase, without 'the', fits."""
        if text == "chain":
            return sorted({self.links(s)[-1] for s in self.moving if self.noun[s] == "link"})
        words, side = text, ""
        for place, of in PLACES.items():
            if words.endswith(f" {place}"):
                words, side = words.removesuffix(f" {place}"), of
        rank = None
        if found := re.fullmatch(r"(.*) from the (left|right|top|bottom)", words):
            ordinal, _, words = found[1].partition(" ")
            rank = ORDINALS.index(ordinal), found[2]
        elif (first := words.partition(" "))[0] in EXTREMES and first[2]:
            words, rank = first[2], (0, EXTREMES[first[0]])
        pool = [s for s in self.moving if self.fits(s, words)] or [s for s in self.fixed if self.name[s] == words]
        if side:
            return [s for s in pool if self.on_side(s, side, pool)]
        if rank is None:
            return pool
        axis, forward = VIEW_SIDES.index(rank[1]) // 2, rank[1] in ("left", "top")
        order = sorted(pool, key=lambda s: self.pixels[s, axis] * (1 if forward else -1))
        return order[rank[0] : rank[0] + 1]

    def fits(self, s: int, words: str) -> bool:
        """Whether a moving object is as these words say: size, colour, material and noun, of which but the last may be
        missing."""
        size, _, rest = words.partition(" ")
        size, rest = (size, rest) if size in ("small", "large") else ("", words)
        before, _, noun = rest.rpartition(" ")
        color, _, material = before.rpartition(" ")
        color, material = (color, material) if material in MATERIALS.values() else (before, "")
        alike = size in ("", self.size[s]) and material in ("", self.material[s])
        return noun == self.noun[s] and alike and (not color or color in self.near_words[s])

    def on_side(self, s: int, side: str, pool: Sequence[int]) -> bool:
        axis = VIEW_SIDES.index(side) // 2
        x = self.pixels[:, axis] / (self.video.width, self.video.height)[axis]
        x = x if side in ("left", "top") else 1 - x
        return x[s] <= 1 / 3 + EPSILON and all(x[o] >= max(1 / 3, x[s] + 0.08) - EPSILON for o in pool if o != s)

    def one(self, text: str) -> int:
        """Slot of 'the ...' (ValueError unless it fits one object alone), or any of 'one of three ...'."""
        if found := re.fullmatch(r"one of (\w+) (.*)", text):
            words = " ".join([*found[2].split(" ")[:-1], singular(found[2].split(" ")[-1])])
            slots = self.resolve(words)
            self.ambiguous.append(text)
            if len(slots) > count_of(found[1]) or not slots:
                raise ValueError(f"{text!r}, but there are {len(slots)}")
            return -1 if slots[0] in self.moving else -2
        slots = self.resolve(text.removeprefix("the "))
        if len(slots) != 1:
            raise ValueError(f"{text!r} fits {len(slots)} objects")
        return slots[0]

    def matching(self, text: str) -> list[int]:
        """Slots that a phrase may mean: one, or several for 'one of'."""
        slot = self.one(text)
        if slot >= 0:
            return [slot]
        words = re.sub(r"one of \w+ ", "", text).split(" ")
        return self.resolve(" ".join([*words[:-1], singular(words[-1])]))
