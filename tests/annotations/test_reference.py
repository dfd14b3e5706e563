"""Frames and annotations of whole videos against a reference in float64 that shares no code with gen2d.

`support/reference.py` computes them from the stored fields of each video. Bounds follow from the accuracy that
docs/frames.md states. Where two objects share a pixel equally within that accuracy, either may own it: such ties
are counted, and the boxes, counts and flows of the video must be those of its choice.
"""

import ast
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
import reference
from numpy.testing import assert_array_equal
from reference import OCCLUDER, Layer, Occluder, View

from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.programs import render
from gen2d.programs.rollout import Rollout

ANNOTATED = [
    *(f"annotations.{name}=true" for name in ("masks", "amodal", "boxes", "centers", "visibility", "flow")),
    "annotations.tracks=3",
]
CAMERAS = {
    "still": (),
    "rotated": ("camera.angle=0.4", "camera.margin=1"),
    "panning": ("camera.pan=[3,[-2,2]]",),
    "turning": ("camera.turn=1.7", "camera.angle=[-3,3]"),
    "zooming": ("camera.zoom=[-2,2]",),
    "shaking": ("camera.shake=0.1", "camera.shake_hertz=2"),
    "following": ("camera.follow=0",),
    "everything": (
        "camera.pan=[[-2,2],1]",
        "camera.turn=[-2,2]",
        "camera.angle=[-3,3]",
        "camera.zoom=0.8",
        "camera.shake=0.1",
        "camera.follow=1",
    ),
}
FPS = 30  # of videos with motion blur
STEPS = 8  # of the solver per frame, in videos with motion blur
STATIC = 1  # objects/kind
OCCLUDERS = ("image.occluders=2", "image.occluder_front=[0,1]")
LOOKS = {"cradle": ("look=outline",), "uniform_motion": ("look=phyworld",), "galton": ("image.blending=linear",)}
# Accuracy of coverages of shapes with radii up to these, px (docs/frames.md), in grey levels.
ACCURACY = {4: 0.001, 32: 0.1, 64: 0.4, np.inf: 2.0}
ROUNDING = 0.5 + 2**-5  # grey levels, of a layer
POSITION = 2.0**-21  # of a position in px, in float32


@dataclasses.dataclass(frozen=True)
class Case:
    """A config whose videos are compared; `dense` renders them in the form for GPUs."""

    config: str
    overrides: tuple[str, ...]
    size: tuple[int, int] = (40, 56)
    frames: int = 4
    videos: int = 2
    dense: bool = False
    exposure: tuple[float, int] | None = None  # frames, instants


@dataclasses.dataclass(frozen=True)
class Frame:
    """One frame as the reference renders it."""

    number: int
    layers: list[Layer]
    mask: np.ndarray  # owners, those of the video where there are ties
    ties: int
    rim: int  # pixels that several objects share


@dataclasses.dataclass(frozen=True)
class RenderedVideo:
    """A video's stored fields, how it was rendered, and the reference's frames."""

    video: dict[str, np.ndarray]
    view: View
    frames: list[Frame]
    exposures: list[list[list[Layer]]] | None  # what is seen at each instant of each frame's exposure

    @property
    def slots(self) -> int:
        return len(self.video["objects/present"])


def fields(case: Case) -> tuple[list[tuple[dict[str, np.ndarray], View]], list[dict[str, np.ndarray]]]:
    """Fields of the videos of a case, as a dataset of its config holds them, and how each is rendered; and with motion
    blur their fields after every step of the solver."""
    height, width = case.size
    sizes = [f"video.frames={case.frames}", f"video.height={height}", f"video.width={width}"]
    common, shutter = [f"storage.batch_size={case.videos}", "seed=5", *case.overrides], []
    if case.exposure:
        length, samples = case.exposure
        shutter = [f"image.exposure={length}", f"image.exposure_samples={samples}"]
        shutter += [f"video.fps={FPS}", f"physics.substeps={STEPS}"]
    config = load_config(f"{case.config}.yaml", [*sizes, *ANNOTATED, *common, *shutter])
    rollout = Rollout(config, jax.devices()[:1])
    (batch,) = rollout.start("train", np.arange(case.videos))
    if case.dense:
        draw = jax.jit(lambda scenes: render.render_frames(scenes, rollout.plan, config.annotations))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax, "default_backend", lambda: "gpu")
            drawn = draw(batch.render_scenes)
    else:
        (drawn,) = rollout.draw([batch], 0, case.videos)
    columns = rollout.host_columns([batch])[0] | {name: np.asarray(array) for name, array in drawn.items()}
    look, rendered = config.look.options, []
    for v in range(case.videos):
        occluders = ()
        if config.image.occluders:
            occluders = tuple(map(Occluder, *(columns[f"occluders/{name}"][v] for name in ("box", "color", "depth"))))
        background = look.grounds[0] if hasattr(look, "grounds") else (255, 255, 255)
        linear = config.image.blending == "linear"
        view = View(height, width, background, look.wall_width, linear, occluders)
        if config.look.name == "outline":
            view = view._replace(line=look.width, fill=look.fill)
        rendered.append(({name: array[v] for name, array in columns.items()}, view))
    if not case.exposure:
        return rendered, []
    every = [f"video.fps={FPS * STEPS}", f"video.frames={(case.frames - 1) * STEPS + 1}"]
    fine = Rollout(load_config(f"{case.config}.yaml", [*common, *every, "physics.substeps=1"]), jax.devices()[:1])
    (columns,) = fine.host_columns(fine.start("train", np.arange(case.videos)))
    return rendered, [{name: array[v] for name, array in columns.items()} for v in range(case.videos)]


def videos(case: Case) -> Iterator[RenderedVideo]:
    """The videos of a case with the reference's frames."""
    rendered, steps = fields(case)
    for v, (video, view) in enumerate(rendered):
        exposures = None
        if case.exposure:
            length, samples = case.exposure
            before = length * (1 - (np.arange(samples) + 0.5) / samples)
            rate = FPS
            exposures = [
                [reference.layers(reference.exposed(video, steps[v], t, b, STEPS, rate), 0, view) for b in before]
                for t in range(case.frames)
            ]
        yield RenderedVideo(video, view, [frame_of(video, t, view) for t in range(case.frames)], exposures)


def accuracy(layer: Layer, size: float) -> float:
    """Largest error of a layer's coverage in a pixel of a frame of some size, px."""
    coverage = next(error for radius, error in ACCURACY.items() if layer.radius <= radius) / 255
    return coverage + 2 * POSITION * max(size, layer.radius)


def frame_of(video: dict, t: int, view: View, size: float = 0) -> Frame:
    """Frame t as the reference renders it."""
    layers = reference.layers(video, t, view)
    ids, shares = reference.shares(layers, view)
    stored = video["masks/instance"][t]
    partial = [(layer.coverage > 0) & (layer.coverage < 1) for layer in layers]
    errors = sum(
        here * (accuracy(layer, size or view.width) + 2**-15) for here, layer in zip(partial, layers, strict=True)
    )
    own = np.where(ids[:, None, None] == stored, shares, 0.0).max(0)
    owner = ids[shares.argmax(0)]
    tied = shares.max(0) - own <= 2 * errors
    return Frame(
        t,
        layers,
        mask=np.where(tied, stored, owner),
        ties=int((tied & (owner != stored)).sum()),
        rim=int(np.any(partial, axis=0).sum()),
    )


def frame_bounds(layers: list[Layer], view: View, size: float = 0) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest values [H, W, 3] that a frame may have: a layer is rounded where it covers part of a pixel."""
    low = high = reference.background(view)
    for layer in layers:
        cover = layer.coverage[..., None]
        error = accuracy(layer, size or view.width) + 2**-15
        rounding = ROUNDING * ((cover > 0) & (cover < 1))
        if layer.color.ndim > 1:  # the mean colour of a line and a fill is rounded, and depends on two coverages
            error, rounding = 3 * error, rounding + 0.5
        ends = [
            reference.mix(under, layer.color, np.clip(cover + off, 0, 1), view.linear)
            for under in (low, high)
            for off in (-error, error)
        ]
        low = np.where(cover > 0, np.min(ends, axis=0) - rounding, low)
        high = np.where(cover > 0, np.max(ends, axis=0) + rounding, high)
    return low, high


CASES = {
    "crowded": Case(  # 68 slots, so ids of three words of 32 bits
        "bouncing", ("scene.balls=[60,64]", "scene.radius=[0.2,0.4]", *CAMERAS["everything"], *OCCLUDERS), frames=3
    )
}
WIDE = Case(  # flows and areas beyond 255 px
    "bouncing",
    (
        "scene.balls=3",
        "scene.width=40",
        "scene.height=4",
        "scene.radius=[1.2,1.6]",
        "scene.velocity=[[34,40],0]",
        "video.fps=2",
    ),
    size=(72, 656),
)
BLURRED = Case(
    "bouncing",
    ("scene.balls=3", "scene.velocity=[[-20,20],[-20,20]]", *CAMERAS["everything"], *OCCLUDERS),
    exposure=(1.0, 4),
)
FULL = {
    "wide": WIDE,
    "crowded, dense": dataclasses.replace(CASES["crowded"], dense=True),
    "blurred light": dataclasses.replace(BLURRED, overrides=(*BLURRED.overrides, "image.blending=linear")),
}
FAMILIES = {
    f"{family}, {camera}": Case(
        family,
        (*CAMERAS[camera], "video.fps=6", *(OCCLUDERS if k % 3 == 2 else ()), "look=flat", *LOOKS.get(family, ())),
        dense=k % 4 == 1,
    )
    for k, (family, camera) in enumerate(zip(plugins.names("scene"), itertools.cycle(CAMERAS), strict=False))
}
SLOW = {"blurred, dense": dataclasses.replace(BLURRED, exposure=(0.5, 2), dense=True)}
EVERY_DAY = "seesaw, everything"  # polygons, some slots empty, a moving camera
TIERED = [
    *(pytest.param(case, id=name) for name, case in CASES.items()),
    *(pytest.param(case, id=name, marks=pytest.mark.full) for name, case in FULL.items()),
    *(
        pytest.param(case, id=name, marks=pytest.mark.full if name == EVERY_DAY else pytest.mark.slow)
        for name, case in (SLOW | FAMILIES).items()
    ),
]


@pytest.fixture(scope="module", params=TIERED)
def rendered(request) -> list[RenderedVideo]:
    """The videos of a case."""
    return list(videos(request.param))


def each_frame(rendered: list[RenderedVideo]) -> Iterator[tuple[RenderedVideo, Frame]]:
    return ((one, frame) for one in rendered for frame in one.frames)


def drawn(one: RenderedVideo) -> list[int]:
    """Slots that are rendered."""
    return [slot for slot in range(one.slots) if reference.rendered(one.video, slot, one.view)]


def test_the_reference_imports_nothing_of_the_project():
    source = ast.parse(Path(reference.__file__).read_text())
    modules = {alias.name for node in ast.walk(source) if isinstance(node, ast.Import) for alias in node.names}
    modules |= {node.module for node in ast.walk(source) if isinstance(node, ast.ImportFrom)}
    assert modules == {"math", "collections.abc", "typing", "numpy"}
    assert not [node for node in ast.walk(source) if isinstance(node, ast.Name) and node.id in ("__import__", "exec")]


@pytest.mark.parametrize(
    ("corners", "radius"),
    [
        ([(3.4, 3.7)], 1.7),
        ([(2.1, 2.3), (5.2, 6.4)], 0.9),
        ([(2.1, 2.3), (7.2, 3.4), (3.3, 6.1)], 0.0),
        ([(2.1, 2.3), (6.2, 3.4), (3.3, 6.1)], 0.8),
    ],
)
def test_the_reference_covers_the_points_within_its_radius(corners, radius):
    shape, size, samples = reference.Outline(np.array(corners), radius), 8, 100
    middles = (np.arange(size * samples) + 0.5) / samples
    points = np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2)
    within = reference.distance(shape.core, points) <= radius
    share = within.reshape(size, samples, size, samples).mean((1, 3))
    covered = reference.coverage(shape, size, size)
    np.testing.assert_allclose(covered, share, atol=1e-3)
    np.testing.assert_allclose(covered.sum(), reference.area(shape), rtol=1e-5)


def test_a_frame_shows_the_exact_areas_of_its_objects(rendered):
    beyond, errors = [], []
    for one, frame in each_frame(rendered):
        stored = one.video["frames"][frame.number].astype(float)
        exposures = one.exposures[frame.number] if one.exposures else [frame.layers]
        low, high = (
            reference.blend(images, one.view)
            for images in zip(*(frame_bounds(layers, one.view) for layers in exposures), strict=True)
        )
        image = reference.blend([reference.frame(layers, one.view) for layers in exposures], one.view)
        blended = 0.5 if one.exposures else 0.0
        beyond.append(np.maximum(low - stored, stored - high).max() - blended)
        errors.append(np.abs(image - stored).mean())
    print(f"frames: {np.max(beyond):.3f} levels beyond the bounds, mean error {np.mean(errors):.4f}")
    assert np.max(beyond) <= 1e-3
    assert np.mean(errors) <= 0.3


def test_a_pixel_shows_the_object_with_the_largest_share_of_it(rendered):
    for one, frame in each_frame(rendered):
        assert_array_equal(one.video["masks/instance"][frame.number], frame.mask)
    ties, rim = (sum(getattr(frame, name) for _, frame in each_frame(rendered)) for name in ("ties", "rim"))
    print(f"masks: {ties} ties of {rim} shared pixels")
    assert ties <= 1e-3 * rim


def test_amodal_masks_are_the_pixels_that_an_object_covers_by_half(rendered):
    ties, rim = 0, 0
    for one, frame in each_frame(rendered):
        bits = np.unpackbits(one.video["masks/amodal"][frame.number], axis=-1)[:, : one.view.height * one.view.width]
        stored = bits.reshape(-1, one.view.height, one.view.width).astype(bool)
        covered = {layer.id - 1: layer for layer in frame.layers if layer.id != OCCLUDER}
        for slot in range(one.slots):
            if slot not in covered:
                assert not stored[slot].any()
                continue
            layer = covered[slot]
            tied = np.abs(layer.coverage - 0.5) <= accuracy(layer, one.view.width)
            assert_array_equal(stored[slot][~tied], layer.coverage[~tied] > 0.5)
            ties += tied.sum()
            rim += ((layer.coverage > 0) & (layer.coverage < 1)).sum()
    print(f"amodal masks: {ties} ties of {rim} pixels on rims")
    assert ties <= 1e-3 * rim


def test_boxes_are_those_of_the_mask_and_of_the_whole_object(rendered):
    worst = 0.0
    for one, frame in each_frame(rendered):
        seen = reference.visible_boxes(frame.mask, one.slots)
        assert_array_equal(one.video["boxes/visible"][frame.number], seen)
        whole = np.zeros((one.slots, 4))
        for slot in drawn(one):
            whole[slot] = reference.box(reference.outline(one.video, frame.number, slot, one.view))
        error = np.abs(one.video["boxes/amodal"][frame.number] - whole)
        worst = max(worst, (error / (1 + np.abs(whole))).max())
    print(f"amodal boxes: {worst:.1e} of the distance from the corner")
    assert worst <= 2e-6


def test_visibility_is_the_share_of_the_area_that_is_seen(rendered):
    largest = 0
    for one in rendered:
        least = 1.0
        for frame in one.frames:
            pixels, fraction = (one.video[f"visibility/{name}"][frame.number] for name in ("pixels", "fraction"))
            largest = max(largest, pixels.max())
            assert_array_equal(pixels, reference.visible_pixels(frame.mask, one.slots))
            expected = np.zeros(one.slots)
            for slot in drawn(one):
                area = reference.area(reference.outline(one.video, frame.number, slot, one.view))
                expected[slot] = min(1.0, pixels[slot] / area)
                least = min(least, expected[slot]) if one.video["objects/kind"][slot] != STATIC else least
            np.testing.assert_allclose(fraction, expected, rtol=1e-5)
        np.testing.assert_allclose(one.video["quality/min_visibility"], least, rtol=1e-5)
    assert largest > 255 or rendered[0].view.width < WIDE.size[1]


DIRECTIONS = {"forward": 1, "backward": -1}


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_flow_is_how_the_content_of_a_pixel_moves(rendered, direction):
    worst, largest = 0.0, 0.0
    for one, frame in each_frame(rendered):
        stored = one.video[f"flow/{direction}"][frame.number].astype(float)
        to = frame.number + DIRECTIONS[direction]
        if not 0 <= to < len(one.frames):
            assert not stored.any()
            continue
        expected = reference.flow(one.video, frame.number, to, frame.mask, one.view)
        rounding = np.spacing(np.abs(expected).astype(np.float16)).astype(float) / 2
        error = np.abs(stored - expected) - rounding
        worst, largest = max(worst, error.max()), max(largest, np.abs(expected).max())
    print(f"flow {direction}: {worst:.1e} px beyond rounding; at most {largest:.0f} px")
    assert worst <= 2e-4
    assert largest > 255 or rendered[0].view.width < WIDE.size[1]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_flow_is_valid_where_it_ends_at_the_same_object(rendered, direction):
    open_, pixels = 0, 0
    for one, frame in each_frame(rendered):
        stored = one.video[f"flow/{direction}_valid"][frame.number]
        to = frame.number + DIRECTIONS[direction]
        if not 0 <= to < len(one.frames):
            assert not stored.any()
            continue
        end = reference.pixel_centers(one.view)
        end = end + reference.flow(one.video, frame.number, to, frame.mask, one.view)
        decided = (np.abs(end - np.rint(end)) > 1e-3).all(-1)
        column, row = np.moveaxis(np.floor(end).astype(int), -1, 0)
        inside = (row >= 0) & (row < one.view.height) & (column >= 0) & (column < one.view.width)
        there = one.frames[to].mask[row.clip(0, one.view.height - 1), column.clip(0, one.view.width - 1)]
        valid = inside & (there == frame.mask)
        assert_array_equal(stored[decided], valid[decided])
        open_, pixels = open_ + (~decided).sum(), pixels + decided.size
    print(f"flow {direction}: {open_} of {pixels} ends on an edge of a pixel")
    assert open_ <= 0.01 * pixels


def test_tracks_are_points_fixed_to_objects_and_are_seen_where_the_mask_shows_the_object(rendered):
    worst = 0.0
    for one in rendered:
        owner, points, seen = (one.video[f"tracks/{name}"] for name in ("object", "points", "visible"))
        slots = drawn(one)
        assert_array_equal(
            owner, np.repeat(np.where(np.isin(np.arange(one.slots), slots), np.arange(one.slots), -1), 3)
        )
        for p, slot in enumerate(owner):
            if slot < 0:
                assert not points[:, p].any()
                assert not seen[:, p].any()
                continue
            fixed = reference.to_body(
                one.video, 0, slot, reference.to_world(one.video, 0, reference.double(points[0, p]), one.view)
            )
            for frame in one.frames:
                world = reference.from_body(one.video, frame.number, slot, fixed)
                expected = reference.to_pixels(one.video, frame.number, world, one.view)
                worst = max(worst, np.abs(points[frame.number, p] - expected).max())
                column, row = np.floor(points[frame.number, p]).astype(int)
                inside = 0 <= row < one.view.height and 0 <= column < one.view.width
                assert seen[frame.number, p] == (inside and frame.mask[row, column] == slot + 1)
    print(f"tracks: {worst:.1e} px")
    assert worst <= 2e-4


def test_tracked_points_are_uniform_in_their_objects(rendered):
    within = []
    for one in rendered:
        owner, points = one.video["tracks/object"], reference.double(one.video["tracks/points"][0])
        for slot in drawn(one):
            world = reference.to_world(one.video, 0, points[owner == slot], one.view)
            core, radius = reference.body_core(one.video, slot), float(one.video["objects/radius"][slot])
            away = reference.distance(core, reference.to_body(one.video, 0, slot, world))
            rounding = 1e-5 * max(one.view.height, one.view.width) / one.video["camera/scale"][0]
            assert (away <= radius + rounding).all()
            if one.video["objects/shape"][slot] == reference.CIRCLE:
                within += [*(away / radius) ** 2]  # share of the area that is nearer to the centre
    if within:
        assert abs(np.mean(within) - 0.5) < 5 / np.sqrt(12 * len(within))


def test_centres_are_the_places_of_the_objects_and_are_seen_where_the_mask_shows_them(rendered):
    worst = 0.0
    for one, frame in each_frame(rendered):
        points, seen = (one.video[f"centers/{name}"][frame.number] for name in ("points", "visible"))
        for slot in range(one.slots):
            if slot not in drawn(one):
                assert not points[slot].any()
                assert not seen[slot]
                continue
            place = reference.double(one.video["states/position"][frame.number, slot])
            expected = reference.to_pixels(one.video, frame.number, place, one.view)
            worst = max(worst, np.abs(points[slot] - expected).max())
            column, row = np.floor(points[slot]).astype(int)
            inside = 0 <= row < one.view.height and 0 <= column < one.view.width
            assert seen[slot] == (inside and frame.mask[row, column] == slot + 1)
    print(f"centres: {worst:.1e} px")
    assert worst <= 2e-4


SIZE, WINDOW = 4096, 64  # px


def window(one: dict, t: int, middle: np.ndarray, view: View) -> tuple[dict, View]:
    """Frame t of a video around the pixel position `middle` [2], as a video of its own with one small frame."""
    corner = np.clip(np.rint(middle).astype(int) - WINDOW // 2, 0, SIZE - WINDOW)
    center = reference.to_world(one, t, corner + WINDOW / 2, view)
    here = (slice(t, t + 1), slice(corner[1], corner[1] + WINDOW), slice(corner[0], corner[0] + WINDOW))
    instant = {name: one[name][t : t + 1] for name in one if name.startswith(("states/", "camera/"))}
    crops = {name: one[name][here] for name in ("frames", "masks/instance")}
    return {**one, **instant, **crops, "camera/center": center[None]}, view._replace(height=WINDOW, width=WINDOW)


@pytest.mark.slow
def test_a_frame_of_4096_pixels_shows_the_exact_areas_of_its_objects():
    case = Case("bouncing", ("scene.balls=3", "camera.margin=0.1"), size=(SIZE, SIZE), frames=2, videos=1)
    ((one, view),) = fields(case)[0]
    rng, seen = np.random.default_rng(0), set()
    for t, slot in itertools.product(range(case.frames), range(len(one["objects/present"]))):
        shape = reference.outline(one, t, slot, view)
        mask, area = one["masks/instance"][t], reference.area(shape)
        np.testing.assert_allclose(one["boxes/amodal"][t, slot], reference.box(shape), atol=2e-3)
        assert one["visibility/pixels"][t, slot] == (mask == slot + 1).sum()
        if one["objects/shape"][slot] == reference.CIRCLE:  # in front of the walls, and whole
            np.testing.assert_allclose(one["visibility/pixels"][t, slot], area, rtol=1e-3)
        rim = reference.boundary(shape)
        for middle in rim[rng.integers(len(rim), size=8)]:
            small, around = window(one, t, middle, view)
            frame = frame_of(small, 0, around, size=SIZE)
            low, high = frame_bounds(frame.layers, around, size=SIZE)
            assert (small["frames"][0] >= low - 1e-3).all()
            assert (small["frames"][0] <= high + 1e-3).all()
            assert_array_equal(small["masks/instance"][0], frame.mask)
            assert frame.ties <= 0.02 * frame.rim
            seen |= {*np.unique(frame.mask)}
        pixels = np.argwhere(mask == slot + 1)[:: max(1, int(area) // 50)]
        end = reference.moved(one, t, 1 - t, slot + 1, pixels[:, ::-1] + 0.5, view)
        flow = one[f"flow/{'backward' if t else 'forward'}"][t][tuple(pixels.T)].astype(float)
        np.testing.assert_allclose(flow, end - pixels[:, ::-1] - 0.5, rtol=2**-11, atol=2e-3)
    assert seen == {*range(len(one["objects/present"]) + 1)}
