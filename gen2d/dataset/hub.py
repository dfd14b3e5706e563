"""The metadata of a dataset card on the Hugging Face Hub: YAML between two lines of dashes at its top."""

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence

from gen2d.dataset.manifest import Manifest
from gen2d.dataset.spec import EARLIER_SCHEMA, shard_name, shard_of

# The task of the Hub that each field serves, if there is one.
TASKS = {
    "frames": "image-to-video",
    "states/position": "time-series-forecasting",
    "masks/instance": "image-segmentation",
    "boxes/visible": "object-detection",
    "tracks/points": "keypoint-detection",
    "text/caption": "text-to-video",
    "text/questions": "visual-question-answering",
}
TAGS = ("gen2d", "video", "physics", "simulation", "synthetic", "world-models")
# Identifiers of the Hub that are SPDX's in small letters; any other licence is 'other', with its name.
LICENCES = (
    *("apache-2.0", "bsd-2-clause", "bsd-3-clause", "mit", "unlicense", "cc0-1.0", "cc-by-4.0", "cc-by-sa-4.0"),
    *("cc-by-nc-4.0", "cc-by-nd-4.0", "cc-by-nc-sa-4.0", "cc-by-nc-nd-4.0", "odbl", "pddl", "cdla-permissive-2.0"),
)
THOUSANDS = ("", "K", "M", "B", "T")


def dataset_metadata(manifest: Manifest) -> str:
    """The metadata of a gen2d dataset, whose shards `datasets.load_dataset` reads as its splits."""
    files = shard_patterns(manifest) if manifest.schema != EARLIER_SCHEMA else {}
    return metadata(manifest.name, sum(manifest.splits.values()), manifest.licence, manifest.fields, files)


def metadata(
    name: str,
    videos: int,
    licence: str,
    fields: Collection[str],
    files: Mapping[str, Sequence[str]],
    tags: Sequence[str] = (),
) -> str:
    """The metadata, from the number of videos, the fields, patterns of the files of each split, and further tags."""
    tasks = [task for field, task in TASKS.items() if field in fields]
    lines = ["---", f"pretty_name: {json.dumps(name)}", *licence_lines(licence)]
    for key, values in (
        ("task_categories", tasks),
        ("size_categories", [size_category(videos)]),
        ("tags", [*TAGS, *tags]),
    ):
        lines += [f"{key}:", *(f"- {value}" for value in values)] if values else []
    if files:
        lines += ["configs:", "- config_name: default", "  data_files:"]
        for split, patterns in files.items():
            lines += [f"  - split: {split}", f"    path: {json.dumps(list(patterns))}"]
    return "\n".join([*lines, "---", ""])


def shard_patterns(manifest: Manifest) -> dict[str, list[str]]:
    """Patterns of the shards of each split, by its name on the Hub, that match the shards of the manifest alone."""
    names, size, patterns = split_names(manifest.splits), manifest.videos_per_shard, {}
    for split, videos in manifest.splits.items():
        whole, rest = divmod(videos, size)
        digits = range(5, max(5, len(str(whole - 1))) + 1) if whole else ()  # of the numbers of whole shards
        own = [shard_name(f"{split}-{'[0-9]' * count}") for count in digits]
        own += [shard_name(shard_of(split, videos - rest, rest, size).name)] if rest else []
        patterns[names[split]] = own
    return patterns


def split_names(splits: Iterable[str]) -> dict[str, str]:
    """The names of splits on the Hub, which allows letters, digits and underscores, by their names here."""
    names: dict[str, str] = {}
    for split in splits:
        name = re.sub(r"\W", "_", split, flags=re.ASCII)
        while name in names.values():
            name += "_"
        names[split] = name
    return names


def size_category(videos: int) -> str:
    """The Hub's word for a number of rows, such as 1K<n<10K."""
    if videos < 1000:
        return "n<1K"
    if videos >= 10**12:
        return "n>1T"
    power = len(str(videos)) - 1

    def short(power: int) -> str:
        return f"{10 ** (power % 3)}{THOUSANDS[power // 3]}"

    return f"{short(power)}<n<{short(power + 1)}"


def licence_lines(licence: str) -> list[str]:
    """The lines of a licence; none if none was chosen."""
    if not licence:
        return []
    if licence.lower() in LICENCES:
        return [f"license: {licence.lower()}"]
    return ["license: other", f"license_name: {json.dumps(licence)}"]
