"""Every plug-in there is, of each kind, declares what a config, `list` and datasets need, or is refused."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from gen2d.cli.report import plugins as plugins_text
from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.config.reading import parse_yaml
from gen2d.core.errors import ConfigError
from gen2d.core.schema import Field
from gen2d.plugin import Annotation, Export, Family, Look, PlainOptions, option

ALL = [(kind, name) for kind in plugins.KINDS for name in plugins.names(kind)]
IN_A_CONFIG = [(kind, name) for kind, name in ALL if kind != "export"]


def asking(kind: str, name: str) -> dict[str, Any]:
    """A config that asks for a plug-in."""
    if kind != "annotation":
        return {kind: name}
    contract = plugins.load(kind, name)
    return {"annotations": {name: contract.usual}} | ({"look": "studio"} if contract.needs else {})


@pytest.mark.parametrize(("kind", "name"), ALL)
def test_a_plug_in_says_what_it_is_and_is_listed(kind: str, name: str) -> None:
    contract = plugins.load(kind, name)
    assert isinstance(contract, plugins.KINDS[kind][1])
    text = plugins_text(name)
    assert plugins.summary(kind, name)
    assert f" {name}: {plugins.summary(kind, name)}" in text
    if kind == "export":
        assert contract.fields
        return
    where = f"annotations.{name}" if kind == "annotation" else kind
    single = isinstance(contract.options, dataclasses.Field)
    declared = (
        {where: contract.options} if single else {f"{where}.{f.name}": f for f in dataclasses.fields(contract.options)}
    )
    for path, field in declared.items():
        assert f"  {path} " in text
        assert field.metadata["option"].meaning in text


@pytest.mark.parametrize(("kind", "name"), IN_A_CONFIG)
def test_a_config_that_asks_for_a_plug_in_means_the_same_when_it_is_read_again(kind: str, name: str) -> None:
    config = load_config(asking(kind, name))
    again = load_config(parse_yaml(config.text(), "its text"))
    assert again == config
    assert again.sha256() == config.sha256() != load_config({"scene": "billiards", "look": "phyworld"}).sha256()
    if kind == "annotation":
        assert name in config.annotations.enabled
        assert name not in load_config({}).annotations.enabled
        fields = plugins.load(kind, name).fields.values()
        assert fields
        assert all(field.per_video for field in fields)


# ---- What is refused

REFUSED = {
    "": "but has no {0}: it must end with {0} = {1}(...)",
    "{0} = 3": "but its {0} is of type int: it must end with {0} = {1}(...)",
    "{0} = plugin.{2}": "but its {0} is of type type: it must end with {0} = {1}(...)",
    "{0} = plugin.{1}()": "which cannot be run (TypeError(",
    "1 +": "which cannot be run (SyntaxError(",
}


@pytest.mark.parametrize("text", REFUSED)
@pytest.mark.parametrize(("kind", "contract"), [(kind, contract) for kind, (_, contract) in plugins.KINDS.items()])
def test_a_file_that_declares_nothing_is_one_sentence(kind: str, contract: type, text: str, tmp_path: Path) -> None:
    words = contract.__name__.upper(), contract.__name__, "Export" if contract is Family else "Family"
    path = tmp_path / "mine.py"
    path.write_text("from gen2d import plugin\n" + text.format(*words))
    with pytest.raises(ConfigError) as caught:
        plugins.load(kind, str(path), "here", path.read_bytes())
    assert str(caught.value).startswith(f"here is '{path}', {REFUSED[text].format(*words)}")
    assert "\n" not in str(caught.value)


@dataclasses.dataclass(frozen=True)
class Plain:
    """A dataclass with a field that is no option."""

    width: float = 1.0


@dataclasses.dataclass(frozen=True)
class Empty:
    """No options."""


@dataclasses.dataclass(frozen=True)
class Hiding(PlainOptions):
    """An option with the name of an attribute of its base class."""

    grounds: float = option(1.0, float, "1", "one")  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]


def nothing(*_: Any) -> Any:
    """What a plug-in's functions are here."""


WRONG: dict[str, tuple[type, dict[str, Any]]] = {
    "Family.options is <class": (Family, {"options": Plain, "layout": nothing, "sample": nothing}),
    "Family.layout is 3, but must be": (Family, {"options": Empty, "layout": 3, "sample": nothing}),
    "Family.derived is [], but must be": (
        Family,
        {"options": Empty, "layout": nothing, "sample": nothing, "derived": []},
    ),
    "Look.options is {}, but must be": (Look, {"options": {}, "paint": nothing, "margin": nothing}),
    "Look.options has an option grounds, which its base class uses": (
        Look,
        {"options": Hiding, "paint": nothing, "margin": nothing},
    ),
    "Annotation.options is False, but must be": (Annotation, {"options": False, "fields": {}, "annotate": nothing}),
    "Annotation.owners is 1, but must be": (
        Annotation,
        {"options": option(False, bool, "", "it"), "fields": {}, "annotate": nothing, "owners": 1},
    ),
    "Export.fields is 'frames', but must be": (Export, {"fields": "frames", "write": nothing}),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_member_of_a_wrong_type_is_refused_where_it_is_declared(message: str) -> None:
    contract, members = WRONG[message]
    with pytest.raises(TypeError) as caught:
        contract(**members)
    assert message in str(caught.value)


def test_drawn_options_of_an_annotation_are_refused() -> None:
    with pytest.raises(TypeError, match="draws nothing"):
        Annotation(
            options=option([0, 1], float, "1", "it", draw=True),
            fields={"it": Field("float32", "n", "1", "it")},
            annotate=nothing,
        )
