"""Impacts on bodies that rigid joints hold: closed forms of one impact, and the matrices that the joints take."""

import jax.numpy as jnp
import numpy as np
import pytest
from laws import holds
from numpy.testing import assert_allclose

from gen2d import Space
from gen2d.physics.banded import factor, inverse_band

ONE_PROGRAM = {"seconds": 0.25, "fps": 240, "contacts": 400}  # of all scenes of a disc and a box on a hinge


@pytest.mark.parametrize(("rows", "width"), [(1, 1), (7, 3), (20, 4)])
def test_band_of_an_inverse_is_that_of_the_whole_inverse(rows, width):
    random = np.random.default_rng(rows)
    i, j = np.indices((rows, rows))
    half = random.normal(size=(rows, rows)) * (i >= j) * (i - j < width) + 5 * np.eye(rows)
    matrix = half @ half.T
    bands = np.stack([np.pad(np.diagonal(matrix, o), (0, o)) for o in range(width)], axis=1)[..., None]
    inverse, ones = np.linalg.inv(matrix), jnp.ones((rows, 1), bool)
    for offset, diagonal in enumerate(inverse_band(factor(jnp.asarray(bands, jnp.float32), ones)).swapaxes(0, 1)):
        expected = np.diagonal(inverse, offset)
        assert_allclose(np.asarray(diagonal)[: rows - offset, 0], expected, rtol=1e-4, atol=1e-6)


def test_disc_that_strikes_a_hinged_plank_at_an_angle_turns_it_as_the_closed_form_says():
    """The hinge's two rows act together where the plank lies across both."""
    space, length, arm, speed, lean = Space(gravity=(0, 0)), 4.0, 3.0, 2.0, 0.6
    along, across = np.array([np.cos(lean), np.sin(lean)]), np.array([-np.sin(lean), np.cos(lean)])
    plank = space.add_box(length / 2 * along, length, 0.2, angle=lean, mass=3.0, elasticity=1.0, friction=0.0)
    space.add_joint("revolute", plank, anchor_a=(0, 0))
    disc = space.add_circle(
        arm * along + 0.5 * across, 0.3, mass=0.7, velocity=-speed * across, elasticity=1.0, friction=0.0
    )
    video, last = space.simulate(**ONE_PROGRAM), 48  # after .2 s
    moment = space.bodies[plank].moment + 3.0 * (length / 2) ** 2
    impulse = 2 * speed / (1 / 0.7 + arm**2 / moment)
    holds("leaning plank: speed of the disc", video.velocity[last, disc] @ across - (impulse / 0.7 - speed), 1e-4)
    holds("leaning plank: spin", video.angular_velocity[last, plank] + arm * impulse / moment, 1e-4)


@pytest.mark.parametrize("elasticity", [0.0, 0.5, 1.0])
def test_disc_that_strikes_a_hinged_plank_bounces_as_the_closed_form_says(elasticity):
    """The plank turns about its hinge at one end: the disc meets the moment about the hinge over the arm squared."""
    space, length, arm, speed = Space(gravity=(0, 0)), 4.0, 3.0, 2.0
    own = elasticity**0.5  # of a pair: the product
    plank = space.add_box((length / 2, 0), length, 0.2, mass=3.0, elasticity=own, friction=0.0)
    space.add_joint("revolute", plank, anchor_a=(0, 0))
    disc = space.add_circle((arm, 0.5), 0.3, mass=0.7, velocity=(0, -speed), elasticity=own, friction=0.0)
    video, last = space.simulate(**ONE_PROGRAM), 16  # the disc strikes after .05 s
    moment = space.bodies[plank].moment + 3.0 * (length / 2) ** 2
    impulse = (1 + elasticity) * speed / (1 / 0.7 + arm**2 / moment)
    holds("hinged plank: speed of the disc", video.velocity[last, disc, 1] - (impulse / 0.7 - speed), 2e-4)
    holds("hinged plank: spin", video.angular_velocity[last, plank] + arm * impulse / moment, 2e-4)


def test_hard_blow_on_a_light_box_far_from_its_hinge_bounces_as_the_closed_form_says():
    """The line of the impulse passes the hinge at .1 m, so the box hardly gives way; a free one would turn by 4 rad."""
    space, arm, speed, side, lever = Space(gravity=(0, 0)), 2.0, 8.0, 0.3, 0.1
    box = space.add_box((arm, 0), side, side, mass=0.1, elasticity=1.0, friction=0.0)
    space.add_joint("revolute", box, anchor_a=(0, 0))
    disc = space.add_circle(
        (arm + side / 2 + 0.3 + 0.41, lever), 0.3, mass=0.7, velocity=(-speed, 0), elasticity=1.0, friction=0.0
    )
    video, last = space.simulate(**ONE_PROGRAM), 14  # the disc strikes after .05 s
    moment = space.bodies[box].moment + 0.1 * arm**2
    impulse = 2 * speed / (1 / 0.7 + lever**2 / moment)
    holds("box far from its hinge: speed of the disc", video.velocity[last, disc, 0] - (impulse / 0.7 - speed), 8e-3)
    spin = video.angular_velocity[last, box] - lever * impulse / moment
    holds("box far from its hinge: spin, of 2.8 rad/s", spin, 5e-3)


def test_disc_that_strikes_one_end_of_a_rod_moves_both_as_the_closed_form_says():
    """The rod leaves 3/4 of the inverse mass of the struck disc at 45 degrees, and passes momentum on to the other."""
    space, speed = Space(gravity=(0, 0)), 2.0
    one = space.add_circle((0, 0), 0.3, mass=1.5, elasticity=1.0, friction=0.0)
    other = space.add_circle((1, 1), 0.3, mass=1.5, elasticity=1.0, friction=0.0)
    space.add_joint("distance", one, other)
    disc = space.add_circle((0, -0.7), 0.3, mass=0.7, velocity=(0, speed), elasticity=1.0, friction=0.0)
    video = space.simulate(15 / 240, fps=240, contacts=0)  # the disc strikes after .05 s
    impulse = 2 * speed / (1 / 0.7 + 0.75 / 1.5)
    holds("rod of two discs: speed of the striking one", video.velocity[-1, disc, 1] - (speed - impulse / 0.7), 2e-4)
    momentum = 1.5 * (video.velocity[-1, one] + video.velocity[-1, other]) - (0, impulse)
    holds("rod of two discs: momentum of both, kg m/s", momentum, 2e-4)


def test_box_that_lands_flat_above_a_hinge_bounces_as_on_a_fixed_plank(caplog):
    """Both of its points press at once, on a plank that can only turn about its middle, and does not."""
    space, speed = Space(gravity=(0, 0)), 2.0
    own = 0.5**0.5  # of a pair: the product
    plank = space.add_box((0, 0), 4.0, 0.2, mass=0.5, elasticity=own, friction=0.0)
    space.add_joint("revolute", plank, anchor_a=(0, 0))
    box = space.add_box((0, 0.7), 1.0, 1.0, mass=2.0, velocity=(0, -speed), elasticity=own, friction=0.0)
    video = space.simulate(16 / 240, fps=240, contacts=0)  # the box lands after .05 s
    holds("box above a hinge: speed after the bounce", video.velocity[-1, box, 1] - 0.5 * speed, 5e-4)
    holds("box above a hinge: spins", video.angular_velocity[-1], 2e-4)
    assert "come apart" not in caplog.text, "the hinge has no arm, and holds"


def test_heavy_boxes_on_a_light_plank_that_they_balance_stand_still():
    """Contacts start with the impulses of the last step, which the hinge takes: they move the plank nowhere."""
    space, masses, places = Space(gravity=(0, -9.8)), [0.9, 1.2, 0.8, 0.77], [-2.7, -0.5, 0.9, 3.0]
    plank = space.add_box((0, 0), 7.5, 0.2, mass=0.33, friction=0.8)
    space.add_joint("revolute", plank, anchor_a=(0, 0))
    boxes = [space.add_box((x, 0.5), 0.8, 0.8, mass=m, friction=0.8) for m, x in zip(masses, places, strict=True)]
    video = space.simulate(0.5, fps=240, contacts=0)
    height, angle = video.position[24:, boxes, 1], video.angle[24:, [plank, *boxes]]  # after .1 s
    holds("balanced plank: change of a height in a step, m", np.diff(height, axis=0), 1e-5)
    holds("balanced plank: change of an angle in a step", np.diff(angle, axis=0), 1e-5)


@pytest.mark.parametrize("angle", [0.3, 0.8, 1.3])
def test_bob_on_a_rod_that_strikes_a_wall_at_an_angle_keeps_its_speed(angle):
    """The wall can only turn the bob back on its circle: an elastic one with its whole speed."""
    space, speed = Space(gravity=(0, 0)), 2.0
    wall = 2 * np.cos(angle) + 0.3
    space.add_segment((wall, -5), (wall, 5), elasticity=1.0, friction=0.0)
    start = angle + 0.1
    place, way = np.array([np.cos(start), np.sin(start)]), np.array([np.sin(start), -np.cos(start)])
    bob = space.add_circle(2 * place, 0.3, velocity=speed * way, elasticity=1.0, friction=0.0)
    space.add_joint("distance", bob, anchor_b=(0, 0))
    video = space.simulate(0.3, fps=240, contacts=0)
    turned = np.hypot(*video.velocity[-1, bob])
    assert video.velocity[-1, bob] @ way < 0, "the bob went on"
    # The direction of the rod is that at the start of the step, in which it turns by 1/240 rad.
    holds(f"bob that strikes at {angle} rad: speed", turned / speed - 1, 2 / 240 / np.tan(angle))


def test_rough_disc_that_grazes_a_hinged_plank_turns_it_as_the_closed_form_says():
    """The end of a standing plank can only move across it, so friction meets the moment about the hinge."""
    space, length, speed, spin = Space(gravity=(0, 0)), 2.0, 1.0, 10.0
    plank = space.add_box((0, length / 2), 0.4, length, mass=3.0, elasticity=0.0, friction=1.0)
    space.add_joint("revolute", plank, anchor_a=(0, 0))
    disc = space.add_circle(
        (0, length + 0.5), 0.3, mass=0.7, velocity=(0, -speed), spin=spin, elasticity=0.0, friction=1.0
    )
    contacts = space.simulate(**ONE_PROGRAM).contacts
    first = np.flatnonzero(np.asarray(contacts.normal_impulse) > 0)[0]
    moment = space.bodies[plank].moment + 3.0 * (length / 2) ** 2
    normal, slip = 0.7 * speed, spin * 0.3
    k = 1 / 0.7 + 0.3**2 / space.bodies[disc].moment + length**2 / moment
    tangent = min(normal, slip / k)
    holds("disc on a standing plank: normal impulse", contacts.normal_impulse[first] / normal - 1, 1e-4)
    holds("disc on a standing plank: friction", abs(contacts.tangent_impulse[first]) / tangent - 1, 1e-3)


@pytest.mark.full
def test_friction_acts_on_the_mass_that_a_hinge_leaves():
    """A disc held by a hinge at its centre can only spin: a rough inelastic plank under it stops its rim."""
    space = Space(gravity=(0, 0))
    wheel = space.add_circle((0, 0), 0.5, mass=1.0, spin=6.0, elasticity=0.0, friction=1.0)
    space.add_joint("revolute", wheel, anchor_a=(0, 0))
    plank = space.add_box((0, -0.7), 3.0, 0.2, mass=2.0, velocity=(0, 6.0), elasticity=0.0, friction=1.0)
    video, last = space.simulate(**ONE_PROGRAM), 24  # after .1 s
    rim = 0.5 * video.angular_velocity[last, wheel]
    along = video.velocity[last, plank, 0] + 0.1 * video.angular_velocity[last, plank]
    holds("wheel on a plank: slip of the rim, m/s", rim - along, 2e-2)
    holds("wheel: speed of its hinge, m/s", video.velocity[: last + 1, wheel], 5e-4)
    assert abs(rim) < 2.9
