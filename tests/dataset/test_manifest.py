"""The manifest: values that the generator cannot have written are refused in a sentence, whatever their hash says."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import forged
import pytest
import synthetic

from gen2d.core.errors import DamagedError
from gen2d.dataset.manifest import read_manifest

HASH = "0" * 64
LARGE = {"dtype": "float64", "axes": "n T H W 1000000 1000", "shape": [5, 8, 8, 10**6, 1000]}
IMPOSSIBLE: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "a file outside": (lambda plain: plain["files"].update({"../x": HASH}), "a name in files is '../x'"),
    "a file elsewhere": (
        lambda plain: plain["files"].update({"plugins/look/a.py/../../../x": HASH}),
        r"a name in files is 'plugins/look/a\.py/",
    ),
    "a hash": (lambda plain: plain["files"].update({"config.yaml": "0" * 63}), r"files\.config\.yaml is '000"),
    "a table elsewhere": (
        lambda plain: plain["tables"]["train"].update(file="../train-3.npy"),
        r"tables\.train\.file is '\.\./train-3\.npy', but must be one of index/train-3\.npy",
    ),
    "shards": (lambda plain: plain["tables"]["train"].update(shards=2), r"tables\.train\.shards is 2"),
    "a large field": (
        lambda plain: plain["fields"]["masks/instance"].update(LARGE),
        r"fields\.masks/instance is \(.*, but must be at most 68719476736 bytes a video",
    ),
    "a shape": (lambda plain: plain["fields"]["states/angle"].update(shape=[5, 4]), r"states/angle\.shape is \[5, 4\]"),
    "a type": (
        lambda plain: plain["fields"]["states/angle"].update(dtype="object"),
        r"states/angle\.dtype is 'object'",
    ),
    "an axis": (lambda plain: plain["fields"]["states/angle"].update(axes="n T Q"), r"states/angle\.axes is 'n T Q'"),
    "a truth": (lambda plain: plain.update(seed=True), "seed is True, but must be a whole number"),
    "a fraction": (lambda plain: plain.update(videos_per_shard=8.0), "videos_per_shard is 8.0"),
    "a terminal's cursor": (lambda plain: plain.update(licence="\x1b[2J"), "licence is .*, but must be printable text"),
    "no videos": (lambda plain: plain["splits"].update(train=0), r"splits\.train is 0"),
    "a name": (lambda plain: plain["splits"].update({"../x": 3}), "a split's name is '../x'"),
    "a constant": (lambda plain: plain["constants"].update(time=[0, 1]), r"constants\.time is \[0, 1\]"),
    "frames": (lambda plain: plain["config"].update(splits={"train": {"frames": 6}}), r"splits\.train\.frames is 6"),
    "infinity": (lambda plain: plain.update(fps=1e301), "fps is 1e\\+301, but must be a finite number"),
    "no rate": (lambda plain: plain.update(fps=0), "fps is 0.0, but must be above 0"),
    "a chunk": (lambda plain: plain.update(chunk_frames=2), "chunk_frames is 2, but must be a divisor of the 5 frames"),
    "a missing part": (lambda plain: plain.pop("stats"), "it has no stats"),
}


@pytest.mark.parametrize("value", IMPOSSIBLE)
def test_a_manifest_with_an_impossible_value_is_refused(tmp_path: Path, value: str) -> None:
    synthetic.make(synthetic.dataset(tmp_path, train=3))
    change, sentence = IMPOSSIBLE[value]

    def changed(plain: dict[str, Any]) -> None:
        change(plain)

    forged.seal(tmp_path, changed)
    with pytest.raises(DamagedError, match=rf"is not a valid manifest: .*{sentence}") as caught:
        read_manifest(tmp_path)
    assert f"{caught.value}".isprintable()
