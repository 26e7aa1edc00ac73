"""Arenas from your own meshes: boxes that cover a mesh, and the profile with both.

Cameras see the mesh, plants and planners use the boxes. Reads STL, OBJ, GLB, glTF, PLY and OFF.
Command: `airl asset`.
Depends on: the extra `mesh` (trimesh).
Guide: docs/how-to/arena-assets.md.
"""

COMMANDS = {
    "asset": (
        "show",
        "make an arena obstacle from a mesh (STL, OBJ, GLB)",
        "airl_mav.addons.meshes.command",
    )
}
