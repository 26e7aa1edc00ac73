"""3D scene in local NED with up = -z; the vehicle's parts are in FRD."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from airl_mav.addons.view.panel import camera_picture
from airl_mav.addons.view.view_messages import Episode, Shown, VehicleShape, VehicleState
from airl_mav.arena.geometry import Arena, Bounds, Shape
from airl_mav.arena.triangles import drawn, standing
from airl_mav.core import frames
from airl_mav.core.frames import goal_height_m
from airl_mav.profiles.projections import PROJECTIONS
from airl_mav.profiles.vehicle import CORNERS, COUNTER_CLOCKWISE
from airl_mav.report import scene

FRUSTUM_M = 0.6
"""Distance of the drawn camera image: ahead, or above for a 360° camera [m]."""

WIDEST_FRUSTUM_DEG = 120.0
"""Maximum horizontal field of view of a drawn frustum [deg]."""

UNROLLED_M = 2.0
"""Width of the drawn image of a 360° camera [m]."""

AMBIENT, SIDE = 0.9, 0.9
"""Intensities of the ambient and the side light; viser adds a light from above."""

SIDE_NED = (-6.0, -9.0, -5.0)
"""Position of the side light, NED [m]."""

CHUNK = 200
"""Segments per part of the trail; finished parts are not sent again."""

BLADE_TURN_RAD = 1.9
"""Rotation of a rotor at full speed per drawing [rad]. A real rotor turns about ten times per
drawing, too fast for a screen."""

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])

Floats = NDArray[np.float64]


class FlightScene:
    """Scene of one server. Call from one thread."""

    def __init__(
        self,
        server: viser.ViserServer,
        root: str = "/flight",
        look: scene.FlightColours = scene.FIRST,
    ) -> None:
        """Prepare an empty scene with all nodes below `root`."""
        self._server = server
        self._root = root
        self._look = look
        self._scene: Any = server.scene
        self._scene.set_up_direction((0.0, 0.0, -1.0))
        self._scene.world_axes.visible = False
        # Shadows render the scene twice and cost a third of the frame rate without a GPU.
        self._scene.configure_default_lights(cast_shadow=False)
        # An environment map halves the frame rate without a GPU. Ambient light replaces it, and
        # the side light makes round shapes visible.
        self._scene.configure_environment_map(None)
        self._scene.add_light_ambient("/light/ambient", intensity=AMBIENT)
        self._scene.add_light_directional("/light/side", intensity=SIDE, position=SIDE_NED)
        self._drawn = -1
        """Number of the drawn episode."""
        self._base: Any = None
        self._reset()

    def _reset(self) -> None:
        if self._base is not None:
            self._base.remove()  # and all below it
        self._base = self._scene.add_frame(self._root, show_axes=False)
        self._is_surrounded = False
        self._movers: list[Any] = []
        self._blades: list[Any] = []
        self._turns = np.zeros(4)
        self._rotor_turn = np.array([-1.0 if c in COUNTER_CLOCKWISE else 1.0 for c in CORNERS])
        self._trail: list[Any] = []
        self._trail_points = 0
        self._picture: Any = None

    def _add(self, kind: str, name: str, *args: Any, **properties: Any) -> Any:
        if kind == "box":
            # Box corners have a normal per side, so both settings look the same. Without flat
            # shading, a page without a GPU compiles one shader less at start.
            properties["flat_shading"] = False
        return getattr(self._scene, f"add_{kind}")(f"{self._root}{name}", *args, **properties)

    def draw(self, shown: Shown, *, picture: bool) -> None:
        """Draw the current state; with `picture`, also the camera's image."""
        episode = shown.episode
        if episode is None:
            return
        with self._server.atomic():
            if shown.episodes != self._drawn:
                self._drawn = shown.episodes
                self._reset()
                self._build(episode)
            if shown.is_surrounded and not self._is_surrounded:
                self._is_surrounded = True
                self._surround(episode, shown.arena)
            if shown.vehicle is not None:
                self._move(shown, shown.vehicle, episode)
        if picture:
            self.draw_picture(shown)

    def draw_picture(self, shown: Shown) -> None:
        """Draw the camera's image in the existing scene."""
        if shown.picture is not None and shown.episode is not None and self._look.whole:
            range_m = shown.episode.vehicle.camera_range_m
            self._camera.image = camera_picture(shown.picture, range_m)

    # --- once an episode

    def _surround(self, episode: Episode, arena: Arena | None) -> None:
        if self._look.whole:
            bounds = scene.OPEN if arena is None else arena.bounds
            self._build_floor(bounds)
            self._build_ends(episode, 0.6 * bounds.height, _below(arena, episode.goal))
            if arena is not None:
                self._build_arena(arena)

    def _build(self, episode: Episode) -> None:
        self._build_vehicle(episode.vehicle)
        none = np.zeros((0, 2, 3), np.float32)
        # Children of a frame at the vehicle's position, so that they move in sync with it.
        self._place = self._add("frame", "/place", show_axes=False)
        self._drop = self._add("line_segments", "/place/drop", none, scene.DROP, thickness=0.015)
        sizes = {"shaft_radius": 0.025, "head_radius": 0.07, "head_length": 0.16}
        self._flown = self._add("arrows", "/place/flown", none, scene.FLOWN, **sizes)
        self._commanded = self._add("arrows", "/place/commanded", none, scene.COMMANDED, **sizes)

    def _build_floor(self, b: Bounds) -> None:
        length, width = b.north_max - b.north_min, b.east_max - b.east_min
        middle = (0.5 * (b.north_min + b.north_max), 0.5 * (b.east_min + b.east_max))
        self._add(
            "grid",
            "/arena/floor",
            *(length, width),
            plane="xy",
            cell_size=1.0,
            section_size=5.0,
            cell_color=scene.GRID,
            section_color=scene.SECTION,
            plane_color=scene.FLOOR,
            plane_opacity=1.0,
            fade_distance=400.0,
            position=(*middle, 0.0),
            # The grid's front side faces along its local +z.
            wxyz=frames.quat_from_euler(math.pi, 0.0, 0.0),
        )

    def _build_arena(self, arena: Arena) -> None:
        # Drawn from inside only: transparent from outside.
        look = {"color": arena.wall_colour, "opacity": scene.WALL_OPACITY, "side": "front"}
        self._add(
            "mesh_simple", "/arena/walls", *scene.walls(arena.bounds), **look, flat_shading=True
        )
        if arena.ground is not None:
            self._add_surface("/arena/ground", arena.ground.points, arena.ground.faces, scene.HILLS)
        shown = drawn(arena.meshes)
        for each in shown:
            colour = arena.colour_of(each.first)
            self._add_surface(f"/arena/mesh/{each.first}", *standing(each), colour)
        for i in range(len(arena.obstacles)):
            if arena.mesh_of(i) in shown:
                continue
            moves = i >= arena.n_static
            colour = scene.MOVING if moves else arena.colour_of(i)
            glass = arena.clear is not None and bool(arena.clear[i])
            node = self._obstacle(arena, i, colour, scene.GLASS_OPACITY if glass else None)
            if moves:
                self._movers.append(node)

    def _add_surface(
        self, name: str, places: Floats, faces: NDArray[np.int32], colour: scene.Colour
    ) -> None:
        mesh = places.astype(np.float32), faces.astype(np.uint32)
        self._add("mesh_simple", name, *mesh, color=colour, side="double", flat_shading=True)

    def _build_ends(self, episode: Episode, height: float, base: float) -> None:
        (north, east), green = episode.goal[:2], {"color": scene.GOAL}
        within = {"radius": episode.goal_radius_m, **green}
        if (height_m := goal_height_m(episode.goal)) is not None:
            height = height_m - base
            self._add("icosphere", "/goal/ball", **within, opacity=0.3, position=episode.goal)
        at = (north, east, -base - 0.03)
        self._add("cylinder", "/goal/disc", **within, height=0.04, opacity=0.45, position=at)
        at = (north, east, -base - 0.5 * height)
        self._add("cylinder", "/goal/pole", **green, radius=0.04, height=height, position=at)
        at = (north, east, -base - height - 0.2)
        self._add("label", "/goal/label", "goal", position=at)
        disc = {"radius": 0.4, "height": 0.03, "color": scene.START, "opacity": 0.5}
        self._add("cylinder", "/start", **disc, position=(0.0, 0.0, -0.02))

    def _obstacle(self, arena: Arena, i: int, colour: scene.Colour, opacity: float | None) -> Any:
        half, at = arena.obstacles.half_size[i].tolist(), tuple(arena.obstacles.center[i].tolist())
        name = f"/arena/obstacle/{i}"
        if arena.obstacles.shape[i] == Shape.BOX:
            turn = frames.quat_from_euler(0.0, 0.0, float(arena.obstacles.yaw[i]))
            size = tuple(2.0 * extent for extent in half)
            look = {"color": colour, "opacity": opacity}
            return self._add("box", name, dimensions=size, position=at, wxyz=turn, **look)
        look = {"color": colour, "opacity": opacity, "position": at}
        if arena.obstacles.shape[i] == Shape.SPHERE:
            return self._add("icosphere", name, radius=half[0], **look)
        return self._add("cylinder", name, radius=half[0], height=2.0 * half[2], **look)

    def _build_vehicle(self, shape: VehicleShape) -> None:
        self._vehicle = self._add("frame", "/vehicle", show_axes=False)
        forward, right, radius = shape.arm_forward_m, shape.arm_right_m, shape.rotor_radius_m
        height = max(0.04, 0.5 * shape.height_m)
        size = 0.45 * min(forward, right)
        body = {"color": self._look.body, "dimensions": (3.4 * size, 2.2 * size, height)}
        self._add("box", "/vehicle/body", **body)
        nose = {"color": scene.NOSE, "dimensions": (0.9 * size, 1.0 * size, 0.6 * height)}
        self._add("box", "/vehicle/nose", **nose, position=(2.0 * size, 0.0, 0.0))
        arm = {**body, "dimensions": (2.0 * math.hypot(forward, right), 0.025, 0.02)}
        for name, side in (("right", 1.0), ("left", -1.0)):
            turn = frames.quat_from_euler(0.0, 0.0, math.atan2(side * right, forward))
            self._add("box", f"/vehicle/arm/{name}", **arm, wxyz=turn)
        for corner in CORNERS:
            at = (
                forward if corner.startswith("front") else -forward,
                right if corner.endswith("right") else -right,
                -0.5 * height - 0.02,
            )
            name = f"/vehicle/rotor/{corner.replace(' ', '-')}"
            disc = {"radius": radius, "height": 0.006, "color": self._look.disc, "opacity": 0.5}
            self._add("cylinder", f"{name}/disc", position=at, **disc)
            blade = {"dimensions": (2.0 * radius, 0.12 * radius, 0.008), "color": scene.BLADE}
            self._blades.append(self._add("box", f"{name}/blade", position=at, **blade))
        if self._look.whole:
            self._build_camera(shape)

    def _build_camera(self, shape: VehicleShape) -> None:
        pitch, yaw = map(math.radians, (shape.camera_pitch_up_deg, shape.camera_yaw_deg))
        turn = frames.quat_from_euler(0.0, pitch, yaw)
        if PROJECTIONS[shape.camera_projection].cylindrical:
            # A 360° camera: the unrolled image is above the vehicle, centred on forward.
            self._camera = self._add(
                "image",
                "/vehicle/camera",
                np.zeros((1, 1, 3), np.uint8),
                render_width=UNROLLED_M,
                render_height=UNROLLED_M / shape.camera_aspect,
                position=(0.0, 0.0, -shape.camera_up_m - FRUSTUM_M),
                wxyz=frames.FRD_FROM_OPTICAL,
            )
            return
        # A fisheye's frustum is drawn at the maximum width.
        across = math.tan(0.5 * math.radians(min(shape.camera_fov_deg, WIDEST_FRUSTUM_DEG)))
        self._camera = self._add(
            "camera_frustum",
            "/vehicle/camera",
            fov=2.0 * math.atan(across / shape.camera_aspect),
            aspect=shape.camera_aspect,
            scale=FRUSTUM_M,
            thickness=0.012,
            color=scene.FLOWN,
            position=(shape.camera_forward_m, shape.camera_right_m, -shape.camera_up_m),
            wxyz=frames.quat_multiply(turn, frames.FRD_FROM_OPTICAL),
        )

    # --- every time

    def _move(self, shown: Shown, vehicle: VehicleState, episode: Episode) -> None:
        at = np.array(vehicle.position)
        self._vehicle.position, self._vehicle.wxyz = at, np.array(vehicle.quaternion)
        self._place.position = at
        self._turns += BLADE_TURN_RAD * self._rotor_turn * np.array(vehicle.rotors)
        for blade, turn in zip(self._blades, self._turns.tolist(), strict=True):
            blade.wxyz = frames.quat_from_euler(0.0, 0.0, turn)
        if shown.arena is not None and self._movers:
            centers = shown.arena.centers_at(vehicle.time_us - episode.started_us)
            for node, center in zip(self._movers, centers[shown.arena.n_static :], strict=True):
                node.position = center
        above = -at[2] - _below(shown.arena, vehicle.position)
        self._drop.points = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, above]]], np.float32)
        self._flown.points = scene.arrow(np.array(vehicle.velocity))
        command = shown.command if self._look.whole else None
        if command is not None:
            command = frames.heading_to_ned(command, frames.quat_yaw(np.array(vehicle.quaternion)))
        self._commanded.points = scene.arrow(command)
        self._extend_trail(shown.trail)

    def _extend_trail(self, trail: list[tuple[float, float, float]]) -> None:
        """Draw the trail in parts; only the last part changes."""
        if len(trail) == self._trail_points or len(trail) < 2:
            return
        self._trail_points = len(trail)
        for part in range(max(0, len(self._trail) - 1), (len(trail) - 2) // CHUNK + 1):
            segments = scene.segments_of(trail[part * CHUNK : (part + 1) * CHUNK + 1])
            if part == len(self._trail):
                name = f"/trail/{part}"
                self._trail.append(
                    self._add("line_segments", name, segments, self._look.trail, thickness=0.04)
                )
            else:
                self._trail[part].points = segments


def _below(arena: Arena | None, place: Sequence[float]) -> float:
    """Return the ground height at a position (>= 2,) NED [m]."""
    if arena is None or arena.ground is None:
        return 0.0
    return arena.ground.height_at(place[0], place[1])
