"""What a picture is made from: all that one video is drawn from, and what is known of its pictures before that."""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp

from gen2d.core.enums import STATIC
from gen2d.records.axes import Array
from gen2d.records.layout import Layout, SlotGroup
from gen2d.renderers.camera import to_pixels
from gen2d.renderers.paint import Paint
from gen2d.renderers.primitives import BodyGeometry, Instants, PixelWindow

LANES = 8  # pixels: a patch's rows are whole SIMD vectors


class Occluders(NamedTuple):
    """Rectangles that stand still in the picture, back to front."""

    box: Array  # [O, 4] px: left, top, right, bottom
    color: Array  # [O, 3] sRGB
    rank: Array  # [O] how many of the moving slots, in drawing order, they stand before


class RenderScene(NamedTuple):
    """All that one video is drawn from; any number of them have their axes before these."""

    bodies: BodyGeometry
    instants: Instants  # at the T frames
    exposed: Instants | None  # [T, S, ...] at the S instants of each exposure
    paint: Paint
    occluders: Occluders | None
    noise: Array | None  # sRGB, standard deviation
    seed: Array  # uint32, of the noise


@dataclasses.dataclass(frozen=True)
class FramePlan:
    """What is known of a picture before anything is drawn."""

    layout: Layout
    height: int  # px
    width: int
    scale: float  # px/m at most
    grow: float = 0.0  # px at most, that a look adds to an object's rim
    still: bool = True  # whether the camera never moves
    linear: bool = False  # whether colours mix in linear light
    frames: bool = True  # whether frames are wanted
    owners: bool = False  # whether it is wanted which object each pixel shows
    exposed: int = 0  # instants of an exposure; 0: no motion blur

    @property
    def behind(self) -> list[tuple[SlotGroup, int]]:
        """The runs of the unmoving layer, back to front."""
        spans = self.layout.painted
        first = next((i for i, (run, _) in enumerate(spans) if not self.still or run.kind != STATIC), len(spans))
        return list(spans[:first])

    @property
    def groups(self) -> "list[TileGroup]":
        """The others, in groups that share a size of patch."""
        found: list[TileGroup] = []
        for run, first in self.layout.painted[len(self.behind) :]:
            reach = self._reach(run)
            if found and found[-1].reach == reach:
                found[-1] = TileGroup((*found[-1].runs, (run, first)), reach)
            else:
                found.append(TileGroup(((run, first),), reach))
        return found

    @property
    def moving(self) -> int:
        """How many slots those are."""
        return sum(len(group.slots) for group in self.groups)

    def _reach(self, run: SlotGroup) -> float:
        """Of an object from its centre, px; as large as the picture where that is not known to be less."""
        reach = self.largest(run)
        return reach if 2 * reach + 2 < max(self.height, self.width) else math.inf

    def largest(self, run: SlotGroup) -> float:
        """No disc of a run is larger, px."""
        return math.inf if run.kind == STATIC else self.layout.reach * self.scale + self.grow


class TileGroup(NamedTuple):
    """Runs that are drawn into patches of one size."""

    runs: tuple[tuple[SlotGroup, int], ...]
    reach: float  # px

    @property
    def slots(self) -> list[int]:
        """Its slots in drawing order."""
        return [slot for run, first in self.runs for slot in range(first, first + run.count)]

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of a patch."""
        if math.isinf(self.reach):
            return height, width
        side = math.floor(2 * self.reach) + 2
        return min(side, height), min(-(-side // LANES) * LANES, width)


def tile_windows(plan: FramePlan, group: TileGroup, at: Instants, run: SlotGroup, first: int) -> PixelWindow:
    """The patches of a run's slots at some instants, top and left [k, I]."""
    height, width = plan.height, plan.width
    rows, columns = group.size(height, width)
    places = to_pixels(at.view, at.position[:, first : first + run.count], height, width)

    def begin(center: Array, size: int, whole: int) -> Array:
        if size == whole:
            return jnp.zeros(center.T.shape, jnp.int32)
        return jnp.clip(jnp.floor(center.T - group.reach).astype(jnp.int32), 0, whole - size)

    return PixelWindow(begin(places[..., 1], rows, height), begin(places[..., 0], columns, width), rows, columns)
