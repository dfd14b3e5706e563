"""Hostile datasets with valid checksums. A seed selects the kind of attack and its parameters."""

import contextlib
import copy
import hashlib
import json
import os
import random
import shutil
import socket
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import forged
import h5py
import numpy as np
import synthetic

from gen2d.core.schema import Field
from gen2d.dataset.spec import SCHEMA

HUGE = [0, -1, 1, 2**31, 2**32, 2**40, 2**53, 2**63, 2**64, -(2**63), 10**400, 1e308, 0.5]
NAMES = [
    "../x",
    "../../etc/passwd",
    "/etc/passwd",
    "a/b",
    "a\\b",
    "",
    ".",
    "..",
    "a\x00b",
    "x" * 300,
    "con",
    "\x1b[2J",
    "\ud800",
    "a\nb",
    "~/x",
    "$HOME",
    "train ",
    "-rf",
    "ünïcode",
    "train-00000",
    "CANARY",
]
DTYPES = [
    "O",
    "V8",
    "S9999999999",
    ">f4",
    "datetime64[s]",
    "f16",
    "U10",
    "float32,float32",
    "c16",
    "S0",
    "float32 ",
    "B1",
    7,
]
JUNK: list[Any] = [None, True, [], {}, "", "x", 0, -1, 1.5, [1], {"a": 1}, 10**30, "\x1b[31m", [[]], {"": None}]

Kind = Callable[[Path, random.Random], str]
KINDS: dict[str, Kind] = {}


def kind(make: Kind) -> Kind:
    KINDS[make.__name__] = make
    return make


def craft(pristine: Path, target: Path, seed: int) -> str:
    """Copy the dataset, manipulate the copy, and return a description of the change."""
    chance = random.Random(seed)
    shutil.copytree(pristine, target)
    name = sorted(KINDS)[seed % len(KINDS)]
    return f"{name}: {KINDS[name](target, chance)}"


def _names(root: Path, chance: random.Random) -> str:
    name = chance.choice(NAMES)
    return str(root.parent / "canary") if name == "CANARY" else name


# ---- The manifest


@kind
def a_name_in_the_manifest(root: Path, chance: random.Random) -> str:
    name, where = _names(root, chance), chance.choice(["name", "splits", "files", "tables", "fields", "file", "schema"])

    def change(plain: dict[str, Any]) -> None:
        if where in ("name", "schema"):
            plain[where] = name
        elif where == "splits":
            for part in ("splits", "stats", "tables"):
                plain[part][name] = plain[part].pop("train")
        elif where == "files":
            plain["files"][chance.choice([name, f"plugins/scene/{name}.py", f"plugins/splits/{name}/look/a.py"])] = (
                "0" * 64
            )
        elif where == "tables":
            plain["tables"][name] = plain["tables"]["train"]
        elif where == "fields":
            plain["fields"][name] = plain["fields"].pop("states/angle")
        else:
            plain["tables"]["train"]["file"] = chance.choice([name, f"index/{name}", f"index/{name}.npy"])

    forged.seal(root, change)
    return f"{where} {name!r}"


@kind
def a_type_in_the_manifest(root: Path, chance: random.Random) -> str:
    field, dtype = (
        chance.choice(["frames", "states/position", "time", "index", "masks/instance"]),
        chance.choice(DTYPES),
    )
    forged.seal(root, lambda plain: plain["fields"][field].update(dtype=dtype))
    return f"{field} {dtype}"


@kind
def a_number_in_the_manifest(root: Path, chance: random.Random) -> str:
    number = chance.choice(HUGE)
    where = chance.choice(
        ["T", "K", "H", "W", "splits", "videos_per_shard", "chunk_frames", "fps", "seed", "shards", "bytes", "largest"]
    )

    def change(plain: dict[str, Any]) -> None:
        if where in "TKHW":
            plain["sizes"][where] = number
            if chance.random() < 0.7:
                for entry in plain["fields"].values():
                    axes = [axis for axis in entry["axes"].split() if axis != "n"]
                    entry["shape"] = [int(axis) if axis.isdigit() else plain["sizes"][axis] for axis in axes]
        elif where == "splits":
            plain["splits"]["train"] = number
        elif where in ("shards", "bytes", "largest"):
            plain["tables"]["train"][where] = number
        else:
            plain[where] = number

    forged.seal(root, change)
    return f"{where} {number!r:.30}"


@kind
def a_value_in_the_manifest(root: Path, chance: random.Random) -> str:
    changed_path = ""

    def change(plain: dict[str, Any]) -> None:
        nonlocal changed_path
        container: Any = plain
        while True:
            key = chance.choice(list(container)) if isinstance(container, dict) else chance.randrange(len(container))
            changed_path += f".{key}"
            inner = container[key]
            if not isinstance(inner, dict | list) or not inner or chance.random() < 0.3:
                action = chance.random()
                if action < 0.2 and isinstance(container, dict):
                    del container[key]
                else:
                    container[key] = copy.deepcopy(chance.choice(JUNK + HUGE))
                return
            container = inner

    forged.seal(root, change)
    return changed_path


@kind
def a_manifest_that_is_none(root: Path, chance: random.Random) -> str:
    texts = {
        "deep": b"[" * 200_000,
        "deep mapping": b'{"a":' * 200_000,
        "empty": b"",
        "list": b"[]",
        "nan": b'{"a": NaN}',
        "text": b'"x"',
        "large": b" " * 2**25,
        "digits": b'{"a": ' + b"9" * 10**5 + b"}",
        "utf-16": "{}".encode("utf-16"),
        "null": b"null",
        "half": f'{{"schema": "{SCHEMA}"'.encode(),
        "nothing sealed": json.dumps({"schema": SCHEMA}).encode(),
        "zeros": bytes(1000),
    }
    which = chance.choice(sorted(texts))
    (root / "manifest.json").write_bytes(texts[which])
    return which


@kind
def a_constant_in_the_manifest(root: Path, chance: random.Random) -> str:
    values = [
        [0.0] * 10**5,
        [[0.0]],
        [1e308] * 5,
        ["x"] * 5,
        [None] * 5,
        5,
        "time",
        [0.1, 0.2, 0.3, 0.4, "a"],
    ]
    value: Any = chance.choice(values)
    if chance.random() < 0.2:
        value = []
        for _ in range(500):
            value = [value]
    forged.seal(root, lambda plain: plain["constants"].update(time=value))
    return f"{value!r:.40}"


@kind
def a_config_in_the_manifest(root: Path, chance: random.Random) -> str:
    configs: list[Any] = [
        {"scene": {"name": str(root.parent / "evil.py")}},
        {"scene": "../../evil.py"},
        {"scene": {"name": "/etc/passwd"}},
        {"scene": []},
        {"scene": {"name": ["x.py"]}},
        {"look": {"name": "evil.py", "sha256": "0" * 64}},
        {"splits": {"../../x": {"look": "evil.py"}}},
        {"splits": {"train": {"frames": 10**9}}},
        {"splits": {"train": {"frames": -1}}},
        {"splits": []},
        {"splits": {"train": []}},
        {},
        {"scene": {"name": "bouncing", "balls": 10**9}},
        {"video": {"frames": 10**9}},
        {"scene": {"name": "bouncing", "radius": {"grid": [1] * 9999}}},
    ]
    config = chance.choice(configs)
    (root.parent / "evil.py").write_text(f"import pathlib\npathlib.Path({str(root.parent / 'ran')!r}).touch()\n")
    forged.seal(root, lambda plain: plain.update(config=config))
    return f"{config!r:.60}"


# ---- Tables and shards


@kind
def a_number_in_a_table(root: Path, chance: random.Random) -> str:
    column, number = (
        chance.choice(["first", "count", "bytes", "data_bytes", "index", "offsets"]),
        chance.choice([0, 1, 2**31, 2**32 - 1]),
    )

    def change(rows: np.ndarray) -> None:
        row = rows[chance.randrange(len(rows))]
        if column == "offsets":
            row["offsets"][chance.randrange(len(row["offsets"]))] = chance.choice([number, 2**63, 2**64 - 1])
        else:
            row[column] = number if column == "count" else chance.choice([number, 2**63, 2**64 - 1])

    forged.change_rows(root, "train", change)
    return f"{column} {number}"


@kind
def a_table_that_is_none(root: Path, chance: random.Random) -> str:
    manifest = forged.read_manifest(root)
    content = (root / manifest.tables["train"].file).read_bytes()
    texts = {
        "cut": content[:-100],
        "empty": b"",
        "header": content[:64],
        "longer": content + bytes(5000),
        "zeros": bytes(len(content)),
        "pickle": b"\x93NUMPY\x01\x00"
        + struct.pack("<H", 118)
        + b"{'descr': '|O', 'fortran_order': False, 'shape': (2,), }".ljust(117)
        + b"\n"
        + content,
        "shape": content.replace(b"(2,)", b"(9,)"),
        "one byte": b"x",
        "huge header": b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31) + content,
    }
    which = chance.choice(sorted(texts))
    forged.put_table(root, manifest, "train", texts[which])
    return which


@kind
def a_number_in_an_index(root: Path, chance: random.Random) -> str:
    field, part = chance.choice(["frames", "masks/instance"]), chance.choice(["offset", "size"])
    number = chance.choice([0, 1, 7, 2**20, 2**31, 2**40, 2**63, 2**64 - 1])

    def change(content: bytearray, index: np.ndarray, row: np.void) -> None:
        index[field][part][chance.randrange(len(index))] = number

    forged.change_shard(root, "train", chance.randrange(2), change)
    return f"{field} {part} {number}"


@kind
def a_chunk_that_grows(root: Path, chance: random.Random) -> str:
    """A chunk that decompresses to more than its declared size, or is no valid chunk."""
    bombs = {
        "zeros": zlib.compress(bytes(10**8), 1),
        "nothing": b"",
        "text": b"hello",
        "two": zlib.compress(b"a") + zlib.compress(b"b"),
        "raw": bytes(200),
        "cut": zlib.compress(bytes(range(256)) * 9)[:-4],
    }
    which = chance.choice(sorted(bombs))
    data = bombs[which]

    def change(content: bytearray, index: np.ndarray, row: np.void) -> None:
        chunk = index["frames"][0, 0]
        chunk["offset"], chunk["size"], chunk["crc32"] = len(content), len(data), zlib.crc32(data)
        content += data

    forged.change_shard(root, "train", 0, change)
    return which


@kind
def a_value_in_a_shard(root: Path, chance: random.Random) -> str:
    field = chance.choice(["states/position", "index", "objects/mass", "objects/present", "quality/contacts"])
    forged.flip_value(root, "train", 0, field, chance.randrange(8))
    return field


@kind
def bytes_in_a_shard(root: Path, chance: random.Random) -> str:
    """Random bytes, mostly in the metadata of HDF5, which h5py then reads."""
    count = chance.choice([1, 2, 10, 100])

    def change(content: bytearray, index: np.ndarray, row: np.void) -> None:
        for _ in range(count):
            offset = chance.randrange(min(len(content), 4000) if chance.random() < 0.7 else len(content))
            content[offset] = chance.choice([0, 255, content[offset] ^ 1 << chance.randrange(8), chance.randrange(256)])

    forged.change_shard(root, "train", chance.randrange(2), change)
    return f"{count}"


@kind
def another_hdf5_file(root: Path, chance: random.Random) -> str:
    """Valid HDF5 that a reader must refuse: huge, compressed, external, virtual or circular datasets."""
    which = chance.choice(
        ["huge", "bomb", "external", "virtual", "soft", "circle", "group", "compound", "text", "attribute", "none"]
    )
    manifest = forged.read_manifest(root)
    path = root / "shards" / "train-00000.h5"

    def change(content: bytearray, index: np.ndarray, row: np.void) -> None:
        path.write_bytes(content)
        with h5py.File(path, "a", locking=False) as file:
            if which == "attribute":
                file["time"].attrs["unit"] = np.zeros((100, 100))
                file.attrs["split"] = np.arange(1000)
            else:
                del file["time"]
            if which == "huge":
                file.create_dataset("time", (2**38,), "f8", chunks=(2**20,))
            elif which == "bomb":
                file.create_dataset("time", data=np.zeros(10**6), chunks=(10**6,), compression="gzip")
            elif which == "external":
                file.create_dataset("time", (5,), "f8", external=[("/etc/passwd", 0, 40)])
            elif which == "virtual":
                layout = h5py.VirtualLayout((5,), "f8")
                layout[:] = h5py.VirtualSource("/etc/passwd", "time", (5,))
                file.create_virtual_dataset("time", layout)
            elif which == "soft":
                file["time"] = h5py.SoftLink("/states/position")
            elif which == "circle":
                file["time"] = h5py.SoftLink("/time")
            elif which == "group":
                file.create_group("time")
            elif which == "compound":
                file.create_dataset("time", data=np.zeros(5, [("a", "f8")]))
            elif which == "text":
                file.create_dataset("time", data=["a"] * 5)
        content[:] = path.read_bytes()

    assert manifest.splits["train"] > 8
    forged.change_shard(root, "train", 0, change)
    return which


# ---- Files


@kind
def a_file_that_is_none(root: Path, chance: random.Random) -> str:
    files = [
        "manifest.json",
        "config.yaml",
        "README.md",
        "croissant.json",
        "sheet.png",
        "index.html",
        ".gen2d/dataset.json",
        "shards/train-00000.h5",
    ]
    files += ["index/train-10.npy", "shards", "index", ".gen2d", ".gen2d/records"]
    name, kind_of_file = (
        chance.choice(files),
        chance.choice(["fifo", "zero", "folder", "socket", "loop", "broken", "gone", "empty", "passwd"]),
    )
    path = root / name
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    if kind_of_file == "fifo":
        os.mkfifo(path)
    elif kind_of_file == "zero":
        path.symlink_to("/dev/zero")
    elif kind_of_file == "folder":
        path.mkdir()
    elif kind_of_file == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            os.chdir(path.parent)  # a socket's path must be short
            server.bind(path.name)
            os.chdir("/")
    elif kind_of_file == "loop":
        path.symlink_to(path)
    elif kind_of_file == "broken":
        path.symlink_to("/nowhere/at/all")
    elif kind_of_file == "empty":
        path.touch()
    elif kind_of_file == "passwd":
        path.symlink_to("/etc/passwd")
    return f"{name} {kind_of_file}"


@kind
def a_file_that_is_huge(root: Path, chance: random.Random) -> str:
    """A sparse file needs no disk space, but hours to read."""
    files = [
        "manifest.json",
        "config.yaml",
        "sheet.png",
        "index.html",
        "croissant.json",
        "index/train-10.npy",
        "shards/train-00000.h5",
    ]
    name, size = chance.choice(files), 2 ** chance.choice([30, 36, 40])
    os.truncate(root / name, size)
    if name.startswith("shards"):

        def change(rows: np.ndarray) -> None:
            rows["bytes"][0] = size

        forged.change_rows(root, "train", change)
    return f"{name} {size}"


@kind
def a_folder_that_leads_away(root: Path, chance: random.Random) -> str:
    """A symbolic link: a repair that follows it writes outside of the dataset."""
    name = chance.choice(["shards", "index", ".gen2d", ".gen2d/records", ".gen2d/snapshots", "plugins"])
    away = root.parent / "away"
    if (root / name).is_dir():
        (root / name).rename(away)
    else:
        away.mkdir()
    (root / name).symlink_to(away)
    path = root / "shards" / "train-00000.h5"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    return name


@kind
def a_log_or_a_snapshot(root: Path, chance: random.Random) -> str:
    name = chance.choice(
        [
            ".gen2d/records/train.0123456789abcdef.1",
            ".gen2d/records/../../x.0123456789abcdef.1",
            ".gen2d/snapshots/0123456789abcdef/manifest.json",
            ".gen2d/next.json",
            ".gen2d/snapshots/file",
            f".gen2d/records/{'x' * 100}.0123456789abcdef.1",
            ".gen2d/records/train.fifo.1",
        ]
    )
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if "fifo" in name:
        os.mkfifo(path.with_name("train.0123456789abcdef.1"))
    else:
        path.write_bytes(chance.choice([b"", b"{}", bytes(10**6), json.dumps({"schema": SCHEMA}).encode()]))
    return name


@kind
def a_file_of_the_manifest(root: Path, chance: random.Random) -> str:
    name = chance.choice(["config.yaml", "sheet.png", "index.html"])
    content = chance.choice(
        [
            b"",
            b"\x89PNG\r\n\x1a\n" + bytes(100),
            b"!!python/object/apply:os.system [id]",
            bytes(10**6),
            b"&a [*a]" * 100,
        ]
    )
    (root / name).write_bytes(content)
    forged.seal(root, lambda plain: plain["files"].update({name: hashlib.sha256(content).hexdigest()}))
    return name


@kind
def a_folder_that_is_another(root: Path, chance: random.Random) -> str:
    name, target = (
        chance.choice(["shards", "index", "plugins", ".gen2d/snapshots"]),
        chance.choice(["/", "/usr", "/sys"]),
    )
    shutil.rmtree(root / name, ignore_errors=True)
    (root / name).symlink_to(target)
    return f"{name} {target}"


@kind
def a_name_on_the_disk(root: Path, chance: random.Random) -> str:
    folder = root / chance.choice(["shards", "index", "plugins", ".gen2d/snapshots", ".gen2d/records", ""])
    folder.mkdir(parents=True, exist_ok=True)
    name = chance.choice([b"\xff.h5", b"\x1b]0;owned\x07", b"a\nb", b"train-00009.h5\r", "ünï\u202ecode".encode()])
    path = folder / os.fsdecode(name)
    if chance.random() < 0.5:
        path.mkdir()
    else:
        path.touch()
    return f"{folder.name} {name!r}"


@kind
def a_picture_that_leads_away(root: Path, chance: random.Random) -> str:
    """Symbolic links with the names of preview files: a preview that follows them overwrites another file."""
    (root.parent / "victim").write_bytes(b"precious")
    for name in (f"{root.name}-sheet.png", f"{root.name}.webp"):
        if chance.random() < 0.2:
            os.mkfifo(root / name)
        else:
            (root / name).symlink_to(root.parent / "victim")
    return "preview"


@kind
def a_manifest_that_swells(root: Path, chance: random.Random) -> str:
    """Long text, of which NumPy makes a wide array, or a deeply nested config, which exhausts recursion."""
    depth, how, inner = chance.choice([60, 70, 300, 900, 970, 990]), chance.choice(["text", "dict", "list"]), {}
    for _ in range(depth):
        inner = {"a": inner} if how == "dict" else [inner]

    def change(plain: dict[str, Any]) -> None:
        if how == "text":
            plain["constants"]["time"] = ["x" * 10**5] + [0] * 16_000
        else:
            plain["config"] = {"scene": inner}

    with contextlib.suppress(RecursionError):
        forged.seal(root, change)
    return f"{how} {depth}"


@kind
def fields_that_are_others(root: Path, chance: random.Random) -> str:
    """A consistent dataset with unexpected fields."""
    which = chance.choice(
        ["no time", "time of each video", "time alone", "index of pairs", "file", "wide", "many", "T"]
    )
    plain_field = {"dtype": "int8", "axes": "n 1000000", "unit": "", "meaning": "", "shape": [1000000], "codec": "none"}

    def change(plain: dict[str, Any]) -> None:
        fields = plain["fields"]
        if which == "no time":
            del fields["time"], plain["constants"]["time"]
        elif which == "time of each video":
            fields["time"].update(axes="n", shape=[])
            del plain["constants"]["time"]
        elif which == "time alone":
            fields["time"].update(axes="", shape=[])
            plain["constants"]["time"] = 1.0
        elif which == "index of pairs":
            fields["index"].update(axes="n 2", shape=[2])
        elif which == "wide":
            added = {f"states/x{number}": plain_field for number in range(60)}
            fields |= added
            for stats in plain["stats"].values():
                stats |= {name: dict.fromkeys(("mean", "std", "min", "max")) for name in added}
        elif which == "many":
            plain["chunk_frames"], plain["sizes"]["T"] = 1, 2**31 - 1
            for entry in fields.values():
                entry["shape"] = [2**31 - 1 if size == 5 else size for size in entry["shape"]]
        elif which == "T":
            plain["chunk_frames"], plain["constants"] = 5, {}
            del plain["sizes"]["T"]
            plain["fields"] = {name: entry for name, entry in fields.items() if "T" not in entry["axes"]}

    if which == "file":  # the name of np.savez's first parameter
        shutil.rmtree(root)
        more = synthetic.FIELDS | {"file": Field("int32", "n", "1", "x")}
        synthetic.make(synthetic.dataset(root, train=10, fields=more))
    forged.seal(root, change)
    return which


@kind
def a_plugin(root: Path, chance: random.Random) -> str:
    code = f"import pathlib\npathlib.Path({str(root.parent / 'ran')!r}).touch()\n".encode()
    digest = hashlib.sha256(code).hexdigest()
    for part in ("scene", "look"):
        (root / "plugins" / part).mkdir(parents=True)
        (root / "plugins" / part / "evil.py").write_bytes(code)

    def change(plain: dict[str, Any]) -> None:
        for part in ("scene", "look"):
            plain["files"][f"plugins/{part}/evil.py"] = digest
            plain["config"][part] = {"name": chance.choice(["evil.py", "/x/evil.py"]), "sha256": digest}

    forged.seal(root, change)
    return "evil.py"
