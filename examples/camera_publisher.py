"""Publish depth images to the companion over ZeroMQ, from any program on the aircraft or beside it.

    python examples/camera_publisher.py tcp://127.0.0.1:5600 &
    airl-companion --camera tcp://127.0.0.1:5600 ...

The images here are of an empty field; put your camera's in their place. The format is in
docs/reference/camera-protocol.md, so a publisher can as well be written in C++.
"""

import math
import struct
import sys
import time

import numpy as np
import zmq

WIDTH, HEIGHT, FOV_DEG, RATE_HZ = 64, 48, 90.0, 30.0

endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp://127.0.0.1:5600"
focal = 0.5 * WIDTH / math.tan(0.5 * math.radians(FOV_DEG))
cx, cy = 0.5 * (WIDTH - 1), 0.5 * (HEIGHT - 1)
# The ground, 2 m below a level camera: depth along the optical axis in millimetres, 0 = no return.
below = (np.arange(HEIGHT) - cy) / focal
rows = np.where(below > 0.1, 2000.0 / np.maximum(below, 0.1), 0.0)
depth_mm = np.repeat(rows[:, None], WIDTH, axis=1).astype("<u2")

with zmq.Context() as context, context.socket(zmq.PUB) as socket:
    socket.bind(endpoint)
    print(f"publishing on {endpoint}, Ctrl-C ends it", flush=True)
    sequence = 0
    while True:
        taken_us = time.monotonic_ns() // 1000
        header = struct.pack(
            *("<4sQqHHddd", b"ADF1", sequence, taken_us, WIDTH, HEIGHT, focal, cx, cy)
        )
        socket.send(header + depth_mm.tobytes())
        sequence += 1
        time.sleep(1.0 / RATE_HZ)
