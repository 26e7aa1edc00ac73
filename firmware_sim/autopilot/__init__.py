"""The built-in flight controller: estimator, control, commander, failsafes, parameters."""
