"""Modbus server (UDP, TCP, RTU) and its register blocks."""
