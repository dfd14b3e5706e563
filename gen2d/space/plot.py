"""Anti-aliased plots of a space for people: one instant, all frames in one image, or a film.

They show the physics rather than a dataset's look: bodies with marks that turn with them, joints as thin lines, and
contacts as red arrows along their normals.
"""

from pathlib import Path
from typing import Any

import numpy as np

from gen2d.core.enums import DYNAMIC
from gen2d.core.errors import ConfigError
from gen2d.core.palettes import Color
from gen2d.core.progress import waiting
from gen2d.media import films
from gen2d.media.drawing import CORNERS, Canvas
from gen2d.media.images import animate, write
from gen2d.space.bodies import Body, Drawable, Film

RED, DARK = (220, 30, 30), (60, 60, 60)
MARGIN = 0.05  # of the longer side of the default view, on each side
FORMATS = (".png", ".webp", ".mp4")
ViewBounds = tuple[float, float, float, float]


class PlotCanvas:
    """An image of a part of the world, `view`, with `size` px on its longer side."""

    def __init__(self, view: ViewBounds, size: int) -> None:
        left, bottom, right, top = view
        if not (right > left and top > bottom):
            raise ConfigError(f"view is {view}, but must be left, bottom, right, top, each side longer than 0 m")
        self.left, self.top, self.scale = left, top, size / max(right - left, top - bottom)
        # Even sizes, which video codecs need.
        self.height, self.width = (max(2, round(side * self.scale / 2) * 2) for side in (top - bottom, right - left))
        self.thickness = max(1.0, size / 250)  # px
        self._canvas = Canvas(self.height, self.width)

    @property
    def image(self) -> np.ndarray:
        """The image [H, W, 3], uint8."""
        return self._canvas.image

    def to_pixels(self, points: Any) -> np.ndarray:
        """World points [..., 2] in px from the image's corner, y down."""
        return (np.asarray(points) - (self.left, self.top)) * (self.scale, -self.scale)

    def disc(self, center: Any, radius: float, color: Color, filled: bool) -> None:
        """Draw a disc or its outline."""
        if filled:
            self._canvas.disc(self.to_pixels(center), radius * self.scale, color)
        else:
            turn = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
            self.outline(center + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1), color, False)

    def outline(self, points: Any, color: Color, filled: bool) -> None:
        """Draw a convex polygon or its outline."""
        if filled:
            self._canvas.polygon(self.to_pixels(points), color)
        else:
            self._canvas.outline(self.to_pixels(points), self.thickness, color)

    def line(self, a: Any, b: Any, color: Color, thickness: float | None = None) -> None:
        """Draw a line between two points."""
        self._canvas.line(self.to_pixels(a), self.to_pixels(b), thickness or self.thickness, color)

    def arrow(self, start: Any, along: np.ndarray) -> None:
        """Draw a red arrow of a fixed length in pixels from a point along a unit vector."""
        length = 0.07 * max(self.height, self.width) / self.scale
        end, side = start + length * along, 0.15 * length * np.array([-along[1], along[0]])
        neck = start + 0.6 * length * along
        self.line(start, neck, RED, self.thickness + 1)
        self.outline([end, neck + side, neck - side], RED, filled=True)


@waiting("Drawing a space")
def picture(
    of: Drawable, frame: int = 0, *, view: ViewBounds | None = None, size: int = 400, contacts: bool = True
) -> np.ndarray:
    """Image of one frame, uint8 [H, W, 3], `size` px on its longer side.

    `view` is the visible part of the world, (left, bottom, right, top) in m; by default everything that the bodies ever
    cover, with a margin. Raises ConfigError if there is no such frame or the view is empty.
    """
    if not -len(of.position) <= frame < len(of.position):
        raise ConfigError(f"frame is {frame}, but must be from 0 to {len(of.position) - 1}")
    frame %= len(of.position)
    canvas = PlotCanvas(view or _default_view(of), size)
    for body, position, angle in sorted(
        zip(of.bodies, of.position[frame], of.angle[frame], strict=True), key=lambda b: b[0].kind == DYNAMIC
    ):
        _draw_body(canvas, body, position, angle, filled=True)
    _draw_joints(canvas, of, frame)
    if contacts:
        _draw_contacts(canvas, of, frame)
    return canvas.image


@waiting("Drawing a space")
def overlay(of: Drawable, *, view: ViewBounds | None = None, size: int = 400, contacts: bool = False) -> np.ndarray:
    """Image of all frames over each other, uint8 [H, W, 3], with moving bodies as outlines; options as in `picture`."""
    canvas = PlotCanvas(view or _default_view(of), size)
    for i, body in enumerate(of.bodies):
        moves = bool(np.ptp(of.position[:, i], axis=0).any() or np.ptp(of.angle[:, i]))
        for frame in range(len(of.position) if moves else 1):
            _draw_body(canvas, body, of.position[frame, i], of.angle[frame, i], filled=body.kind != DYNAMIC)
    for frame in range(len(of.position) if contacts else 0):
        _draw_contacts(canvas, of, frame)
    return canvas.image


@waiting("Drawing a space")
def save(of: Film, path: str | Path, **options: Any) -> Path:
    """Write an image of all frames over each other (.png) or a film (.webp, which loops, or .mp4); return the path.

    Options are those of `overlay` for images, and of `picture` for films. Raises ConfigError for another suffix,
    UserError for .mp4 without PyAV, and OSError if the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ConfigError(f"{path}: ends in {path.suffix or 'nothing'}, but must end in one of {', '.join(FORMATS)}")
    if path.suffix == ".png":
        write(path, overlay(of, **options))
        return path
    view = options.pop("view", None) or _default_view(of)
    film = np.stack([picture(of, frame, view=view, **options) for frame in range(len(of.position))])
    if path.suffix == ".webp":
        animate(path, film[None], of.fps)
    else:
        films.CODECS["h264"].write(path, film, of.fps)
    return path


def _to_world(points: Any, position: np.ndarray, angle: float) -> np.ndarray:
    """Points [V, 2] of a body's frame in world coordinates."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[cos, sin], [-sin, cos]]) + position


def _draw_body(canvas: PlotCanvas, body: Body, position: np.ndarray, angle: float, filled: bool) -> None:
    if body.shape == "polygon":
        corners = _to_world(body.vertices, position, angle)
        canvas.outline(corners, body.color, filled)
        if filled and body.kind == DYNAMIC:
            canvas.outline(corners, DARK, False)
    elif body.shape == "circle":
        canvas.disc(position, body.radius, body.color, filled)
        if filled and body.kind == DYNAMIC:
            canvas.disc(position, body.radius, DARK, False)
            canvas.line(position, _to_world([(body.radius, 0)], position, angle)[0], DARK)
    elif body.radius * canvas.scale < canvas.thickness:
        a, b = _to_world([(-body.half_length, 0), (body.half_length, 0)], position, angle)
        canvas.line(a, b, body.color, canvas.thickness + 1)
    else:
        rim = _to_world(_stadium(body), position, angle)
        canvas.outline(rim, body.color, filled)
        if filled and body.kind == DYNAMIC:
            canvas.outline(rim, DARK, False)


def _stadium(body: Body) -> np.ndarray:
    turn = np.linspace(-np.pi / 2, np.pi / 2, 17)
    cap = np.stack([body.half_length + body.radius * np.cos(turn), body.radius * np.sin(turn)], axis=1)
    return np.concatenate([cap, -cap])


def _draw_joints(canvas: PlotCanvas, of: Drawable, frame: int) -> None:
    for joint in of.joints:
        ends = [
            anchor if i < 0 else _to_world(anchor, of.position[frame, i], of.angle[frame, i])
            for i, anchor in ((joint.a, joint.anchor_a), (joint.b, joint.anchor_b))
        ]
        canvas.line(ends[0], ends[1], DARK)
        for end in ends:
            canvas.disc(end, 1.5 * canvas.thickness / canvas.scale, DARK, True)


def _draw_contacts(canvas: PlotCanvas, of: Drawable, frame: int) -> None:
    contacts = of.contacts
    if contacts is None:
        return
    points, normals = np.asarray(contacts.point), np.asarray(contacts.normal)
    current = (np.asarray(contacts.frame) == frame) & normals.any(axis=1)  # no normal: ended before the frame
    for point, normal in zip(points[current], normals[current], strict=True):
        canvas.arrow(point, normal)


def _default_view(of: Drawable) -> ViewBounds:
    """Rectangle around everything that the bodies and joints ever cover, with a margin."""
    low, high = [], []
    for i, body in enumerate(of.bodies):
        if body.shape == "polygon":
            corners = body.vertices
        else:
            corners = np.array([(-body.half_length, 0.0), (body.half_length, 0.0)])
        points = np.stack([_to_world(corners, p, a) for p, a in zip(of.position[:, i], of.angle[:, i], strict=True)])
        low.append(points.min((0, 1)) - body.radius)
        high.append(points.max((0, 1)) + body.radius)
    anchors = [anchor for j in of.joints for i, anchor in ((j.a, j.anchor_a), (j.b, j.anchor_b)) if i < 0]
    (left, bottom), (right, top) = np.min([*low, *anchors], axis=0), np.max([*high, *anchors], axis=0)
    margin = MARGIN * max(right - left, top - bottom)
    return float(left - margin), float(bottom - margin), float(right + margin), float(top + margin)
