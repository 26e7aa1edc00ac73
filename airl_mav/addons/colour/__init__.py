"""Colour cameras: appearance of arenas, their rendering, image sensors, and `airl render`.

Renders sRGB with sun, shadows, textures, reflections and fog in real time; depth, segmentation and
optical flow of the same pixels; motion blur, exposure control, noise and JPEG of an image sensor.
Used by cameras of kind rgb and grey, and by the tables `appearance` of arenas and `imaging` of
cameras.
Command: `airl render`.
Depends on: the extra `film` for videos.
Guide: docs/explanation/colour.md.
"""

_HERE = "airl_mav.addons.colour"

COMMANDS = {"render": ("show", "draw an arena, or a film of a flight", f"{_HERE}.command")}
COLOUR = {
    "batch": f"{_HERE}.batch:ColourImages",
    "clear": f"{_HERE}.appearance:clear_of",
    "expose": f"{_HERE}.picture:expose_colour",
    "look": f"{_HERE}.appearance:look_of",
    "looks": f"{_HERE}.batch:Looks",
    "sensor": f"{_HERE}.image_sensor:ImageFormation",
}
PROFILE_SECTIONS = {
    "arena.appearance": f"{_HERE}.profile:Appearance",
    "camera.imaging": f"{_HERE}.profile:Imaging",
}
