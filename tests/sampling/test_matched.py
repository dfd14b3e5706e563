"""Matched sets: their members are the same to the bit but for one thing, which their fields name."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tiny import everything

import gen2d
from gen2d.config import matched
from gen2d.config.config import load_config
from gen2d.core.enums import STATIC
from gen2d.core.errors import ConfigError, FolderError
from gen2d.generation import run
from gen2d.records.layout import Layout
from gen2d.sampling.builder import assemble, boxes, capsules, discs
from gen2d.sampling.matched import counterfactuals, violations
from gen2d.sampling.matched import sets as sets_module
from gen2d.sampling.sampler import Sampler

MEMBERS, VIDEOS, FPS = 3, 241, 20  # 80 sets and an original
CHANGES = [*matched.INTERVENTIONS, "density", "gravity"]
CONFIG = {
    "name": "sets",
    "video": {"frames": 16, "fps": FPS, "height": 16, "width": 20},
    "scene": {
        "name": "bouncing",
        "balls": [2, 3],
        "width": 6,
        "height": 5,
        "radius": [0.3, 0.6],
        "density": [1, 5],
        "spin": [-3, 3],
        "gravity": [0, [-6, -2]],
    },
    "physics": {"substeps": 4},
    "image": {"noise": [1, 3]},
    "matched": {"change": CHANGES, "members": MEMBERS, "distance": [1, 2]},
    "storage": {"batch_size": 48, "videos_per_shard": 96},
}
STATES = ("position", "angle", "velocity", "angular_velocity")
Videos = dict[str, Any]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sets") / "sets"
    gen2d.generate(CONFIG, VIDEOS, out, seed=5, device="cpu")
    return out


@pytest.fixture(scope="module")
def videos(root: Path) -> Videos:
    return everything(root)


def code(kind: str) -> int:
    """The number that stands for a change, of which the last two are factors."""
    return CHANGES.index(kind)


def pairs(videos: Videos, *kinds: str) -> list[tuple[Videos, Videos]]:
    """Each original and each member of its set that is changed in one of these ways."""
    changed = np.isin(videos["matched/kind"], [code(kind) for kind in kinds]) & (videos["matched/size"] != 0)
    found = []
    for i in np.flatnonzero(changed & (videos["matched/member"] > 0)):
        original = i - videos["matched/member"][i]
        found.append(tuple({name: values[k] for name, values in videos.items()} for k in (original, i)))
    assert len(found) > 8  # so that a law is of some videos
    return found


def differ(one: Videos, other: Videos) -> np.ndarray:
    """Whether the states of each frame and slot [T, K] are other bits."""
    return np.any(
        [(one[f"states/{s}"] != other[f"states/{s}"]).reshape(*one["states/angle"].shape, -1).any(-1) for s in STATES],
        axis=0,
    )


def free_gaps(video: Videos, frame: Any, slot: Any) -> np.ndarray:
    """The gaps in m between a ball and the other balls, and the walls, at a frame."""
    place, radius = video["states/position"][frame], video["objects/radius"]
    others = (video["objects/kind"] == 0) & video["objects/present"] & (np.arange(len(radius)) != slot)
    balls = np.linalg.norm(place[others] - place[slot], axis=-1) - radius[others] - radius[slot]
    return np.concatenate([balls, place[slot] - radius[slot], [6, 5] - place[slot] - radius[slot]])


def travelled(video: Videos, frame: Any) -> float:
    """No two objects come nearer to each other by more in the frame before this one, m."""
    speed = np.linalg.norm(video["states/velocity"][[frame - 1, frame]], axis=-1).max()
    return float(2 * (speed + 6 / FPS) / FPS + 1e-3)


# ---- Which video is which


def test_a_video_is_a_member_of_its_set(videos: Videos):
    number = np.arange(VIDEOS)
    assert_array_equal(videos["matched/set"], number // MEMBERS)
    assert_array_equal(videos["matched/member"], number % MEMBERS)
    assert_array_equal(videos["matched/kind"], videos["matched/kind"][number - number % MEMBERS])
    assert set(videos["matched/kind"]) == set(range(len(CHANGES)))
    originals = videos["matched/member"] == 0
    for name, nothing in (("onset", -1), ("object", -1), ("partner", -1), ("size", 0)):
        assert (videos[f"matched/{name}"][originals] == nothing).all()
    assert (videos["matched/size"][~originals] > 0).mean() > 0.9


@pytest.mark.parametrize("kind", CHANGES)
def test_before_its_onset_a_member_is_the_original_to_the_bit(videos: Videos, kind: str):
    for one, other in pairs(videos, kind):
        both = one["objects/present"] & other["objects/present"]
        different, onset = (differ(one, other) & both).any(1), other["matched/onset"]
        assert onset == (np.argmax(different) if different.any() else -1)
        if kind != "remove":
            alike = onset if onset >= 0 or kind == "gravity" else 16
            assert_array_equal(one["frames"][:alike], other["frames"][:alike])
        assert other["matched/partner"] == -1 or kind == "identity_swap"


def test_members_share_all_that_was_drawn_but_for_the_factor_they_are_about(videos: Videos):
    names = [name for name in videos if name.split("/")[0] in ("factors", "objects", "world", "camera")]
    for one, other in pairs(videos, *CHANGES[1:]):
        kind = CHANGES[other["matched/kind"]]
        changed = {"density": {"objects/mass", "objects/moment"}, "gravity": {"world/gravity"}}.get(kind, set())
        assert {n for n in names if (one[n] != other[n]).any()} == changed | ({f"factors/{kind}"} if changed else set())


# ---- Counterfactuals


def test_a_removed_object_is_gone_and_nothing_else_changes_until_it_would_have_met_another(videos: Videos):
    for one, other in pairs(videos, "remove"):
        slot, onset = other["matched/object"], other["matched/onset"]
        assert one["objects/present"][slot]
        assert one["objects/mass"][slot] == other["matched/size"]
        for name, values in other.items():
            if name.startswith("objects/"):
                assert not values[slot].any(), name
                assert_array_equal(np.delete(values, slot, 0), np.delete(one[name], slot, 0))
        if onset > 0:
            met = np.argmax(np.where(np.arange(len(one["objects/kind"])) == slot, 0, differ(one, other)[onset]))
            apart = np.linalg.norm(np.subtract(*one["states/position"][onset - 1, [slot, met]]))
            assert apart - one["objects/radius"][[slot, met]].sum() < travelled(one, onset)


def test_members_of_a_set_lose_different_objects(videos: Videos):
    gone = {}
    for _, other in pairs(videos, "remove"):
        gone.setdefault(int(other["matched/set"]), []).append(int(other["matched/object"]))
    assert all(len(set(slots)) == len(slots) for slots in gone.values())


def test_another_density_does_not_show_until_the_first_contact_of_the_object(videos: Videos):
    for one, other in pairs(videos, "density"):
        slot, onset = other["matched/object"], other["matched/onset"]
        assert_array_equal(np.flatnonzero(one["objects/mass"] != other["objects/mass"]), [slot])
        assert_allclose(np.abs(one["factors/density"] - other["factors/density"]).max(), other["matched/size"])
        assert_array_equal(one["frames"][0], other["frames"][0])
        assert onset == -1 or free_gaps(one, onset - 1, slot).min() < travelled(one, onset)


def test_members_that_hide_a_factor_hide_it_of_one_object(videos: Videos):
    hidden = {}
    for _, other in pairs(videos, "density"):
        hidden.setdefault(int(other["matched/set"]), set()).add(int(other["matched/object"]))
    assert {len(slots) for slots in hidden.values()} == {1}


def drawn(*sets: str) -> tuple[Videos, Videos]:
    """The factors of an original [...], and of the 255 members of its set [255, ...]."""
    config = load_config(CONFIG, ["matched.members=256", *(f"matched.{text}" for text in sets)])
    key, sampler = jax.random.key(3), Sampler(config)

    def factors(number: jax.Array) -> dict[str, jax.Array]:
        member = sets_module.member_of(key, number, config.matched, 8)
        return sampler.sample_factors(key, change=lambda *found: counterfactuals.change_factors(member, config, *found))

    found = {name: np.asarray(values) for name, values in jax.jit(jax.vmap(factors))(jnp.arange(256)).items()}
    return {name: values[0] for name, values in found.items()}, {name: values[1:] for name, values in found.items()}


@pytest.mark.parametrize("objects", ["one", "all"])
@pytest.mark.parametrize("scale", ["null", "0.5"])
def test_a_factor_is_another_one_for_one_or_for_all_drawn_anew_or_scaled(objects: str, scale: str):
    one, others = drawn("change=density", f"objects={objects}", f"scale={scale}")
    assert {name for name in one if (one[name] != others[name]).any()} == {"density"}
    changed, there = one["density"] != others["density"], np.arange(3) < one["balls"]
    assert (changed == changed[0]).all()
    assert changed[0].sum() == 1 if objects == "one" else (changed[0] == there).all()
    assert (changed <= there).all()
    if scale == "null":
        assert len(np.unique(others["density"][changed])) == changed.sum()
        assert ((others["density"] >= 1) & (others["density"] <= 5))[:, there].all()
    else:
        assert_allclose(others["density"], np.where(changed, one["density"] / 2, one["density"]), rtol=1e-6)


def test_the_object_whose_factor_is_changed_is_there():
    """Also where few of the objects are: of five at most, one or two."""
    config = load_config(CONFIG, ["scene.balls=[1, 5]", "matched.change=density", "matched.objects=one"])
    sampler = Sampler(config)

    def factors(key: jax.Array, number: int) -> dict[str, jax.Array]:
        member = sets_module.member_of(key, jnp.asarray(number), config.matched, 8)
        return sampler.sample_factors(key, change=lambda *found: counterfactuals.change_factors(member, config, *found))

    program = jax.jit(jax.vmap(factors, (0, None)))
    one, other = (program(jax.random.split(jax.random.key(0), 200), number) for number in (0, 1))
    assert_array_equal((np.asarray(one["density"]) != np.asarray(other["density"])).sum(1), 1)


def test_a_scaled_factor_stays_within_what_it_may_be():
    assert drawn("change=elasticity", "scale=9")[1]["elasticity"].max() == 1


# ---- Violations


def test_a_violation_happens_within_its_range(videos: Videos):
    frames = [other["matched/onset"] for _, other in pairs(videos, "teleport", "identity_swap", "ghost_contact")]
    assert min(frames) >= round(0.3 * 16)
    assert max(frames) <= round(0.7 * 16)
    assert len(set(frames)) > 3


def test_one_object_jumps_to_a_free_place_and_goes_on(videos: Videos):
    for one, other in pairs(videos, "teleport"):
        slot, onset = other["matched/object"], other["matched/onset"]
        jump = other["states/position"][onset] - one["states/position"][onset]
        assert_array_equal(np.flatnonzero(jump.any(-1)), [slot])
        assert_allclose(np.linalg.norm(jump[slot]), other["matched/size"], rtol=1e-5)
        assert 1 <= other["matched/size"] <= 2
        assert free_gaps(other, onset, slot).min() > 0
        for name in STATES[1:]:
            assert_array_equal(one[f"states/{name}"][onset], other[f"states/{name}"][onset])


def test_two_objects_change_places_and_motions(videos: Videos):
    for one, other in pairs(videos, "identity_swap"):
        a, b, onset = other["matched/object"], other["matched/partner"], other["matched/onset"]
        for name in STATES:
            before, after = one[f"states/{name}"][onset], other[f"states/{name}"][onset]
            assert_array_equal(after[[a, b]], before[[b, a]])
            assert_array_equal(np.delete(after, [a, b], 0), np.delete(before, [a, b], 0))
        radius = one["objects/radius"][(one["objects/kind"] == 0) & one["objects/present"]]
        assert_allclose(np.ptp(one["objects/radius"][[a, b]]), np.diff(np.sort(radius)).min(), atol=1e-5)


def test_gravity_turns_round(videos: Videos):
    seen = 0
    for one, other in pairs(videos, "gravity_flip"):
        onset, gravity = other["matched/onset"], one["world/gravity"]
        assert_allclose(other["matched/size"], 2 * np.linalg.norm(gravity), rtol=1e-6)
        for slot in np.flatnonzero((one["objects/kind"] == 0) & one["objects/present"]):
            if free_gaps(one, onset - 1, slot).min() > travelled(one, onset):
                gained = [np.diff(v["states/velocity"][[onset - 1, onset], slot], axis=0)[0] for v in (one, other)]
                assert_allclose(gained[0], gravity / FPS, atol=1e-5)
                assert_allclose(gained[1], -gravity / FPS, atol=1e-5)
                seen += 1
    assert seen > 8


def test_an_object_bounces_off_nothing(videos: Videos):
    for one, other in pairs(videos, "ghost_contact"):
        slot, onset = other["matched/object"], other["matched/onset"]
        assert_array_equal(np.flatnonzero(differ(one, other)[onset]), [slot])
        before, after = (v["states/velocity"][onset, slot].astype(float) for v in (one, other))
        assert_array_equal(one["states/position"][onset], other["states/position"][onset])
        assert_allclose(np.linalg.norm(after), np.linalg.norm(before), rtol=1e-5)
        turn = np.arccos(before @ after / (before @ before))
        assert_allclose(turn, other["matched/size"], atol=1e-3)
        assert np.pi / 3 <= other["matched/size"] <= np.pi


def test_an_object_gains_energy(videos: Videos):
    for one, other in pairs(videos, "energy_gain"):
        slot, onset, gain = other["matched/object"], other["matched/onset"], other["matched/size"]
        energy = [
            v["objects/mass"][slot] / 2 * (v["states/velocity"][onset, slot].astype(float) ** 2).sum()
            + v["objects/moment"][slot] / 2 * v["states/angular_velocity"][onset, slot].astype(float) ** 2
            for v in (one, other)
        ]
        assert_allclose(energy[1], gain**2 * energy[0], rtol=1e-5)
        assert_array_equal(np.flatnonzero(differ(one, other)[onset]), [slot])
        assert_array_equal(one["states/position"][onset], other["states/position"][onset])


def test_a_gap_is_that_to_the_rim():
    places = jnp.asarray([[2.0, 1.0]])
    parts = [discs(places, 0.5), capsules(places + 4, 0.3, 1.0, 0.25), boxes(places - 5, 0.7, 2.0, 1.0, kind=STATIC)]
    scene, state = assemble(Layout(tuple(part.run for part in parts)), parts, jnp.zeros(2))
    points = np.random.default_rng(0).uniform(-8, 8, (500, 2))
    gap = np.asarray(
        jax.vmap(lambda point: violations.gaps(point, scene.objects, state))(jnp.asarray(points, jnp.float32))
    )
    assert_allclose(gap[:, 0], np.linalg.norm(points - [2, 1], axis=1) - 0.5, atol=1e-5)
    along = np.clip((points - [6, 5]) @ [np.cos(0.3), np.sin(0.3)], -1, 1)
    core = np.array([6, 5]) + along[:, None] * [np.cos(0.3), np.sin(0.3)]
    assert_allclose(gap[:, 1], np.linalg.norm(points - core, axis=1) - 0.25, atol=1e-5)
    local = np.abs((points - [-3, -4]) @ [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]) - [1, 0.5]
    outside = np.linalg.norm(np.maximum(local, 0), axis=1)
    assert_allclose(gap[:, 2], local.max(1), atol=1e-5)
    assert (gap[:, 2] <= outside + 1e-5).all()
    assert_allclose(violations.extent(scene.objects), [0.5, 1.25, np.hypot(1, 0.5)], rtol=1e-6)


# ---- The rest of the program


def test_a_stream_gives_the_same(root: Path, videos: Videos):
    stream = gen2d.stream(CONFIG, 5, 12, n=VIDEOS, fields=["frames", "states/*", "matched/*"], device="cpu")
    for first, batch in zip(range(0, 48, 12), stream, strict=False):
        for name, values in batch.items():
            assert_array_equal(values, videos[name][first : first + 12], err_msg=name)


def test_drawn_again_the_noise_is_that_of_the_set(root: Path, videos: Videos):
    some = [0, 1, 2, 7, 240]
    assert_array_equal(gen2d.render(gen2d.open(root), some), videos["frames"][some])


def test_whole_sets_are_loaded_by_their_numbers(root: Path):
    ds = gen2d.open(root, fields="matched/*")
    sets = np.array([3, 70, 5])
    batch = ds.batch((sets[:, None] * MEMBERS + np.arange(MEMBERS)).ravel())
    assert_array_equal(batch["matched/set"].reshape(-1, MEMBERS), np.repeat(sets[:, None], MEMBERS, 1))


def test_violations_are_not_simulated_again_from_scenes_that_do_not_tell_of_them(root: Path):
    with pytest.raises(ConfigError, match="violations") as caught:
        gen2d.simulate_again(gen2d.open(root), [1])
    assert "\n" not in str(caught.value)


def test_the_number_of_members_is_the_configs(root: Path):
    other = load_config(CONFIG, ["matched.members=2"])
    assert other.sha256() != load_config(CONFIG).sha256()
    with pytest.raises(FolderError, match=r"matched\.members"):
        gen2d.generate(other, VIDEOS, root, seed=5, device="cpu")


BAD: dict[str, tuple[list[str], str]] = {
    "unknown": (["change=densty"], "did you mean density?"),
    "twice": (["change=[density, density]"], "name each change once"),
    "empty": (["change=[]"], "matched.change is []"),
    "constant": (["change=friction"], "scene.friction is always the same"),
    "whole": (["change=balls", "scale=2"], "scene.balls is a whole number"),
    "built around": (["change=radius", "scale=2"], "scene.radius is: draw it anew"),
    "too large": (["change=radius", "scale=20"], "must fit a box"),
    "negative": (["change=density", "scale=-1"], "matched.scale is -1"),
    "alone": (["change=remove", "members=1"], "matched.members is 1"),
    "nothing": (["change=null"], "change is null, but"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_set_is_one_sentence(case: str):
    sets, message = BAD[case]
    with pytest.raises(ConfigError) as caught:
        load_config(CONFIG, [f"matched.{text}" for text in sets])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "also", "message"),
    [
        ("teleport", "annotations.contacts=4", "annotations.contacts must be off"),
        ("energy_gain", "annotations.energy=true", "annotations.energy must be off"),
        ("ghost_contact", "video.frames=1", "video.frames is 1"),
        ("gravity_flip", "scene.gravity=[0, 0]", "there is no scene.gravity"),
        ("identity_swap", "scene.balls=1", "has no 2 that move"),
        ("remove", "camera.follow=0", "camera.follow may be what is gone"),
    ],
)
def test_what_cannot_be_is_one_sentence(kind: str, also: str, message: str):
    with pytest.raises(ConfigError) as caught:
        load_config(CONFIG, [f"matched.change={kind}", also])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_incomplete_sets_are_logged_before_the_run():
    plain: dict[str, Any] = {name: options for name, options in CONFIG.items() if name != "matched"}
    counts = {"train": 3 * MEMBERS + 1, "test": 2 * MEMBERS}
    assert run._incomplete_sets(load_config(plain), counts) == []
    assert run._incomplete_sets(load_config(CONFIG), counts) == [
        "train: 10 videos are no multiple of matched.members, 3, so the last set is incomplete"
    ]


def test_without_sets_nothing_is_stored_and_keys_are_the_videos_own():
    plain: dict[str, Any] = {name: options for name, options in CONFIG.items() if name != "matched"}
    config = load_config(plain)
    words, numbers = jnp.zeros(3, jnp.uint32), jnp.arange(6, dtype=jnp.uint32)
    assert sets_module.fields(config.matched) == {}
    keys = jax.random.key_data(sets_module.keys_of(words, numbers, config.matched))
    assert len(np.unique(keys, axis=0)) == 6
    of_sets = jax.random.key_data(sets_module.keys_of(words, numbers, load_config(CONFIG).matched))
    assert_array_equal(of_sets, np.repeat(keys[:2], 3, axis=0))
