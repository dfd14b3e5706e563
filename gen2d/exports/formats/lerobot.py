"""LeRobot's dataset format, version 3.0: an episode per video, which `lerobot` itself reads.

    data/chunk-000/file-000.parquet         a row per frame: the fields that have a value per frame
    videos/observation.images.frames/...    a film per episode
    meta/info.json, stats.json, tasks.parquet                   features, statistics, tasks
    meta/episodes/chunk-000/file-000.parquet                    a row per episode, with its own statistics

`observation.state` is the vector of all states; each field of a value per frame also has a column of its own, such as
`observation.states.position` [slot, (x, y)]. Fields of a value per video, such as factors, are columns `gen2d/NAME` of
the episodes. The task of an episode is its caption, where captions are stored. There are no actions.
Needs PyArrow and PyAV.
"""

import json
import math
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from gen2d.plugin import Batch, ConfigError, Export, Field, Source, arrays, films, tables
from gen2d.plugin import dataset as loader

VERSION = "v3.0"
EPISODES = "meta/episodes"
CAMERA, STATE = "observation.images.frames", "observation.state"
STATES = ("states/position", "states/velocity", "states/angle", "states/angular_velocity")
TASK, CAPTION = "Predict the motion of the objects.", "text/short_caption"
CHUNK = 1000  # files in a folder
FILE_BYTES, FILE_VIDEOS = 100 * 2**20, 1000  # about the maximum of a data file, which holds one video at least
GROUP = 64  # videos in a row group
NAMES = "chunk-{chunk_index:03d}/file-{file_index:03d}"
INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")
MOST_AXES = 5  # of an array in `datasets`


# The table of tasks has pandas' metadata, which say that the texts are the index.
_PANDAS = {
    "index_columns": ["__index_level_0__"],
    "columns": [
        {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, field, kind, dtype in [
            ("task_index", "task_index", "int64", "int64"),
            (None, "__index_level_0__", "unicode", "object"),
        ]
    ],
    "column_indexes": [],
    "pandas_version": "2.2.0",
}


def part_videos(source: Source) -> int:
    """Number of videos in a data file."""
    size = sum(math.prod(_shape(source, field)) * 8 for field in _frame_fields(source).values()) * source.sizes["T"]
    return max(1, min(FILE_VIDEOS, FILE_BYTES // max(1, size)))


def check(source: Source) -> None:
    """Raise ConfigError for frames that the codec or the format cannot store, UserError without PyArrow or PyAV."""
    tables.pyarrow()
    if source.fps != int(source.fps):
        raise ConfigError(f"video.fps is {source.fps:g}, but must be a whole number for lerobot")
    arrays.check_films(source, f"lerobot with the codec {source.codec}", films.CODECS[source.codec])


def write(target: Path, source: Source) -> None:
    """Write a data file, the films of its episodes, and a file with their rows."""
    codec, fields, arrow = films.CODECS[source.codec], _frame_fields(source), tables.pyarrow()
    number, episodes = source.places.start // part_videos(source), []
    path = _file(target / "data", number, ".parquet")
    schema = arrow.schema([(name, kind) for name, kind in _types(source, fields).items()])
    episode_of = {source.key(number): place for place, number in zip(source.places, source.numbers, strict=True)}

    def encoded(key: str, video: Batch) -> Batch:
        film = _file(target / "videos" / CAMERA, episode_of[key], codec.suffix)
        codec.write(film, video["frames"], source.fps)
        return arrays.without_frames(video) | {CAMERA: _histogram(video["frames"])}

    with arrow.parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        videos, places = source.map(encoded), iter(source.places)
        while group := list(islice(videos, GROUP)):
            own = list(islice(places, len(group)))
            rows = _rows(source, fields, group, own)
            table = arrow.Table.from_arrays([tables.nested(values) for values in rows.values()], schema=schema)
            writer.write_table(table)
            episodes += [_episode(source, place, video) for place, video in zip(own, group, strict=True)]
            source.advance(len(group))
    arrow.parquet.write_table(arrow.Table.from_pylist(episodes), _file(target / EPISODES, number, ".parquet"))


def finish(target: Path, source: Source) -> None:
    """Write the files of meta/ that are of all episodes, and the card."""
    arrow, fields, frames = tables.pyarrow(), _frame_fields(source), source.sizes["T"]
    statistics, tasks = _Statistics(), dict[str, int]()
    for video in _videos(source):
        statistics.add(_columns(source, video, fields))
        tasks.setdefault(_task(video), len(tasks))
    about, meta = _info(source, fields, len(source), len(tasks)), target / "meta"
    meta.mkdir(exist_ok=True)
    (meta / "info.json").write_text(json.dumps(about, indent=4) + "\n")
    (meta / "stats.json").write_text(json.dumps(statistics.as_json() | _frame_statistics(source), indent=4) + "\n")
    table = arrow.table({"task_index": list(tasks.values()), "__index_level_0__": list(tasks)})
    arrow.parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(_PANDAS)}), meta / "tasks.parquet")
    text = f"{len(source)} episodes of {frames} frames for `lerobot`: `LeRobotDataset(REPOSITORY, root=FOLDER)`."
    tables.write_card(target, source, [*source.fields], "data/*/*.parquet", text, ("LeRobot",))


def _file(folder: Path, number: int, suffix: str) -> Path:
    """Path of a file by its number, in a folder that is there."""
    path = folder / f"{NAMES.format(chunk_index=number // CHUNK, file_index=number % CHUNK)}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _frame_fields(source: Source) -> dict[str, Field]:
    """The fields that have a value per frame, but images."""
    fields = {name: field for name, field in source.fields.items() if field.axes.split()[1:2] == ["T"]}
    return {name: field for name, field in fields.items() if not field.is_image and not field.is_text}


def _column(name: str) -> str:
    return f"observation.{name.replace('/', '.')}"


def _shape(source: Source, field: Field) -> tuple[int, ...]:
    """Shape of a frame's value; a single value has the shape (1,)."""
    return field.shape(source.sizes)[1:] or (1,)


def _state(video: Batch) -> np.ndarray:
    """All states of each frame in a vector, float32 [T, values]."""
    parts = [video[name] for name in STATES if name in video]
    count = len(next(iter(parts))) if parts else 0
    flat = [part.reshape(count, -1) for part in parts]
    return np.concatenate(flat, axis=1).astype(np.float32) if flat else np.zeros((0, 0), np.float32)


def _state_names(source: Source) -> list[str]:
    """Names of the values of `observation.state`, such as position.3.x."""
    names = []
    for name in STATES:
        if name in source.fields:
            shape = source.fields[name].shape(source.sizes)[1:]
            ends = (".x", ".y") if len(shape) == 2 else ("",)
            names += [f"{name.split('/')[1]}.{slot}{end}" for slot in range(shape[0]) for end in ends]
    return names


def _features(source: Source, fields: dict[str, Field]) -> dict[str, Any]:
    """LeRobot's features but the film."""
    names, features = _state_names(source), dict[str, Any]()
    if names:
        features[STATE] = {"dtype": "float32", "shape": [len(names)], "names": names}
    for name, field in fields.items():
        features[_column(name)] = {"dtype": field.dtype, "shape": list(_shape(source, field)), "names": None}
    dtypes = ("float32", "int64", "int64", "int64", "int64")
    return features | {
        name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in zip(INDICES, dtypes, strict=True)
    }


def _types(source: Source, fields: dict[str, Field]) -> dict[str, Any]:
    """Arrow's type of each column of the data."""
    arrow, types = tables.pyarrow(), dict[str, Any]()
    for name, feature in _features(source, fields).items():
        kind = arrow.from_numpy_dtype(np.dtype(feature["dtype"]))
        for _ in feature["shape"] if feature["shape"] != [1] else ():
            kind = arrow.list_(kind)
        types[name] = kind
    return types


def _rows(source: Source, fields: dict[str, Field], group: list[Batch], places: list[int]) -> dict[str, np.ndarray]:
    """Columns of the frames of these videos."""
    frames, rows = source.sizes["T"], dict[str, np.ndarray]()
    if _state_names(source):
        rows[STATE] = np.concatenate([_state(video) for video in group])
    for name in fields:
        rows[_column(name)] = np.concatenate([video[name] for video in group])
    frame = np.tile(np.arange(frames), len(group))
    episode = np.repeat(np.array(places), frames)
    # The tasks are numbered by their first episodes, as in `finish`, which alone knows them all.
    numbers = _task_numbers(source) if CAPTION in source.fields else None
    task = np.zeros_like(frame) if numbers is None else np.array([numbers[place] for place in episode.tolist()])
    timestamps = (frame / source.fps).astype(np.float32)
    indices = (timestamps, frame, episode, episode * frames + frame, task)
    rows |= dict(zip(INDICES, indices, strict=True))
    return {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in rows.items()}


def _task_numbers(source: Source) -> list[int]:
    """Number of the task of each episode of the whole export."""
    split = source.ds.options.split
    ds = loader.open(source.ds.root, split, (CAPTION,), snapshot=source.ds.snapshot)
    numbers = range(len(ds)) if source.selection is None else source.selection
    tasks = dict[str, int]()
    return [tasks.setdefault(_task(ds[int(number)]), len(tasks)) for number in numbers]


def _videos(source: Source) -> Iterator[Batch]:
    """All videos without images."""
    stored = source.ds.manifest.fields
    names = [name for name in source.fields if name in stored and not stored[name].is_image]
    ds = loader.open(source.ds.root, source.ds.options.split, names, snapshot=source.ds.snapshot)
    numbers = iter(source.numbers)
    while group := list(islice(numbers, GROUP)):
        yield from ds.__getitems__(group)


def _task(video: Batch) -> str:
    return bytes(video[CAPTION]).decode() or TASK if CAPTION in video else TASK


def _episode(source: Source, place: int, video: Batch) -> dict[str, Any]:
    """Row of an episode, from the video with the histogram of its frames in their place."""
    frames, data = source.sizes["T"], place // part_videos(source)
    row = {
        "episode_index": place,
        "tasks": [_task(video)],
        "length": frames,
        "data/chunk_index": data // CHUNK,
        "data/file_index": data % CHUNK,
        "dataset_from_index": place * frames,
        "dataset_to_index": (place + 1) * frames,
        f"videos/{CAMERA}/chunk_index": place // CHUNK,
        f"videos/{CAMERA}/file_index": place % CHUNK,
        f"videos/{CAMERA}/from_timestamp": 0.0,
        f"videos/{CAMERA}/to_timestamp": frames / source.fps,
        f"{EPISODES}/chunk_index": data // CHUNK,
        f"{EPISODES}/file_index": data % CHUNK,
    }
    for name, field in source.fields.items():
        if "T" not in field.axes.split():
            value = video[name]
            row[f"gen2d/{name}"] = bytes(value).decode() if field.is_text and not value.ndim else _plain(value)
    for name, values in _episode_statistics(source, video).items():
        row |= {f"stats/{name}/{key}": value for key, value in values.items()}
    return row


def _episode_statistics(source: Source, video: Batch) -> dict[str, Any]:
    """Statistics of an episode, of the frames and of columns of one axis; LeRobot reads those of no others back."""
    statistics, fields = _Statistics(), _frame_fields(source)
    statistics.add(_columns(source, video, [name for name in fields if len(_shape(source, fields[name])) == 1]))
    return statistics.as_json() | {CAMERA: _camera_statistics(video[CAMERA], source.sizes["T"])}


def _columns(source: Source, video: Batch, names: Iterable[str]) -> Batch:
    """Values of a video's frames by LeRobot's names: the vector of all states, and these fields."""
    state = {STATE: _state(video)} if _state_names(source) else {}
    return state | {_column(name): video[name] for name in names}


def _histogram(frames: np.ndarray) -> np.ndarray:
    """Number of pixels of each grey level, by channel [3, 256]."""
    return np.stack([np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)])


def _camera_statistics(histogram: np.ndarray, frames: int) -> dict[str, Any]:
    """Statistics of an episode's frames, from 0 to 1."""
    levels, share = np.arange(256) / 255, histogram / histogram.sum(-1, keepdims=True)
    mean = share @ levels
    ends = [[levels[np.flatnonzero(counts)[end]] for counts in histogram] for end in (0, -1)]
    std = np.sqrt((share * (levels - mean[:, None]) ** 2).sum(-1))
    values = {"min": ends[0], "max": ends[1], "mean": mean, "std": std}
    return {key: [[[float(value)]] for value in channels] for key, channels in values.items()} | {"count": [frames]}


def _plain(value: np.ndarray) -> Any:
    if value.dtype.kind == "S":
        return [text.decode() for text in value.tolist()]
    return value.tolist()


def _info(source: Source, fields: dict[str, Field], episodes: int, tasks: int) -> dict[str, Any]:
    """Contents of info.json."""
    (height, width), fps = source.frame_size, int(source.fps)
    codec = films.CODECS[source.codec]
    film = {"video.height": height, "video.width": width, "video.codec": source.codec, "video.fps": fps}
    film |= {"video.pix_fmt": codec.pixels, "video.is_depth_map": False, "video.channels": 3, "has_audio": False}
    camera = {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": film}
    return {
        "codebase_version": VERSION,
        "robot_type": "gen2d",
        "total_episodes": episodes,
        "total_frames": episodes * source.sizes["T"],
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{NAMES}.parquet",
        "video_path": f"videos/{{video_key}}/{NAMES}{codec.suffix}",
        "features": {CAMERA: camera, **_features(source, fields)},
    }


class _Statistics:
    """Least, largest and mean value, standard deviation and number of frames of each column."""

    def __init__(self) -> None:
        self.moments: dict[str, list[Any]] = {}

    def add(self, columns: Batch) -> None:
        for name, column in columns.items():
            values = column.astype(np.float64)
            own = [values.min(0), values.max(0), values.sum(0), (values**2).sum(0), len(values)]
            old = self.moments.get(name)
            if old is not None:
                own = [np.minimum(old[0], own[0]), np.maximum(old[1], own[1]), *(old[k] + own[k] for k in (2, 3, 4))]
            self.moments[name] = own

    def as_json(self) -> dict[str, Any]:
        return {
            name: {
                "min": np.atleast_1d(least).tolist(),
                "max": np.atleast_1d(largest).tolist(),
                "mean": np.atleast_1d(total / count).tolist(),
                "std": np.atleast_1d(np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0))).tolist(),
                "count": [count],
            }
            for name, (least, largest, total, squares, count) in self.moments.items()
        }


def _frame_statistics(source: Source) -> dict[str, Any]:
    """Statistics of the frames, from 0 to 1, as the manifest has them."""
    stats = source.ds.manifest.stats[source.ds.options.split].get("frames")
    if stats is None:
        return {}
    channels = {key: [[[value / 255]] for value in stats[key] or []] for key in ("min", "max", "mean", "std")}
    return {CAMERA: channels | {"count": [len(source) * source.sizes["T"]]}}


EXPORT = Export(
    fields=("frames", "*"),
    write=write,
    check=check,
    separate=True,
    part_videos=part_videos,
    finish=finish,
    codecs=("h264", "av1", "mp4v"),
    loss="without images other than frames",
)
