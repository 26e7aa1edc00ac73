"""What everything else stands on: time, units, frames, files, errors, the machine."""
