"""Configs: what is read is what is meant; what cannot be is one sentence with file, field, value and what may be."""

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import CONFIG, tiny_config

from gen2d.cli.report import plugins as listing
from gen2d.config import plugins, sections
from gen2d.config.config import MAX_SEED, load_config
from gen2d.config.distribution_syntax import parse
from gen2d.config.reading import parse_yaml, yaml_text
from gen2d.config.resolved import resolved
from gen2d.core.errors import ConfigError
from gen2d.engines import Ray

BAD = {
    "scene: {balls: 0}": ("scene.balls is 0", "1 or more"),
    "scene: {balls: 2.5}": ("scene.balls is 2.5", "whole number"),
    "scene: {balls: [5, 3]}": ("scene.balls is [5, 3]", "lower end first"),
    "scene: {radius: -1}": ("scene.radius is -1", "0.001 or more"),
    "scene: {radius: big}": ("scene.radius is 'big'", "[low, high]"),
    "scene: {radius: [1, 2, 3]}": ("scene.radius is [1, 2, 3]", "2 numbers"),
    "scene: {radius: {gauss: [1, 2]}}": ("scene.radius is {'gauss': [1, 2]}", "normal"),
    "scene: {radius: {log_uniform: [0, 2]}}": ("log_uniform", "above 0"),
    "scene: {radius: {normal: [1, 0.1]}}": ("scene.radius is", "0.001 or more for every value drawn"),
    "scene: {radius: 7}": ("scene.radius may be 7 m", "must fit a box"),
    "scene: {elasticity: 1.5}": ("scene.elasticity is 1.5", "1 or less"),
    "scene: {gravity: -9.8}": ("scene.gravity is -9.8", "a list of 2 numbers, such as [0, -9.8]"),
    "scene: {ball: 3}": ("scene.ball is not an option", "did you mean balls?"),
    "scene: bounce": ("scene is 'bounce'", "did you mean bouncing?"),
    "look: {name: flatt}": ("look is 'flatt'", "did you mean flat?"),
    "look: 3": ("look is 3", "a name"),
    "video: {frames: 0}": ("video.frames is 0", "1 or more"),
    "video: {frames: true}": ("video.frames is True", "whole number"),
    "video: {width: 1e9}": ("video.width is 1000000000.0", "8192 or less"),
    "video: [64, 64]": ("video is [64, 64]", "a mapping"),
    "vidoe: {frames: 3}": ("vidoe is not a section", "did you mean video?"),
    "physics: {substeps: .nan}": ("physics.substeps is nan", "whole number"),
    "physics: {mixing: average}": ("physics.mixing is 'average'", "one of product"),
    "physics: {precision: 64}": ("physics.precision is 64", "one of float32, float64"),
    "splits: {train: {}, test: {physics: {precision: float64}}}": (
        "splits.test.physics.precision is 'float64', but must be that of all splits, float32",
    ),
    "storage: {codec: mp4}": ("storage.codec is 'mp4'", "one of gzip"),
    "camera: {center: [1]}": ("camera.center is [1]", "a list of 2 numbers"),
    "seed: -1": ("seed is -1", "0 to 2**63 - 1"),
    "seed: 9223372036854775808": ("seed is 9223372036854775808", "0 to 2**63 - 1"),
    "name: a/b": ("name is 'a/b'", "letters"),
    "annotations: {mask: true}": ("annotations.mask is not an option", "did you mean masks?"),
    "annotations: {masks: 2}": ("annotations.masks is 2", "true or false"),
    "annotations: {tracks: {points: 2}}": ("annotations.tracks is {'points': 2}", "a whole number"),
    "annotations: [masks]": ("annotations is ['masks']", "a mapping"),
    "annotations: {a/turn.py: true}": ("an annotation is 'a/turn.py'", "there is no such file"),
    "annotations: {a/turn.py: true, b/turn.py: true}": ("annotations has 2 files named turn.py", "one only"),
    "video: {frames: 3, frames: 4}": ('duplicate key "frames"', "line 1"),
    "video: {frames: [3": ("not valid YAML", "line"),
    "- 1": ("holds list", "mapping of sections"),
    "a.b": ("holds str", "mapping of sections"),
    "video: 0": ("video is 0", "a mapping"),
    "{[1, 2]: 3}": ("(1, 2) is not a section",),
    "annotations: {masks: yes}": ("annotations.masks is 'yes'", "must be true or false"),
    "video: {frames: !!int 3}": ("not valid YAML", "tags such as !!binary are not allowed"),
    "video: &v {frames: *v}": ("not valid YAML", "&v contains itself"),
    "video: {frames: 2001-99-99}": ("not valid YAML", "month"),
    "scene: {velocity: [1e40, 0]}": ("scene.velocity is", "number"),
    "scene: {spin: {normal: [0, 1, 6, 7]}}": ("scene.spin is", "within 4 deviations"),
    "scene: {spin: {intersection: [{normal: [0, 3]}, [13.5, 100]]}}": ("scene.spin is", "an intersection that leaves"),
    "scene: {balls: {integer: [1, 10000000000]}}": ("scene.balls is", "between -2**31 and 2**31"),
    "splits: {train: {}, test: {look: {background: 2020-01-01}}}": ("splits.test must hold nothing but texts",),
    "splits: {train: {}, test: {physics: {1: 2020-01-01}}}": ("splits.test must hold nothing but texts",),
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_config_is_one_sentence_that_names_file_field_value_and_range(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    sentence = str(caught.value)
    assert str(path) in sentence
    assert "\n" not in sentence
    for part in BAD[text]:
        assert part in sentence


@pytest.mark.parametrize(
    "text",
    ["physics.substeps", "=3", "physics.substeps=0", "physics..x=1", "nothing.at=1", "video=[1", "video.fps.x=3"],
)
def test_a_bad_override_is_one_sentence(text):
    with pytest.raises(ConfigError):
        load_config(CONFIG, [text])


def test_overrides_reach_every_level():
    config = load_config(
        "bouncing.yaml", ["physics.substeps=8", "scene.gravity=[0, [-12, -4]]", "look.wall_width=0", "name=mine"]
    )
    assert config.physics.substeps == 8
    assert config.scene.options.gravity[1].support == (-12, -4)
    assert (config.look.options.wall_width, config.name) == (0, "mine")


def test_scientific_notation_is_a_number():
    assert parse_yaml("[1e-3, 1E6, -2e+1, 1.5e3]", "here") == [1e-3, 1e6, -20.0, 1500.0]


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=20), inner, max_size=4),
    max_leaves=20,
)


@settings(deadline=None)
@given(st.dictionaries(st.text(), PLAIN | st.sampled_from(["yes", "on", "1e-3", "017", "2001-01-01", "~", "=", "<<"])))
def test_plain_values_survive_yaml_in_their_order(values):
    again = parse_yaml(yaml_text(values), "its text")
    assert again == values
    assert list(again) == list(values)


@pytest.mark.parametrize("name", plugins.config_names())
def test_a_resolved_config_means_the_same(name):
    config = load_config(name)
    again = load_config(parse_yaml(config.text(), "its text"))
    assert again.plain() == config.plain()
    assert again.sha256() == config.sha256()


def test_the_hash_sees_every_option_but_not_the_seed():
    config = load_config(CONFIG)
    assert load_config({**CONFIG, "seed": 5}).sha256() == config.sha256()
    assert load_config(tiny_config(physics={"damping": 0.1})).sha256() != config.sha256()
    assert load_config(tiny_config(scene={"friction": 0.1})).sha256() != config.sha256()


def test_a_licence_is_part_of_the_recipe_only_where_there_is_one() -> None:
    plain, licensed = load_config("bouncing.yaml"), load_config("bouncing.yaml", ["licence=cc-by-4.0"])
    assert "licence" not in plain.plain()
    assert load_config("bouncing.yaml", ["licence=null"]).sha256() == plain.sha256() != licensed.sha256()
    assert load_config(licensed.plain()) == licensed
    assert resolved(licensed)["licence"] == "cc-by-4.0"
    for text in ("1", "[MIT]", '"two\\nlines"', "x" * 101):
        with pytest.raises(ConfigError, match=r"licence is .*, but must be the name of a licence"):
            load_config("bouncing.yaml", [f"licence={text}"])


@given(st.integers(0, MAX_SEED))
def test_every_seed_is_kept(seed):
    assert load_config({**CONFIG, "seed": seed}).seed == seed


def test_every_option_says_its_default_unit_and_meaning_and_is_listed():
    declared = [kind for kind in vars(sections).values() if getattr(kind, "__module__", "") == sections.__name__]
    for kind in ("scene", "look", "annotation"):
        declared += [plugins.load(kind, name).options for name in plugins.names(kind)]
    single = [field for field in declared if isinstance(field, dataclasses.Field)]
    fields = single + [f for kind in declared if dataclasses.is_dataclass(kind) for f in dataclasses.fields(kind)]
    assert len(fields) > 300
    listed = listing()
    for field in fields:
        option = field.metadata["option"]
        assert field.default is not dataclasses.MISSING, field.name
        assert option.meaning in listed, field.name
        assert option.allowed, field.name
        assert option.unit or option.kind in (bool, str, int), field.name


def test_each_family_has_a_config_of_its_name():
    for name in plugins.names("scene"):
        assert load_config(f"{name}.yaml").scene.name == name


def test_configs_hold_the_numbers_of_their_page():
    def balls(name: str) -> tuple[float, float]:
        return load_config(name).scene.options.balls.support

    def shape(name: str) -> tuple[int, int, int]:
        video = load_config(name).video
        return video.frames, video.height, video.width

    assert balls("bouncing.yaml") == (3, 8)
    assert balls("benchmark.yaml") == (8, 8)
    assert shape("bouncing.yaml") == shape("benchmark.yaml") == (64, 64, 64)
    for name in ("uniform_motion", "collision", "parabola"):
        config = load_config(f"phyworld_{name}.yaml")
        assert shape(f"phyworld_{name}.yaml") == (32, 256, 256)
        assert len(config.splits) > 1
    low, high = load_config("billiards.yaml").scene.options.rows.support
    assert (low * (low + 1) / 2, high * (high + 1) / 2) == (6, 15)
    pile = load_config("pile.yaml").scene.options
    supports = [getattr(pile, name).support for name in ("discs", "boxes", "capsules")]
    assert (sum(low for low, _ in supports), sum(high for _, high in supports)) == (6, 20)


def test_a_later_option_is_written_only_where_it_is_changed():
    """So that datasets of configs that lack it keep their identity."""
    config, wide = load_config({}), load_config({"physics": {"precision": "float64"}})
    assert "precision" not in config.text()
    assert load_config({"physics": {"precision": "float32"}}) == config
    assert load_config(wide.plain()) == wide != config
    assert wide.sha256() != config.sha256()


def test_defaults_are_those_of_the_pages():
    physics = load_config({}).physics
    assert physics.max_step == 1 / 240
    assert (physics.contact_hertz, physics.contact_damping_ratio, physics.push_speed) == (30, 2, 3)
    look = load_config({}).look.options
    assert (look.wall_width, look.contrast) == (1.5, 120)
    engine = Ray()
    assert (engine.workers, engine.gpus_per_worker, engine.cpus_per_worker, engine.retries) == (None, 1, None, 3)


@pytest.mark.parametrize("quantity", ["density", "elasticity", "color", "gravity"])
def test_a_quantity_has_one_unit_and_range_in_all_families(quantity):
    options = [
        field.metadata["option"]
        for family in plugins.names("scene")
        for field in dataclasses.fields(load_config(f"{family}.yaml").scene.contract.options)
        if field.name == quantity or field.name.endswith(f"_{quantity}")
    ]
    assert len({(option.unit, option.low, option.high, option.draw) for option in options}) == 1


def test_a_family_of_ones_own_is_a_file(tmp_path):
    own = tmp_path / "own.py"
    own.write_text("from gen2d.scenes.bouncing import *\nfrom gen2d.scenes.bouncing import Options\n")
    config = load_config({"scene": {"name": str(own), "balls": 2}})
    assert config.scene.options.balls.support == (2, 2)
    before = config.sha256()
    own.write_text(own.read_text() + "# changed\n")
    assert load_config({"scene": {"name": str(own), "balls": 2}}).sha256() != before
    own.write_text("import nothing_at_all")
    with pytest.raises(ConfigError, match="cannot be run"):
        load_config({"scene": str(own)})
    with pytest.raises(ConfigError, match="no such file"):
        load_config({"scene": str(tmp_path / "other.py")})


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6))
def test_a_range_keeps_its_ends(low, width):
    assert parse([low, low + width]).support == (low, low + width)


def test_a_folder_does_not_hide_a_config_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("bouncing", "mine"):
        (tmp_path / name).mkdir()
    assert plugins.find_config("bouncing") == plugins.config_folder() / "bouncing.yaml"
    with pytest.raises(ConfigError, match="'mine', which is a folder; name a YAML file"):
        plugins.find_config("mine")
