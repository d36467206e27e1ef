"""Work only on the newest item, in a separate thread."""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition, Thread
from typing import Generic, TypeVar

T = TypeVar("T")


class NewestOnly(Generic[T]):
    """Works on one item at a time, and then on the newest item; there is no queue.

    Args:
        work: called with each item, in the thread.
        fail: called with the exception that ended the thread; later items are dropped.
    """

    def __init__(self, work: Callable[[T], None], fail: Callable[[Exception], None]) -> None:
        self._work = work
        self._fail = fail
        self._waiting: list[T] = []  # at most one item
        self._is_open = True
        self._changed = Condition()
        self._thread = Thread(target=self._run, name="newest-only", daemon=True)
        self._thread.start()

    def put(self, item: T) -> bool:
        """Make the item the next to work on; return whether this drops an item that waited."""
        with self._changed:
            drops = bool(self._waiting)
            self._waiting = [item]
            self._changed.notify()
        return drops

    def close(self) -> None:
        """End the thread after its present item; an item that waits is dropped."""
        with self._changed:
            self._is_open = False
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or not self._is_open)
                if not self._is_open:
                    return
                item = self._waiting.pop()

            try:
                self._work(item)
            except Exception as error:
                self._fail(error)
                return
