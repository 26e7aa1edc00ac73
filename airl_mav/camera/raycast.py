"""Depth image of an arena by analytic ray casting: kernel of both training and plant.

A pinhole's pixel has the ray d = forward + x right + y down with (x, y) = ((u - cx) / focal,
(v - cy) / focal), so the distance t along it is the depth along the optical axis (planar z-depth,
RealSense Z16). A cylinder's pixel has d = cos(a) forward + sin(a) right + y down with
a = (u - cx) / focal, and t is the depth in the plane of forward and right. Both are affine along a
line of the image: a row of a pinhole, a column of a cylinder. Each pixel of a fisheye has a
separate unit ray, and t is the range along it.

All computations use inverse depth s = 1 / t. For a plane it is n.d / n.(p - o): affine in the
pixel, no division, finite for grazing rays. For a sphere or cylinder it is a root of a quadratic. A
convex body is hit if its last entry is no farther than its first exit. The image keeps the maximum
s of all bodies. One final division per pixel converts it to metres.

The outer loop runs over obstacles: each updates only the projected rectangle of its bounding box or
sphere. The loops along a line are branch-free and vectorize. They use float64: a float32 direction
is off by millimetres on a floor at a distance of 20 m.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from airl_mav.camera import primitives, projection
from airl_mav.camera.bvh import Meshes, is_owned, raised
from airl_mav.camera.meshes import Faces, draw_meshes
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Quat, Vec, rotate


@borrowing_kernel
def body_of(
    scene: projection.Scene, axes: projection.Pose, camera: Vec, i: int
) -> projection.ProjectedBody:
    """Return an obstacle in the world's axes."""
    center, half_size = scene.center, scene.half_size
    offset = (center[i, 0] - camera[0], center[i, 1] - camera[1], center[i, 2] - camera[2])
    half = (half_size[i, 0], half_size[i, 1], half_size[i, 2])
    pose = projection.Pose(axes.forward, axes.across, axes.along, offset)
    return projection.ProjectedBody(i, scene.shape[i], half, scene.yaw[i], pose)


@borrowing_kernel
def _draw_obstacle(
    out: projection.Image,
    ids: primitives.Ids | None,
    drawn_in: primitives.Rectangles | None,
    optics: projection.Optics,
    body: projection.ProjectedBody,
) -> bool:
    """Draw one obstacle; return True if the camera is inside."""
    cos, sin = 1.0, 0.0
    shape, world, half, view = body.shape, body.pose, body.half, optics.lens
    if shape == primitives.BOX:
        cos, sin = math.cos(body.yaw), math.sin(body.yaw)
    elif shape == primitives.CYLINDER:
        # Its bounding box is narrowest in the image when turned towards the camera.
        distance = math.hypot(world.center[0], world.center[1])
        if distance > 0.0:
            cos, sin = world.center[0] / distance, world.center[1] / distance
    pose = primitives.turned(world, cos, sin)
    sphere = shape != primitives.BOX and shape != primitives.CYLINDER
    turns = 0
    span = (0.0, 0.0, 0, 0)
    rectangle = (0, 0, 0, 0)
    if view.cylindrical:
        # A body behind the camera may appear at both ends of the image.
        turns = 1
        span = projection.cylinder_span(out, view, pose, half, sphere)
    else:
        rectangle = projection.rectangle_of(out, optics.bent, view, pose, half, sphere)
    own = projection.ProjectedBody(body.number, shape, half, body.yaw, pose)
    for turn in range(-turns, turns + 1):
        if view.cylindrical:
            rectangle = projection.cut(out, view, span, turn)
        if drawn_in is not None:
            for side in range(4):
                drawn_in[turn + turns, side] = rectangle[side]
        if rectangle[0] >= rectangle[1] or rectangle[2] >= rectangle[3]:
            continue
        inside: bool
        if shape == primitives.BOX:
            inside = primitives.draw_box(out, ids, optics, own, rectangle)
        elif shape == primitives.CYLINDER:
            inside = primitives.draw_cylinder(out, ids, optics, own, rectangle)
        else:
            inside = primitives.draw_sphere(out, ids, optics, own, rectangle)
        if inside:
            return True
    return False


@borrowing_kernel
def invert(out: projection.Image) -> None:
    """Convert inverse depth to depth [m], in place."""
    zero, one = np.float32(0.0), np.float32(1.0)
    # The limits keep the quotient finite and raise near depths to MIN_DEPTH_M.
    least, most = np.float32(primitives.TINY), np.float32(1.0 / projection.MIN_DEPTH_M)
    for v in range(out.shape[0]):
        row = out[v]
        for u in range(len(row)):
            s = row[u]
            t = one / min(max(s, least), most)
            row[u] = t if s > zero else zero


@borrowing_kernel
def blank(out: projection.Image, bent: projection.Bent | None) -> None:
    """Write 0 into pixels of a tabled projection outside the field of view."""
    if bent is None:
        return
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            i, j, k = bent.forward[v, u], bent.across[v, u], bent.along[v, u]
            if i == 0.0 and j == 0.0 and k == 0.0:
                out[v, u] = 0.0


@borrowing_kernel
def aim(
    lines: projection.Lines,
    xs: projection.Line,
    quaternion: Quat | NDArray[np.float64],
    lens: projection.LensConstants,
) -> tuple[projection.ImageProjection, projection.Pose]:
    """Write the rays of an image's lines; return the view, and camera axes without a centre.

    `lines` (n, 2) receives the components of each line's first ray on the forward axis and the axis
    across, `xs` (m,) each ray's component on the axis along.
    """
    q = (quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    forward, right, down = (
        rotate(q, (1.0, 0.0, 0.0)),
        rotate(q, (0.0, 1.0, 0.0)),
        rotate(q, (0.0, 0.0, 1.0)),
    )
    focal, cx, cy, cylindrical = lens.focal, lens.cx, lens.cy, lens.cylindrical
    s_min = max(1.0 / lens.range_m, primitives.TINY)
    nowhere = (0.0, 0.0, 0.0)
    # The lines of a cylinder are columns: across is right, along is down.
    if cylindrical:
        for u in range(len(lines)):
            angle = (u - cx) / focal
            lines[u, 0], lines[u, 1] = math.cos(angle), math.sin(angle)
        for v in range(len(xs)):
            xs[v] = (v - cy) / focal
        return projection.ImageProjection(focal, cx, cy, s_min, cylindrical), projection.Pose(
            forward, right, down, nowhere
        )
    for v in range(len(lines)):
        lines[v, 0], lines[v, 1] = 1.0, (v - cy) / focal
    for u in range(len(xs)):
        xs[u] = (u - cx) / focal
    return projection.ImageProjection(focal, cy, cx, s_min, cylindrical), projection.Pose(
        forward, down, right, nowhere
    )


@borrowing_kernel
def draw_bodies(
    out: projection.Image,
    ids: primitives.Ids | None,
    drawn_in: primitives.Rectangles | None,
    optics: projection.Optics,
    scene: projection.Scene,
    meshes: Meshes | None,
    faces: Faces | None,
) -> int:
    """Write the inverse depth of an arena; return the obstacle around the camera, or -1.

    `out` (n, m) is inverse depth [1/m], 0 = no return. `ids` (n, m) is CEILING, SKY, ...,
    OBSTACLE + number, or GROUND for hills, `drawn_in` (obstacles + meshes, 3, 4) the rectangles of
    bodies, `faces` (n, m) the visible triangles of meshes. These three are written unless None.
    """
    bounds, camera, axes = scene.bounds, optics.camera, optics.axes
    room = (
        0.5 * (bounds[0] + bounds[1]) - camera[0],
        0.5 * (bounds[2] + bounds[3]) - camera[1],
        -0.5 * bounds[4] - camera[2],
    )
    half_room = (0.5 * (bounds[1] - bounds[0]), 0.5 * (bounds[3] - bounds[2]), 0.5 * bounds[4])
    pose = projection.Pose(axes.forward, axes.across, axes.along, room)
    primitives.draw_room(out, ids, optics, pose, half_room, bounds[5] > 0.0)
    for i in range(len(scene.shape)):
        # A mesh is drawn in place of its obstacles.
        if is_owned(meshes, i):
            continue
        kept = None if drawn_in is None else drawn_in[i]
        if _draw_obstacle(out, ids, kept, optics, body_of(scene, axes, camera, i)):
            return i
    if meshes is not None:
        draw_meshes(out, ids, faces, drawn_in, optics, optics.bent, meshes)
    return -1


@kernel
def write_transposed(out: NDArray[Any], drawn: NDArray[Any]) -> None:
    """Write an image (w, h) rendered by columns to `out` (h, w).

    A slice assignment would also compile numba's error texts, for seconds at each use.
    """
    for u in range(drawn.shape[0]):
        for v in range(drawn.shape[1]):
            out[v, u] = drawn[u, v]


@kernel
def render_depth(
    out: projection.Image,
    position: Vec | NDArray[np.float64],
    quaternion: Quat | NDArray[np.float64],
    lens: projection.LensConstants,
    scene: projection.Scene,
    meshes: Meshes | None,
) -> None:
    """Render the depth image of an arena.

    The floor is the rectangle of the bounds at z = 0. The walls are thin, stand on its edges and
    are visible from both sides. A ray above the walls has no return, unless there is a ceiling at
    their height. A camera less than `MIN_DEPTH_M` above the ground is raised to that height (a
    resting vehicle sinks in by the contact's penetration). Inside an obstacle every pixel reads
    `MIN_DEPTH_M`. Meshes are rendered in place of the obstacles that they own, also from inside.

    `out` (height, width) is depth [m], written; 0 = no return. It is measured along the optical
    axis of a pinhole, in the camera's horizontal plane of a cylinder, along the ray of a fisheye.
    The camera is at `position` NED [m]. Its x axis by `quaternion` (camera -> NED) is the optical
    axis; y points to the right of the image, z to its bottom. `meshes` contains the visible meshes,
    hills included; None has no cost.
    """
    camera = raised(meshes, position)
    height, width = out.shape
    cylindrical, bent = lens.cylindrical, lens.bent
    xs = np.empty(height if cylindrical else width)
    lines = np.empty((width if cylindrical else height, 2))
    view, axes = aim(lines, xs, quaternion, lens)
    # Columns of a cylinder are drawn into contiguous memory, then transposed into `out`.
    drawn = np.empty((width, height), np.float32) if cylindrical else out
    optics = projection.Optics(lines, xs, bent, view, axes, camera)
    inside = draw_bodies(drawn, None, None, optics, scene, meshes, None)
    if inside >= 0:
        out[:, :] = projection.MIN_DEPTH_M
        blank(out, bent)
        return
    invert(drawn)
    if cylindrical:
        write_transposed(out, drawn)
