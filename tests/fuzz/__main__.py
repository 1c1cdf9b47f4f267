"""Run the fuzzer: `python -m tests.fuzz --minutes N --seed S`; all options with `--help`.

The inputs are judged in a process of their own, which is started again after a crash. The exit
status is 1 if an input is not right or refused well. A line of the list of failures ends with what
makes the input again: `--seed S --door X --index K`, which also shows the traceback.
"""

import argparse
import fnmatch
import sys
import time
import traceback

from tests.fuzz.core import FINE, Counts, Door, quiet, time_limit
from tests.fuzz.report import refusals_to_read, table, told_failures
from tests.fuzz.settings import prepare
from tests.fuzz.workers import judged_in_process


def main() -> int:
    """Run the command line."""
    options = _options()
    prepare()
    from tests.fuzz.doors import all_doors

    doors = [d for name, d in all_doors().items() if fnmatch.fnmatch(name, options.door)]
    if not doors:
        print(f"no door is called {options.door}; choose from {', '.join(all_doors())}")
        return 2
    if options.index is not None:
        return 0 if all(_replay(door, options.seed, options.index) for door in doors) else 1
    counts, refused = Counts(), []
    start = time.monotonic()
    try:
        for one in judged_in_process([door.name for door in doors], options.seed, options.start):
            counts.add(one)
            refused.append(one)
            if options.verbose and one.outcome not in FINE:
                print(f"{one.outcome}: {one.door}: {one.text}: {one.detail}", flush=True)
            is_late = time.monotonic() > start + 60 * options.minutes
            if is_late or (options.inputs and counts.total >= options.inputs):
                break
    finally:  # also if the fuzzer itself fails
        print(told_failures(counts, options.seed))
        print(table(counts, time.monotonic() - start))
    if options.read:
        print(refusals_to_read(refused, options.read, options.seed))
    return 1 if counts.smallest else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description=(sys.modules["tests.fuzz"].__doc__),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=5.0, help="time after which to stop")
    parser.add_argument("--inputs", type=int, default=0, help="inputs after which to stop")
    parser.add_argument("--seed", type=int, default=0, help="seed of the inputs")
    parser.add_argument("--door", default="*", help="name of a door, or a pattern: 'bodies.*'")
    parser.add_argument("--index", type=int, help="judge this input of the door alone")
    parser.add_argument("--start", type=int, default=0, help="index of the first input")
    parser.add_argument("--read", type=int, default=0, help="print so many refusals, to read")
    parser.add_argument("--verbose", action="store_true", help="print failures as they come")
    return parser.parse_args()


def _replay(door: Door, seed: int, index: int) -> bool:
    """Judge one input, with all that is known of it."""
    one = door.draw(seed, index)
    print(f"{door.name}({one})")
    judged = door.judge_input(one, index)
    print(f"{judged.outcome} in {judged.seconds:.2f} s: {judged.detail}")
    if judged.outcome not in FINE:
        _show_traceback(door, seed, index)
    return judged.outcome in FINE


def _show_traceback(door: Door, seed: int, index: int) -> None:
    one = door.draw(seed, index)
    try:
        with time_limit(door.seconds), quiet():
            door.check(door.function(**one.arguments), **one.arguments)
    except BaseException:
        traceback.print_exc()


if __name__ == "__main__":
    sys.exit(main())
