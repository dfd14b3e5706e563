"""Code that comes with a dataset runs only if each file of it is trusted, by this user and nobody else."""

import os
from pathlib import Path

import pytest

from gen2d.config import trust
from gen2d.core.errors import ConfigError, UntrustedError
from gen2d.storage.sealed import sha256

COPIES = {"plugins/look/a.py": b"a", "plugins/look/b.py": b"b"}
A, B = (sha256(content) for content in COPIES.values())


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path / "gen2d"


def trusted(*given: str) -> bool:
    try:
        trust.check_trusted(COPIES, given, "data")
    except UntrustedError:
        return False
    return True


def test_every_file_must_be_trusted() -> None:
    assert [trusted(*given) for given in ((), (A,), (B,), (A, B))] == [False, False, False, True]
    with pytest.raises(UntrustedError, match=f"data/plugins/look/b.py is code that came with .* say trust='{B}'"):
        trust.check_trusted(COPIES, A, "data")
    trust.check_trusted({}, (), "data")
    trust.check_trusted({"plugins/look/a.py": b"a"}, A, "data")


@pytest.mark.parametrize("given", ["", A[:63], A.upper(), f"{A} ", "yes"])
def test_what_is_no_hash_is_no_trust(given: str) -> None:
    with pytest.raises(ConfigError, match="must be the sha256 of a file, 64 hexadecimal digits"):
        trust.check_trusted(COPIES, given, "data")


def test_what_this_user_has_generated_with_is_trusted_from_then_on(home: Path) -> None:
    mask = os.umask(0)
    try:
        trust.remember(COPIES.values())
    finally:
        os.umask(mask)
    assert trusted()
    content = trust.list_path().read_bytes()
    trust.remember(COPIES.values())
    assert trust.list_path().read_bytes() == content
    assert trust.list_path().stat().st_mode & 0o777 == 0o600
    assert home.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_a_list_that_others_may_write_is_not_read(mode: int) -> None:
    trust.remember(COPIES.values())
    trust.list_path().chmod(mode)
    assert not trusted()
    assert trusted(A, B)


def test_a_list_of_another_user_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    trust.remember(COPIES.values())
    another = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: another)
    assert not trusted()
