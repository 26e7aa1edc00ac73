"""Video: a camera's images as H.264 over RTP, for QGroundControl and other players.

Announces the camera by MAVLink's camera protocol.
Command: `airl video`. Option: `--video HOST:PORT` of `airl sitl`.
Depends on: `companion.frame_source`, MAVSDK; the extra `film`.
Guide: docs/how-to/view-and-export.md.
"""

COMMANDS = {
    "video": ("show", "stream the camera to QGroundControl", "airl_mav.addons.video.command")
}

LIGHT = True

SITL_OPTIONS = {"video": "airl_mav.addons.video.command:shown_beside"}
