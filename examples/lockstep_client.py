"""A companion that takes turns in lockstep, without MAVSDK and without anything of airl-mav.

It arms, takes off, flies a square and lands. Start it with the simulator's onboard port, then the
simulator:

    python examples/lockstep_client.py 14540
    airl-firmware --lockstep --arena open-field

docs/reference/lockstep-protocol.md describes the messages.
"""

import re
import socket
import sys

from pymavlink.dialects.v20 import common as m

link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", int(sys.argv[1])))  # airl-firmware's --api-port
mav = m.MAVLink(None, srcSystem=245, srcComponent=191)
vehicle, turn, now, sent, newest = None, 0, 0, 0, {}


def send(message):
    link.sendto(message.pack(mav), vehicle)
    mav.seq = (mav.seq + 1) % 256


def say(text):
    send(m.MAVLink_statustext_message(m.MAV_SEVERITY_DEBUG, text.encode()))


def receive():
    global vehicle
    datagram, vehicle = link.recvfrom(4096)
    messages = mav.parse_buffer(datagram)
    newest.update((message.get_type(), message) for message in messages)
    return messages


def sleep(seconds):
    """Give the turn back, and take turns until the time has come."""
    global turn, now
    wake = now + int(1e6 * seconds)
    while turn == 0 or now < wake:
        over = turn
        if over:
            say(f"D{over} {wake} {sent}")
        while turn == over:
            for message in receive():
                text = message.text if message.get_type() == "STATUSTEXT" else ""
                given = re.match(r"F(\d+) (\d+) ", text)
                if given and int(given[1]) > over:
                    turn, now = int(given[1]), int(given[2])
                elif given:
                    say(f"D{over} {wake} {sent}")  # it was lost
            if over == 0:
                send(m.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))  # here I am


def command(number, *params):
    """Time stands until the answer is there; return whether it was yes."""
    params = [*params, *[float("nan")] * (7 - len(params))]
    send(m.MAVLink_command_long_message(1, 1, number, 0, *params))
    while not any(a.get_type() == "COMMAND_ACK" and a.command == number for a in receive()):
        pass
    return newest["COMMAND_ACK"].result == m.MAV_RESULT_ACCEPTED


def fly(north, east, seconds):
    global sent
    sent += 1
    velocity_only = 0b1101_1100_0111
    send(
        m.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, m.MAV_FRAME_LOCAL_NED, velocity_only, 0, 0, 0, north, east, 0, 0, 0, 0, 0, 0
        )
    )
    sleep(seconds)


sleep(0)
while not command(m.MAV_CMD_COMPONENT_ARM_DISARM, 1):
    sleep(0.5)
command(m.MAV_CMD_NAV_TAKEOFF)
while newest["LOCAL_POSITION_NED"].z > -2.2:
    sleep(0.1)
fly(0, 0, 0.1)
command(m.MAV_CMD_DO_SET_MODE, 1, 6)  # PX4's offboard
for north, east in (1, 0), (0, 1), (-1, 0), (0, -1):
    fly(north, east, 4)
command(m.MAV_CMD_NAV_LAND)
while newest["HEARTBEAT"].base_mode & m.MAV_MODE_FLAG_SAFETY_ARMED:
    sleep(0.1)
say(f"D{turn} end")
