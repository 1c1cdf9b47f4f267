"""The page "When something goes wrong": it quotes messages of the sources, and has all of them."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "troubleshooting.md"
SOURCES = [*(ROOT / "jaxsimp").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")]
VALUE = "…"
WORDS = 3
"""Least number of fixed words of a message that the page must have: others pass on a message."""


def quoted() -> list[str]:
    """Messages in the tables of the page that are of this package: in code, in the first column."""
    rows = [row.split(" | ")[0] for row in PAGE.read_text().splitlines() if row.startswith("| ")]
    return [message for cell in rows for message in re.findall(r"`([^`]+)`", cell)]


def text_of(node: ast.expr) -> str:
    """The fixed words of an expression, with `VALUE` for each part that is computed."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(text_of(part) for part in parts)
        case ast.BinOp(left=left, right=right):
            return text_of(left) + text_of(right)
    return VALUE


def raised() -> list[str]:
    """Texts of the errors that the sources raise, with `VALUE` for each part that is computed."""
    nodes = [node for path in SOURCES for node in ast.walk(ast.parse(path.read_text()))]
    calls = [node.exc for node in nodes if isinstance(node, ast.Raise)]
    texts = [text_of(text) for call in calls if isinstance(call, ast.Call) for text in call.args]
    return sorted({text for text in texts if len(re.findall(r"\w+", text)) >= WORDS})


@pytest.fixture(scope="module")
def written() -> str:
    """Every text in the sources, one a line."""
    nodes = [node for path in SOURCES for node in ast.walk(ast.parse(path.read_text()))]
    texts = [text_of(node) for node in nodes if isinstance(node, ast.expr)]
    return "\n".join(" ".join(text.split()) for text in texts if text != VALUE)


def test_the_page_quotes_messages():
    assert len(quoted()) > 50


@pytest.mark.parametrize("message", quoted())
def test_a_quoted_message_is_in_the_sources(message, written):
    # Fixed words in their order, with anything between: values, and words of a branch.
    parts = [re.escape(part.strip()) for part in message.split(VALUE)]
    assert re.search(".*".join(parts), written), message


def test_every_error_of_the_sources_is_on_the_page():
    # A quoted message is a form: its fixed words in their order, with anything between.
    forms = [re.compile(".*".join(map(re.escape, each.split(VALUE)))) for each in quoted()]
    texts = raised()
    assert len(texts) > 200
    assert not [text for text in texts if not any(form.search(text) for form in forms)]
