"""Deferred Ctrl-C and SIGTERM: a run stops between two updates."""

from __future__ import annotations

import signal
import threading
from types import FrameType


class Interrupt:
    """Records the first SIGINT or SIGTERM inside a ``with`` block; a second one acts as usual.

    It records nothing outside the main thread, where Python delivers signals.

    Example:
        >>> with Interrupt() as interrupt:
        ...     signal.raise_signal(signal.SIGTERM)
        >>> interrupt.signum == signal.SIGTERM
        True
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self._usual = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGINT, signal.SIGTERM):
                self._usual[signum] = signal.signal(signum, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._usual.items():
            signal.signal(signum, handler)
        self._usual = {}

    def exit_if_signalled(self, sentence: str) -> None:
        """Print ``sentence`` and exit with the signal's code if one was recorded."""
        if self.signum is not None:
            print(f"\n{sentence}", flush=True)
            raise SystemExit(128 + self.signum)

    def _note(self, signum: int, frame: FrameType | None) -> None:
        self.signum = signum
        self.__exit__()
