"""Datasets made on a Ray cluster equal those of a plain run, byte for byte, whatever is killed on the way."""

import dataclasses
import json
import os
import random
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import buckets
import pytest
from clusters import Cluster, add_node, two_cores
from tiny import CONFIG, command, run_command, tiny_config

import gen2d
from gen2d.config.config import load_config
from gen2d.engines import Ray
from gen2d.engines.protocol import EngineError, Report
from gen2d.generation.regenerate import repair
from gen2d.generation.run import generate
from gen2d.generation.worker import GenerationJob, ShardWorker

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own
N = 90  # videos: eleven shards of 8 and one of 2
TOKEN = "GEN2D_TEST_CLUSTER"


def files(root: Path) -> dict[str, bytes]:
    """Content of all files of a dataset but the run log, which holds times."""
    paths = (path for path in root.rglob("*") if path.is_file() and path.name not in ("run.jsonl", "lock"))
    return {str(path.relative_to(root)): path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of a plain run."""
    root = tmp_path_factory.mktemp("plain") / "data"
    assert generate(CONFIG, N, root).complete
    return files(root)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A head without cores and a machine with two."""
    with two_cores(**{TOKEN: str(tmp_path_factory.mktemp("token"))}) as cluster:
        yield cluster


def processes(name: str, token: str) -> list[int]:
    """Numbers of the processes whose command line contains this name, on machines with this token."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            is_named = name.encode() in (path / "cmdline").read_bytes()
            if is_named and f"{TOKEN}={token}".encode() in (path / "environ").read_bytes():
                found.append(int(path.name))
        except OSError:
            continue
    return found


def actors() -> list[int]:
    """Process numbers of the workers on this file's machines."""
    return processes("ray::Actor", os.environ[TOKEN])


def kill(processes: list[int], number: int = signal.SIGKILL) -> int:
    """Send a signal to one of the processes; returns how many it reached."""
    for process in processes[:1]:
        try:
            os.kill(process, number)
        except ProcessLookupError:
            return 0
        return 1
    return 0


def test_bytes_equal_those_of_a_plain_run_although_a_worker_is_killed(
    cluster: Cluster, plain: dict[str, bytes], tmp_path: Path
):
    lines: list[str] = []
    killed = []

    def log(line: str) -> None:
        lines.append(line)
        if line.startswith("First shard"):
            killed.append(kill(actors()))

    summary = generate(CONFIG, N, tmp_path / "data", engine=Ray(cluster.address, workers=2), log=log)
    assert (summary.complete, summary.generated) == (True, N)
    assert files(tmp_path / "data") == plain
    assert killed == [1]
    assert sum("is lost (its process died)" in line for line in lines) <= 1, lines
    assert "2 workers (cpu " in "".join(lines)
    entries = [json.loads(line) for line in (tmp_path / "data/.gen2d/run.jsonl").read_text().splitlines()]
    made = [place for entry in entries[:-1] for place in entry["shards"]["train"]]
    assert sorted(made) == list(range(12))
    again = generate(CONFIG, N, tmp_path / "data", engine=Ray(cluster.address, workers=2), log=lines.append)
    assert again.generated == 0
    assert files(tmp_path / "data") == plain


def test_the_users_own_files_reach_the_workers(cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The workers run elsewhere, so that the file is found in its copy only."""
    monkeypatch.chdir(tmp_path)
    family = (Path(gen2d.__file__).parent / "scenes" / "bouncing.py").read_text()
    Path("own.py").write_text(family)
    config = tiny_config(scene={"name": "own.py"})
    one = generate(config, 10, "one")
    two = generate(config, 10, "two", engine=Ray(cluster.address))
    assert one.complete
    assert two.complete
    assert files(tmp_path / "one") == files(tmp_path / "two")
    assert (tmp_path / "two/plugins/scene/own.py").read_text() == family


@pytest.mark.full
def test_one_sentence_if_no_worker_sees_the_folder_or_fits_the_dataset(cluster: Cluster, tmp_path: Path):
    generate(CONFIG, 4, tmp_path / "data")
    with pytest.raises(gen2d.FolderError, match="holds another dataset"):
        generate(CONFIG, 8, tmp_path / "data", seed=1, engine=Ray(cluster.address))
    crowded = tiny_config(scene={"balls": 6, "radius": 1.6, "width": 8, "height": 8})
    with pytest.raises(gen2d.UserError, match=r"^scene: video 0 could not be placed without overlap"):
        generate(crowded, 8, tmp_path / "crowded", engine=Ray(cluster.address))


def damaged(plain: dict[str, bytes], root: Path) -> list[str]:
    """Write the dataset with a flipped bit in one shard and without another; returns the damaged shards."""
    for name, content in plain.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    path = root / "shards/train-00003.h5"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    (root / "shards/train-00005.h5").unlink()
    return ["train-00003", "train-00005"]


def test_verify_and_export_run_on_a_cluster(cluster: Cluster, plain: dict[str, bytes], tmp_path: Path):
    engine = Ray(cluster.address, workers=2)
    damaged(plain, tmp_path / "bad")
    found = gen2d.verify(tmp_path / "bad", engine=engine)
    assert len(found) >= 2
    assert found == gen2d.verify(tmp_path / "bad")
    for name, content in plain.items():
        (tmp_path / "good" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "good" / name).write_bytes(content)
    assert gen2d.verify(tmp_path / "good", engine=engine) == []
    for to in ("npz", "webdataset"):
        for name, where in (("one", None), ("two", engine)):
            out = tmp_path / f"{to}-{name}"
            gen2d.export(tmp_path / "good", to, out, engine=where, select="index >= 5", fields="states/*")
        assert files(tmp_path / f"{to}-one") == files(tmp_path / f"{to}-two")
    with pytest.raises(gen2d.ConfigError, match=r"^to is objects, whose files hold many videos: leave out engine"):
        gen2d.export(tmp_path / "good", "objects", tmp_path / "three", engine=engine)


# ---- Without Ray


def worker_of(out: Path, count: int = N) -> ShardWorker:
    return ShardWorker(load_config(CONFIG), out, {"train": count}, "cpu", lambda line: None)


def test_two_attempts_at_one_shard_at_once_are_one(plain: dict[str, bytes], tmp_path: Path):
    from gen2d.dataset.folder import open_folder
    from gen2d.generation.complete import complete

    workers = [worker_of(tmp_path / "data") for _ in range(2)]
    shards = open_folder(workers[0].dataset)
    threads = [threading.Thread(target=worker.run, args=([shard],)) for shard in shards[:6] for worker in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    workers[0].run(shards[6:])
    for worker in workers:
        assert worker.check() == ""
        worker.close()
    assert complete(workers[0].dataset)
    assert files(tmp_path / "data") == plain


def test_workers_of_other_bits_versions_or_files_are_refused_by_what_differs(tmp_path: Path):
    def report(versions: dict[str, str], **changes: dict[str, str]) -> Report:
        producer = dict(original.details.producer)
        producer |= {key: {**producer[key], **values} for key, values in changes.items()}
        details = dataclasses.replace(original.details, producer=producer)
        versions = {**original.versions, **versions}
        return dataclasses.replace(original, versions=versions, identity=details.identity, details=details)

    original = worker_of(tmp_path).report()
    other_bits, h5py = report({}, fingerprint={"device": "cpu avx"}), original.versions["h5py"]
    edited = report({}, sources={"gen2d/physics/step.py": "0"})
    job = GenerationJob(load_config(CONFIG), tmp_path, {"train": N}, "cpu")
    assert job.refusals([other_bits, original, original, report({"h5py": "3.0.0"}), edited]) == [
        f"it would make other bits: fingerprint.device is {original.device} there and cpu avx here",
        "",
        "",
        f"it has h5py 3.0.0, but here is {h5py}",
        "its gen2d differs in gen2d/physics/step.py",
    ]
    identity = other_bits.identity  # of the folder, though not of most workers
    begun = GenerationJob(load_config(CONFIG), tmp_path, {"train": N}, "cpu", identity)
    assert [bool(refusal) for refusal in begun.refusals([original, original, other_bits])] == [True, True, False]


def test_a_worker_that_does_not_see_the_folder_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("gen2d.generation.worker.SEEN", 0.0)
    assert "does not see the dataset" in worker_of(tmp_path / "nowhere").check()


# ---- Longer


@pytest.mark.full
def test_a_killed_driver_starts_again(plain: dict[str, bytes], tmp_path: Path):
    """Also on a cluster of its own, which ends with it."""
    arguments = ["--config", tmp_path / "tiny.yaml", "--n", N, "--out", tmp_path / "data", "--engine", "ray"]
    (tmp_path / "tiny.yaml").write_text(json.dumps(CONFIG))
    argv, environment = command(*arguments, "--json")
    with subprocess.Popen(argv, env=environment, stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "First shard" in line:
                process.kill()
                break
    done = run_command(*arguments)
    assert done.returncode == 0, done.stderr
    assert all(" ..." in line or "worker (" in line or "First shard" in line for line in done.stderr.splitlines())
    assert {n: d for n, d in files(tmp_path / "data").items() if ".tmp." not in n} == plain


@pytest.mark.full
def test_a_lost_head_is_one_sentence(tmp_path: Path):
    """And what is made stays; Ray itself would wait for a minute and end the process with its own words."""
    (tmp_path / "tiny.yaml").write_text(json.dumps(CONFIG))
    arguments = ["--config", tmp_path / "tiny.yaml", "--n", 200_000, "--out", tmp_path / "data", "--engine", "ray"]
    argv, environment = command(*arguments, **{TOKEN: str(tmp_path)})
    with subprocess.Popen(argv, env=environment, stdout=-1, stderr=-1, text=True) as process:
        assert process.stderr is not None
        lines = []
        for line in process.stderr:
            lines.append(line)
            if "First shard" in line:
                assert kill(processes("gcs_server", str(tmp_path))) == 1
    assert process.returncode == 2
    assert lines[-1].startswith("gen2d: the head of the cluster, ")
    assert lines[-1].endswith(", is lost; what is made stays\n")
    assert len(list((tmp_path / "data/shards").glob("*.h5"))) > 1


@pytest.mark.full
def test_repair_runs_on_a_cluster(cluster: Cluster, plain: dict[str, bytes], tmp_path: Path):
    bad = damaged(plain, tmp_path / "data")
    assert repair(tmp_path / "data", bad[:1], engine=Ray(cluster.address, workers=2)) == bad
    assert files(tmp_path / "data") == plain


@pytest.mark.full
def test_a_cluster_of_three_machines_loses_one_and_gains_one(cluster: Cluster, plain: dict[str, bytes], tmp_path: Path):
    others = [add_node(cluster), add_node(cluster)]
    foreign = add_node(cluster, XLA_FLAGS="--xla_cpu_enable_fast_math=true")
    lines: list[str] = []

    def log(line: str) -> None:
        lines.append(line)
        if line.startswith("First shard"):
            cluster.remove_node(others.pop(), allow_graceful=False)
            others.append(add_node(cluster))

    try:
        assert generate(CONFIG, N, tmp_path / "data", engine=Ray(cluster.address), log=log).complete
    finally:
        for node in (*others, foreign):
            cluster.remove_node(node)
    assert files(tmp_path / "data") == plain
    released = [line for line in lines if "is released: it would make other bits: fingerprint.xla_flags is " in line]
    assert len(released) == 1, lines


@pytest.mark.full
def test_a_bucket_that_fails_one_request_in_twenty(plain: dict[str, bytes], monkeypatch: pytest.MonkeyPatch):
    """On a cluster of its own, whose workers know the bucket from the environment."""
    choice = random.Random(0)
    with buckets.serving() as server:
        for name, value in buckets.environment(server).items():
            monkeypatch.setenv(name, value)
        server.fault = lambda request: "fail" if choice.random() < 0.05 else ""
        url = f"s3://{buckets.BUCKET}/data"
        assert generate(CONFIG, N, url, engine=Ray(workers=None)).complete
        failed, server.fault = len(server.requests), lambda request: ""
        assert failed > 50
        assert buckets.tree(url) == {name: data for name, data in plain.items() if not name.startswith(".gen2d")}


@pytest.mark.slow
def test_fifty_kills(cluster: Cluster, tmp_path: Path):
    """Workers die at fifty random moments, of starting, generating and ending; a run that gives up begins again."""
    count, killed, rounds, given_up = 800, 0, 0, 0
    choice, stop = random.Random(0), threading.Event()
    assert generate(CONFIG, count, tmp_path / "plain").complete
    plain = files(tmp_path / "plain")

    def killer() -> None:
        nonlocal killed
        while not stop.wait(choice.uniform(0, 5)):
            processes = actors()
            choice.shuffle(processes)
            killed += kill(processes, choice.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM]))

    thread = threading.Thread(target=killer)
    thread.start()
    try:
        while killed < 50:
            rounds += 1
            root = tmp_path / f"{rounds}"
            while not (root / "manifest.json").exists():
                try:
                    generate(CONFIG, count, root, engine=Ray(cluster.address, workers=2))
                except EngineError:
                    given_up += 1
            assert files(root) == plain
    finally:
        stop.set()
        thread.join()
    print(f"{killed} kills in {rounds} runs, of which {given_up} gave up and began again")
