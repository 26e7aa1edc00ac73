"""MAVLink: endpoints, codec, streams, one file per microservice.

`server.MavlinkServer` is the entry point: links (`link.Link`) over endpoints (`endpoint`), fed by
an `BuiltinAutopilot`. Everything runs on one thread, in simulated time.
"""
