"""Doors, inputs, and the judgement of one input."""

import inspect
import re
import resource
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from random import Random
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from tests.fuzz.refusals import faults_of_refusal
from tests.fuzz.telling import told

SECONDS = 20.0
"""Longest time of one input."""
SPARE_BYTES = 4 * 2**30
"""Memory that an input may take, beyond what the process has mapped before."""
BYTES = 8000
"""Random bytes from which an input is drawn."""


class Outcome(StrEnum):
    """What happened to an input; see the package."""

    RIGHT = "right"
    REFUSED_WELL = "refused well"
    REFUSED_BADLY = "refused badly"
    VALID_REFUSED = "valid refused"
    OTHER = "other exception"
    SILENT = "silent"
    HANG = "hang"


FINE = (Outcome.RIGHT, Outcome.REFUSED_WELL)


@dataclass(frozen=True)
class Input:
    """Arguments by name, and the names of those that were drawn from hostile values."""

    arguments: Mapping[str, Any]
    hostile: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return ", ".join(f"{name}={told(value)}" for name, value in self.arguments.items())


@dataclass(frozen=True)
class Parameter:
    """A parameter of a door: strategies of its valid and of its hostile values.

    `optional` parameters are left out half of the time.
    """

    valid: SearchStrategy[Any]
    hostile: SearchStrategy[Any]
    optional: bool = True


@dataclass(frozen=True)
class Judged:
    """The judgement of one input."""

    door: str
    index: int
    outcome: Outcome
    detail: str
    text: str
    seconds: float

    @property
    def kind(self) -> str:
        """What failures of one kind share: an error's type and place, or words without values."""
        raised, _, place = self.detail.rpartition(" (at ")
        if place:
            return f"{raised.partition(':')[0]} {place}"
        text = re.sub(r"'[^']*'|\([^()]*\)|\[[^\[\]]*\]|\S*/\S*", "_", self.detail)
        return re.sub(r"[-+]?\b(\d[\d.e+-]*|nan|inf)", "#", text)[:55]


def accept(**_: Any) -> None:
    """A predicate that does not know: what is accepted is judged by the checks alone."""
    return None


def no_check(result: Any, **_: Any) -> None:
    """No check of what was accepted."""


@dataclass(frozen=True)
class Door:
    """A public function or command, and how to judge it.

    Attributes:
        name: room and function.
        function: called with the arguments by name.
        parameters: strategies of the arguments.
        is_valid: predicate of the arguments: True if they must be accepted, False if they must be
            refused, None if both will do.
        check: function of the result and the arguments that raises an `AssertionError` if the
            result is wrong.
        weight: inputs in one round; low for slow doors.
        seconds: longest time of one input.
        prepare: called once before, without a limit of time, as to compile what inputs share.
    """

    name: str
    function: Callable[..., Any]
    parameters: Mapping[str, Parameter]
    is_valid: Callable[..., bool | None] = accept
    check: Callable[..., None] = no_check
    weight: int = 10
    seconds: float = SECONDS
    prepare: Callable[[], object] | None = None

    def draw(self, seed: int, index: int) -> Input:
        """The input with an index: it depends on the seed, the door's name and the index alone."""
        drawn, take = self._taker
        for attempt in range(100):  # a draw may need more bytes than there are
            drawn.clear()
            source = Random(f"{seed} {self.name} {index} {attempt}")
            take.hypothesis.fuzz_one_input(source.randbytes(BYTES))
            if drawn:
                return drawn[0]
        raise RuntimeError(f"{self.name}: no input could be drawn")

    @cached_property
    def inputs(self) -> SearchStrategy[Input]:
        """Valid arguments, of which none, one or two are replaced by hostile ones."""
        return _inputs(self.parameters)

    @cached_property
    def _taker(self) -> tuple[list[Input], Any]:
        drawn: list[Input] = []

        @settings(database=None, deadline=None, suppress_health_check=list(HealthCheck))
        @given(self.inputs)
        def take(one: Input) -> None:
            drawn.append(one)

        return drawn, take

    @cached_property
    def _prepared(self) -> bool:
        """Whether `prepare` has been called: it is, at the first look."""
        if self.prepare is not None:
            with quiet():
                self.prepare()
        return True

    def judge(self, seed: int, index: int) -> Judged:
        """Draw an input, call the door, and judge what happens."""
        return self.judge_input(self.draw(seed, index), index)

    def judge_input(self, one: Input, index: int = -1) -> Judged:
        """Call the door with an input, and judge what happens."""
        self._prepared  # noqa: B018 # the first look prepares
        text = str(one)
        valid = self._verdict(one)
        start = time.perf_counter()
        outcome, detail = self._outcome(one, valid)
        seconds = time.perf_counter() - start
        if seconds > self.seconds and outcome != Outcome.HANG:
            outcome, detail = Outcome.HANG, f"{seconds:.0f} s, then: {outcome}: {detail}"
        return Judged(self.name, index, outcome, detail, text, seconds)

    def _verdict(self, one: Input) -> bool | None:
        """What the predicate says; no to arguments that it cannot even read."""
        try:
            with quiet():
                return self.is_valid(**one.arguments)
        except (TypeError, ValueError, AttributeError, IndexError, OverflowError):
            return False

    def _outcome(self, one: Input, valid: bool | None) -> tuple[Outcome, str]:
        try:
            with time_limit(self.seconds), memory_limit(), quiet():
                result = self.function(**one.arguments)
        except TimeOut:
            return Outcome.HANG, f"over {self.seconds:g} s"
        except (ValueError, OSError, TypeError) as error:
            return self._refusal(one, valid, error)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            return Outcome.OTHER, _error_text(error)
        if valid is False:
            blamed = ", ".join(sorted(one.hostile)) or "the values together"
            return Outcome.SILENT, f"accepted, and it is not valid: {blamed}"
        try:
            with time_limit(3 * self.seconds), quiet():
                self.check(result, **one.arguments)
        except AssertionError as error:
            return Outcome.SILENT, f"accepted, and the result is wrong: {error}"
        except TimeOut:
            return Outcome.HANG, "in the check of the result"
        except Exception as error:
            return Outcome.SILENT, f"accepted, and the check fails: {_error_text(error)}"
        return Outcome.RIGHT, ""

    def _refusal(self, one: Input, valid: bool | None, error: Exception) -> tuple[Outcome, str]:
        if isinstance(error, TypeError):
            if _is_of_signature(error):
                return Outcome.REFUSED_WELL, _error_text(error)
            return Outcome.OTHER, _error_text(error)
        if valid is True:
            return Outcome.VALID_REFUSED, _error_text(error)
        faults = faults_of_refusal(str(error), one.arguments)
        if not _is_raised_on_purpose(error):
            faults.append("words of its own")
        if faults:
            return Outcome.REFUSED_BADLY, f"no {', no '.join(faults)}: {_error_text(error)}"
        return Outcome.REFUSED_WELL, _error_text(error)


def _is_of_signature(error: TypeError) -> bool:
    """Whether a `TypeError` is about the names of arguments, and not about a value."""
    text = str(error)
    ours = "is no parameter here; choose from" in text
    signature = "unexpected keyword argument" in text or "required positional" in text
    return ours or signature or "os.PathLike object, not" in text  # what Python says to a path


def _is_raised_on_purpose(error: BaseException) -> bool:
    """Whether an error comes from a `raise` statement, and not from a call that failed."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and "raise" in (frames[-1].line or "")


def _error_text(error: BaseException) -> str:
    """The type and the text of an error, and the file where it was raised unless it is refusal."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if isinstance(error, ValueError | OSError) and not isinstance(error, UnicodeError):
        return text
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "/jaxsimp/" in frame.filename] or frames[-1:]
    at = f" (at {'/'.join(own[-1].filename.split('/')[-3:])}:{own[-1].lineno})" if own else ""
    return text[:300] + at


def _inputs(parameters: Mapping[str, Parameter]) -> SearchStrategy[Input]:
    names = list(parameters)

    @st.composite
    def drawn(draw: Any) -> Input:
        count = min(draw(st.sampled_from((0, 0, 0, 1, 1, 1, 1, 1, 1, 2))), len(names))
        hostile = draw(
            st.lists(st.sampled_from(names), min_size=count, max_size=count, unique=True)
            if count
            else st.just([])
        )
        arguments = {}
        for name, parameter in parameters.items():
            if name in hostile:
                arguments[name] = draw(parameter.hostile)
            elif not (parameter.optional and draw(st.booleans())):
                arguments[name] = draw(parameter.valid)
        return Input(arguments, frozenset(hostile))

    return drawn()


def parameters_of(function: Callable[..., Any]) -> set[str]:
    """Names of the parameters in a function's signature, without `**` ones."""
    kinds = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
    found = inspect.signature(function).parameters.values()
    return {each.name for each in found if each.kind not in kinds}


@contextmanager
def memory_limit() -> Iterator[None]:
    """Let allocations that are far too large fail, instead of the machine."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (mapped + SPARE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


class TimeOut(BaseException):
    """An input takes too long. No `Exception`, which the code under test might catch."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise a `TimeOut` after so many seconds, in the main thread."""

    def ring(*_: object) -> None:
        raise TimeOut

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def quiet() -> Iterator[None]:
    """Without warnings: they are judged by the results that they warn of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@dataclass
class Counts:
    """Judgements by door and outcome, and the shortest failing input of each kind."""

    by_door: dict[str, dict[Outcome, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    smallest: dict[tuple[str, Outcome, str], Judged] = field(default_factory=dict)
    times: dict[tuple[str, Outcome, str], int] = field(default_factory=dict)

    def add(self, one: Judged) -> None:
        """Count a judgement."""
        own = self.by_door.setdefault(one.door, dict.fromkeys(Outcome, 0))
        own[one.outcome] += 1
        self.seconds[one.door] = self.seconds.get(one.door, 0.0) + one.seconds
        if one.outcome in FINE:
            return
        key = one.door, one.outcome, one.kind
        self.times[key] = self.times.get(key, 0) + 1
        if key not in self.smallest or len(one.text) < len(self.smallest[key].text):
            self.smallest[key] = one

    @property
    def total(self) -> int:
        """Number of inputs."""
        return sum(sum(own.values()) for own in self.by_door.values())

    def of(self, outcome: Outcome) -> int:
        """Number of inputs with an outcome."""
        return sum(own[outcome] for own in self.by_door.values())
