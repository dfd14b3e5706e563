"""An independent reader of captions and questions: it parses the English and looks at the stored fields in float64.

It imports NumPy alone, and shares with gen2d only the list of colour words, which it is given. `Reader(...).problems`
lists the sentences that are false, not understood, or whose 'the ...' fits several objects.
"""

import re
from collections.abc import Callable, Iterator

import numpy as np
from caption_scene import COUNTS, EPSILON, TURNS, VIEW_SIDES, SceneReader, count_of, singular


class Reader(SceneReader):
    """What the stored fields of one video say; `video` has fps, height, width; `colors` are the words of the list."""

    # ---- What happens

    def touching(self, s: int, frame: int) -> dict[int, int]:
        return {
            (b if a == s else a): row
            for kind, f, _, a, b, *_, row in self.rows
            if f == frame and kind != 4 and s in (a, b)
        }

    def heading(self, vector: np.ndarray, frame: int, words: str) -> bool:
        """Whether a vector points where the words say, within an eighth of a turn."""
        key = words.replace("to the ", "").strip()
        if key not in TURNS:
            return False
        off = np.angle(
            np.exp(
                1j * (np.arctan2(vector[1], vector[0]) - self.f["camera/angle"][frame] - TURNS.index(key) * np.pi / 4)
            )
        )
        return bool(abs(off) <= np.pi / 8 + 1e-4)

    def rests_from(self, s: int) -> float | None:
        speed = np.hypot(*self.velocity[:, s].T) + abs(self.spin[:, s]) * self.reach[s]
        still = 0
        while still < self.frames and speed[-1 - still] < 0.02:
            still += 1
        enough = 0 < still < self.frames and (still - 1) >= 0.1 * self.video.fps - EPSILON
        return (self.frames - still) / self.video.fps if enough else None

    def topples_at(self, s: int) -> tuple[float, str] | None:
        turn = self.angle[:, s] - self.angle[0, s]
        stands = (
            np.hypot(*self.velocity[0, s]) < 0.02
            and np.hypot(*self.velocity[1, s]) < np.hypot(*self.gravity) / self.video.fps / 2
        )
        far = np.flatnonzero(abs(turn) >= np.pi / 4)
        if self.shape[s] != 3 or s in self.group or not stands or not len(far):
            return None
        return far[0] / self.video.fps, "right" if turn[far[0]] < 0 else "left"

    def stays(self, s: int) -> bool:
        moved = np.hypot(*(self.position[:, s] - self.position[0, s]).T).max()
        return bool(
            s not in self.group
            and self.gravity.any()
            and moved < 0.05 * self.reach[s]
            and abs(self.angle[:, s] - self.angle[0, s]).max() < 0.05
        )

    def beyond(self, s: int) -> np.ndarray:
        """How far an object is beyond the left, right, top and bottom of the view [T, 4], px; negative: it is seen."""
        found = np.empty((self.frames, 4))
        radius = self.f["objects/radius"][s]
        for t in range(self.frames):
            scale, turn = self.f["camera/scale"][t], self.f["camera/angle"][t]
            d = self._corners(s, t) - self.f["camera/center"][t]
            z = (d[:, 0] + 1j * d[:, 1]) * np.exp(-1j * turn) * scale
            x, y, r = self.video.width / 2 + z.real, self.video.height / 2 - z.imag, scale * radius
            found[t] = -(x.max() + r), x.min() - r - self.video.width, -(y.max() + r), y.min() - r - self.video.height
        return found

    def crossings(self, s: int, leaves: bool) -> Iterator[tuple[float, str]]:
        beyond = self.beyond(s)
        out = beyond.max(-1)
        for t in range(self.frames - 1):
            if (out[t] < 0) == leaves and (out[t + 1] >= 0) == leaves:
                side = VIEW_SIDES[int(beyond[t + 1 if leaves else t].argmax())]
                yield (t + out[t] / (out[t] - out[t + 1])) / self.video.fps, side

    def near(self, time: float, texts: str | None) -> bool:
        return texts is None or abs(time - float(texts)) <= 0.5 * 10.0 ** -len(texts.partition(".")[2]) + 1e-5

    # ---- Clauses: each checks one pattern for a subject, a time (None if it is not said), and the words of the pattern

    def clause(self, text: str, s: int) -> bool:
        time, change = None, ""
        if found := re.fullmatch(r"(.*?) (?:at|after) (\d+\.\d+) s(, speeding up|, slowing down)?", text):
            text, time, change = found[1], found[2], found[3] or ""
        elif found := re.fullmatch(r"(.*?)(, speeding up|, slowing down)", text):
            text, change = found[1], found[2]
        for pattern, check in CLAUSES:
            if words := re.fullmatch(pattern, text):
                return check(self, s, time, change, *words.groups())
        raise ValueError(f"not understood: {text!r}")

    def starts(self, s: int, time: str | None, change: str, pace: str | None, way: str, number: str) -> bool:
        v = self.velocity[0, s]
        speed = float(np.hypot(*v))
        share = speed / (self.video.width / self.f["camera/scale"][0])
        right_pace = {
            "slowly ": share < 0.1 + EPSILON,
            "quickly ": share > 0.5 - EPSILON,
            None: 0.1 - EPSILON <= share <= 0.5 + EPSILON,
        }[pace]
        return right_pace and self.heading(v, 0, way) and abs(float(number) - speed) <= 0.051 * speed

    def free(self, s: int, frame: int, last: int) -> bool:
        return not any(
            f in range(frame + 1, last + 1) and kind != 4 and s in (a, b) for kind, f, _, a, b, *_ in self.rows
        )

    def falls(self, s: int, time: str | None, change: str) -> bool:
        down = self.gravity / np.hypot(*self.gravity)
        height = -(self.position[:, s] @ down)
        known = max((r[1] for r in self.rows), default=0) if self.missed else self.frames
        frames = range(self.frames) if time is None else [round(float(time) * self.video.fps)]
        for frame in frames:
            last = frame
            if frame > 0 and self.free(s, frame - 1, frame) and height[frame - 1] > height[frame] + EPSILON:
                continue  # it began earlier
            while last + 1 < min(known, self.frames) and self.free(s, last, last + 1):
                last += 1
            if (np.diff(height[frame : last + 1]) < EPSILON).all() and height[frame] - height[last] >= 2 * self.reach[
                s
            ] - EPSILON:
                return True
        return False

    def peaks(self, s: int, time: str | None, change: str) -> bool:
        down = self.gravity / np.hypot(*self.gravity)
        height, across = -(self.position[:, s] @ down), self.position[:, s] @ np.array([-down[1], down[0]])
        frames = range(self.frames) if time is None else [round(float(time) * self.video.fps)]
        for top in frames:
            first = last = top
            while first > 0 and self.free(s, first - 1, first):
                first -= 1
            while last + 1 < self.frames and self.free(s, last, last + 1):
                last += 1
            window = slice(first, last + 1)
            high = height[top] >= height[window].max() - EPSILON
            if (
                high
                and height[top] - height[first] >= self.reach[s] - EPSILON
                and np.ptp(across[window]) >= 2 * self.reach[s] - EPSILON
            ):
                return True
        return False

    def runs(self, s: int, time: str | None, change: str, verb: str, way: str, surface: str) -> bool:
        other = self.matching(surface)
        frames = range(self.frames) if time is None else [round(float(time) * self.video.fps)]
        return any(self.runs_from(s, frame, verb, way, o, change) for frame in frames for o in other)

    def runs_from(self, s: int, first: int, verb: str, way: str, other: int, change: str) -> bool:
        last = first - 1
        if first > 0 and self.does_run(s, first - 1, verb, other):
            return False  # it began earlier
        while last + 1 < self.frames and self.does_run(s, last + 1, verb, other):
            last += 1
        moved = self.position[last, s] - self.position[first, s]
        if (last - first) / self.video.fps < 0.25 - EPSILON or np.hypot(*moved) < self.reach[s] - EPSILON:
            return False
        ratio = np.hypot(*self.velocity[last, s]) / np.hypot(*self.velocity[first, s])
        right = {
            ", speeding up": ratio >= 1.5 - EPSILON,
            ", slowing down": ratio <= 1 / 1.5 + EPSILON,
            "": 1 / 1.5 - EPSILON <= ratio <= 1.5 + EPSILON,
        }
        return bool(right[change] and self.heading(moved, first, way))

    def does_run(self, s: int, frame: int, verb: str, other: int) -> bool:
        rows = self.touching(s, frame)
        v, spin = self.velocity[frame, s], self.spin[frame, s]
        if [*rows] != [other] or np.hypot(*v) < 0.1 - EPSILON:
            return False
        if self.shape[s] != 0:
            return verb == "slide" and abs(spin) * self.reach[s] <= 0.2 * np.hypot(*v) + EPSILON
        normal = self.f["contacts/normal"][rows[other]] * (1 if self.f["contacts/a"][rows[other]] == s else -1)
        x, y = self.f["objects/radius"][s] * normal
        slip = np.hypot(v[0] - spin * y, v[1] + spin * x) / np.hypot(*v)
        return slip <= 0.1 + EPSILON if verb == "roll" else slip >= 0.5 - EPSILON

    def hit(self, s: int, time: str | None, change: str, text: str, bounces: bool) -> bool:
        others = self.matching(text)
        for when, a, b, approach, separation in self.hits:
            off = self.kind[b if a == s else a] == 1 and approach >= 0.2 and separation >= 0.3 * approach
            if s in (a, b) and (b if a == s else a) in others and self.near(when, time) and bool(off) == bounces:
                return True
        return False

    def topples(self, s: int, time: str | None, change: str, way: str) -> bool:
        found = self.topples_at(s)
        return found is not None and self.near(found[0], time) and found[1] == way

    def swings(self, s: int, time: str | None, change: str, back: str | None) -> bool:
        (pin,) = self.pins(s)
        z = self.position[:, s] - self.position[:, pin]
        bearing = np.unwrap(np.arctan2(z[:, 1], z[:, 0]))
        if np.ptp(bearing) < 0.3 - EPSILON:
            return False
        rise = max(bearing[j:].max() - bearing[j] for j in range(self.frames))
        drop = max(bearing[j] - bearing[j:].min() for j in range(self.frames))
        start = np.flatnonzero(abs(bearing - bearing[0]) >= 0.15)[0] / self.video.fps
        return (min(rise, drop) >= 0.3 - EPSILON) == (back is not None) and self.near(start, time)

    def tilts(self, s: int, time: str | None, change: str, way: str) -> bool:
        turn = self.angle[:, s] - self.angle[0, s]
        far = np.flatnonzero(abs(turn) >= 0.05)
        return (
            bool(len(far))
            and ("right" if turn[far[0]] < 0 else "left") == way
            and self.near(far[0] / self.video.fps, time)
        )

    def sags(self, s: int, time: str | None, change: str) -> bool:
        height = self.position[:, self.links(s)].mean(1) @ (-self.gravity / np.hypot(*self.gravity))
        low = int(height.argmin())
        return (
            len(self.pins(s)) == 2
            and height[0] - height[low] >= 0.2 - EPSILON
            and self.near(low / self.video.fps, time)
        )

    def behind(self, s: int, time: str | None, change: str, text: str, gone: bool) -> bool:
        screen = self.one(text)
        hidden = self.inside(s, screen) >= self.f["objects/radius"][s]
        in_front = self.f["objects/depth"][screen] > self.f["objects/depth"][s]
        for t in np.flatnonzero(hidden[1:] & ~hidden[:-1]) + 1:
            if in_front and bool(hidden[t:].all()) == gone and self.near(t / self.video.fps, time):
                return True
        return False

    def crosses(self, s: int, time: str | None, change: str, side: str, leaves: bool) -> bool:
        return any(side == where and self.near(when, time) for when, where in self.crossings(s, leaves))

    def rests(self, s: int, time: str | None, change: str) -> bool:
        found = self.rests_from(s)
        return found is not None and self.near(found, time)

    # ---- Whole captions

    def problems(self, text: str, complete: bool = False) -> list[str]:
        """Sentences of a caption that are false or not understood; a `complete` one counts the hits it leaves out."""
        found: list[str] = []
        self.mentioned = self.more = 0
        for sentence in re.split(r"(?<=\.) (?=[A-Z])", text):
            try:
                if not self.is_true(sentence.removesuffix(".")):
                    found.append(f"false: {sentence}")
            except (ValueError, KeyError) as error:
                found.append(f"{error}: {sentence}")
        if complete and not found and self.mentioned + self.more != len(self.hits):
            found.append(f"{self.mentioned} and {self.more} hits of {len(self.hits)}")
        return found

    def is_true(self, sentence: str) -> bool:
        if found := re.fullmatch(r"There (?:is|are) (at least )?(\d+) more hits?", sentence):
            self.more = int(found[2])
            return 0 < self.more < len(self.hits) + 1 and bool(found[1]) == self.missed
        if re.match(
            r"(There (is|are) )?(a|an|nothing|\d+|" + "|".join(COUNTS) + r") (?!of |least )", sentence, re.IGNORECASE
        ):
            return self.opening(sentence)
        verbs = "topple|fall|leave the view|come to rest|stay in place"
        first = r"(?:, the first (?:at|after) ([\d.]+) s)?"
        if found := re.fullmatch(rf"(?:(At) least )?(All|(\w+) of the) (\w+) (\w+) ({verbs}){first}", sentence):
            slots = [s for s in self.moving if self.noun[s] == singular(found[5])]
            times = {s: t for s in slots if (t := self.does(s, found[6])) is not None}
            count = len(slots) if found[2] == "All" else count_of(found[3].lower())
            certain = not self.missed or found[6] != "fall" or count == len(slots)
            right = len(times) == count and len(slots) == count_of(found[4]) and certain == (found[1] is None)
            return right and self.near(min(times.values()), found[7])
        sentence = sentence[0].lower() + sentence[1:]
        names = "|".join(v for v in VERBS)
        found = re.match(rf"((?:the|one of) .*?) ({names})", sentence)
        if not found:
            raise ValueError("no subject")
        slots = self.matching(found[1])
        clauses = re.split(r", (?:and )?then ", sentence[len(found[1]) + 1 :])
        self.mentioned += sum(bool(re.match(HITS, clause)) for clause in clauses)
        return any(all(self.clause(clause, s) for clause in clauses) for s in slots)

    def does(self, s: int, verb: str) -> float | None:
        """Time at which an object begins to do something for the first time; None if it does not."""
        if verb == "topple":
            found = self.topples_at(s)
            return found and found[0]
        if verb == "come to rest":
            return None if self.stays(s) else self.rests_from(s)
        if verb == "stay in place":
            return 0.0 if self.stays(s) else None
        if verb == "leave the view":
            return next((when for when, _ in self.crossings(s, True)), None)
        fps = self.video.fps
        return next((t / fps for t in range(self.frames) if self.falls(s, f"{t / fps!r}", "")), None)

    def opening(self, sentence: str) -> bool:
        pattern = (
            r"(?:There (?:is|are) )?(.*?)( in a box)?( with .*?)?( on a pin)?( under gravity(?: upwards| to the \w+)?)?"
        )
        found = re.fullmatch(pattern, sentence)
        assert found
        hung = {pin for s in self.moving if not self.links(s) for pin in self.pins(s)}
        if bool(found[4]) != any(self.noun[pin] == "pin" for pin in hung):
            return False
        sides = {"floor", "ceiling", "left wall", "right wall"}
        boxed = sides <= set(self.name.values())
        x, y = self.gravity
        side = f" to the {'right' if x > 0 else 'left'}" if abs(x) > abs(y) else "" if y < 0 else " upwards"
        pulled = f" under gravity{side}" if x or y else None
        extras = [
            self.name[s]
            for s in self.fixed
            if self.noun[s] != "pin" and not (boxed and self.name[s] in sides | {"wall"})
        ]
        stated = [item for part in (found[3] or " with ")[6:].split(" and ") for item in part.split(", ") if item]
        listed = {
            singular(i.partition(" ")[2]) if not i.startswith(("a ", "an ")) else i.partition(" ")[2]: count_of(
                i.partition(" ")[0]
            )
            for i in stated
        }
        things = re.sub(r" on a pin| between two pins", "", found[1])
        return (
            bool(found[2]) == boxed and found[5] == pulled and listed == {name: extras.count(name) for name in extras}
            and self.counts(things[0].lower() + things[1:])
        )  # fmt: skip

    def counts(self, text: str) -> bool:
        """Whether a list of objects names each of the moving ones once."""
        total = 0
        others = [s for s in self.moving if self.noun[s] != "link"]
        words_of = {s: self.full(s) if len(others) <= 4 else f"{self.color[s]} {self.noun[s]}".strip() for s in others}
        if len({*words_of.values()}) > 10:  # too many for a sentence
            words_of = {s: self.noun[s] for s in others}
        for item in (item for part in text.split(" and ") for item in part.split(", ")):
            if found := re.fullmatch(r"a chain of (\w+) links", item):
                total += count_of(found[1])
                continue
            number, _, words = item.partition(" ")
            words = words if number in ("a", "an") else singular(words)
            # The words are all that can be said: an object that has a colour word is not listed without it.
            if count_of(number) != sum(words == own for own in words_of.values()):
                return False
            total += count_of(number)
        return total == len(self.moving)

    def full(self, s: int) -> str:
        return " ".join(word for word in (self.size[s], self.color[s], self.material[s], self.noun[s]) if word)

    # ---- Questions

    def answer(self, question: str) -> str:
        """Answer of a question, from its words."""
        text, after = question.removesuffix("?"), -1.0
        if found := re.fullmatch(r"After ([\d.]+) s, (.*)", text):
            after, text = float(found[1]), found[2]
        text = text[0].lower() + text[1:]
        if found := re.fullmatch(r"how many (\w+) (are there|.*)", text):
            slots = [s for s in self.moving if self.noun[s] == singular(found[1])]
            return (
                f"{len(slots) if found[2] == 'are there' else sum(self.does(s, found[2]) is not None for s in slots)}"
            )
        if found := re.fullmatch(r"what colour is (the .*)", text):
            return self.color[self.one(found[1])]
        if found := re.fullmatch(r"what does (the .*) collide with first", text):
            s = self.one(found[1])
            _, a, b, *_ = next(hit for hit in self.hits if s in hit[1:3])
            return f"object {b if a == s else a}"
        if found := re.fullmatch(r"does (the .*) (topple|leave the view|come to rest|stay in place)", text):
            when = [t for t in [self.does(self.one(found[1]), found[2])] if t is not None]
            if found[2] == "leave the view":
                when = [t for t, _ in self.crossings(self.one(found[1]), True)]
            return "yes" if any(t > after for t in when) else "no"
        found = re.fullmatch(r"do (the .*) and (the .*) hit each other", text) or re.fullmatch(
            r"does (the .*) hit (the .*)", text
        )
        if not found:
            raise ValueError(f"not understood: {question}")
        pair = {self.one(found[1]), self.one(found[2])}
        return "yes" if any({a, b} == pair and t > after for t, a, b, *_ in self.hits) else "no"


VERBS = [
    "first moves", "starts", "begins", "reaches", "is at", "hits", "strikes", "runs into", "bounces off",
    "rebounds from", "topples", "tips", "swings", "is swinging", "tilts", "hangs", "sags", "passes behind",
    "moves behind", "disappears",
    "vanishes", "leaves", "exits", "enters", "comes", "stops", "stays", "moves (?:slowly |quickly )?(?:up|down|to the)",
]  # fmt: skip
HITS = r"(hits|strikes|runs into|bounces off|rebounds from) "
WAY = r"((?:up |down )?to the (?:left|right)|up|down)"
CLAUSES: list[tuple[str, Callable[..., bool]]] = [
    (rf"(?:first )?moves (slowly |quickly )?{WAY} at ([\d.e+]+) m/s", Reader.starts),
    (r"(?:starts|begins) to fall", Reader.falls),
    (r"reaches its highest point|is at its highest", Reader.peaks),
    (rf"(?:starts|begins) to (roll|slide) {WAY} on (.*)", Reader.runs),
    (r"(?:hits|strikes|runs into) (.*)", lambda r, s, t, c, x: r.hit(s, t, c, x, False)),
    (r"(?:bounces off|rebounds from) (.*)", lambda r, s, t, c, x: r.hit(s, t, c, x, True)),
    (r"(?:topples|tips over) to the (left|right)", Reader.topples),
    (r"(?:starts|begins) to swing( back and forth)?", Reader.swings),
    (r"(?:tilts|tips) to the (left|right)", Reader.tilts),
    (r"hangs lowest|sags to its lowest point", Reader.sags),
    (r"(?:passes|moves) behind (.*)", lambda r, s, t, c, x: r.behind(s, t, c, x, False)),
    (r"(?:disappears|vanishes) behind (.*)", lambda r, s, t, c, x: r.behind(s, t, c, x, True)),
    (r"(?:leaves|exits) the view at the (\w+)", lambda r, s, t, c, x: r.crosses(s, t, c, x, True)),
    (r"(?:enters the view|comes into view) from the (\w+)", lambda r, s, t, c, x: r.crosses(s, t, c, x, False)),
    (r"comes to rest|stops", Reader.rests),
    (r"stays in place|stays where it is", lambda r, s, t, c: r.stays(s)),
]
