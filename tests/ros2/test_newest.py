"""The node works on the newest cloud, one at a time, and nothing queues."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event, Thread

from amvnet_ros.newest import NewestOnly

from fixtures.processes import PATIENCE


def ignore(error: Exception) -> None:
    raise AssertionError(error)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE  # comes only if the condition never holds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.001)  # between two looks


def test_what_arrives_during_the_work_is_dropped_but_for_the_newest() -> None:
    begun = Event()
    go_on = Event()
    done: list[int] = []

    def work(item: int) -> None:
        begun.set()
        assert go_on.wait(PATIENCE)
        done.append(item)

    worker = NewestOnly(work, ignore)
    assert not worker.put(0)
    assert begun.wait(PATIENCE)

    # 0 is at work: 1 waits, and each later one takes the place of the one before.
    assert [worker.put(item) for item in range(1, 6)] == [False, True, True, True, True]
    go_on.set()
    until(lambda: len(done) == 2)
    worker.close()
    assert done == [0, 5]


def test_a_slow_source_loses_nothing() -> None:
    done: list[int] = []
    worker = NewestOnly(done.append, ignore)
    for item in range(20):
        assert not worker.put(item)
        until(lambda: len(done) > item)  # noqa: B023
    worker.close()
    assert done == list(range(20))


def test_closing_waits_for_the_item_at_work_and_for_no_other() -> None:
    begun = Event()
    go_on = Event()
    done: list[object] = []

    def work(item: int) -> None:
        begun.set()
        assert go_on.wait(PATIENCE)
        done.append(item)

    def close() -> None:
        worker.close()
        done.append("closed")

    worker = NewestOnly(work, ignore)
    worker.put(0)
    assert begun.wait(PATIENCE)
    worker.put(1)

    closing = Thread(target=close)
    closing.start()
    until(lambda: not worker._is_open)
    assert not done
    go_on.set()
    closing.join(PATIENCE)
    assert done == [0, "closed"]


def test_an_error_ends_the_work_and_is_told() -> None:
    errors: list[Exception] = []

    def work(item: int) -> None:
        raise ZeroDivisionError(item)

    worker = NewestOnly(work, errors.append)
    worker.put(7)
    until(lambda: bool(errors))
    worker.put(8)
    worker.close()
    assert [error.args for error in errors] == [(7,)]
