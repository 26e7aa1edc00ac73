"""Meshes for tests: triangles that stand on the floor, in files, placed in a room."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from airl_mav.arena.geometry import Arena, Bounds, Obstacles, PlacedMesh
from airl_mav.arena.triangles import Triangles, encoded
from airl_mav.profiles.assets import MeshFile

ROOM = Bounds(-12.0, 12.0, -12.0, 12.0, 5.0)


def triangles(mesh: trimesh.Trimesh) -> Triangles:
    """Return a mesh, z up, as triangles that stand on the floor."""
    forward, left, up = np.asarray(mesh.vertices, np.float64).T
    places = np.stack([forward, -left, -(up - up.min())], axis=1)
    return Triangles(places.astype(np.float32), np.asarray(mesh.faces, np.int32))


def kept(held: Triangles, path: Path) -> MeshFile:
    """Write triangles; return their file."""
    data = encoded(held)
    path.write_bytes(data)
    return MeshFile(file=str(path), sha256=hashlib.sha256(data).hexdigest())


def ring() -> trimesh.Trimesh:
    """Return a ring that stands, of 768 triangles: its hole is seen through, it shades itself."""
    made = trimesh.creation.torus(0.8, 0.3, major_sections=32, minor_sections=12)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([1.4, 0.3, 0.0]).as_matrix()
    made.apply_transform(turn)
    return made


def scene_of(file: MeshFile, placed: list[tuple[float, float, float, float]]) -> Arena:
    """Return a room with meshes: north, east, yaw, scale of each. Their boxes are in the way."""
    n = len(placed)
    center = np.array([(north, east, -0.5) for north, east, _, _ in placed]).reshape(n, 3)
    boxes = Obstacles(np.zeros(n, np.int8), center, np.full((n, 3), 0.5), np.zeros(n))
    meshes = tuple(
        PlacedMesh(file, (north, east), yaw, scale, i, 1)
        for i, (north, east, yaw, scale) in enumerate(placed)
    )
    return Arena("test", 0, ROOM, (90, 90, 90), boxes, (), np.zeros(2), meshes=meshes)
