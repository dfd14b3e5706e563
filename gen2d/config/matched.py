"""Checks of the section `matched`, the options of matched sets."""

import dataclasses
import math
from typing import Any

import numpy as np

from gen2d.config import plugins
from gen2d.config.distributions import Distribution
from gen2d.config.options import factor_options
from gen2d.core import palettes
from gen2d.core.enums import DYNAMIC, STATIC
from gen2d.records.layout import Layout

INTERVENTIONS = ("remove", "teleport", "identity_swap", "gravity_flip", "ghost_contact", "energy_gain")
VIOLATIONS = INTERVENTIONS[1:]  # physically impossible events in the middle of a video


def free_slots(layout: Layout) -> np.ndarray:
    """Whether each slot [K] holds a dynamic object without joints."""
    free = np.concatenate([np.full(run.count, run.kind == DYNAMIC) for run in layout.groups])
    free[[slot for joint in layout.joints for slot in (joint.a, joint.b)]] = False
    return free


def check(options: Any, default: Any, scene: Any, video: Any, annotations: Any, camera: Any) -> None:
    """Raise ValueError, beginning with the option's name, if matched sets with these options are impossible."""
    if not options.change:
        if options != default:
            raise ValueError("change is null, but other options are given: name what a set's members differ in")
        return
    if len(set(options.change)) < len(options.change):
        raise ValueError(f"change is {list(options.change)}, but must name each change once")
    layout = scene.contract.layout(scene.options)
    for name in options.change:
        if name in INTERVENTIONS:
            _check_intervention(name, scene, layout, video, camera)
        else:
            _check_factor(name, options, scene, layout)
    annotated = [name for name in ("contacts", "energy", "lyapunov") if getattr(annotations, name)]
    violations = [name for name in options.change if name in VIOLATIONS]
    if annotated and violations:
        raise ValueError(
            f"change is {violations[0]}, which breaks the laws of motion: annotations.{annotated[0]} must be off"
        )


def check_look(options: Any, scene: Any, look: Any) -> None:
    """Raise ValueError, beginning with the option's name, if a palette's colours hide a change, or change with it."""
    named = palettes.palette_of(look.options)
    if not options.change or named is None:
        return
    palette, specs, layout = look.options.palette, factor_options(scene.contract), scene.contract.layout(scene.options)
    moving = sum(run.count for run in layout.groups if run.kind != STATIC) - int(layout.later_links.sum())
    for name in options.change:
        if name.endswith("color"):
            raise ValueError(f"change is {name}, which look.palette={palette} hides: look.palette must be scene")
        counts = name == "remove" or (name in specs and specs[name].kind is int)
        if counts and moving > len(named.objects):
            raise ValueError(
                f"change is {name}, but look.palette={palette} has {len(named.objects)} colors for up to {moving} "
                "objects, whose colors would change too: look.palette must be scene or random"
            )


def _check_intervention(name: str, scene: Any, layout: Layout, video: Any, camera: Any) -> None:
    min_objects = {"gravity_flip": 0, "identity_swap": 2}.get(name, 1)
    if free_slots(layout).sum() < min_objects:
        raise ValueError(f"change is {name}, but the scene has no {min_objects} that move and are on no joint")
    if name in VIOLATIONS and video.frames < 2:
        raise ValueError(f"change is {name}, but video.frames is {video.frames}, and that happens on the way")
    if name == "remove" and camera.follow is not None:
        raise ValueError("change is remove, but camera.follow may be what is gone: it must be null")
    gravity = getattr(scene.options, "gravity", ())
    if name == "gravity_flip" and all(part.support == (0, 0) for part in gravity):
        raise ValueError("change is gravity_flip, but there is no scene.gravity to reverse")


def _check_factor(name: str, options: Any, scene: Any, layout: Layout) -> None:
    specs = factor_options(scene.contract)
    if name not in specs:
        raise ValueError(f"change is {name!r}, which is no factor; {plugins.nearest(name, [*INTERVENTIONS, *specs])}")
    value = getattr(scene.options, name)
    parts = value if isinstance(value, tuple) else (value,)
    if options.scale is None:
        if all(low == high for low, high in (part.support for part in parts)):
            raise ValueError(f"change is {name}, but scene.{name} is always the same: give it a range, or scale it")
        return
    if specs[name].kind is int:
        raise ValueError(f"scale is for numbers, but scene.{name} is a whole number, which can be drawn anew only")
    scaled = tuple(_scaled(part, options.scale, specs[name]) for part in parts)
    widened = dataclasses.replace(scene.options, **{name: scaled if isinstance(value, tuple) else scaled[0]})
    scene.contract.check(widened)
    if scene.contract.layout(widened) != layout:
        raise ValueError(f"scale is for what the scene is not built around, but scene.{name} is: draw it anew")


def _scaled(part: Distribution, scale: Distribution, spec: Any) -> Distribution:
    """A uniform distribution over the range of a factor's part after scaling, within the option's limits."""
    ends = [end * factor for end in part.support for factor in scale.support]
    low, high = (-math.inf if spec.low is None else spec.low), (math.inf if spec.high is None else spec.high)
    return Distribution("uniform", (max(min(ends), low), min(max(ends), high)))
