"""A time-out for calls that have none of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T")


def guarded(call: Callable[[], T], timeout: float, dispose: Callable[[T], object] = lambda _: None) -> T:
    """What ``call`` returns or raises, where it does within ``timeout`` [s]. Raises TimeoutError otherwise.

    A call that is late goes on in a daemon thread, since nobody can stop it; what it returns in the end is given to
    ``dispose``.
    """
    done, late = threading.Event(), threading.Lock()
    results: list[T] = []
    errors: list[BaseException] = []
    given_up = False

    def run() -> None:
        try:
            result = call()
        except BaseException as error:
            errors.append(error)
        else:
            with late:
                if not given_up:
                    results.append(result)
            if not results:
                with suppress(Exception):
                    dispose(result)
        done.set()

    thread = threading.Thread(target=run, name="guarded call", daemon=True)
    thread.start()
    done.wait(max(timeout, 0.0))
    with late:
        given_up = True
    if results:
        thread.join()
        return results[0]
    if errors:
        thread.join()
        raise errors[0]
    raise TimeoutError(f"nothing within {timeout:g} s")
