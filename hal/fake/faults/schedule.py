"""Fault orders over time: timers that begin and end faults, the faults in force, and their strikes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from random import Random
from typing import Protocol

from hal.fake.faults.orders import Fault, FaultError, Vocabulary, read_schedule


@dataclass(slots=True)
class _Force:
    fault: Fault
    seen: int = 0
    struck: int = 0


class ActiveFaults:
    """The faults in force at one device.

    Args:
        seed: of the random strikes.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = Random(seed)
        self._forces: dict[str, list[_Force]] = {}
        self.struck: dict[str, int] = {}

    def add(self, fault: Fault) -> None:
        """Put a fault in force."""
        self._forces.setdefault(fault.what, []).append(_Force(fault))

    def remove(self, fault: Fault) -> None:
        """Lift a fault; does nothing where its strikes are used up."""
        kept = [force for force in self._forces.get(fault.what, []) if force.fault is not fault]
        self._forces[fault.what] = kept

    def on(self, what: str) -> Fault | None:
        """The fault of that word in force, or None; does not count as a strike."""
        forces = self._forces.get(what)
        return forces[-1].fault if forces else None

    def strike(self, what: str, **match: str) -> Fault | None:
        """Offer the faults of a word an opportunity; return the one that strikes, or None.

        Args:
            what: the word.
            match: parameter values that a fault must have (or have as ``all``) to be considered.
        """
        for force in self._forces.get(what, ()):
            fault = force.fault
            if any(fault.values.get(key) not in (value, "all") for key, value in match.items()):
                continue
            force.seen += 1
            if force.seen % fault.every or (fault.share < 1.0 and self._random.random() >= fault.share):
                continue
            force.struck += 1
            self.struck[what] = self.struck.get(what, 0) + 1
            if force.struck == fault.count:
                self.remove(fault)
            return fault
        return None

    def in_force(self) -> list[Fault]:
        """All faults in force."""
        return [force.fault for forces in self._forces.values() for force in forces]


class Target(Protocol):
    """A fake device that accepts fault orders."""

    @property
    def vocabulary(self) -> Vocabulary:
        """Its words."""
        ...

    def check(self, fault: Fault) -> None:
        """Refuse with `FaultError` an order that makes no sense for this device."""
        ...

    def in_force(self) -> list[Fault]:
        """Faults neither lifted nor used up."""
        ...

    def begin(self, fault: Fault) -> None:
        """A fault comes into force now (a ``once`` fault happens now)."""
        ...

    def end(self, fault: Fault) -> None:
        """A fault is lifted now."""
        ...


class FaultSchedule:
    """Applies orders to devices at the loop's (virtual) times.

    Args:
        targets: devices by their ``where`` names.
        loop: the clock; default the running loop.
    """

    def __init__(self, targets: Mapping[str, Target], loop: asyncio.AbstractEventLoop | None = None) -> None:
        self._targets = dict(targets)
        self._loop = loop or asyncio.get_running_loop()
        self._timers: dict[Fault, asyncio.TimerHandle] = {}
        self._in_force: list[Fault] = []

    @property
    def vocabularies(self) -> dict[str, Vocabulary]:
        """Of all targets, by name."""
        return {name: target.vocabulary for name, target in self._targets.items()}

    def load(self, text: str) -> list[Fault]:
        """Read a TOML schedule and start it now. Raises `FaultError` before any order is in force."""
        faults = read_schedule(text, self.vocabularies)
        for fault in faults:
            self._targets[fault.where].check(fault)
        for fault in faults:
            self.order(fault)
        return faults

    def order(self, fault: Fault) -> None:
        """Schedule one order; ``when`` counts from now."""
        if fault.where not in self._targets:
            raise FaultError("where", f"{fault.where!r} is not a device here; available: {', '.join(self._targets)}")
        self._targets[fault.where].check(fault)
        self._timers[fault] = self._loop.call_at(self._loop.time() + fault.when, self._begin, fault)

    def clear(self, what: str = "", where: str = "") -> list[Fault]:
        """Lift faults in force and cancel pending ones, all or those of a word or device; returns them."""
        known = dict.fromkeys([*self._in_force, *self._timers])
        chosen = [f for f in known if what in ("", f.what) and where in ("", f.where)]
        for fault in chosen:
            if fault in self._timers:
                self._timers.pop(fault).cancel()
            if fault in self._in_force:
                self._lift(fault)
        return chosen

    def listing(self) -> Iterable[str]:
        """One line for every fault in force or pending."""
        for target in self._targets.values():
            yield from (f"in force {fault}" for fault in target.in_force())
        yield from (f"to come {fault}" for fault in self._timers if fault not in self._in_force)

    def close(self) -> None:
        """Cancel all timers and lift everything."""
        self.clear()

    def _begin(self, fault: Fault) -> None:
        del self._timers[fault]
        target = self._targets[fault.where]
        if target.vocabulary[fault.what].kind != "once":
            self._in_force.append(fault)
            if fault.lasts > 0:
                self._timers[fault] = self._loop.call_at(self._loop.time() + fault.lasts, self._end, fault)
        target.begin(fault)

    def _end(self, fault: Fault) -> None:
        del self._timers[fault]
        self._lift(fault)

    def _lift(self, fault: Fault) -> None:
        self._in_force.remove(fault)
        self._targets[fault.where].end(fault)
