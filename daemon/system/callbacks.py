"""Types of callbacks that several packages share."""

from __future__ import annotations

from collections.abc import Callable

OnDone = Callable[[str], None]
"""Called at the end of a request: with an empty text, or with the reason why it was not carried out."""
