"""Scene of a flight in Foxglove's primitives: arena, goal, path, vehicle, velocities.

Seeking viewers load the newest message of each topic. Foxglove's frame `world` is ENU: x east, y
north, z up. Bodies are FLU: x forward, y left, z up. `core.frames` converts.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from foxglove import messages
from numpy.typing import NDArray

from airl_mav.addons.view.view_messages import VehicleShape
from airl_mav.arena.geometry import Arena, Bounds, Shape
from airl_mav.arena.triangles import drawn, standing
from airl_mav.black_box.messages import Channel
from airl_mav.core import clock, constants, frames
from airl_mav.core.frames import Goal, goal_height_m
from airl_mav.profiles.vehicle import CORNERS
from airl_mav.report import scene

Floats = NDArray[np.float64]

WORLD, VEHICLE, ESTIMATE, CAMERA = "world", "vehicle", "estimate", "camera"
"""Frame names: the arena; the true and the estimated vehicle; the camera's optical frame (x right,
y down, z forward)."""

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])

PROTOBUF = "protobuf"


_CHANNELS: dict[tuple[str, Any], Channel] = {}


def channel(topic: str, message: Any) -> Channel:
    """Return the channel of a topic for messages of this type."""
    key = topic, type(message)
    if key not in _CHANNELS:
        schema = message.get_schema()
        data = bytes(schema.data)
        _CHANNELS[key] = Channel(topic, schema.name, schema.encoding, data, PROTOBUF)
    return _CHANNELS[key]


def timestamp(unix_us: int) -> messages.Timestamp:
    """Convert a calendar time [µs since 1970]."""
    seconds, rest_us = divmod(unix_us, constants.US_PER_S)
    return messages.Timestamp(seconds, rest_us * clock.NS_PER_US)


def vector(v: Floats) -> messages.Vector3:
    """Convert a vector (3,) without changing its frame."""
    x, y, z = v.tolist()
    return messages.Vector3(x=x, y=y, z=z)


def quaternion(q: Floats) -> messages.Quaternion:
    """Convert a rotation (4,) [w, x, y, z] without changing its frames."""
    w, x, y, z = q.tolist()
    return messages.Quaternion(x=x, y=y, z=z, w=w)


def place(ned: Floats) -> messages.Vector3:
    """Convert a position (3,) NED [m] to `world`."""
    return vector(frames.ned_to_enu(np.asarray(ned, np.float64)))


def attitude(ned_from_frd: Floats) -> messages.Quaternion:
    """Convert an attitude (4,) FRD -> NED to FLU -> `world`."""
    return quaternion(frames.quat_ned_frd_to_enu_flu(ned_from_frd))


def pose(ned: Floats, ned_from_frd: Floats = UNTURNED) -> messages.Pose:
    """Convert a pose NED [m], FRD -> NED, to `world`."""
    return messages.Pose(position=place(ned), orientation=attitude(ned_from_frd))


def points(ned: Floats) -> list[messages.Point3]:
    """Convert positions (n, 3) NED [m] to `world`."""
    return [messages.Point3(x=x, y=y, z=z) for x, y, z in frames.ned_to_enu(ned).tolist()]


def colour(rgb: scene.Colour, opacity: float = 1.0) -> messages.Color:
    """Convert a colour with an opacity, 0 to 1."""
    red, green, blue = (part / 255.0 for part in rgb)
    return messages.Color(r=red, g=green, b=blue, a=opacity)


_ORIGIN = messages.Pose(position=vector(np.zeros(3)), orientation=quaternion(UNTURNED))

THIN_M = 0.02
"""Thickness of floor, walls and discs [m]."""

Size = tuple[float, float, float]


def _entity(name: str, at: messages.Timestamp, **primitives: Any) -> messages.SceneEntity:
    return messages.SceneEntity(timestamp=at, frame_id=WORLD, id=name, **primitives)


def arena_scene(
    arena: Arena | None, goal: Goal, goal_radius_m: float, at: messages.Timestamp
) -> messages.SceneUpdate:
    """Return the static scene: floor, hills, walls, obstacles, goal and start."""
    bounds = scene.OPEN if arena is None else arena.bounds
    ground = None if arena is None else arena.ground
    base_m = 0.0 if ground is None else ground.height_at(goal[0], goal[1])
    top_m = goal_height_m(goal) or base_m + 0.6 * bounds.height
    entities = [
        _entity("floor", at, cubes=[_floor(bounds)]),
        _ends(goal, goal_radius_m, (base_m, top_m), at),
    ]
    if ground is not None:
        entities.append(_surface("ground", ground.points, ground.faces, scene.HILLS, at))
    if arena is not None:
        entities.append(_entity("walls", at, cubes=_walls(bounds, arena.wall_colour)))
        centers = arena.obstacles.center
        shown = drawn(arena.meshes)
        entities += [
            obstacle(arena, i, centers[i], scene.STILL, f"obstacle/{i}", at)
            for i in range(arena.n_static)
            if arena.mesh_of(i) not in shown
        ]
        entities += [
            _surface(f"mesh/{each.first}", *standing(each), scene.STILL, at) for each in shown
        ]
    return messages.SceneUpdate(entities=entities)


def movers_scene(arena: Arena, from_us: int, at: messages.Timestamp) -> messages.SceneUpdate:
    """Return the moving obstacles at a time after the reset [µs]."""
    centers = arena.centers_at(from_us)
    moving = range(arena.n_static, len(arena.obstacles))
    return messages.SceneUpdate(
        entities=[obstacle(arena, i, centers[i], scene.MOVING, f"mover/{i}", at) for i in moving]
    )


def path_scene(way: Floats, at: messages.Timestamp) -> messages.SceneUpdate:
    """Return the complete path (n, 3) NED [m] as a line."""
    line = messages.LinePrimitive(
        type=messages.LinePrimitiveLineType.LineStrip,
        pose=_ORIGIN,
        thickness=2.0,  # pixels
        scale_invariant=True,
        points=points(way),
        color=colour(scene.FIRST.trail),
    )
    return messages.SceneUpdate(entities=[_entity("path", at, lines=[line])])


def velocity_scene(
    position: Floats, flown: Floats, commanded: Floats | None, at: messages.Timestamp
) -> messages.SceneUpdate:
    """Return velocities (3,) NED [m/s] as arrows from the vehicle's position (3,) NED [m]."""
    arrows = [_arrow(position, flown, scene.FLOWN)]
    if commanded is not None:
        arrows.append(_arrow(position, commanded, scene.COMMANDED))
    shown = [arrow for arrow in arrows if arrow is not None]
    return messages.SceneUpdate(entities=[_entity("velocity", at, arrows=shown)])


def vehicle_scene(
    shape: VehicleShape, frame: str, look: scene.FlightColours, at: messages.Timestamp
) -> messages.SceneUpdate:
    """Return a vehicle built from primitives that move with its frame."""
    forward, right = shape.arm_forward_m, shape.arm_right_m
    height, size = max(0.04, 0.5 * shape.height_m), 0.45 * min(forward, right)
    opacity = 1.0 if look.whole else 0.4
    nose = _in_body(np.array([2.0 * size, 0.0, 0.0]))
    cubes = [
        _cube(_in_body(np.zeros(3)), (3.4 * size, 2.2 * size, height), look.body, opacity),
        _cube(nose, (0.9 * size, size, 0.6 * height), scene.NOSE, opacity),
    ]
    rotors = []
    for corner in CORNERS:
        fore, side = "front" in corner, "right" in corner
        at_frd = np.array(
            [forward if fore else -forward, right if side else -right, -0.5 * height - THIN_M]
        )
        arm = _in_body(np.array([*(0.5 * at_frd[:2]), 0.0]), math.atan2(at_frd[1], at_frd[0]))
        cubes.append(_cube(arm, (math.hypot(*at_frd[:2]), 0.025, 0.02), look.body, opacity))
        rotors.append(
            _cylinder(_in_body(at_frd), shape.rotor_radius_m, THIN_M, look.disc, 0.5 * opacity)
        )
    entity = messages.SceneEntity(
        timestamp=at, frame_id=frame, id=frame, frame_locked=True, cubes=cubes, cylinders=rotors
    )
    return messages.SceneUpdate(entities=[entity])


def obstacle(
    arena: Arena, i: int, center: Floats, rgb: scene.Colour, name: str, at: messages.Timestamp
) -> messages.SceneEntity:
    """Return obstacle i with its current centre (3,) NED [m]."""
    half_size = arena.obstacles.half_size[i]
    yaw = frames.quat_from_euler(0.0, 0.0, float(arena.obstacles.yaw[i]))
    glass = arena.clear is not None and bool(arena.clear[i])
    look: dict[str, Any] = {
        "pose": pose(center, yaw),
        "size": vector(2.0 * half_size),
        "color": colour(rgb, scene.GLASS_OPACITY if glass else 1.0),
    }
    if arena.obstacles.shape[i] == Shape.BOX:
        return _entity(name, at, cubes=[messages.CubePrimitive(**look)])
    if arena.obstacles.shape[i] == Shape.SPHERE:
        return _entity(name, at, spheres=[messages.SpherePrimitive(**look)])
    whole = messages.CylinderPrimitive(**look, bottom_scale=1.0, top_scale=1.0)
    return _entity(name, at, cylinders=[whole])


def _surface(
    name: str, places: Floats, faces: NDArray[np.int32], rgb: scene.Colour, at: messages.Timestamp
) -> messages.SceneEntity:
    surface = messages.TriangleListPrimitive(
        pose=_ORIGIN, points=points(places), color=colour(rgb), indices=faces.ravel().tolist()
    )
    return _entity(name, at, triangles=[surface])


def _floor(b: Bounds) -> messages.CubePrimitive:
    north, east = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
    size = (b.north_max - b.north_min, b.east_max - b.east_min, THIN_M)
    return _cube(pose(np.array([north, east, 0.5 * THIN_M])), size, scene.FLOOR)


def _walls(b: Bounds, rgb: scene.Colour) -> list[messages.CubePrimitive]:
    north, east = 0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max)
    along_east = (THIN_M, b.east_max - b.east_min, b.height)
    along_north = (b.north_max - b.north_min, THIN_M, b.height)
    sides = [
        (b.north_min, east, along_east),
        (b.north_max, east, along_east),
        (north, b.east_min, along_north),
        (north, b.east_max, along_north),
    ]
    return [
        _cube(pose(np.array([x, y, -0.5 * b.height])), size, rgb, scene.WALL_OPACITY)
        for x, y, size in sides
    ]


def _ends(
    goal: Goal, radius_m: float, pole_m: tuple[float, float], at: messages.Timestamp
) -> messages.SceneEntity:
    """Return start and goal; `pole_m` are the lower and upper height of the goal's pole."""

    def disc(place: Size, radius: float, rgb: scene.Colour) -> messages.CylinderPrimitive:
        return _cylinder(pose(np.array(place) - [0.0, 0.0, THIN_M]), radius, THIN_M, rgb, 0.45)

    (north, east), (base, top) = goal[:2], pole_m
    middle = pose(np.array([north, east, -0.5 * (base + top)]))
    pole = _cylinder(middle, 0.04, top - base, scene.GOAL)
    name = messages.TextPrimitive(
        pose=pose(np.array([north, east, -top - 0.4])),
        billboard=True,
        font_size=0.6,
        color=colour(scene.GOAL),
        text="goal",
    )
    discs = (
        disc((north, east, -base), radius_m, scene.GOAL),
        disc((0.0, 0.0, 0.0), 0.4, scene.START),
    )
    return _entity("goal", at, cylinders=[discs[0], pole, discs[1]], texts=[name])


def _cylinder(
    at: messages.Pose, radius: float, height: float, rgb: scene.Colour, opacity: float = 1.0
) -> messages.CylinderPrimitive:
    return messages.CylinderPrimitive(
        pose=at,
        size=messages.Vector3(x=2.0 * radius, y=2.0 * radius, z=height),
        bottom_scale=1.0,
        top_scale=1.0,
        color=colour(rgb, opacity),
    )


def _cube(
    at: messages.Pose, size: Size, rgb: scene.Colour, opacity: float = 1.0
) -> messages.CubePrimitive:
    return messages.CubePrimitive(pose=at, size=vector(np.array(size)), color=colour(rgb, opacity))


def _in_body(frd: Floats, yaw: float = 0.0) -> messages.Pose:
    """Return the pose of a part at FRD [m] on the body, rotated right by `yaw` [rad]."""
    turned = frames.quat_from_euler(0.0, 0.0, -yaw)
    return messages.Pose(position=vector(frames.frd_to_flu(frd)), orientation=quaternion(turned))


def _arrow(position: Floats, velocity: Floats, rgb: scene.Colour) -> messages.ArrowPrimitive | None:
    """Return the arrow of a velocity NED [m/s]; None if too short."""
    length = scene.ARROW_S * float(np.linalg.norm(velocity))
    if length < scene.LEAST_ARROW_M:
        return None
    head = min(0.16, 0.5 * length)
    return messages.ArrowPrimitive(
        pose=messages.Pose(
            position=place(position),
            orientation=quaternion(frames.quat_from_direction(frames.ned_to_enu(velocity))),
        ),
        shaft_length=length - head,
        shaft_diameter=0.05,
        head_length=head,
        head_diameter=0.14,
        color=colour(rgb),
    )
