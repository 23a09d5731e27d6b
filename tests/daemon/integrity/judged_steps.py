"""Shared by the tests of the state machine: evidence of one cycle after the other, and what is said after it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from daemon.health.reasons import Reason
from daemon.integrity.evidence import Evidence, Light, Match
from daemon.integrity.state_machine import judge
from daemon.integrity.state_memory import Memory
from daemon.snapshot import State

PERIOD = 0.1
ALL = (True, True, True)
GOOD = Match(True, ALL)
BAD = Match(False, (False, False, False))
CORRIDOR = Match(True, (False, True, True))
LIT = Light(alive=True, used=True, placed=True, agrees=True, known=ALL)


def seen(t: float, match: Match | None = GOOD, **more: object) -> Evidence:
    return replace(Evidence(t, silence=0.5, match=match, mapped=True), **more)  # type: ignore[arg-type]  # test shorthand


def run(memory: Memory, evidence: Iterable[Evidence]) -> Memory:
    for item in evidence:
        memory = judge(memory, item)
    return memory


def scans(begin: float, count: int, match: Match | None = GOOD, **more: object) -> list[Evidence]:
    return [seen(begin + PERIOD * i, match, **more) for i in range(count)]


def tracking(**more: object) -> Memory:
    memory = run(Memory(), scans(0.0, 30, **more))
    assert memory.state is State.TRACKING
    return memory


def said(memory: Memory) -> tuple[State, Reason]:
    return memory.state, memory.reason
