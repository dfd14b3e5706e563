"""Which video is which member of a matched set, and what is stored of it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS, VIOLATIONS
from gen2d.core.schema import Field
from gen2d.records import keys
from gen2d.records.axes import Array
from gen2d.records.keys import key_for

# ---- Which video is which, and which is changed how


class SetMember(NamedTuple):
    """One video's part in its set."""

    number: Array  # in the set
    changed: Array  # whether it is not the original
    kind: Array  # place in matched.change
    frame: Array  # at which a violation happens
    set_key: Array
    own_key: Array


def keys_of(words: Array, numbers: Array, options: Any) -> Array:
    """A key per video, that of its set where there are sets."""
    return keys.video_keys(words, numbers // options.members if options.change else numbers)


def member_of(key: Array, number: Array, options: Any, frames: int) -> SetMember:
    set_key = key_for(key, "matched")
    kind = jax.random.randint(key_for(set_key, "change"), (), 0, len(options.change))
    share = options.onset.sample(key_for(set_key, "onset"), ())
    frame = jnp.clip(jnp.round(share * frames).astype(jnp.int32), 1, frames - 1)
    return SetMember(number, number > 0, kind, frame, set_key, jax.random.fold_in(set_key, number))


def along_slots(values: Array, like: Array) -> Array:
    """Values [K] that broadcast to those of `like` [K, ...]."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


# ---- What is stored


UNITS = "kg removed; m of a teleport or a swap; m/s^2; rad of a ghost contact; times as fast; a factor's own unit"


def fields(options: Any) -> dict[str, Field]:
    """What is stored of sets."""
    if not options.change:
        return {}
    codes = ", ".join(f"{code} {name}" for name, code in zip(options.change, change_codes(options), strict=True))
    return {
        "matched/set": Field("int32", "n", "1", f"its members are {options.members} videos in a row"),
        "matched/member": Field("uint8", "n", "1", "the video's place in its set; 0: the original"),
        "matched/kind": Field("uint8", "n", "1", f"what the set's members differ in: {codes}"),
        "matched/onset": Field(
            "int32", "n", "1", "first frame with a state that is another than the original's; -1: none"
        ),
        "matched/object": Field("int16", "n", "object", "slot of what is changed; -1: none, or more than one"),
        "matched/partner": Field("int16", "n", "object", "slot of what the object changes places with; -1: none"),
        "matched/size": Field("float32", "n", "1", f"of the change, 0: none ({UNITS})"),
    }


def omitted_fields(options: Any) -> tuple[str, ...]:
    """What is not stored: of a video put together from two, neither tells."""
    parts = "quality/max_penetration", "quality/contacts"
    return parts if set(options.change or ()) & set(VIOLATIONS) else ()


def change_codes(options: Any) -> list[int]:
    """The number that stands for each of the changes: factors come after all else."""
    named, own = list(INTERVENTIONS), iter(range(len(INTERVENTIONS), 256))
    return [named.index(name) if name in named else next(own) for name in options.change]
