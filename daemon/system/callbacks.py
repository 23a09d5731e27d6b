"""Callback types that several packages share."""

from __future__ import annotations

from collections.abc import Callable

OnDone = Callable[[str], None]
"""Completion callback of a request. Its text is empty on success, otherwise the reason of the failure."""
