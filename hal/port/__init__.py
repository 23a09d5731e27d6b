"""Byte ports: serial, TCP, memory; opening and recovery."""
