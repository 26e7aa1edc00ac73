"""Does a flight controller do on the wire what it is counted on to do: one script for any firmware.

`session` talks to it (MAVSDK, and raw messages through MAVSDK), `ground`, `air`, `frames`,
`stepping` and `loss` each ask for something and judge the answer, `sequence` puts them in order
and lands whatever happens. `step_response` and `reference` know nothing of any link.
"""
