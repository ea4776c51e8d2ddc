"""A small autopilot that behaves to MAVLink clients as PX4 v1.17 was measured to.

`vehicle` is the model, without socket or clock; `modes`, `parameters` and `world` are its tables;
`link` speaks MAVLink for one vehicle; `server` runs any number of them in real time over UDP.
"""
