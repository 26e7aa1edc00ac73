"""MAVLink microservices, one file each.

A service is a table from message name to handler. A handler gets the message and a `Context`
and tells whether the message was meant for this vehicle and did something.
"""
