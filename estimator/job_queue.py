"""The queue of background jobs: those to be started, and those whose result is pending.

A job is a description: two functions marked by :func:`job_function`, each with its arguments. A checkpoint of the state
stores the description, and a replay can start the job again from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any, Final, TypeVar

from estimator.measurements import Answer, Job

LOST: Final = 100
"""Keyframes after which a job without a result is abandoned: a failed job never returns one."""

SEARCH, SOLVE, SETTLE, DRAW = 3, 2, 1, 9
"""Priorities, lowest first: search the map, solve the graph, finish a submap; draw the map after all of these."""

Apply = partial[None]
"""Receives the payload of a result as its last argument."""

F = TypeVar("F", bound=Callable[..., object])

JOB_FUNCTIONS: Final[set[Callable[..., object]]] = set()
"""All functions that a job may consist of."""


class Owner(Enum):
    """Owner of a job that belongs to no particular object."""

    LOOP_SEARCH = "loop search"
    SOLUTION = "solution"


def job_function(function: F) -> F:
    """Mark a module-level function that a job consists of. A checkpoint refers to it by package and name."""
    JOB_FUNCTIONS.add(function)
    return function


@dataclass(frozen=True, slots=True, eq=False)
class Pending:
    """A job without a result yet.

    Attributes:
        owner: object that the job belongs to, None for no particular one.
        keyframes: count of keyframes when it was queued.
        apply: receives the result's payload.
    """

    owner: object
    keyframes: int
    apply: Apply


@dataclass(slots=True, eq=False)
class JobQueue:
    """All background jobs of the estimator.

    Attributes:
        waiting: to be started with the next result of a step.
        pending: without a result yet, by job ID.
        next_id: of the next job, never used twice.
        keyframes: created since the queue was last cleared, a clock for failed jobs.
    """

    waiting: list[Job] = field(default_factory=list)
    pending: dict[int, Pending] = field(default_factory=dict)
    next_id: int = 1
    keyframes: int = 0

    def ask(self, priority: int, run: partial[Any], apply: Apply, owner: object = None) -> None:
        """Queue a job; ``apply`` receives its payload in the step with the result.

        Both are partial calls of functions marked by :func:`job_function`.
        """
        self.waiting.append(Job(self.next_id, priority, run))
        self.pending[self.next_id] = Pending(owner, self.keyframes, apply)
        self.next_id += 1

    def busy(self, owner: object) -> bool:
        """Whether a job of this owner is pending."""
        return any(job.owner is owner for job in self.pending.values())

    def cancel(self, owner: object) -> None:
        """Ignore the results of this owner's jobs."""
        self.pending = {job_id: job for job_id, job in self.pending.items() if job.owner is not owner}

    def count_keyframe(self) -> tuple[object, ...]:
        """Count a keyframe and abandon the jobs that must have failed; returns their owners."""
        self.keyframes += 1
        lost = [job_id for job_id, job in self.pending.items() if self.keyframes - job.keyframes > LOST]
        return tuple(self.pending.pop(job_id).owner for job_id in lost)

    def answer(self, answer: Answer) -> None:
        """Apply a result; one of an abandoned job is dropped."""
        job = self.pending.pop(answer.job_id, None)
        if job is not None:
            job.apply(answer.payload)

    def take(self) -> tuple[Job, ...]:
        """The jobs to be started now."""
        jobs = tuple(self.waiting)
        self.waiting.clear()
        return jobs

    def clear(self) -> None:
        """Remove all jobs; results that still arrive are dropped."""
        self.waiting.clear()
        self.pending.clear()
        self.keyframes = 0
