"""Captures measured beside each other, a process each. Methods compute with one thread: their sums stay the same."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from colmap_refract.errors import RefractError

Say = Callable[[str], None]
T = TypeVar("T")
Task = Callable[[Say], T]

_POLL = 0.5  # seconds
_words: Any = None
"""In a worker: the queue of what it is doing."""


def together(tasks: Sequence[Task[T]], num_processes: int, say: Say) -> list[T]:
    """The results of tasks, in their order.

    Args:
        tasks: can be pickled, and so can what they return. Each is told how to say what it does.
        num_processes: at once; with one, or one task, all runs in this process.
        say: told what is being done.

    Raises:
        RefractError: a process was killed; and what a task raises.
        KeyboardInterrupt: Ctrl-C; no process is left.
    """
    if min(num_processes, len(tasks)) <= 1:
        with threadpool_limits(limits=1, user_api="blas"):
            return [task(say) for task in tasks]
    # A fork would copy the locks of threads that are not there any more.
    context = multiprocessing.get_context("spawn")
    words = context.Queue()
    workers: set[int] = set()
    with tempfile.TemporaryDirectory(prefix="colmap_refract-", ignore_cleanup_errors=True) as scratch:
        executor = ProcessPoolExecutor(
            min(num_processes, len(tasks)), mp_context=context, initializer=_begin, initargs=(words, scratch)
        )
        try:
            futures = [executor.submit(_do, task) for task in tasks]
            _watch(futures, words, workers, say)
            return [future.result() for future in futures]
        except BrokenProcessPool:
            raise RefractError(
                "a process of the experiments was killed: is there memory enough? Use --num_threads 1"
            ) from None
        except BaseException:
            # What they have in hand is of no use any more, and their files are in the folder that goes now.
            for pid in workers:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            raise
        finally:
            executor.shutdown(wait=False, cancel_futures=True)


def _watch(futures: Sequence[Future[T]], words: Any, workers: set[int], say: Say) -> None:
    """Pass on what the workers say until all is done, or one has failed."""
    pending = set(futures)
    while pending:
        done, pending = wait(pending, timeout=_POLL, return_when=FIRST_COMPLETED)
        if any(future.exception() is not None for future in done):
            return
        with suppress(queue.Empty):
            while True:
                pid, text = words.get_nowait()
                workers.add(pid)
                if text:
                    say(f"{len(futures) - len(pending)} of {len(futures)} captures done; {text}")


def _begin(words: Any, scratch: str) -> None:
    """In a new worker."""
    global _words
    _words = words
    tempfile.tempdir = scratch
    # Of what is not loaded yet: only what is fatal. What matters comes as an exception.
    os.environ["GLOG_minloglevel"] = "3"  # noqa: SIM112
    # The parent ends the workers when it is interrupted.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    words.put((os.getpid(), ""))


def _do(task: Task[T]) -> T:
    """In a worker."""
    with threadpool_limits(limits=1, user_api="blas"):
        return task(lambda text: _words.put((os.getpid(), text)))
