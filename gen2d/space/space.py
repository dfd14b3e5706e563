"""Scenes in a few lines of Python, simulated at once.

    space = gen2d.Space(gravity=(0, -9.8))
    floor = space.add_segment((-5, 0), (5, 0), elasticity=1)
    ball = space.add_circle((0, 3), radius=0.5, elasticity=0.8)
    video = space.simulate(seconds=2)
    video.position[:, ball], video.contacts.time, video.energy.residual
    video.save("fall.webp")

A body's number counts the bodies in the order in which they are added; it is also its index in every result. The
solver's slots have another order, because each slot group of a layout holds one shape and kind: `Space.slots` maps
numbers to slots.
"""

import dataclasses
import itertools
import logging
import math
from collections.abc import Sequence
from typing import Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from gen2d.config.options import build
from gen2d.config.sections import PhysicsOptions
from gen2d.core.enums import DYNAMIC, SHAPES
from gen2d.core.errors import ConfigError
from gen2d.core.progress import waiting
from gen2d.physics import inertia
from gen2d.physics.params import SolverParams, solver_params
from gen2d.physics.simulate import Forces, SaveAt, substeps
from gen2d.records.axes import to_device
from gen2d.records.layout import JointSpec, Layout, SlotGroup
from gen2d.records.scene import Joints, Objects, Scene, State
from gen2d.space.arrange import (
    body_numbers,
    closest_points,
    compiled_program,
    filled_contacts,
    pad_vertices,
    shape_family,
    slot_order,
    slots_of_span,
    world_anchor,
)
from gen2d.space.bodies import KINDS, Body, BodyOptions, Joint, Overlaps, Pair, Poses, hinge_gap
from gen2d.space.checks import checked_color, checked_corners, checked_number, checked_pair, rotate
from gen2d.space.video import Video

_log = logging.getLogger(__name__)
TORN = 0.1  # of the longest arm or radius of gyration: larger gaps of hinges are warned of; usual ones are under 1e-3
SAFE_RATIO = 10  # of two masses: at 240 steps/s the heavier one first sinks in by 2 mm


class Space:
    """Scene of bodies and joints, which are added one by one, and the options of its physics.

    Units are SI units and radians; y points up.

    Parameters
    ----------
    gravity : pair of float
        Acceleration in m/s^2.
    **physics
        Options of a config's section `physics`, with the same defaults: damping (1/s), mixing ("product", "mean",
        "max", "geometric"), bounce_threshold (m/s), max_step (s), substeps, contact_hertz (Hz), contact_damping_ratio,
        push_speed (m/s), precision ("float32", "float64"), impact_order ("pairs", "time"), relax_iterations,
        extreme_mass_ratios.

    Raises
    ------
    ConfigError
        If an argument is invalid.

    Examples
    --------
    >>> space = gen2d.Space(gravity=(0, -9.8))
    >>> floor = space.add_segment((-5, 0), (5, 0), elasticity=1)
    >>> ball = space.add_circle((0, 3), radius=0.5, elasticity=0.8)
    >>> video = space.simulate(seconds=2)
    >>> height = video.position[:, ball, 1]
    """

    def __init__(self, gravity: Pair = (0.0, -9.8), **physics: float | str) -> None:
        self.gravity = checked_pair("Space: gravity", gravity)
        self.physics: PhysicsOptions = build(PhysicsOptions, physics, "physics", "Space")
        self.bodies: list[Body] = []
        self.joints: list[Joint] = []

    def add_circle(self, position: Pair, radius: float, *, angle: float = 0.0, **options: Unpack[BodyOptions]) -> int:
        """Add a disc.

        Parameters
        ----------
        position : pair of float
            Centre in m.
        radius : float
            Radius in m, above 0.
        angle : float
            Angle in rad.
        **options
            Options of the body; see `BodyOptions`.

        Returns
        -------
        int
            Number of the body.

        Raises
        ------
        ConfigError
            If an argument is invalid.
        """
        name = "add_circle"
        radius = checked_number(f"{name}: radius", radius, above=0)
        return self._add(name, "circle", checked_pair(f"{name}: position", position), angle, radius=radius, **options)

    def add_segment(self, a: Pair, b: Pair, *, radius: float = 0.0, **options: Unpack[BodyOptions]) -> int:
        """Add a line segment, which is static by default.

        Parameters
        ----------
        a, b : pair of float
            Ends of the segment in m.
        radius : float
            Half the thickness in m, with round ends. A dynamic segment of radius 0 has no area, so it needs a mass.
        **options
            Options of the body; see `BodyOptions`.

        Returns
        -------
        int
            Number of the body.

        Raises
        ------
        ConfigError
            If an argument is invalid.
        """
        radius = checked_number("add_segment: radius", radius, low=0)
        return self._add_line("add_segment", "segment", a, b, radius, **{"kind": "static", **options})

    def add_chain(
        self,
        points: Sequence[Pair] | np.ndarray,
        *,
        closed: bool = False,
        radius: float = 0.0,
        **options: Unpack[BodyOptions],
    ) -> list[int]:
        """Add a chain of segments from point to point, such as hilly ground; bodies do not feel its joints.

        Parameters
        ----------
        points : array_like, [P, 2]
            At least 2 points in m.
        closed : bool
            Whether a last segment leads back to the first point, which takes 3 points.
        radius : float
            Half the thickness of the segments in m.
        **options
            Options of each segment; see `BodyOptions`. The kind is "static".

        Returns
        -------
        list of int
            Numbers of the segments, in the order of their points.

        Raises
        ------
        ConfigError
            If an argument is invalid.

        Examples
        --------
        >>> space = gen2d.Space()
        >>> ground = space.add_chain([(-4, 1), (0, 0), (4, 1)], friction=0.2)
        >>> box = space.add_box((-3, 1.5), 0.4, 0.4)
        """
        least, number = 3 if closed else 2, len(points)
        if number < least:
            raise ConfigError(f"add_chain: points has {number} points, but must have at least {least}")
        if (kind := options.get("kind", "static")) != "static":
            raise ConfigError(f"add_chain: kind is {kind!r}, but must be 'static'")
        radius = checked_number("add_chain: radius", radius, low=0)
        ends = [checked_pair(f"add_chain: points[{i}]", point) for i, point in enumerate(points)]
        starts = ends if closed else ends[:-1]
        for i, start in enumerate(starts):
            if (start == ends[(i + 1) % number]).all():
                raise ConfigError(f"add_chain: points[{i}] and the next are both {start.tolist()}, but must differ")
        chain: Any = {**options, "kind": "static"}
        return [
            self._add_line("add_chain", "segment", start, ends[(i + 1) % number], radius, **chain)
            for i, start in enumerate(starts)
        ]

    def add_capsule(self, a: Pair, b: Pair, radius: float, **options: Unpack[BodyOptions]) -> int:
        """Add a capsule: all points within `radius` of the line segment from a to b.

        Parameters
        ----------
        a, b : pair of float
            Centres of the ends in m.
        radius : float
            Radius of the ends in m, above 0.
        **options
            Options of the body; see `BodyOptions`.

        Returns
        -------
        int
            Number of the body.

        Raises
        ------
        ConfigError
            If an argument is invalid.
        """
        return self._add_line(
            "add_capsule", "capsule", a, b, checked_number("add_capsule: radius", radius, above=0), **options
        )

    def add_box(
        self, position: Pair, width: float, height: float, *, angle: float = 0.0, **options: Unpack[BodyOptions]
    ) -> int:
        """Add a rectangle.

        Parameters
        ----------
        position : pair of float
            Centre in m.
        width, height : float
            Sides in m along the body's x and y axes, above 0.
        angle : float
            Angle in rad.
        **options
            Options of the body; see `BodyOptions`.

        Returns
        -------
        int
            Number of the body.

        Raises
        ------
        ConfigError
            If an argument is invalid.
        """
        name = "add_box"
        w, h = (checked_number(f"{name}: {n}", x, above=0) / 2 for n, x in (("width", width), ("height", height)))
        corners = np.array([(-w, -h), (w, -h), (w, h), (-w, h)])
        return self._add(
            name, "polygon", checked_pair(f"{name}: position", position), angle, vertices=corners, **options
        )

    def add_polygon(self, vertices: Sequence[Pair] | np.ndarray, **options: Unpack[BodyOptions]) -> int:
        """Add a convex polygon. Its position is its centre of mass, its angle 0.

        Parameters
        ----------
        vertices : array_like, [V, 2]
            The 3 to 8 corners in world coordinates, in m, clockwise or counter-clockwise.
        **options
            Options of the body; see `BodyOptions`.

        Returns
        -------
        int
            Number of the body.

        Raises
        ------
        ConfigError
            If an argument is invalid.
        """
        corners = checked_corners("add_polygon: vertices", vertices)
        with jax.enable_x64(True):
            centre = np.asarray(inertia.polygon_centroid(jnp.asarray(corners)))
        return self._add("add_polygon", "polygon", centre, 0.0, vertices=corners - centre, **options)

    def add_joint(
        self, kind: str, a: int, b: int | None = None, *, anchor_a: Pair | None = None, anchor_b: Pair | None = None,
        length: float | None = None, stiffness: float = math.inf, damping: float = 0.0,
        limits: tuple[float, float] | None = None, motor_speed: float = 0.0, motor_torque: float = 0.0,
        collide: bool = False,
    ) -> int:  # fmt: skip
        """Add a joint between two bodies, or between a body and the world.

        Parameters
        ----------
        kind : str
            "distance" for a rod or a spring between the anchors, or "revolute" for a hinge in `anchor_a`.
        a, b : int
            Numbers of the bodies; without `b`, the joint ties a to the world.
        anchor_a, anchor_b : pair of float, optional
            Anchors in world coordinates, in m; by default the centres of mass. A revolute joint needs `anchor_a` and
            has no `anchor_b`; a distance joint to the world needs `anchor_b`.
        length : float, optional
            Length of a distance joint in m; by default the current distance of the anchors.
        stiffness : float
            Stiffness of a distance joint in N/m; infinite for a rod.
        damping : float
            Damping of a distance joint in N s/m.
        limits : pair of float, optional
            Smallest and largest angle of a revolute joint in rad, from the current one: of b relative to a, or of a
            relative to the world.
        motor_speed : float
            Target speed of a revolute joint's motor in rad/s.
        motor_torque : float
            Largest torque of the motor in N m; 0 for none.
        collide : bool
            Whether the two bodies collide with each other.

        Returns
        -------
        int
            Number of the joint.

        Raises
        ------
        ConfigError
            If an argument is invalid, or neither body is dynamic.
        """
        name = "add_joint"
        if kind not in ("distance", "revolute"):
            raise ConfigError(f"{name}: kind is {kind!r}, but must be one of distance, revolute")
        ends = [self._checked_body(f"{name}: {n}", i) for n, i in (("a", a), ("b", b)) if i is not None]
        if len(set(ends)) == 1 and b is not None:
            raise ConfigError(f"{name}: a and b are both {a}, but must be two bodies")
        if all(self.bodies[i].kind != DYNAMIC for i in ends):
            raise ConfigError(f"{name}: neither body is dynamic, but one of them must be")
        numbers = {
            "rest": 0.0,
            "stiffness": checked_number(f"{name}: stiffness", stiffness, low=0, infinite=True),
            "damping": checked_number(f"{name}: damping", damping, low=0),
            "motor_speed": checked_number(f"{name}: motor_speed", motor_speed),
            "motor_torque": checked_number(f"{name}: motor_torque", motor_torque, low=0),
        }
        low, high = (-math.inf, math.inf) if limits is None else limits
        numbers["lower"] = checked_number(f"{name}: limits[0]", low, infinite=True)
        numbers["upper"] = checked_number(f"{name}: limits[1]", high, low=low, infinite=True)
        if kind == "distance" and (limits is not None or motor_torque):
            raise ConfigError(f"{name}: limits and motor are of a revolute joint, but this one is a distance joint")
        if kind == "revolute":
            if anchor_a is None or anchor_b is not None or length is not None or stiffness != math.inf or damping:
                raise ConfigError(f"{name}: a revolute joint needs anchor_a, and has no anchor_b, length or spring")
            anchor_b = anchor_a
        elif b is None and anchor_b is None:
            raise ConfigError(f"{name}: anchor_b is None, but a joint to the world needs a point of it")
        # The world comes first, so that a hinge's angle is that of the body.
        pairs = [(a, anchor_a), (b, anchor_b)] if b is not None else [(-1, anchor_b), (a, anchor_a)]
        points = [self.bodies[i].position if p is None else checked_pair(f"{name}: anchor", p) for i, p in pairs]
        (one, two), numbers["rest"] = (i for i, _ in pairs), self._angle(pairs[1][0]) - self._angle(pairs[0][0])
        if kind == "distance":
            now = float(np.hypot(*(points[1] - points[0])))
            numbers["rest"] = now if length is None else checked_number(f"{name}: length", length, low=0)
        inside = [self._to_body_frame(i, p) for (i, _), p in zip(pairs, points, strict=True)]
        self.joints.append(Joint(kind, one, two, inside[0], inside[1], bool(collide), numbers))
        return len(self.joints) - 1

    def _checked_body(self, name: str, number: Any) -> int:
        if not isinstance(number, int | np.integer) or isinstance(number, bool) or not 0 <= number < len(self.bodies):
            raise ConfigError(f"{name} is {number!r}, but must be the number of a body, 0 to {len(self.bodies) - 1}")
        return int(number)

    def _angle(self, number: int) -> float:
        return 0.0 if number < 0 else self.bodies[number].angle

    def _to_body_frame(self, number: int, point: np.ndarray) -> np.ndarray:
        if number < 0:
            return point
        return rotate(point - self.bodies[number].position, -self.bodies[number].angle)

    def _add_line(self, name: str, shape: str, a: Pair, b: Pair, radius: float, **options: Any) -> int:
        first, last = checked_pair(f"{name}: a", a), checked_pair(f"{name}: b", b)
        x, y = last - first
        if x == 0 and y == 0:
            raise ConfigError(f"{name}: a and b are both {first.tolist()}, but must be two points")
        length, angle = math.hypot(x, y), math.atan2(y, x)
        return self._add(name, shape, (first + last) / 2, angle, radius=radius, half_length=length / 2, **options)

    def _add(
        self, name: str, shape: str, position: np.ndarray, angle: float, *,
        radius: float = 0.0, half_length: float = 0.0, vertices: np.ndarray | None = None,
        kind: str = "dynamic", velocity: Pair = (0.0, 0.0), spin: float = 0.0,
        density: float = 1.0, mass: float | None = None, moment: float | None = None,
        elasticity: float = 0.0, friction: float = 0.7, rolling_resistance: float = 0.0,
        color: Any = None, force: Pair | None = None, torque: float | None = None,
    ) -> int:  # fmt: skip
        if kind not in KINDS:
            raise ConfigError(f"{name}: kind is {kind!r}, but must be one of {', '.join(KINDS)}")
        number, label = len(self.bodies), lambda option: f"{name}: {option}"
        body = Body(
            shape=shape,
            position=position,
            angle=checked_number(label("angle"), angle),
            kind=KINDS[kind],
            radius=radius,
            half_length=half_length,
            vertices=np.zeros((0, 2)) if vertices is None else vertices,
            velocity=checked_pair(label("velocity"), velocity),
            spin=checked_number(label("spin"), spin),
            mass=math.inf,
            moment=math.inf,
            elasticity=checked_number(label("elasticity"), elasticity, low=0),
            friction=checked_number(label("friction"), friction, low=0),
            rolling_resistance=checked_number(label("rolling_resistance"), rolling_resistance, low=0),
            color=checked_color(label("color"), color, number, KINDS[kind]),
            force=checked_pair(label("force"), (0.0, 0.0) if force is None else force),
            torque=checked_number(label("torque"), 0.0 if torque is None else torque),
        )
        if body.elasticity > 1:
            raise ConfigError(f"{name}: elasticity is {elasticity!r}, but must be a number from 0 to 1")
        if kind == "static" and (body.velocity.any() or body.spin):
            raise ConfigError(f"{name}: a static body has velocity or spin, but must stand still (kinematic: may move)")
        if kind == "dynamic":
            body = dataclasses.replace(body, **_inertia(name, body, density, mass, moment))
        self.bodies.append(body)
        return number

    # ---- Input of the solver

    @property
    def slots(self) -> np.ndarray:
        """Slot of each body in `scene()`, [K]."""
        return self._arrange()[1]

    def scene(self) -> tuple[Scene, State, Layout]:
        """Scene and initial state of one video, as a sampler returns them, and their layout.

        If a joint is tied to the world, an extra slot represents the world: a dynamic body of infinite mass that
        collides with nothing.

        Returns
        -------
        scene : Scene
            Fields of objects have the axes [K, ...] with a row per slot; batch them with `jax.vmap`.
        state : State
            Initial positions [K, 2] m, angles [K] rad and velocities.
        layout : Layout
            Slot groups and joints.

        Raises
        ------
        ConfigError
            If no body is dynamic.
        """
        with jax.enable_x64(self.physics.x64):
            return self._scene()

    def _scene(self) -> tuple[Scene, State, Layout]:
        groups, slots, bodies = self._arrange()
        real = np.dtype(self.physics.precision)

        def column(name: str, dtype: Any = real) -> jax.Array:
            return jnp.asarray(np.array([getattr(body, name) for body in bodies]).astype(dtype))

        corners = max((group.vertices for group in groups), default=0)
        vertices = np.array([pad_vertices(body.vertices, corners) for body in bodies])
        counts = np.array([len(body.vertices) for body in bodies], np.uint8)
        numbers = body_numbers(slots, len(bodies))  # -1: the world's
        objects = Objects(
            present=jnp.ones(len(bodies), bool),
            shape=jnp.asarray([SHAPES.index(body.shape) for body in bodies], jnp.uint8),
            depth=jnp.asarray(np.maximum(numbers, 0), jnp.int16),
            kind=column("kind", np.uint8),
            color=column("color", np.uint8),
            vertices=jnp.asarray(vertices.astype(real)) if corners else None,
            vertex_count=jnp.asarray(counts) if corners else None,
            rolling_resistance=column("rolling_resistance") if any(b.rolling_resistance for b in bodies) else None,
            force=column("force") if any(b.force.any() for b in bodies) else None,
            torque=column("torque") if any(b.torque for b in bodies) else None,
            **{name: column(name) for name in ("radius", "half_length", "mass", "moment", "elasticity", "friction")},
        )
        state = State(column("position"), column("angle"), column("velocity"), column("spin"))
        scene = Scene(objects, jnp.asarray(self.gravity, real), self._joints(real))
        # The last one, -1, is the world's if a joint needs it.
        slot = [*slots.tolist(), *np.flatnonzero(numbers < 0).tolist()]
        joints = tuple(JointSpec(j.kind, slot[j.a], slot[j.b], j.collide, j.limited) for j in self.joints)
        return scene, state, Layout(groups, joints=joints)

    def _joints(self, real: Any) -> Joints | None:
        if not self.joints:
            return None
        anchors = {
            n: jnp.asarray(np.array([getattr(j, n) for j in self.joints]), real) for n in ("anchor_a", "anchor_b")
        }
        return Joints(
            **anchors, **{n: jnp.asarray([j.numbers[n] for j in self.joints], real) for n in self.joints[0].numbers}
        )

    def _arrange(self) -> tuple[tuple[SlotGroup, ...], np.ndarray, list[Body]]:
        """Slot groups, the slot of each body, and the bodies by slot, including the world's if a joint needs it."""
        bodies = list(self.bodies)
        moving = [shape_family(body) for body in bodies if body.kind == DYNAMIC]
        if not moving:
            raise ConfigError(f"Space: none of its {len(bodies)} bodies is dynamic, but one or more must be")
        if any(joint.a < 0 for joint in self.joints):
            # It costs nothing in a group of odd size, as the solver pads groups to even sizes.
            shape = min(dict.fromkeys(moving), key=lambda s: moving.count(s) % 2 == 0)
            bodies.append(world_anchor(shape))
        order = sorted(range(len(bodies)), key=lambda i: slot_order(bodies[i]))
        groups = []
        for _, group in itertools.groupby((bodies[i] for i in order), key=slot_order):
            members = list(group)
            corners = max(len(body.vertices) for body in members)
            groups.append(SlotGroup(shape_family(members[0]), len(members), members[0].kind, corners))
        return tuple(groups), np.argsort(order)[: len(self.bodies)], [bodies[i] for i in order]

    # ---- Simulation

    @waiting("Compiling, and simulating a space")
    def simulate(
        self, seconds: float, fps: float = 30.0, *, substeps: int | None = None, contacts: int | None = None,
        energy: bool = True, forces: Forces | None = None,
    ) -> Video:  # fmt: skip
        """Simulate the space from its initial state.

        The first call compiles a program, which takes seconds. Another space with as many bodies of each shape and the
        same joints reuses it. Logs a warning if masses differ more than contacts at rest bear: by a factor of 10,
        and if hinges come apart.

        Parameters
        ----------
        seconds : float
            Duration in s; the video has round(seconds * fps) + 1 frames, of which frame 0 is the initial state.
        fps : float
            Frame rate in frames/s.
        substeps : int, optional
            Steps per frame; by default as many as `max_step` (1/240 s) requires.
        contacts : int, optional
            Largest number of contact rows; by default 4 for each body and frame, which is more than can touch. 0 for
            none.
        energy : bool
            Whether to record energy and momentum.
        forces : callable, optional
            `forces(state, time)` returns the force [K, 2] in N and the torque [K] in N m on each body at each step,
            from the state (position [K, 2], angle [K] and so on) and the time in s. jax traces it, once for each new
            function.

        Returns
        -------
        Video
            Trajectories of all bodies, contacts and energy.

        Raises
        ------
        ConfigError
            If an argument is invalid, or no body is dynamic.

        Examples
        --------
        >>> drag = lambda state, time: (-0.1 * state.velocity, -0.1 * state.angular_velocity)
        >>> video = space.simulate(seconds=2, fps=60, forces=drag)
        """
        seconds, fps = (checked_number(f"simulate: {n}", x, above=0) for n, x in (("seconds", seconds), ("fps", fps)))
        frames = round(seconds * fps) + 1
        if frames < 2:
            raise ConfigError(
                f"simulate: seconds is {seconds:g}, but must be {0.5 / fps:g} or more at {fps:g} frames/s"
            )
        self._warn_of_masses()
        scene, state, layout = self.scene()
        rows = (
            4 * layout.slots * (frames - 1)
            if contacts is None
            else int(checked_number("simulate: contacts", contacts, low=0))
        )
        params, steps = self._solver_params(fps, substeps)
        slots = self.slots
        slot_forces = None if forces is None else (forces, tuple(int(s) for s in slots))
        program = compiled_program(layout, params, frames, steps, SaveAt(rows, energy), slot_forces, self.physics.x64)
        trajectory = program(*jax.tree.map(lambda x: x[None], (scene, state)))
        trajectory = jax.tree.map(lambda x: np.asarray(x)[0], trajectory)
        states = trajectory.states
        self._warn_of_gaps(states.position[:, slots], states.angle[:, slots], 1 / (fps * steps))
        return Video(
            bodies=tuple(self.bodies),
            joints=tuple(self.joints),
            time=np.arange(frames) / fps,
            position=states.position[:, slots],
            angle=states.angle[:, slots],
            velocity=states.velocity[:, slots],
            angular_velocity=states.angular_velocity[:, slots],
            contacts=None if trajectory.contacts is None else filled_contacts(trajectory.contacts, slots, layout.slots),
            energy=trajectory.energy,
            quality=trajectory.quality,
        )

    def _warn_of_masses(self) -> None:
        """Log a warning if the masses of dynamic bodies differ more than contacts at rest can bear."""
        masses = [body.mass for body in self.bodies if body.kind == DYNAMIC and math.isfinite(body.mass)]
        if masses and max(masses) > SAFE_RATIO * min(masses):
            _log.warning(
                "Space: masses from %.3g to %.3g kg differ by a factor of %.3g: a body that rests on one of less than "
                "1/%g of its mass sinks in where no static body bears that one; half the max_step bears four times "
                "the factor",
                *(min(masses), max(masses), max(masses) / min(masses), SAFE_RATIO),
            )

    def _warn_of_gaps(self, position: np.ndarray, angle: np.ndarray, step: float) -> None:
        """Log a warning if hinges come apart, as the tension in a chain is too large for steps of `step` s."""
        later = slice(len(position) // 2, None)  # anchors that are apart at the start have met by then
        gap = hinge_gap(self.joints, position[later], angle[later])
        ends = [end for joint in self.joints for end in ((joint.a, joint.anchor_a), (joint.b, joint.anchor_b))]
        arms = [math.hypot(*anchor) for body, anchor in ends if body >= 0]
        held = [self.bodies[body] for body, _ in ends if body >= 0 and self.bodies[body].kind == DYNAMIC]
        radii = [math.sqrt(body.moment / body.mass) for body in held]  # of gyration: a wheel's hinge has no arm
        if not gap <= TORN * max([*arms, *radii], default=0.0):
            _log.warning(
                "Space: hinges come apart by %.3g m: a link of mass m and length l under a tension T needs steps below "
                "sqrt(m l / 3 T), and max_step is %.3g s: ask for a fraction of it, or give a taut chain some slack",
                *(gap, step),
            )

    def _solver_params(self, fps: float, asked: int | None) -> tuple[SolverParams, int]:
        physics = self.physics
        if asked is not None:
            asked = int(checked_number("simulate: substeps", asked, low=1))
        steps = substeps(fps, asked or physics.substeps, physics.max_step)
        return solver_params(physics, fps, steps), steps

    def poses(self, position: np.ndarray | None = None, angle: np.ndarray | None = None) -> Poses:
        """Bodies at given positions and angles, and their overlaps; nothing is simulated.

        Pairs without a dynamic body, and pairs that a joint keeps from colliding, are ignored.

        Parameters
        ----------
        position : array_like, [T, K, 2], optional
            Positions in m; by default those at which the bodies were added, with T = 1.
        angle : array_like, [T, K], optional
            Angles in rad; by default those at which the bodies were added.

        Returns
        -------
        Poses
            The poses, with their overlaps as `contacts`.

        Raises
        ------
        ConfigError
            If an array has another shape, or no body is dynamic.
        """
        count = len(self.bodies)
        positions = (
            np.array([[body.position for body in self.bodies]]) if position is None else np.asarray(position, float)
        )
        if positions.ndim != 3 or positions.shape[1:] != (count, 2):
            raise ConfigError(f"poses: position has shape {list(positions.shape)}, but must have [T, {count}, 2]")
        angles = np.array([body.angle for body in self.bodies]) if angle is None else np.asarray(angle, float)
        if angle is not None and angles.shape != positions.shape[:2]:
            raise ConfigError(f"poses: angle has shape {list(angles.shape)}, but must have {list(positions.shape[:2])}")
        angles = np.broadcast_to(angles, positions.shape[:2])
        with jax.enable_x64(self.physics.x64):
            overlaps = self._overlaps(positions, angles)
        return Poses(tuple(self.bodies), tuple(self.joints), positions, angles, overlaps)

    def overlaps(self) -> Overlaps:
        """Overlaps in the initial state, as in `poses`."""
        return self.poses().contacts

    def _overlaps(self, position: np.ndarray, angle: np.ndarray) -> Overlaps:
        scene, _, layout = self.scene()
        objects = to_device(jax.tree.map(lambda x: x[None], scene.objects))
        number, exempt = body_numbers(self.slots, layout.slots), layout.exempt
        body_poses = jnp.asarray(position.transpose(2, 1, 0)), jnp.asarray(angle.T)
        overlaps = []
        for span_a, span_b in itertools.combinations_with_replacement(layout.spans, 2):
            pairs = [
                (i, j)
                for i in slots_of_span(span_a)
                for j in slots_of_span(span_b)
                if i < j and number[i] >= 0 <= number[j] and frozenset((i, j)) not in exempt
            ]
            if not pairs or (span_a[0].kind != DYNAMIC and span_b[0].kind != DYNAMIC):
                continue
            sides = [np.array(side) for side in zip(*pairs, strict=True)]
            first, second = (number[side] for side in sides)
            poses = [[x[..., who, :] for x in body_poses] for who in (first, second)]
            for gap, point, normal in closest_points((span_a[0], span_b[0]), objects, sides, poses):
                pair, frame = np.nonzero(np.asarray(gap) < 0)
                points, normals = (np.asarray(x)[:, pair, frame].T for x in (point, normal))
                overlaps.append(
                    Overlaps(frame, first[pair], second[pair], points, normals, -np.asarray(gap)[pair, frame])
                )
        if not overlaps:
            return Overlaps._make([*np.zeros((3, 0), int), *np.zeros((2, 0, 2)), np.zeros(0)])
        rows = [np.concatenate(parts) for parts in zip(*overlaps, strict=True)]
        order = np.argsort(rows[0], kind="stable")
        return Overlaps._make(row[order] for row in rows)


def _inertia(name: str, body: Body, density: float, mass: float | None, moment: float | None) -> dict[str, float]:
    """Mass in kg and moment of inertia in kg m^2 of a dynamic body."""
    density = checked_number(f"{name}: density", density, above=0)
    mass = None if mass is None else checked_number(f"{name}: mass", mass, above=0)
    with jax.enable_x64(True):
        half, radius, corners, rho = (
            jnp.asarray(x, float) for x in (body.half_length, body.radius, body.vertices, density)
        )
        mass_of, moment_of = {
            "circle": (lambda: inertia.disc_mass(radius, rho), lambda m: inertia.disc_moment(radius, m)),
            "capsule": (
                lambda: inertia.stadium_mass(half, radius, rho),
                lambda m: inertia.stadium_moment(half, radius, m),
            ),
            "polygon": (lambda: inertia.polygon_mass(corners, rho), lambda m: inertia.polygon_moment(corners, m)),
        }[shape_family(body)]
        mass = float(mass_of()) if mass is None else mass
        if mass == 0:
            raise ConfigError(f"{name}: mass is None, but a dynamic body of radius 0 needs one")
        moment = float(moment_of(jnp.asarray(mass))) if moment is None else moment
    return {"mass": mass, "moment": checked_number(f"{name}: moment", moment, above=0, infinite=True)}
