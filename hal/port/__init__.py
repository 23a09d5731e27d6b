"""Byte ports to devices (serial, TCP, memory), their opener, and the reconnect loop of a driver."""
