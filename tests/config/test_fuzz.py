"""Whatever stands in a config, it is a config, or one sentence: no traceback, no hang, nothing longer than a screen."""

import signal
from collections.abc import Callable, Iterator
from typing import Any

import fuzz
import pytest
from tiny import run_main, sentences

from gen2d.config.config import Config, from_mapping, load_config
from gen2d.config.reading import parse_yaml
from gen2d.core.errors import LONGEST, ConfigError

SECONDS = 90  # the slowest text takes 7 s on an idle machine


class TookTooLong(BaseException):
    """What the alarm raises, wherever the program is."""


@pytest.fixture(autouse=True)
def _alarm() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise TookTooLong

    before = signal.signal(signal.SIGALRM, ring)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def is_config(read: Callable[[], Config]) -> bool:
    """Whether it is one; if not, the error must be one sentence."""
    signal.alarm(SECONDS)
    try:
        read()
    except ConfigError as error:
        sentence = str(error)
        assert sentence.isprintable()
        assert 10 < len(sentence) <= LONGEST + 10
        return False
    finally:
        signal.alarm(0)
    return True


@pytest.mark.parametrize("text", fuzz.TEXTS, ids=lambda text: repr(text[:20]))
def test_a_text_is_a_config_or_one_sentence(text: str) -> None:
    is_config(lambda: from_mapping(parse_yaml(text, "t.yaml"), "t.yaml"))


def of_mapping(mapping: Any) -> Callable[[], Config]:
    return lambda: load_config(mapping)


@pytest.mark.parametrize("count", [300, pytest.param(2000, marks=pytest.mark.slow)])
def test_a_config_with_something_changed_is_a_config_or_one_sentence(count: int) -> None:
    found = [is_config(of_mapping(mapping)) for mapping in fuzz.changed_configs(count, seed=count)]
    assert 0 < sum(found) < count / 2  # some changes do no harm, most do


def test_the_command_line_says_it_in_one_sentence_too(tmp_path: Any) -> None:
    for number, text in enumerate(fuzz.TEXTS):
        path = tmp_path / f"{number}.yaml"
        path.write_text(text, encoding="utf-8")
        signal.alarm(SECONDS)
        try:
            from_mapping(parse_yaml(text, str(path)) or {}, str(path))
        except ConfigError:
            done = run_main("--config", path, "--n", 1, "--out", tmp_path / "out")
            assert (done.returncode, done.stdout, len(sentences(done.stderr))) == (2, "", 1)
            assert str(path) in done.stderr
    assert not (tmp_path / "out").exists()
