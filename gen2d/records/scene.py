"""Scenes (objects, joints, gravity) and their states (positions and velocities)."""

from gen2d.records.axes import Array, axes, record


@record
class Objects:
    """Properties of a scene's slots; all fields of an empty slot are zero."""

    present: Array = axes("objects/present", "n K", "1", "whether the slot holds an object", "bool")
    kind: Array = axes("objects/kind", "n K", "1", "kind of body: 0 dynamic, 1 static, 2 kinematic", "uint8")
    shape: Array = axes("objects/shape", "n K", "1", "shape: 0 circle, 1 segment, 2 capsule, 3 polygon", "uint8")
    radius: Array = axes("objects/radius", "n K", "m", "radius of a disc or of rounded corners")
    half_length: Array = axes("objects/half_length", "n K", "m", "half the distance between the core's ends")
    depth: Array = axes("objects/depth", "n K", "1", "drawing order; 0: farthest back", "int16")
    mass: Array = axes("objects/mass", "n K", "kg", "mass; infinite for a static object")
    moment: Array = axes("objects/moment", "n K", "kg m^2", "moment of inertia; infinite for a static object")
    elasticity: Array = axes("objects/elasticity", "n K", "1", "coefficient of restitution, before mixing")
    friction: Array = axes("objects/friction", "n K", "1", "coefficient of friction, before mixing")
    color: Array = axes("objects/color", "n K 3", "sRGB", "color: red, green, blue", "uint8")
    vertices: Array | None = axes(
        "objects/vertices", "n K V 2", "m", "vertices of a polygon in its frame, counter-clockwise", default=None
    )
    vertex_count: Array | None = axes("objects/vertex_count", "n K", "1", "number of vertices", "uint8", default=None)
    rolling_resistance: Array | None = axes(
        "objects/rolling_resistance",
        "n K",
        "1",
        "rolling resistance: torque over normal force and radius",
        default=None,
    )
    force: Array | None = axes("objects/force", "n K 2", "N", "constant force at the centre of mass", default=None)
    torque: Array | None = axes("objects/torque", "n K", "N m", "constant torque", default=None)


@record
class Joints:
    """Parameters of the joints; the layout holds their kinds and the slots that they connect."""

    anchor_a: Array = axes("joints/anchor_a", "n J 2", "m", "anchor in the frame of object a")
    anchor_b: Array = axes("joints/anchor_b", "n J 2", "m", "anchor in the frame of object b")
    rest: Array = axes("joints/rest", "n J", "m, rad", "rest length of a distance joint, rest angle of a revolute one")
    stiffness: Array = axes("joints/stiffness", "n J", "N/m", "stiffness of a distance joint; infinite: rigid")
    damping: Array = axes("joints/damping", "n J", "N s/m", "damping of a distance joint that is not rigid")
    lower: Array = axes("joints/lower", "n J", "rad", "lower limit of a revolute joint; -infinite: none")
    upper: Array = axes("joints/upper", "n J", "rad", "upper limit of a revolute joint; infinite: none")
    motor_speed: Array = axes("joints/motor_speed", "n J", "rad/s", "target speed of the motor of a revolute joint")
    motor_torque: Array = axes("joints/motor_torque", "n J", "N m", "largest torque of the motor; 0: no motor")


@record
class Scene:
    """Quantities that are constant during a video."""

    objects: Objects
    gravity: Array = axes("world/gravity", "n 2", "m/s^2", "acceleration of free fall, y up")
    joints: Joints | None = None


@record
class State:
    """Positions and velocities of all objects, at one instant or (with axis T) at every frame."""

    position: Array = axes("states/position", "n T K 2", "m", "position of the centre of mass, y up")
    angle: Array = axes("states/angle", "n T K", "rad", "angle, counter-clockwise, not wrapped")
    velocity: Array = axes("states/velocity", "n T K 2", "m/s", "velocity of the centre of mass")
    angular_velocity: Array = axes("states/angular_velocity", "n T K", "rad/s", "angular velocity, counter-clockwise")
