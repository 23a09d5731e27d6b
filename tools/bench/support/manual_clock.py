"""A clock that is put forward by hand, for cycles in simulated time."""


class ManualClock:
    """See :class:`hal.clock.Clock`; ``t`` is the monotonic time in s."""

    def __init__(self) -> None:
        self.t = 0.0

    def now(self) -> float:
        """The monotonic time in s."""
        return self.t

    def utc(self) -> float:
        """Seconds since 1970."""
        return 1.8e9 + self.t
