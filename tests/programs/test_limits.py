"""Limits of the solver that a config exceeds: what is warned of, with which numbers, and that they are measured."""

import math

import numpy as np
import pytest
from laws import holds
from tiny import CONFIG, run_main

from gen2d import Space, generate
from gen2d.config import plugins
from gen2d.config.config import load_config
from gen2d.programs.limits import exceeded_limits, safe_ratio, sinking

G, DENSITIES = 9.81, "scene.density={log_uniform: [0.001, 1000]}"


def limits(config: str, *overrides: str) -> list[str]:
    return exceeded_limits(load_config(config, overrides))


@pytest.mark.parametrize("fps", [240, pytest.param(480, marks=pytest.mark.full)])
def test_a_heavy_box_on_two_light_ones_sinks_as_deep_as_the_law_says_and_rises_again(fps: int) -> None:
    """With one pass in all steps, as for a load that comes later than the first of a video."""
    ratios = np.array([10.0, 30.0, 100.0])
    space = Space(gravity=(0, -G), max_step=1 / fps, relax_iterations=1)
    space.add_segment((-5, 0), (15, 0))
    for place, ratio in enumerate(ratios):
        for height, density in ((0.5, 1.0), (1.5, 1.0), (2.5, ratio)):
            space.add_box((5.0 * place, height), 1, 1, density=density)
    heights = space.simulate(4, fps=fps, energy=False, contacts=0).position[:, 1:, 1]
    depth = np.maximum(1 - (heights[:, 2::3] - heights[:, 1::3]), 1 - (heights[:, 1::3] - heights[:, ::3]))
    share = depth.max(0) / [sinking(ratio, G, 1 / fps) for ratio in ratios]
    holds("sinking at 10, 30 and 100:1 over that of the law", share, 1.0)
    holds(".4 times the law over the sinking", 0.4 / share, 1.0)
    holds("sinking in the end over that of the law", depth[-1] / depth.max(0), 0.25)


@pytest.mark.parametrize("name", plugins.config_names())
def test_no_config_that_comes_with_gen2d_is_warned_of(name: str) -> None:
    assert limits(name) == []


@pytest.mark.parametrize("name", plugins.names("scene"))
def test_no_family_with_its_defaults_is_warned_of(name: str) -> None:
    assert exceeded_limits(load_config({"scene": name})) == []


def test_masses_that_differ_too_much_are_named_with_what_is_safe() -> None:
    (sentence,) = limits("bouncing", DENSITIES)
    lightest, heaviest = 0.001 * math.pi * 0.25, 1000 * math.pi
    assert "scene.density and scene.radius" in sentence
    assert f"balls of {heaviest:.3g} kg on balls of {lightest:.3g} kg" in sentence
    safe = safe_ratio(0.02, 9.8, 1 / 240)  # of a thickness of 1 m
    assert f"ratios up to {safe:.4g} are" in sentence
    on = "physics.extreme_mass_ratios=true", "physics.relax_iterations=null"
    assert f"; with {on[0]}, fewer heavy bodies go through light ones" in sentence
    one_pass = "physics.relax_iterations=1"
    assert f"; with {on[0]} and {on[1]}, fewer" in limits("bouncing", DENSITIES, one_pass)[0]
    assert f"; with {on[1]}, fewer" in limits("bouncing", DENSITIES, one_pass, on[0])[0]
    assert "fewer" not in limits("bouncing", DENSITIES, on[0])[0]
    narrow = f"scene.density=[1, {safe / 4 * 0.99}]"  # the radii make a factor of 4
    assert limits("bouncing", narrow) == []
    (wider,) = limits("bouncing", f"scene.density=[1, {safe / 4 * 1.5}]")
    step = wider.split("physics.max_step=")[1].split()[0]
    assert limits("bouncing", f"scene.density=[1, {safe / 4 * 1.5}]", f"physics.max_step={step}") == []
    assert limits("bouncing", DENSITIES, "scene.gravity=[0, 0]") == []  # nothing rests on anything
    assert limits("pile", DENSITIES) == []  # all objects of a video have the same density


def test_a_step_that_is_too_long_is_the_cause() -> None:
    (sentence, *_) = limits("tower", "physics.max_step=0.05", "scene.density=1")
    assert "fewer heavy bodies" not in sentence
    assert "in steps of 0.0417 s, not even equal masses are safe" in sentence


def test_speeds_that_are_too_large_for_the_step_are_named_with_a_step_that_is_safe() -> None:
    still = "scene.gravity=[0, 0]"
    (sentence,) = limits("bouncing", "scene.velocity=[{normal: [0, 30]}, 0]", still)
    assert "scene.velocity allow balls of 120 m/s, which move by 0.5 m in a step of 0.00417 s" in sentence
    assert sentence.endswith("physics.max_step=0.002 or less is short enough")
    assert limits("bouncing", "scene.velocity=[[-59, 59], 0]", still) == []
    assert len(limits("bouncing", "scene.velocity=[{mixture: [[0, 1], [60, 61]]}, 0]", still)) == 1
    assert limits("bouncing", "scene.velocity=[0, 0]", still) == []  # nothing moves
    falling = math.sqrt(2 * 9.8 * 10)
    (sentence,) = limits("bouncing", "scene.velocity=[0, 0]", "scene.radius=0.05")
    assert f"allow balls of {falling:.3g} m/s" in sentence


def test_ranges_and_physics_of_splits_count() -> None:
    base = {"scene": {"name": "bouncing", "gravity": [0, -9.8]}}
    heavy = {"heavy": {"factors": {"density": [2, 1000]}}}
    assert len(exceeded_limits(load_config(base | {"splits": {"train": {}, **heavy}}))) == 1
    coarse = {"coarse": {"physics": {"max_step": 0.1}}}
    assert len(exceeded_limits(load_config(base | {"splits": {"train": {}, **coarse}}))) == 2


def test_a_run_says_so_once_and_check_says_it_too(tmp_path) -> None:
    lines: list[str] = []
    config = CONFIG | {"scene": CONFIG["scene"] | {"density": [1, 1000]}}
    (expected,) = exceeded_limits(load_config(config))
    generate(config, 4, tmp_path / "videos", log=lines.append)
    assert [str(line) for line in lines].count(expected) == 1
    done = run_main("config", "check", "bouncing", "--set", DENSITIES)
    (sentence,) = limits("bouncing", DENSITIES)
    assert (done.returncode, done.stdout) == (0, f"bouncing: valid; {sentence}\n")
