"""Everything that runs on the drone: link, camera, pilot, watchdog."""
