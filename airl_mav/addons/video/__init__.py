"""Video: a camera's images as H.264 over RTP, for QGroundControl and other players.

Announces the camera by MAVLink's camera protocol.
Command: `airl video`. Option: `--video HOST:PORT` of `airl sitl`.
Depends on: `companion.frame_source`, MAVSDK; the extra `film`.
Guide: docs/how-to/view-and-export.md.
"""

COMMANDS = {
    "video": (
        "what the camera sees, in QGroundControl and other players of RTP",
        "airl_mav.addons.video.command",
    )
}

LIGHT = True

SITL_OPTIONS = {"video": "airl_mav.addons.video.command:shown_beside"}
