"""A field that is not stored is named with the option that makes it, or with the closest names of its group."""

from pathlib import Path
from typing import Any

import jax
import pytest
import synthetic

from gen2d.config.config import load_config
from gen2d.core.errors import ConfigError
from gen2d.loading import dataset as loader
from gen2d.loading.fields import MAKERS, RENDERED, suggestion
from gen2d.programs.rollout import Rollout

SMALL = {"video": {"frames": 4, "height": 16, "width": 16}, "scene": {"name": "bouncing", "balls": 2}}


def fields_of(*overrides: str) -> list[str]:
    return list(Rollout(load_config(SMALL, overrides), jax.devices()[:1]).schema.fields)


@pytest.mark.parametrize("option", sorted(set(MAKERS.values()) - {"storage.frames=video"}))
def test_the_option_that_is_named_makes_the_field(option: str) -> None:
    extra = ["annotations.contacts=4"] if "captions" in option else []
    if "matched" in option:
        extra = ["scene.gravity=[0, [-20, 0]]"]
    if option.removeprefix("annotations.").removesuffix("=true") in ("depth", "normals", "shadow"):
        extra = ["look=studio"]
    choice = f"{option}=gravity" if "matched" in option else option
    plain, made = fields_of(*extra), fields_of(choice, *extra)
    new = [name for name in made if name not in plain]
    assert sorted(new) == sorted(name for name, maker in MAKERS.items() if maker == option)
    assert "frames" not in fields_of("storage.frames=none")
    for name in new:
        said = suggestion(name, plain)
        assert option in said
        assert ("render={} in gen2d.open renders it" in said) == name.startswith(RENDERED)


NAMES = ["states/position", "states/velocity", "objects/mass", "objects/present", "factors/mass", "index"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("states/postion", ": did you mean 'states/position'?"),
        ("objects/mas", ": did you mean 'objects/mass'?"),
        ("factors/mas", ": did you mean 'factors/mass'?"),
        ("state/position", ": did you mean 'states/position'?"),
        ("object/presnt", ": did you mean 'objects/present'?"),
        ("states/colour", ": it has states/position, states/velocity"),
        (
            "masks/instnce",
            ": did you mean 'masks/instance', which is not stored: render={} in gen2d.open renders it, and the option "
            "annotations.masks=true of gen2d.generate stores it",
        ),
        ("matched/*", ", which is not stored: the option matched.change of gen2d.generate stores it"),
        ("energy/heat", f": it has {', '.join(NAMES)}; annotations.energy=true makes others of energy/"),
        ("zebra", f": it has {', '.join(NAMES)}"),
    ],
)
def test_close_names_are_those_of_the_group(name: str, said: str) -> None:
    assert suggestion(name, NAMES) == said


def test_a_long_list_is_cut() -> None:
    assert suggestion("zebra", [f"f{i}" for i in range(30)]).endswith(", f11 and 18 more")


def test_opening_says_it(tmp_path: Path) -> None:
    root: Any = synthetic.make(synthetic.small(tmp_path / "toy", {"train": 4})).root
    with pytest.raises(ConfigError) as caught:
        loader.open(root, fields=["boxes/visible"])
    assert str(caught.value) == (
        f"{root} has no field 'boxes/visible', which is not stored: render={{}} in gen2d.open renders it, and the "
        "option annotations.boxes=true of gen2d.generate stores it"
    )
