"""Whether a refusal helps: it names the value, what is allowed, and what to do."""

import re
from collections.abc import Mapping
from typing import Any

from tests.fuzz.telling import spellings

REMEDIES = (
    "give choose use take make add write leave raise lower move remove join cut start spread pass "
    "exchange name call install convert export set close turn ask decimate subdivide flatten "
    "settle repair save load replace reduce increase rename run lay put keep check open delete "
    "read wait free say change want stop let map pick wrap".split()
)
"""Verbs that tell a user what to do."""
LIMITS = (
    "finite whole number numbers array zero one two three four ids id shape least most up below "
    "above between only positive each metres seconds names unique distinct order rope sheet mesh "
    "triangles file folder json utf-8 text integer float task plan surface particle simple itself out".split()
)
"""Words of what is allowed, besides numbers and lists of names."""


def faults_of_refusal(text: str, values: Mapping[str, Any]) -> list[str]:
    """What a refusal lacks, of "value", "limit" and "remedy".

    Args:
        text: text of the error.
        values: the arguments that may be to blame, by name.
    """
    faults = {
        "value": not names_value(text, values),
        "limit": not names_limit(text),
        "remedy": not names_remedy(text),
    }
    return [name for name, is_fault in faults.items() if is_fault]


def names_value(text: str, values: Mapping[str, Any]) -> bool:
    """Whether a text names one of some values, a file, or a number that follows from them."""
    if any(spelled and spelled in text for each in values.values() for spelled in spellings(each)):
        return True
    given, _, _ = text.partition(";")
    return bool(re.search(r"\d|\bnan\b|\binf\b|\bempty\b|\bno\b|/\w+\.", given))


def names_limit(text: str) -> bool:
    """Whether a text says what is allowed, after what was given: a number, words, or names."""
    _, _, allowed = text.partition(";")
    words = set(re.findall(r"[a-z0-9-]+", (allowed or text).lower()))
    return bool(words & set(LIMITS)) or bool(re.search(r"\d|, ", allowed or text))


def names_remedy(text: str) -> bool:
    """Whether a text says what to do."""
    words = set(re.findall(r"[a-z]+", text.lower()))
    return bool(words & set(REMEDIES))

