"""Inputs judged in a process of their own, which may crash, or hang where no signal is heard."""

import multiprocessing
import signal
import traceback
from collections.abc import Iterator
from multiprocessing.connection import Connection
from typing import Any

from tests.fuzz.core import SECONDS, Door, Judged, Outcome
from tests.fuzz.settings import prepare

PATIENCE = 6 * SECONDS
"""Time without a sign of life after which a process is killed."""


def judged_in_process(names: list[str], seed: int, start: int = 0) -> Iterator[Judged]:
    """Judgements without end: rounds over the doors, a door's weight of inputs in each.

    Args:
        names: names of the doors.
        seed: seed of the inputs.
        start: index of the first input of each door.
    """
    follow = dict.fromkeys(names, start)
    first = names[0]
    while True:
        process, connection = _started(names, follow, first, seed)
        try:
            door, index = first, follow[first]
            while True:
                if not connection.poll(PATIENCE):
                    why, outcome = f"no sign of life for {PATIENCE:g} s", Outcome.HANG
                    break
                try:
                    kind, message = connection.recv()
                except EOFError:
                    process.join()
                    why, outcome = f"the process ended with {process.exitcode}", Outcome.OTHER
                    break
                if kind == "begins":
                    door, index, text = message
                    follow[door] = index + 1
                elif kind == "fails":
                    raise RuntimeError(
                        f"the fuzzer itself fails at or after {door} {index}:\n{message}"
                    )
                else:
                    yield message
            yield Judged(door, index, outcome, why, text, PATIENCE)
            first = door
        finally:
            process.kill()
            process.join()


def _started(
    names: list[str], follow: dict[str, int], first: str, seed: int
) -> tuple[Any, Connection]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(names, follow, first, seed, theirs), daemon=True)
    process.start()
    theirs.close()
    return process, ours


def _work(
    names: list[str], follow: dict[str, int], first: str, seed: int, connection: Connection
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare()
    from tests.fuzz.doors import all_doors

    doors = all_doors()
    order = names[names.index(first) :] + names[: names.index(first)]
    try:
        while True:
            for name in order:
                for _ in range(doors[name].weight):
                    _judge_next(doors[name], follow, seed, connection)
    except Exception:
        connection.send(("fails", traceback.format_exc()))


def _judge_next(door: Door, follow: dict[str, int], seed: int, connection: Connection) -> None:
    index = follow[door.name]
    follow[door.name] += 1
    one = door.draw(seed, index)
    connection.send(("begins", (door.name, index, str(one))))
    connection.send(("judged", door.judge_input(one, index)))
