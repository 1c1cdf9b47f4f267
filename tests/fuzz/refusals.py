"""Whether a refusal helps: it names the value, what is allowed, and what to do."""

import re
from collections.abc import Mapping
from typing import Any

from tests.fuzz.telling import spellings

REMEDIES = """
add ask call change check choose close convert cut decimate delete exchange export flatten free
give increase install join keep lay leave let load lower make map move name open pass pick put
raise read reduce remove rename repair replace return run save say set settle spread start stop
subdivide take turn use wait want wrap write
"""
"""Verbs that tell a user what to do."""
LIMITS = """
above another array below between distinct each false file finite float folder four id ids integer
itself jaxsimp json least mesh metres most names number numbers once one only order out particle
plan positive rope seconds shape sheet simple surface task text three triangles true two unique up
utf-8 whole zero
"""
"""Words of what is allowed, besides numbers and lists of names."""


FOREIGN = re.compile(r"allow_pickle|pickle\.load|charset_normalizer|ModuleNotFound|NotImplemented")
"""What other libraries say that misleads a user: to load a file unsafely, to install a part."""


def faults_of_refusal(text: str, values: Mapping[str, Any]) -> list[str]:
    """What a refusal lacks, of "value", "limit", "remedy" and "words of its own".

    Args:
        text: text of the error.
        values: the arguments that may be to blame, by name.
    """
    faults = {
        "value": not names_value(text, values),
        "limit": not names_limit(text),
        "remedy": not names_remedy(text),
        "words of its own": bool(FOREIGN.search(text)),
    }
    return [name for name, is_fault in faults.items() if is_fault]


def names_value(text: str, values: Mapping[str, Any]) -> bool:
    """Whether a text names one of some values, a file, or a number that follows from them."""
    if any(spelled and spelled in text for each in values.values() for spelled in spellings(each)):
        return True
    if any(callable(each) and name in text for name, each in values.items()):
        return True  # a function has a name alone
    given, _, _ = text.partition(";")
    return bool(re.search(r"\d|\bnan\b|\binf\b|\bempty\b|\bno\b|/\w|'.*'", given))


def names_limit(text: str) -> bool:
    """Whether a text says what is allowed, after what was given: a number, words, or names."""
    _, _, allowed = text.partition(";")
    words = set(re.findall(r"[a-z0-9-]+", (allowed or text).lower()))
    return bool(words & set(LIMITS.split())) or bool(re.search(r"\d|, ", allowed or text))


def names_remedy(text: str) -> bool:
    """Whether a text says what to do."""
    words = set(re.findall(r"[a-z]+", text.lower()))
    return bool(words & set(REMEDIES.split()))
