"""The queue of background jobs: what is to be handed out, and what waits for an answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from estimator.measurements import Answer, Job

LOST: Final = 100
"""Keyframes after which a job that has not answered is given up: a job that failed never answers."""

SEARCH, SOLVE, SETTLE, DRAW = 3, 2, 1, 9
"""Priorities, lowest first: search the map, solve the graph, settle a submap; draw the map after all of these."""

Apply = Callable[[object], None]


@dataclass(frozen=True, slots=True, eq=False)
class Pending:
    """A job without an answer yet.

    Attributes:
        owner: on whose behalf it runs, None for nobody in particular. keyframes: count of keyframes when it was asked
            for. apply: takes the answer's payload.
    """

    owner: object
    keyframes: int
    apply: Apply


@dataclass(slots=True, eq=False)
class JobQueue:
    """All background jobs of the estimator.

    Attributes:
        waiting: to be handed out with the next result. pending: without an answer yet, by job ID. next_id: of the next
            job, never used twice. keyframes: laid since the queue was last cleared, a clock for jobs that failed.
    """

    waiting: list[Job] = field(default_factory=list)
    pending: dict[int, Pending] = field(default_factory=dict)
    next_id: int = 1
    keyframes: int = 0

    def ask(self, priority: int, run: Callable[[], object], apply: Apply, owner: object = None) -> None:
        """Queue a job; ``apply`` takes its payload in the step that receives the answer."""
        self.waiting.append(Job(self.next_id, priority, run))
        self.pending[self.next_id] = Pending(owner, self.keyframes, apply)
        self.next_id += 1

    def busy(self, owner: object) -> bool:
        """Whether a job of this owner has no answer yet."""
        return any(job.owner is owner for job in self.pending.values())

    def cancel(self, owner: object) -> None:
        """Ignore the answers to this owner's jobs."""
        self.pending = {job_id: job for job_id, job in self.pending.items() if job.owner is not owner}

    def count_keyframe(self) -> tuple[object, ...]:
        """Count a keyframe and give up the jobs that must have failed; returns the owners of these."""
        self.keyframes += 1
        lost = [job_id for job_id, job in self.pending.items() if self.keyframes - job.keyframes > LOST]
        return tuple(self.pending.pop(job_id).owner for job_id in lost)

    def answer(self, answer: Answer) -> None:
        """Apply an answer; one that nothing waits for any more is dropped."""
        job = self.pending.pop(answer.job_id, None)
        if job is not None:
            job.apply(answer.payload)

    def take(self) -> tuple[Job, ...]:
        """The jobs to be handed out now."""
        jobs = tuple(self.waiting)
        self.waiting.clear()
        return jobs

    def clear(self) -> None:
        """Forget all jobs; answers that still come are dropped."""
        self.waiting.clear()
        self.pending.clear()
        self.keyframes = 0
