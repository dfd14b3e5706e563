"""Render scene of a video, and the frame plan: image properties that are known before rendering."""

import dataclasses
import math
import operator
from typing import NamedTuple

import jax.numpy as jnp

from gen2d.core.enums import SHAPES, STATIC
from gen2d.records.axes import Array
from gen2d.records.layout import Layout, SlotGroup
from gen2d.renderers.camera import to_pixels
from gen2d.renderers.paint import Paint
from gen2d.renderers.primitives import BodyGeometry, Instants, PixelWindow
from gen2d.renderers.sensor import Sensor

LANES = 8  # px; tile widths are rounded up to multiples of this, whole SIMD vectors


class Occluders(NamedTuple):
    """Rectangles that are fixed in the image, back to front."""

    box: Array  # [O, 4] px: left, top, right, bottom
    color: Array  # [O, 3] sRGB
    rank: Array  # [O] number of slots of `FramePlan.groups` behind them, in drawing order


class RenderScene(NamedTuple):
    """Input of the rasterizer for one video; batches add leading axes."""

    bodies: BodyGeometry
    instants: Instants  # at the T frames
    exposed: Instants | None  # [T, S, ...] at the S instants of each exposure
    paint: Paint
    occluders: Occluders | None
    sensor: Sensor | None  # None: frames are not changed by lens and sensor
    seed: Array  # uint32, of noise and of the track points


@dataclasses.dataclass(frozen=True)
class FramePlan:
    """Static properties of the frames: size, scale, camera, and which outputs are wanted."""

    layout: Layout
    height: int  # px
    width: int
    scale: float  # px/m, upper bound
    grow: float = 0.0  # px, upper bound of what the look adds to an object's rim
    grown: tuple[str, ...] = SHAPES  # shapes to which the look adds it
    blur: float = 0.0  # px, upper bound of half the width of the soft edges of shadows
    still: bool = True  # whether the camera never moves
    linear: bool = False  # whether colours mix in linear light
    frames: bool = True  # whether frames are wanted
    owners: bool = False  # whether owners are wanted: the object that each pixel shows
    exposed: int = 0  # instants per exposure; 0: no motion blur

    @property
    def static_runs(self) -> list[tuple[SlotGroup, int]]:
        """Runs of the static layer, each with its first slot, back to front; empty if the camera moves."""
        return self._behind if self.still else []

    @property
    def _behind(self) -> list[tuple[SlotGroup, int]]:
        """Static runs behind all moving ones, as in `static_runs`."""
        spans = self.layout.back_to_front
        first = next((i for i, (run, _) in enumerate(spans) if run.kind != STATIC), len(spans))
        return list(spans[:first])

    @property
    def shaded_first(self) -> int:
        """Number of runs of `groups`, the first ones, whose shadows lie below all of them: static ones, whose shadows
        fall on the background alone. Each later slot has its shadow below itself, on everything behind it."""
        return len(self._behind) - len(self.static_runs)

    @property
    def groups(self) -> "list[TileGroup]":
        """Remaining runs, in consecutive groups that share a tile size."""
        groups: list[TileGroup] = []
        for run, first in self.layout.back_to_front[len(self.static_runs) :]:
            reach = self.largest(run)
            if 2 * reach + 2 >= max(self.height, self.width):  # a tile would be as large as the frame
                reach = math.inf
            if groups and groups[-1].reach == reach:
                groups[-1] = TileGroup((*groups[-1].runs, (run, first)), reach)
            else:
                groups.append(TileGroup(((run, first),), reach))
        return groups

    @property
    def moving(self) -> int:
        """Number of slots in `groups`."""
        return sum(len(group.slots) for group in self.groups)

    def largest(self, run: SlotGroup) -> float:
        """Upper bound of the distance from centre to rim (px) of a run's objects; infinite for static runs."""
        grow = self.grow if run.shape in self.grown else 0.0
        return math.inf if run.kind == STATIC else self.layout.reach * self.scale + grow


class TileGroup(NamedTuple):
    """Consecutive runs that are rendered into tiles of one size."""

    runs: tuple[tuple[SlotGroup, int], ...]
    reach: float  # px

    @property
    def slots(self) -> list[int]:
        """Slots in drawing order."""
        return [slot for run, first in self.runs for slot in range(first, first + run.count)]

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of a tile."""
        if self.reach == math.inf:
            return height, width
        # Even, so that fewer reaches need a program of their own.
        rows = operator.index(-(-math.floor(2 * self.reach) // 2)) * 2 + 2
        return min(rows, height), min(-(-rows // LANES) * LANES, width)


def tile_windows(
    plan: FramePlan, group: TileGroup, at: Instants, run: SlotGroup, first: int, offset: Array | float = 0.0
) -> PixelWindow:
    """Tiles of a run's slots, moved by `offset` [2] m, at the instants `at`, with top and left [k, I]."""
    height, width = plan.height, plan.width
    rows, columns = group.size(height, width)
    centers = to_pixels(at.view, at.position[:, first : first + run.count] + offset, height, width)

    def begin(center: Array, size: int, whole: int) -> Array:
        if size == whole:
            return jnp.zeros(center.T.shape, jnp.int32)
        return jnp.clip(jnp.floor(center.T - group.reach).astype(jnp.int32), 0, whole - size)

    return PixelWindow(begin(centers[..., 1], rows, height), begin(centers[..., 0], columns, width), rows, columns)
