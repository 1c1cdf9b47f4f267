"""What the fuzzer prints: failures by kind with the shortest input of each, refusals, a table."""

from collections.abc import Sequence
from random import Random

from tests.fuzz.core import Counts, Judged, Outcome


def told_failures(counts: Counts, seed: int) -> str:
    """The shortest failing input of each kind, by door."""
    lines = []
    for key, one in sorted(counts.smallest.items()):
        lines.append(
            f"{one.door}: {one.outcome} ({counts.times[key]} times)\n"
            f"    {one.text[:400]}\n"
            f"    {one.detail[:500]}\n"
            f"    --seed {seed} --door {one.door} --index {one.index}"
        )
    return "\n".join(lines)


def refusals_to_read(judged: Sequence[Judged], number: int, seed: int) -> str:
    """Some refusals that passed the check of their text, to be read by eye."""
    refused = [one for one in judged if one.outcome == Outcome.REFUSED_WELL]
    chosen = Random(seed).sample(refused, min(number, len(refused)))
    return "\n".join(f"{one.door}({one.text[:200]})\n    {one.detail}" for one in chosen)


def table(counts: Counts, seconds: float) -> str:
    """Inputs by door and outcome."""
    heads = ["door", *Outcome, "seconds"]
    rows = [
        [door, *(str(own[outcome] or "") for outcome in Outcome), f"{counts.seconds[door]:.0f}"]
        for door, own in counts.by_door.items()
    ]
    rows.append(["all", *(str(counts.of(outcome)) for outcome in Outcome), f"{seconds:.0f}"])
    widths = [max(map(len, column)) for column in zip(heads, *rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [heads, *rows]
    ]
    rate = counts.total / seconds if seconds else 0.0
    return "\n".join([*lines, f"{counts.total} inputs, {rate:.1f} a second"])
