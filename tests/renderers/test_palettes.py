"""Named palettes: their colours can be told apart, each object gets its own, and its name is stored."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import CONFIG
from worlds import straight_motion, world

import gen2d
from gen2d.config.config import load_config
from gen2d.core.enums import SHAPES, STATIC
from gen2d.core.errors import ConfigError
from gen2d.core.palettes import NAME_BYTES, PALETTES
from gen2d.programs import render
from gen2d.programs.rollout import Rollout
from gen2d.records.layout import Layout, SlotGroup
from gen2d.renderers.color import to_linear
from gen2d.renderers.compositing import background_image
from gen2d.renderers.paint import NO_MATERIAL

# To XYZ relative to the white point D65 (IEC 61966-2-1).
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def cielab(color):
    """CIELAB (CIE 1976) coordinates [3] of an sRGB colour."""
    ratio = TO_XYZ @ np.asarray(to_linear(jnp.asarray(color, float))) / TO_XYZ.sum(1)
    x, y, z = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("name", PALETTES)
def test_colours_of_a_palette_are_far_apart(name):
    palette = PALETTES[name]
    objects, ground = [[cielab(c) for c in colors] for colors in (palette.objects.values(), palette.ground)]
    apart = [np.linalg.norm(a - b) for a, b in itertools.combinations(objects, 2)]
    behind = [np.linalg.norm(a - b) for a, b in itertools.product([*objects, cielab(palette.wall[1])], ground)]
    print(f"{name}: objects {min(apart):.0f} apart at least, {min(behind):.0f} from the background")
    assert min(apart) >= 20
    assert min(behind) >= 20
    assert palette.wall[0] not in palette.objects
    assert all(0 < len(entry) <= NAME_BYTES for entry in palette.objects)


def colors_of(palette, present, videos=50, look="flat"):
    """Colours [videos, K, 3] that a look gives moving discs, some of which are present, and a static one."""
    layout = Layout((SlotGroup("circle", len(present)), SlotGroup("circle", 1, 1)), (0.0, 0.0, 10.0, 10.0), 1.6)
    scene = world([{"radius": 1.0 if there else 0.0} for there in (*present, True)])[0]
    config = load_config({"look": {"name": look, "palette": palette}})
    keys = jax.random.split(jax.random.key(0), videos)
    return np.asarray(jax.vmap(lambda key: render.paint_of(key, config, scene, layout).color)(keys))


@pytest.mark.parametrize("name", ["paper", "grey"])
def test_objects_of_a_video_have_distinct_colours_of_the_palette_in_a_random_order(name):
    entries = {tuple(map(float, color)) for color in PALETTES[name].objects.values()}
    present = np.arange(20) % 3 == 1
    for seen, count in ((present, len(entries)), (np.arange(20) < len(entries), len(entries))):
        colors = colors_of(name, seen)[:, :-1][:, np.flatnonzero(seen)[:count]]
        assert all(len({*map(tuple, video)}) == min(count, seen.sum()) for video in colors.tolist())
        assert {tuple(c) for c in colors.reshape(-1, 3).tolist()} == entries
    crowd = colors_of(name, np.ones(20, bool))
    counts = [np.unique(video[:-1], axis=0, return_counts=True)[1] for video in crowd]
    assert all(count.max() - count.min() <= 1 for count in counts)
    assert (crowd[:, -1] == PALETTES[name].wall[1]).all()
    assert len(np.unique(crowd[:, 0], axis=0)) == len(entries)


@pytest.mark.parametrize("scene", ["chain", pytest.param("wrecking_ball", marks=pytest.mark.full)])
def test_the_links_of_a_chain_have_one_colour(scene):
    """Which no other moving object has, but for a tower of more blocks than colours are left."""
    config = load_config({"scene": scene, "look": {"name": "flat", "palette": "dusk"}, "video": {"frames": 2}})
    rollout = Rollout(config, jax.devices()[:1])
    columns = rollout.host_columns(rollout.start("train", np.arange(rollout.batch_size)))[0]
    links = (columns["objects/shape"] == SHAPES.index("capsule")) & columns["objects/present"]
    rest = columns["objects/present"] & ~links & (columns["objects/kind"] != STATIC)
    first = set()
    for color, link, other in zip(columns["objects/color"], links, rest, strict=True):
        assert link.sum() > 3
        assert len(np.unique(color[link], axis=0)) == 1
        colors = {*map(tuple, color[other].tolist())}
        assert len(colors) == min(other.sum(), 8)
        assert other.sum() > 7 or tuple(color[link][0].tolist()) not in colors
        assert other.any() == (scene == "wrecking_ball")
        first.add(tuple(color[link][0].tolist()))
    assert len(first) > 3


def test_a_palette_colours_all_looks_alike():
    one, other = (colors_of("lab", np.ones(5, bool), look=look) for look in ("flat", "studio"))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("name", "axis"), [("grass", 0), ("chalkboard", 1)])
def test_the_grain_of_a_backdrop_is_stretched(name, axis):
    """Blades of grass are upright, and smears of chalk level; the backdrop keeps to the palette's ground."""
    config = load_config(
        {"scene": {"name": "uniform_motion"}, "video": {"height": 96, "width": 96, "frames": 1},
         "look": {"name": "flat", "palette": name, "background_kind": "backdrop"}}
    )  # fmt: skip
    scenes, plan, *_ = straight_motion(config, 1)
    at = jax.tree.map(lambda a: a[:1], jax.tree.map(lambda a: a[0], scenes.instants))
    image = np.asarray(background_image(jax.tree.map(lambda a: a[0], scenes), at, plan))[0].sum(-1)
    changes = [np.abs(np.diff(image, axis=i)).mean() for i in (0, 1)]
    assert 1.5 * changes[axis] < changes[1 - axis]
    palette = PALETTES[name]
    assert palette.grain is not None
    low, high = (end(np.sum([*palette.ground, palette.grain.color], 1)) for end in (np.min, np.max))
    assert low <= image.min() <= image.max() <= high


def test_the_name_of_each_colour_is_stored():
    config = load_config(CONFIG, ["look={name: flat, palette: dusk}"])
    rollout = Rollout(config, jax.devices()[:1])
    numbers = np.arange(rollout.batch_size)
    columns = rollout.host_columns(rollout.start("train", numbers))[0]
    assert rollout.schema.fields["objects/color_name"].axes == "n K"
    names = rollout.schema.host_columns(columns, "train")["objects/color_name"]
    colors, known = columns["objects/color"], PALETTES["dusk"].objects | dict([PALETTES["dusk"].wall])
    present = columns["objects/present"]
    assert not present.all()
    assert not names[~present].any()
    assert all(
        known[name.decode()] == tuple(color) for name, color in zip(names[present], colors[present], strict=True)
    )


def test_without_a_palette_and_materials_no_names_are_stored():
    schema = Rollout(load_config(CONFIG), jax.devices()[:1]).schema
    assert not {"objects/color_name", "objects/material_name", "objects/material"} & set(schema.fields)


@pytest.mark.full
def test_the_name_of_each_material_is_stored(tmp_path):
    """Of a split with a look that has materials and a palette; in another split there are no names."""
    splits = {"train": {}, "plain": {"look": "flat", "videos": 8, "overlaps": True}}
    config = {**CONFIG, "look": {"name": "studio", "material": ["paper", "metal"]}, "splits": splits}
    gen2d.generate(config, n=24, out=tmp_path)
    fields = ["objects/material", "objects/material_name", "objects/present", "objects/kind"]
    video = gen2d.open(tmp_path, "train", fields=fields)[:]
    present, names = video["objects/present"], video["objects/material_name"]
    assert not present.all()
    assert not names[~present].any()
    assert set(names[present & (video["objects/kind"] != STATIC)].tolist()) == {b"paper", b"metal"}
    assert set(names[present & (video["objects/kind"] == STATIC)].tolist()) == {b"paper"}
    listed = load_config(config).look.options.materials
    codes = video["objects/material"][present]
    assert [listed[code].encode() for code in codes] == names[present].tolist()
    other = gen2d.open(tmp_path, "plain", fields=fields)[:]
    assert not other["objects/material_name"].any()
    assert not gen2d.open(tmp_path, "plain", fields=["objects/color_name"])[:]["objects/color_name"].any()
    assert (other["objects/material"] == NO_MATERIAL).all()


@pytest.mark.parametrize(("change", "palette"), [("color", "paper"), ("remove", "grey"), ("balls", "grey")])
def test_a_matched_change_that_a_palette_hides_or_spreads_is_refused(change, palette):
    with pytest.raises(ConfigError, match=f"look.palette={palette}"):
        load_config({"matched": {"change": change}, "look": {"name": "flat", "palette": palette}})
    load_config({"matched": {"change": change}})


def test_a_matched_change_of_a_chain_of_more_links_than_colours_is_not_refused():
    """The links have one colour, whatever their number."""
    look = {"name": "flat", "palette": "paper"}
    load_config({"scene": {"name": "chain", "links": 12}, "matched": {"change": "pulled_above"}, "look": look})


RED = {"color": [[200, 250], [0, 20], [0, 20]]}


@pytest.mark.parametrize("factors", [RED, {"mixture": [RED, {"radius": 0.5, **RED}]}])
def test_a_split_by_a_colour_that_a_palette_replaces_is_refused(factors):
    scene = {"name": "bouncing", "color": [[0, 90]] * 3, "radius": [0.6, 0.7]}
    config = {"scene": scene, "splits": {"a": {}, "b": {"factors": factors}}}
    load_config(config)
    with pytest.raises(ConfigError, match="palette=lab replaces"):
        load_config(config | {"look": {"name": "flat", "palette": "lab"}})
