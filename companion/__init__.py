"""Everything that would be copied to the drone: link, camera, pilot, watchdog."""
