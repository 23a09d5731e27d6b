"""Structured journal fields for log lines about faults and state changes, with catalogue message IDs."""

from __future__ import annotations

from typing import Any, Final

from daemon.health.faults import FAULTS, Fault

FAULT_ID: Final = "0f26ad5c5f9d4f6fa1a3c8a7e7c1d9b4"
OVER_ID: Final = "5c0cb1d0b8a64f27a0a5f5a4b0b9d3e1"
STATE_ID: Final = "a7d9d3f86c0e4f21b1c4a98e2f63d07c"
"""Message IDs of the journal's catalogue (systemd/lumiloop.catalog). Part of the contract: never change."""


def of_fault(fault: Fault, over: bool = False) -> dict[str, Any]:
    """``extra=`` of a log line about the start or, with ``over``, the end of a fault."""
    text, remedy = FAULTS[fault]
    fields = {"LUMILOOP_FAULT": int(fault), "LUMILOOP_FAULT_NAME": fault.name, "LUMILOOP_MEANING": text}
    if over:
        return _extra({"MESSAGE_ID": OVER_ID, **fields})  # the end of a fault needs no action
    return _extra({"MESSAGE_ID": FAULT_ID, **fields, "LUMILOOP_REMEDY": remedy})


def of_state(state: str, reason: str, remedy: str) -> dict[str, Any]:
    """``extra=`` of a log line about a new state of localisation."""
    fields = {"LUMILOOP_STATE": state, "LUMILOOP_REASON": reason, "LUMILOOP_REMEDY": remedy}
    return _extra({"MESSAGE_ID": STATE_ID, **fields})


def _extra(fields: dict[str, object]) -> dict[str, Any]:
    return {"fields": fields}
