"""Membership of videos in matched sets, and its stored fields."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from gen2d.config.matched import INTERVENTIONS, VIOLATIONS
from gen2d.core.schema import Field
from gen2d.records import keys
from gen2d.records.axes import Array
from gen2d.records.keys import key_for


class SetMember(NamedTuple):
    """A video's membership in its set."""

    number: Array  # in the set; 0: the original
    changed: Array  # whether it is not the original
    kind: Array  # index into matched.change
    frame: Array  # at which a violation happens
    set_key: Array
    own_key: Array


def keys_of(words: Array, numbers: Array, options: Any) -> Array:
    """Key of each video [n]; the members of a set share one."""
    return keys.video_keys(words, numbers // options.members if options.change else numbers)


def member_of(key: Array, number: Array, options: Any, frames: int) -> SetMember:
    """Membership of the video with this number in its set; `key` is that of the set."""
    set_key = key_for(key, "matched")
    kind = jax.random.randint(key_for(set_key, "change"), (), 0, len(options.change))
    share = options.onset.sample(key_for(set_key, "onset"), ())
    frame = jnp.clip(jnp.round(share * frames).astype(jnp.int32), 1, frames - 1)
    return SetMember(number, number > 0, kind, frame, set_key, jax.random.fold_in(set_key, number))


def along_slots(values: Array, like: Array) -> Array:
    """Values [K] with trailing axes, which broadcast to `like` [K, ...]."""
    return values.reshape(-1, *[1] * (like.ndim - 1))


UNITS = (
    "remove: kg; teleport, identity_swap: m; gravity_flip: m/s^2; ghost_contact: rad; energy_gain: speed ratio; "
    "factor of the scene: its unit"
)


def fields(options: Any) -> dict[str, Field]:
    """Stored fields of matched sets."""
    if not options.change:
        return {}
    codes = ", ".join(f"{code} {name}" for name, code in zip(options.change, change_codes(options), strict=True))
    return {
        "matched/set": Field("int32", "n", "1", f"number of the set, which has {options.members} consecutive videos"),
        "matched/member": Field("uint8", "n", "1", "number of the video in its set; 0: the original"),
        "matched/kind": Field("uint8", "n", "1", f"code of the change in the set, whose original has it too: {codes}"),
        "matched/onset": Field("int32", "n", "1", "first frame that differs from the original; -1: none"),
        "matched/object": Field("int16", "n", "object", "slot of the changed object; -1: none, or more than one"),
        "matched/partner": Field("int16", "n", "object", "slot of the other object of a swap; -1: none"),
        "matched/size": Field("float32", "n", "1", f"size of the change; 0: none ({UNITS})"),
    }


def omitted_fields(options: Any) -> tuple[str, ...]:
    """Fields that are not stored for violations: the quality of neither simulation describes the spliced video."""
    parts = "quality/max_penetration", "quality/contacts"
    return parts if set(options.change or ()) & set(VIOLATIONS) else ()


def change_codes(options: Any) -> list[int]:
    """Code of each change in matched.change: first all interventions, then factors."""
    names, factor_codes = list(INTERVENTIONS), iter(range(len(INTERVENTIONS), 256))
    return [names.index(name) if name in names else next(factor_codes) for name in options.change]
