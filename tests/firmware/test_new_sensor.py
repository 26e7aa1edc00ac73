"""A sensor added as docs/architecture.md says: a model of a profile, an add-on of two files."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.support.processes import ROOT

PROFILE = ROOT / "airl_mav" / "profiles" / "vehicle.py"
LAST_FIELD = """\
        None, "what measures how the ground moves below; absent = nothing does"
    )
"""

MODEL = '''\
class Hygrometer(ProfileModel):
    """Sensor of the humidity."""

    rate_hz: float = quantity("samples a second", "Hz", ge=1, le=250)
    noise_percent: float = quantity("white noise, sd", "1", ge=0, le=100)


class Sensors(ProfileModel):
'''

FIELD = """\
    hygrometer: Hygrometer | None = later_field(None, "what measures the humidity")
"""

INIT = '''\
"""Hygrometer of a vehicle."""

SENSORS = {"hygrometer": "firmware_sim.addons.hygrometer.hygrometer:HYGROMETER"}
'''

SENSOR = '''\
"""Hygrometer: simulation, HYGROMETER_SENSOR and a topic of the log."""

from firmware_sim.plant.sensors import SimulatedSensor
from firmware_sim.sensor_table import Sensor, SensorStream, SensorTopic


class SimulatedHygrometer(SimulatedSensor):
    """Humidity that falls with height [%]."""

    def read(self, row, elapsed_us):
        return 50.0 + row[2] + self.profile.noise_percent * self.white().item()


def hygrometer_sensor(state):
    newest = state.readings.get("hygrometer")
    if newest is None:
        return None
    return 0, round(state.temperature_c * 1e2), round(newest.reading * 1e2)


def humidity(state):
    newest = state.readings.get("hygrometer")
    return None if newest is None else (newest.time_us, newest.reading)


HYGROMETER = Sensor(
    "hygrometer",
    "firmware_sim.addons.hygrometer.hygrometer:SimulatedHygrometer",
    {"HYGROMETER_SENSOR": SensorStream(hygrometer_sensor, onboard_hz=5.0, gcs_hz=1.0)},
    {"sensor_hygrometer": SensorTopic(100, "uint64_t timestamp_sample; float humidity", humidity)},
)
'''

# Only these two parts come from the other tree, so that no kernel is compiled again.
FLIGHT = """\
import json, sys
from pathlib import Path

import airl_mav.profiles, firmware_sim.addons

airl_mav.profiles.__path__.insert(0, sys.argv[1])
firmware_sim.addons.__path__.insert(0, sys.argv[2])

from pyulog import ULog

from airl_mav.core.clock import SimClock
from airl_mav.profiles.vehicle import Hygrometer
from firmware_sim.engine.record import TRUE_TICK
from firmware_sim.addons.flight_log.flight_log import UlogFlightLog
from firmware_sim.mavlink.endpoint import MemoryEndpoint
from firmware_sim.mavlink.px4_links import onboard_link
from firmware_sim.mavlink.server import MavlinkServer
from firmware_sim.simulation import EpisodeSetup, Simulation
from tests.support.flight_rig import quad
from tests.support.mavlink_clients import RawClient

hygrometer = Hygrometer(rate_hz=10, noise_percent=0.1)
sensors = quad().sensors.model_copy(update={"hygrometer": hygrometer})
simulation = Simulation(EpisodeSetup(quad().model_copy(update={"sensors": sensors}), None, 1),
                        start_us=0, clock=SimClock())
autopilot, endpoint = simulation.autopilot, MemoryEndpoint()
server = MavlinkServer([onboard_link(endpoint)], autopilot, boot_unix_us=0)
client, path = RawClient(endpoint), Path(sys.argv[3])
log = UlogFlightLog(path, autopilot.parameters, 0, 0)
for _ in range(500):
    server.receive(simulation.time_us)
    simulation.tick()
    log.after_ticks(simulation.flown, simulation.truths, autopilot.state())
    server.send(simulation.time_us)
log.close()
simulation.close()
sent = [each.humidity / 1e2 for each in client.received("HYGROMETER_SENSOR")]
(topic,) = (each for each in ULog(str(path)).data_list if each.name == "sensor_hygrometer")
print(json.dumps({"sent": sent, "logged": topic.data["humidity"].tolist()}))
"""


def test_a_sensor_is_added_with_three_files_and_flown(tmp_path: Path) -> None:
    profiles, addon = tmp_path / "profiles", tmp_path / "addons" / "hygrometer"
    profiles.mkdir()
    addon.mkdir(parents=True)
    text = PROFILE.read_text()
    assert text.count(LAST_FIELD) == 1 and text.count("class Sensors(ProfileModel):\n") == 1
    text = text.replace("class Sensors(ProfileModel):\n", MODEL)
    (profiles / "vehicle.py").write_text(text.replace(LAST_FIELD, LAST_FIELD + FIELD))
    (addon / "__init__.py").write_text(INIT)
    (addon / "hygrometer.py").write_text(SENSOR)
    assert len(list(tmp_path.rglob("*.py"))) == 3

    done = subprocess.run(
        [
            *(sys.executable, "-c", FLIGHT, str(profiles), str(addon.parent)),
            str(tmp_path / "flight.ulg"),
        ],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    # At 5 Hz over two seconds; the log has 10 Hz.
    assert 9 <= len(found["sent"]) <= 11 and 18 <= len(found["logged"]) <= 21
    for values in found.values():
        assert all(abs(value - 50.0) < 1.0 for value in values) and len(set(values)) > 5
