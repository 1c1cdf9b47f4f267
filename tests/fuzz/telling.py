"""Values as short texts, for lines that reproduce an input and for messages that name it."""

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np


def told(value: Any) -> str:
    """A value as a short text: small arrays in full, others by type, shape and what is odd."""
    if isinstance(value, np.ndarray):
        return _told_array(value)
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        inner = ", ".join(told(each) for each in value[:6]) + ", ..." * (len(value) > 6)
        return f"({inner})" if isinstance(value, tuple) else f"[{inner}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {told(each)}" for key, each in value.items()) + "}"
    if hasattr(value, "short"):
        return str(value.short)
    text = f"{type(value).__name__} {np.asarray(value)}" if is_jax(value) else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= 90 else f"{text[:87]}..."


def _told_array(array: np.ndarray) -> str:
    kind = "" if type(array) is np.ndarray else f" {type(array).__name__}"
    if array.size <= 6:
        return f"array({' '.join(str(array.tolist()).split())}, {array.dtype}){kind}"
    odd = ""
    if array.dtype.kind == "f":
        wrong = np.flatnonzero(~np.isfinite(array))
        if wrong.size:
            odd = f", [{wrong[0]}] is {array.flat[wrong[0]]}"
        else:
            odd = f", {array.min():.4g} to {array.max():.4g}"
    return f"array of {array.dtype}{kind}, shape {array.shape}{odd}"


def is_jax(value: Any) -> bool:
    """Whether a value is an array of numbers of JAX, and no key of its random numbers."""
    is_array = type(value).__module__.startswith("jax") and hasattr(value, "dtype")
    return is_array and "key" not in str(value.dtype)


def spellings(value: Any) -> set[str]:
    """Texts by which a message may name a value: itself, its type, its shape."""
    if hasattr(value, "spellings"):
        return set(value.spellings)
    shape = getattr(value, "shape", ())
    found = {str(value)[:40], repr(value)[:40], type(value).__name__, f"shape {shape}"}
    if isinstance(value, np.ndarray) or is_jax(value):
        return found | _of_array(np.asarray(value))
    if isinstance(value, int | float | np.number):
        return found | _of_number(value) | {"single number"}
    if isinstance(value, tuple | list):
        parts = [spellings(each) for each in value[:20]]
        return found.union(*parts) | {
            f"shape ({len(value)},",
            *(() if value else ("empty", "()", "[]")),
        }
    if isinstance(value, str):
        return found | {str(Path(value[:200]))}  # "" is the folder "."
    if is_dataclass(value) and not isinstance(value, type):
        return found.union(*(spellings(getattr(value, each.name)) for each in fields(value)))
    if isinstance(value, dict):
        return found.union(*map(spellings, value.values()), map(str, value))
    return found


def _of_number(value: Any) -> set[str]:
    found = {str(value)[:40], repr(value)[:40]}
    for form in ("g", ".3g", ".4g", ".6g", ".0f", ".1%"):
        try:
            found.add(format(value, form))
        except (ValueError, TypeError, OverflowError):
            continue
    return found


def _of_array(array: np.ndarray) -> set[str]:
    found = {str(array.dtype), str(array.shape), str(array.tolist())[:40]}
    if array.size == 0:
        found |= {"empty", "no ", "0"}
    if array.dtype.kind in "iufb" and array.size:
        wrong = array[~np.isfinite(array)] if array.dtype.kind == "f" else array
        for each in [*wrong.ravel()[:20], array.min(), array.max()]:
            found |= _of_number(each)
    if array.dtype.kind not in "iufb":
        found |= {str(each)[:30] for each in array.ravel()[:10]}
    return found
