"""Pictures of an arena, films and ground truth of a flight, from a colour camera.

Renders depth, segmentation, optical flow and colour, in real time or path traced.
Command: `airl render`.
Depends on: `airl_mav.camera`, the add-on `view`; the extra `render` for path tracing.
Guide: docs/how-to/camera.md.
"""

COMMANDS = {
    "render": (
        "what a colour camera sees: an arena as a picture, a flight as a film",
        "airl_mav.addons.render.command",
    )
}
